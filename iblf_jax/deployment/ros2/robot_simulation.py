"""The motion of a robot that efforts drive: MuJoCo's robot, its sensor, and the efforts in transit,
without ROS.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators.delay import WHOLE_TOLERANCE
from iblf_jax.control.sensors import Ideal
from iblf_jax.control.sensors._base import AnySensor
from iblf_jax.deployment.mujoco_plant import MujocoPlant
from iblf_jax.deployment.transit import CommandsInTransit
from iblf_jax.simulation.noise import noise_key, normals


class Reading(NamedTuple):
    """What the robot measures at the start of a period."""

    t: float
    """Time since the start of the motion [s]."""
    q: np.ndarray
    """Measured positions, (n,) [rad]."""
    dq: np.ndarray
    """Measured velocities, (n,) [rad/s]."""
    effort: np.ndarray
    """Torques of the drives before the period, (n,) [N m]."""


class Row(NamedTuple):
    """One row of the recorded motion, or R rows stacked; a jump of the torque has a row before it
    and one after it.
    """

    t: Any
    instant: Any
    """Whether the row is the one of a time step, and not of one side of a jump."""
    state: Any
    """Positions and velocities of all joints of MuJoCo's model."""
    tau: Any
    sample: Any
    """Index of the last reading."""
    is_braked: Any


