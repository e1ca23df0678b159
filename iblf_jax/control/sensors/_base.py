"""The contracts of a sensor, of the sensor of one level of a plant, and of the velocity estimate of
a sensor that measures positions.

A sensor is read once per period, at its start.  The loop passes it standard normal numbers that
depend only on seed, run, sample and joint.  Torque is never measured.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, families
from iblf_jax.core.families import Part, attribute
from iblf_jax.core.pytree import component
from iblf_jax.world.plants import state_of_levels

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

    @property
    def x(self) -> jax.Array:
        """All levels, (r, n)."""
        return state_of_levels(self.q, self.dq, self.higher)


def measurement_of(x: jax.Array) -> Measurement:
    """The measurement of the levels x, (r, n), without an error."""
    return Measurement(x[0], x[1], x[2:] if len(x) > 2 else ())


class AnySensor(Part):
    """What every sensor states: a `Sensor` of the state x, a `RobotSensor` of q and q', or a
    `LevelSensor` of one level.
    """

    levels: ClassVar[int] = 2
    """Number of levels that it measures as a part of `Levels`."""
    is_measured: ClassVar[bool] = True
    """Whether it measures anything."""
    velocity: Velocity | None = None
    """The velocity estimate of a sensor that measures positions."""

    @attribute
    @abc.abstractmethod
    def draws(self) -> int:
        """Number of normal numbers per joint, or component, and sample."""

    @attribute
    def unrounded(self) -> Self:
        """The same sensor without rounding, with which the fastest mode of a loop is computed."""
        return self

    @attribute
    def resolution(self) -> Any:
        """Size of a count, () or (n,) [rad], for the default ranges of gains; 0 for a sensor that
        does not round.  (r, n) in the units of the levels for a `Sensor`.
        """
        return 0.0

    def advice(self, period: jax.Array) -> list[str]:
        """Warnings about the values of the fields at the period, () [s]."""
        return []


class Sensor(AnySensor):
    """The contract of a sensor of all levels of a plant in strict-feedback form, which receives the
    state x.
    """

    @attribute
    def order(self) -> int | None:
        """The number of levels r; None for any number."""
        return None

    @attribute
    def measured(self) -> tuple[int, ...] | None:
        """The levels that it measures, counted from 1; None for all."""
        return None

    def init(self, x: jax.Array, period: jax.Array) -> State:
        """State before the first sample, given x, (r, n), there and the period, () [s]; `()` for a
        sensor without a state.
        """
        return ()

    @abc.abstractmethod
    def measure(
        self, x: jax.Array, normal: jax.Array, period: jax.Array, state: State
    ) -> tuple[Measurement, State]:
        """The measurement, and the next state.

        Args:
          x: true levels, (r, n), in their units.
          normal: independent standard normal numbers, (draws, n).
          period: () [s].
          state: of the sample before.
        """


class RobotSensor(AnySensor):
    """The contract of a sensor of a robot, which receives q and q'.

    The levels from the third on of a plant with such a sensor are measured without error.
    """

    def init(self, q: jax.Array, dq: jax.Array, period: jax.Array) -> State:
        """State before the first sample, given q [rad] and dq [rad/s] there and the period, ()
        [s]; `()` for a sensor without a state.
        """
        return ()

    @abc.abstractmethod
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


@component
class RobotSensorAdapter(Sensor):
    """measure(x, ...) = sensor.measure(x_1, x_2, ...): a sensor of q and q' in the closed loop.

    It is no part of a scenario.

    Args:
      sensor: any sensor of robots.

    Source: none; the state of a robot is x = (q, q').
    """

    sensor: RobotSensor

    @property
    def draws(self) -> int:
        """Those of the sensor."""
        return self.sensor.draws

    def init(self, x: jax.Array, period: jax.Array) -> State:
        """State of the sensor."""
        return self.sensor.init(x[0], x[1], period)

    def measure(
        self, x: jax.Array, normal: jax.Array, period: jax.Array, state: State
    ) -> tuple[Measurement, State]:
        """Measurement of the sensor, and the other levels without error."""
        measured, after = self.sensor.measure(x[0], x[1], normal, period, state)
        if len(x) > 2:
            measured = measured._replace(higher=x[2:])
        return measured, after


def sensor_of_x(sensor: AnySensor) -> Sensor:
    """A sensor as the closed loop calls it."""
    if isinstance(sensor, Sensor):
        return sensor
    assert isinstance(sensor, RobotSensor)
    return RobotSensorAdapter(sensor)


def contract_of(sensor: object) -> type[Sensor] | type[RobotSensor]:
    """The contract that a sensor is meant to fit."""
    return families.contract_of(sensor, Sensor, RobotSensor)


class LevelSensor(AnySensor):
    """The contract of a sensor of one level of a plant in strict-feedback form, a part of `Levels`.

    All numbers are in the unit of the level.
    """

    levels = 1

    def init_level(self, x: jax.Array, period: jax.Array) -> State:
        """State before the first sample, given the level there, (n,), and the period, () [s]; `()`
        for a sensor without a state.
        """
        return ()

    @abc.abstractmethod
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


class Velocity(Part):
    """The contract of a velocity estimate from measured positions."""

    @attribute
    @abc.abstractmethod
    def draws(self) -> int:
        """Number of normal numbers per joint and sample."""

    def advice(self, period: jax.Array) -> list[str]:
        """Warnings about the values of the fields at the period, () [s]."""
        return []

    def init(self, y: jax.Array, dq: jax.Array, period: jax.Array) -> State:
        """State before the first sample, for a joint that arrives at y [rad] with the velocity
        dq [rad/s]; `()` for a velocity without a state.
        """
        return ()

    @abc.abstractmethod
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
