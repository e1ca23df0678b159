"""The noise of the measured levels, and how an observer amplifies it.

Around a constant state a sensor is a linear system whose inputs are its normal numbers and its
rounding errors,

    z_{k+1} = F z_k + B w_k,   y_k = H z_k + D w_k,

with the rounding of a step r as white noise of the standard deviation r / sqrt(12).  In the steady
state P = F P F^T + B W B^T, and the covariance of the measurement is H P H^T + D W D^T.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from iblf_jax.control.sensors import Sensor
from iblf_jax.control.sensors._base import sensor_of_x
from iblf_jax.core import checks
from iblf_jax.core.units import of_component, per_second
from iblf_jax.simulation.levels import start_levels
from iblf_jax.world import plants

if TYPE_CHECKING:
    from iblf_jax.simulation.scenario import Scenario

DOUBLINGS = 40
"""Steps of the doubling algorithm for P, which then contains 2^40 samples."""


class LinearSensor(NamedTuple):
    """The matrices of a sensor around a constant state: z of m numbers, w of p, y of r n."""

    F: jax.Array
    """Next z by z, (m, m)."""
    B: jax.Array
    """Next z by w, (m, p)."""
    H: jax.Array
    """y by z, (r n, m)."""
    D: jax.Array
    """y by w, (r n, p)."""


def standard_deviations(scenario: Scenario) -> np.ndarray:
    """Standard deviations of the measured levels of the model, (r, n), each in the unit of its
    level; 0 for a level that is not measured.

    Args:
      scenario: with a sampling and concrete numbers.
    """
    F, B, H, D = (np.asarray(matrix, float) for matrix in _linear_sensor(scenario))
    P = B @ B.T
    for _ in range(DOUBLINGS):
        P = P + F @ P @ F.T
        F = F @ F
    variance = np.diag(H @ P @ H.T + D @ D.T)
    return np.sqrt(variance).reshape(-1, scenario.n)


@jax.jit
def _linear_sensor(scenario: Scenario) -> LinearSensor:
    """The matrices of the sensor at the start, for inputs of the standard deviation 1."""
    sensor, period = scenario.sensor, checks.given(scenario.sampling).period
    smooth = sensor_of_x(sensor.unrounded)
    x = start_levels(scenario)
    read = x if isinstance(sensor, Sensor) else x[:1]
    steps = jnp.broadcast_to(jnp.asarray(sensor.resolution), read.shape)
    start, rebuild = ravel_pytree(smooth.init(x, period))
    dtype = x.dtype  # which the vector of a sensor without memory may lack

    def sample(z: jax.Array, normal: jax.Array, error: jax.Array) -> jax.Array:
        """The next state and the measurement, in one vector."""
        moved = x.at[: len(read)].add(error * steps / np.sqrt(12.0))
        found, after = smooth.measure(moved, normal, period, rebuild(z.astype(start.dtype)))
        known = found.x[: scenario.loop.model.order]
        return jnp.concatenate([ravel_pytree(after)[0].astype(dtype), known.reshape(-1)])

    zero = jnp.zeros((sensor.draws, scenario.n), dtype)
    arguments = (start.astype(dtype), zero, jnp.zeros_like(read))
    by_z, by_normal, by_error = jax.jacfwd(sample, argnums=(0, 1, 2))(*arguments)
    by_inputs = [slopes.reshape(len(by_z), -1) for slopes in (by_normal, by_error)]
    by_w = jnp.concatenate(by_inputs, axis=1)
    count = start.size
    return LinearSensor(by_z[:count], by_w[:count], by_z[count:], by_w[count:])


def noise_advice(scenario: Scenario) -> list[str]:
    """A warning about an observer that amplifies the noise of the sensor, with the numbers of each
    level; none for an observer without `noise_gain`, or a sensor without noise.
    """
    gain = scenario.observer.noise_gain
    if gain is None:
        return []
    noise = standard_deviations(scenario)
    kappa = np.asarray(gain, float)
    if kappa.ndim == 1:
        kappa = kappa[:, None]
    kappa = np.broadcast_to(kappa, noise.shape)
    rows = []
    for level in range(len(noise)):
        if np.any(noise[level] * kappa[level] > 0):
            rows.append(_row(scenario, level, noise[level], kappa[level]))
    if not rows:
        return []
    kind = type(scenario.observer).__name__
    return [
        f"observer: {kind} amplifies the sensor's noise by its gain (standard deviations):"
        f" {'; '.join(rows)}. The law adds the estimate to the rate of each level. A smaller gain,"
        " or 0 for a noisy level without a disturbance, reduces it."
    ]


def _row(scenario: Scenario, level: int, noise: np.ndarray, kappa: np.ndarray) -> str:
    """The noise of a level and of its estimate in words, for its worst component."""
    worst = int(np.argmax(noise * kappa))
    unit = of_component(plants.units_of(scenario.model)[level], worst)
    return (
        f"level {level + 1}: {noise[worst]:.3g} {unit} times {kappa[worst]:.3g} 1/s give"
        f" {noise[worst] * kappa[worst]:.3g} {per_second(unit)} in d_hat_{level + 1}"
    )
