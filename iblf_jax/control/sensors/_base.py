"""The contracts of a sensor, of the sensor of one level of a plant, and of the velocity estimate of
a sensor that measures positions.

A sensor is read once per period, at its start.  The loop passes it standard normal numbers that
depend only on seed, run, sample and joint.  Torque is never measured.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.optional import OptionalMembers

State = Any
"""A pytree of arrays of floats; `()` for a sensor without memory."""


class Measurement(NamedTuple):
    """The measurement that law and observer receive."""

    q: jax.Array
    """Position, (n,) [rad]."""
    dq: jax.Array
    """Velocity, (n,) [rad/s]."""
    higher: Any = ()
    """The levels from the third on of a plant in strict-feedback form, (r - 2, n); `()` for a
    robot."""


class Sensor(Protocol):
    """The contract of a sensor.

    A sensor that rounds also has the properties `unrounded`, the same sensor without rounding, with
    which the fastest mode of a loop is computed, and `resolution`, the size of a count, () or (n,)
    [rad], for the default ranges of gains.  A sensor may have a method `advice(period)`, a list of
    warnings.

    A sensor of all levels of a plant in strict-feedback form has the class attribute
    `receives_x = True`; its methods then receive the state x, (r, n), in the place of q and q'.
    With any other sensor the levels from the third on are measured without error.  The `resolution`
    of such a sensor is (r, n), and it may have the properties `order`, the number of levels r, and
    `measured`, the levels that it measures, counted from 1; without it it measures all.
    """

    @property
    def draws(self) -> int:
        """Number of normal numbers per joint and sample."""
        ...

    def init(self, q: jax.Array, dq: jax.Array, period: jax.Array) -> State:
        """State before the first sample, given q [rad] and dq [rad/s] there and the period, ()
        [s].
        """
        ...

    def measure(
        self, q: jax.Array, dq: jax.Array, normal: jax.Array, period: jax.Array, state: State
    ) -> tuple[Measurement, State]:
        """The measurement, and the next state.

        Args:
          q, dq: true position [rad] and velocity [rad/s], (n,).
          normal: independent standard normal numbers, (draws, n).
          period: () [s].
          state: of the sample before.
        """
        ...


class LevelSensor(Protocol):
    """The contract of a sensor of one level of a plant in strict-feedback form, a part of `Levels`.

    A member that rounds has a leaf `resolution` and a property `unrounded`, as a `Sensor`; one that
    measures nothing has `is_measured = False`.
    """

    @property
    def draws(self) -> int:
        """Number of normal numbers per component and sample."""
        ...

    @property
    def levels(self) -> int:
        """1, by which `Levels` distinguishes it from a sensor of position and velocity."""
        ...

    def init_level(self, x: jax.Array, period: jax.Array) -> State:
        """State before the first sample, given the level there, (n,), and the period, () [s]."""
        ...

    def measure_level(
        self, x: jax.Array, normal: jax.Array, period: jax.Array, state: State
    ) -> tuple[jax.Array, State]:
        """The measured level, (n,), and the next state.

        Args:
          x: true level, (n,), in its unit.
          normal: independent standard normal numbers, (draws, n).
          period: () [s].
          state: of the sample before.
        """
        ...


class Part(Protocol):
    """A part of `Levels`: a `Sensor` of a position and its velocity, or a `LevelSensor`."""

    @property
    def draws(self) -> int:
        """Number of normal numbers per component and sample."""
        ...


class Velocity(Protocol):
    """The contract of a velocity estimate from measured positions.

    It may have a method `advice(period)`, which returns a list of warnings.
    """

    @property
    def draws(self) -> int:
        """Number of normal numbers per joint and sample."""
        ...

    def init(self, y: jax.Array, dq: jax.Array, period: jax.Array) -> State:
        """State before the first sample, for a joint that arrives at y [rad] with the velocity
        dq [rad/s].
        """
        ...

    def estimate(
        self, y: jax.Array, dq: jax.Array, normal: jax.Array, period: jax.Array, state: State
    ) -> tuple[jax.Array, State]:
        """The velocity, (n,) [rad/s], and the next state.

        Args:
          y: measured position, (n,) [rad].
          dq: true velocity, (n,) [rad/s], for members that measure it.
          normal: independent standard normal numbers, (draws, n).
          period: () [s].
          state: of the sample before.
        """
        ...


sensor_member = OptionalMembers(
    receives_x=False,
    unrounded=None,
    resolution=0.0,
    velocity=None,
    advice=lambda period: [],
    order=None,
    measured=None,
    levels=2,
    is_measured=True,
)
"""Reads optional members of a sensor, of the sensor of a level or of a velocity estimate."""


def unrounded(sensor: Sensor) -> Sensor:
    """A sensor without its rounding; itself if it does not round."""
    return sensor_member.variant(sensor, "unrounded")  # type: ignore[no-any-return]


def rounded(x: jax.Array, step: jax.Array | float) -> jax.Array:
    """A reading rounded to multiples of `step`.

    Its derivative is defined as 1, that of the reading before rounding, because the derivative of
    the rounding is 0 almost everywhere.
    """
    return x + jax.lax.stop_gradient(step * jnp.round(x / step) - x)


def above_nyquist(name: str, cutoff: jax.Array, period: jax.Array) -> list[str]:
    """A warning about a cutoff above the Nyquist frequency; none for traced values."""
    if not checks.is_concrete((cutoff, period)) or not np.any(
        np.asarray(cutoff) > np.pi / np.asarray(period)
    ):
        return []
    highest, nyquist = float(np.max(np.asarray(cutoff))), np.pi / float(period)
    name = f"sensor.velocity.{name} = {highest:g} rad/s"
    return [
        f"{name} is above the Nyquist frequency of sampling.period, {nyquist:.4g} rad/s: it smooths"
        " nothing. Lower it, or sample faster."
    ]
