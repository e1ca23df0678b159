"""Default ranges of what is tuned: within the conditions of Theorem 2, and within the capabilities
of time step, sampling period and drive.

The lower end of a leaf is k1 > 0, K2 > 1/2 or kf > 1 where all its entries start there, otherwise
its sign decides.  The upper end of a gain x is f x0 with the largest f <= MAX_FACTOR for which
the loop at the start and along its reference satisfies

    dt |lambda|_max <= STABILITY_FRACTION R                     for a continuous law,
    rho(map from a period to the next) < 1                      for a sampled law,

where R is the stability range of the integrator, and, where there is a sensor, the drive at rest
can deliver each torque of |d tau / d y_j| r_j and (sum_kj (d tau / d w_kj)^2)^(1/2).  One count r_j
of a joint's encoder, and one standard deviation of all its noise w, are steps of the command that
the motion does not need.  Where such a step alone exceeds the torque of a drive, or its rate
(bandwidth times the step, behind a lag), the drive tracks the encoder.  A drive that the starting
gains already exceed sets no limit.

First each gain is examined with the others at their start.  Then all gains with default ranges are
scaled together, each to f_i^s x0, with the largest s up to 1 for which the same conditions hold.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators._base import actuator_member
from iblf_jax.control.sensors._base import sensor_member, unrounded
from iblf_jax.engine.period import radius_at
from iblf_jax.engine.step_size import fastest_along, start_and_along
from iblf_jax.simulation.closed_loop import LoopState, run_sampled_law
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario

THEOREM_LIMITS = {"controller.k1": 0.05, "controller.K2": 0.505, "observer.kf": 1.01}
"""Default lower limits: just inside Theorem 2's conditions (3.17), (3.25) on the gains of the
paper's law."""
STABILITY_FRACTION = 0.7
"""Part of the integrator's stability range that gains may use by default."""
TIMES = np.linspace(0.0, 6.0, 7)
"""Along the reference, at which the loop is examined [s]."""
MAX_FACTOR = 1e2
"""Largest upper end of a gain by default, relative to its start."""
BISECTION_STEPS = 10
FACTOR_BEYOND_CONDITION = 1.01
"""Upper end of a gain, relative to its start, where already the start violates a condition."""
AS_GIVEN = "as given"
BY_THEOREM = "the conditions of Theorem 2"
BY_SIGN = "its sign"
UNLIMITED = "none"
BY_FACTOR = f"{MAX_FACTOR:g} times its start"
BY_STEP = "beyond it the step dt is too long for the loop"
BY_PERIOD = "beyond it the loop is unstable at its sampling period"
BY_COUNT = (
    "beyond it one count of the encoder commands more torque, or a higher rate of it, than the"
    " drive can deliver"
)
BY_NOISE = (
    "beyond it the sensor's noise commands more torque, or a higher rate of it, than the drive can"
    " deliver"
)
TOGETHER = ", with all gains at their upper ends"


def default_low(path: str, sign: str | None, start: np.ndarray) -> tuple[float, str]:
    """The lower end of the range of a leaf that starts at `start`, and why it is there."""
    leaf = re.sub(r"(\[\d+\])+$", "", path)
    if leaf in THEOREM_LIMITS and np.all(start >= THEOREM_LIMITS[leaf]):
        return THEOREM_LIMITS[leaf], BY_THEOREM
    if sign in ("positive", "nonnegative"):
        return 0.0, BY_SIGN
    return -np.inf, UNLIMITED