class SensorReadings:
    """The readings of a sensor, one after the other, with the noise that `cosimulate` has."""

    def __init__(
        self, sensor: Any, q: np.ndarray, dq: np.ndarray, period: float, seed: int
    ) -> None:
        self.sensor = sensor
        self.is_ideal = isinstance(sensor, Ideal)
        self.key = noise_key(jax.random.PRNGKey(seed))
        self.period = jnp.asarray(period, jnp.asarray(q).dtype)
        self.state = sensor.init(jnp.asarray(q), jnp.asarray(dq), self.period)
        self.count = 0
        if not self.is_ideal:  # The first call compiles, which takes longer than a period.
            jax.block_until_ready(self._measured(q, dq))

    def read(self, q: np.ndarray, dq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The measured positions and velocities, (n,) each, of the true ones."""
        if self.is_ideal:
            return q, dq
        measured, self.state = self._measured(q, dq)
        self.count += 1
        return np.asarray(measured.q, float), np.asarray(measured.dq, float)

    def _measured(self, q: np.ndarray, dq: np.ndarray) -> tuple[Any, Any]:
        position, velocity = jnp.asarray(q), jnp.asarray(dq)
        index = jnp.asarray(self.count)
        return _measured(self.sensor, position, velocity, self.key, index, self.period, self.state)


@jax.jit
def _measured(sensor: Any, q, dq, key, index, period, state):
    """The measurement of a sample, and the next state of the sensor."""
    normal = normals(key, index, sensor.draws, q.size).astype(q.dtype)
    return sensor.measure(q, dq, normal, period, state)


class RobotSimulation:
    """A robot in motion.

    The torque is zero before the first effort.  An effort acts from its arrival on until the next
    one arrives, and at most for `effort_timeout`, after which the torque is zero.  While the brake
    is engaged, the robot keeps its position; the next effort that acts releases it.  It is engaged
    at the start unless it is "never", and after the effort time-out if it is "always".
    """

    def __init__(
        self,
        robot: MujocoPlant,
        q: np.ndarray,
        dq: np.ndarray,
        *,
        period: float,
        dt: float,
        sensor: AnySensor,
        delay: float,
        effort_timeout: float,
        brake: str,
        seed: int,
    ) -> None:
        """The arguments of `robot_node`; q and dq are the initial state, (n,) each."""
        self.robot = robot
        self.period = period
        self.dt = dt
        self.steps_per_period = round(period / dt)
        self.tolerance = WHOLE_TOLERANCE * dt
        self.effort_timeout = effort_timeout
        self.brakes_after_timeout = brake == "always"
        self.is_braked = brake != "never"
        robot.place(q, dq)
        self.readings = SensorReadings(sensor, q, dq, period, seed)
        self.efforts = CommandsInTransit(delay)
        self.torque = np.zeros(len(q))
        self.zero_torque_from = math.inf
        """Time at which the last effort stops to act [s]."""
        self.timeouts = 0
        """Number of efforts that acted until their time-out."""
        self.index = 0
        """Number of periods that have passed."""
        self.samples: list[Reading] = []
        self.rows: list[Row] = []
        self.diverged = False
        self.is_recording = True
        """Whether `rows` and `samples` have the complete motion, and not only its last instant."""

    @property
    def t(self) -> float:
        """Time since the start of the motion [s]."""
        return self.index * self.steps_per_period * self.dt

    @property
    def is_released(self) -> bool:
        """Whether no brake holds the robot, or an effort that releases it is on its way."""
        return not self.is_braked or bool(self.efforts.commands)

    def measure(self) -> Reading:
        """Reads the sensor; a second reading at the same time replaces the first."""
        q, dq = self.readings.read(self.robot.q, self.robot.dq)
        reading = Reading(self.t, q, dq, self.torque.copy())
        if self.samples and self.samples[-1].t == reading.t:
            self.samples.pop()
        elif self.rows:  # The signals of the law jump with every reading.
            self.record(reading.t, instant=False)
        if not self.is_recording:
            self.samples.clear()
        self.samples.append(reading)
        return reading

    def receive(self, t: float, effort: np.ndarray) -> None:
        """An effort, (n,) [N m], that reached the robot's computer at time t [s]; it acts after the
        delay.
        """
        self.efforts.send(t, effort)

    def advance(self) -> None:
        """Integrates over one period."""
        first = self.index * self.steps_per_period
        for step in range(first, first + self.steps_per_period):
            self.begin_step(step * self.dt)
            self.integrate(step * self.dt, (step + 1) * self.dt)
        self.diverged = self.robot.has_diverged()
        self.index += 1

    def begin_step(self, t: float) -> None:
        """Applies the efforts that arrive at t, and records the instant."""
        self.change_torque(t)
        self.record(t, instant=True)

    def integrate(self, t: float, end: float) -> None:
        """Advances MuJoCo from t to `end`; a step in which the torque changes is divided there."""
        while t < end - self.tolerance:
            h = max(min(self.next_change(end), end) - t, 0.0)
            if not self.is_braked:
                self.robot.apply(self.torque)
                self.robot.step(t, h)
            t += h
            if t < end - self.tolerance:
                self.change_torque(t)
                self.record(t, instant=False)

    def next_change(self, otherwise: float) -> float:
        """Time at which the torque changes next [s]; `otherwise` if it does not."""
        return min(self.efforts.next_arrival(otherwise), self.zero_torque_from)

    def change_torque(self, t: float) -> None:
        """Applies the newest effort that has arrived by t, or zero torque after its time-out."""
        until = t + self.tolerance
        if self.next_change(math.inf) > until:
            return
        if self.rows and self.rows[-1].t != t:
            self.record(t, instant=False)
        effort = self.efforts.received(until)
        if effort is not None:
            self.torque = effort
            self.zero_torque_from = t + self.effort_timeout
            self.is_braked = False
        if self.zero_torque_from <= until:
            self.torque = np.zeros_like(self.torque)
            self.zero_torque_from = math.inf
            self.timeouts += 1
            if self.brakes_after_timeout:
                self.is_braked = True
                self.robot.place(self.robot.q, np.zeros_like(self.torque))

    def record(self, t: float, instant: bool) -> None:
        """Appends the row of a time."""
        sample = max(len(self.samples) - 1, 0)
        row = Row(t, instant, self.robot.state, self.torque, sample, self.is_braked)
        if not self.is_recording:
            self.rows.clear()
        self.rows.append(row)

    def finish(self) -> None:
        """Records the last instant."""
        self.begin_step(self.t)