def default_highs(
    scenario: Scenario, values: dict[str, np.ndarray], dt: float, method: str
) -> dict[str, tuple[np.ndarray, str]]:
    """The upper ends of the ranges of some leaves, and why they are there.

    Args:
      scenario: canonical.
      values: path -> start of the leaf.
      dt, method: time step [s] and integrator of the runs.
    """
    gains = {
        path: x
        for path, x in values.items()
        if path.startswith(("controller.", "observer.")) and np.all(x > 0)
    }
    ends: dict[str, tuple[np.ndarray, str]] = {
        path: (np.full(x.shape, np.inf), UNLIMITED)
        for path, x in values.items()
        if path not in gains
    }
    limited_by_drive = not drive_exceeded(scenario)

    def violated(logarithms: dict[str, float]) -> str:
        """What is violated with gains scaled by exp(x); empty where nothing is."""
        scaled = {path: jnp.asarray(gains[path] * np.exp(x)) for path, x in logarithms.items()}
        changed = with_parameters(scenario, scaled)
        if changed.sampling is None:
            fits = (
                dt * fastest_along(changed, TIMES) <= STABILITY_FRACTION * tableau(method).stability
            )
            return "" if fits else BY_STEP
        if sampled_too_slowly(changed):
            return BY_PERIOD
        return drive_exceeded(changed) if limited_by_drive else ""

    def largest_share(logarithms: dict[str, float]) -> tuple[float, str]:
        return _largest_share(lambda s: violated({path: s * x for path, x in logarithms.items()}))

    furthest = float(np.log(MAX_FACTOR))
    reach: dict[str, float] = {}
    why: dict[str, str] = {}
    for path in gains:
        share, reason = largest_share({path: furthest})
        reach[path] = share * furthest
        why[path] = reason or BY_FACTOR
    share, reason = 1.0, ""
    if len(gains) > 1:
        share, reason = largest_share(reach)
    for path, x in gains.items():
        if reason and reach[path] > 0:
            why[path] = reason + TOGETHER
        ends[path] = max(np.exp(share * reach[path]), FACTOR_BEYOND_CONDITION) * x, why[path]
    return ends


def _largest_share(violated: Callable[[float], str]) -> tuple[float, str]:
    """The largest share s up to 1 for which nothing is violated, 0 if there is none, and what is
    violated beyond it.
    """
    reason = violated(1.0)
    if not reason:
        return 1.0, ""
    at_start = violated(0.0)
    if at_start:
        return 0.0, at_start
    low = 0.0
    high = 1.0
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (low + high)
        found = violated(middle)
        if found:
            high = middle
            reason = found
        else:
            low = middle
    return low, reason


def sampled_too_slowly(scenario: Scenario) -> bool:
    """Whether the law is sampled and its loop grows from one period to the next."""
    sampling = scenario.sampling
    return sampling is not None and not radius_at(scenario, float(sampling.period), TIMES) < 1.0


def drive_exceeded(scenario: Scenario) -> str:
    """Why the sensor, by a count or by its noise, commands more than the actuator can deliver from
    rest; empty where it does not.
    """
    actuator = scenario.actuator
    if scenario.sampling is None or actuator_member(actuator, "unlimited") is None:
        return ""
    commands = _command_steps(scenario, jnp.asarray(TIMES, scenario.initial.q.dtype))
    zero = jnp.zeros_like(scenario.initial.q)
    rest = actuator.init(zero)
    deliver = jax.vmap(lambda tau: actuator.deliver(tau, zero, rest).limited)
    for reason, torques in zip((BY_COUNT, BY_NOISE), commands, strict=True):
        if bool(jnp.any(deliver(torques.reshape(-1, scenario.n)))):
            return reason
    return ""


@jax.jit
def _command_steps(scenario: Scenario, times: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Steps of the command by one count of each joint (T + 1, n, n), and the standard deviation by
    the noise (T + 1, n), [N m].
    """
    sensor = scenario.sensor
    # A sensor without rounding or resolution has no counts.
    smooth = dataclasses.replace(scenario, sensor=unrounded(sensor))
    resolution = jnp.asarray(sensor_member(sensor, "resolution"), times.dtype)
    count = jnp.broadcast_to(resolution, (scenario.n,))

    def command(t: jax.Array, state: LoopState, q: jax.Array, normal: jax.Array) -> jax.Array:
        return run_sampled_law(smooth, t, state._replace(q=q), normal).sampled.commands[0]

    def at(t: jax.Array, state: LoopState) -> tuple[jax.Array, jax.Array]:
        normal = jnp.zeros((sensor.draws, scenario.n), times.dtype)
        by_q, by_noise = jax.jacfwd(partial(command, t, state), argnums=(0, 1))(state.q, normal)
        return by_q.T * count[:, None], jnp.sqrt(jnp.sum(by_noise**2, axis=(1, 2)))

    from_start = jnp.concatenate([jnp.zeros_like(times[:1]), times])
    return jax.vmap(at)(from_start, start_and_along(scenario, times))
