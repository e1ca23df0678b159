"""The recorded motion of a simulated robot, and the `Rollout` that follows from it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Ideal
from iblf_jax.core import checks
from iblf_jax.core.presentation import Content, Result
from iblf_jax.deployment.cosimulate import (
    RecordedMotion,
    Rows,
    check_single,
    rollout_of,
    stacked,
    with_period,
)
from iblf_jax.deployment.mujoco_plant import MujocoPlant
from iblf_jax.deployment.ros2.law_replay import replay_law
from iblf_jax.deployment.ros2.robot_simulation import Reading, Row
from iblf_jax.simulation.metrics import Fold, as_folds
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class RobotMotion(Result):
    """The true motion of a simulated robot, what it published, and the efforts that it received.

    There are K states, one a period, and R rows, one a time step of MuJoCo and two at a change of
    the torque.  Times count from the origin, the state that the first effort answered.
    """

    joints: tuple[str, ...]
    period: float
    """Period of the states [s]."""
    dt: float
    """Time step of MuJoCo [s]."""
    origin: float
    """Stamp of the state at t = 0 [s]."""
    ended: float
    """Clock of the computer at the end [s]."""
    t: np.ndarray
    """Times of the rows, (R,) [s]."""
    instant: np.ndarray
    """Whether a row is that of a time step, (R,) bool."""
    q: np.ndarray
    """True positions, (R, n) [rad]."""
    dq: np.ndarray
    """True velocities, (R, n) [rad/s]."""
    ddq: np.ndarray
    """True accelerations, (R, n) [rad/s^2]."""
    tau: np.ndarray
    """Torques that acted, (R, n) [N m]."""
    sample: np.ndarray
    """Index of the last state of each row, (R,)."""
    state_t: np.ndarray
    """Times of the states, (K,) [s]."""
    measured_q: np.ndarray
    """Measured positions, (K, n) [rad]."""
    measured_dq: np.ndarray
    """Measured velocities, (K, n) [rad/s]."""
    published: np.ndarray
    """Whether a state was published; the others are dropouts, (K,) bool."""
    latency: np.ndarray
    """From the publication of a state to the next effort, (K,) [s]; NaN if no effort arrived before
    the next publication."""
    lateness: np.ndarray
    """From the nominal instant of a state to its publication in real time, (K,) [s]."""
    effort_t: np.ndarray
    """Times at which efforts arrived, without those that were lost or refused, (M,) [s]."""
    counts: dict[str, int]
    """Numbers of events: `dropped efforts`, `refused efforts`, `expired efforts`,
    `skipped states` of a robot that was late by more than a period."""
    diverged: bool
    """Whether the state was not finite or too fast; the motion ends there."""

    def _content(self) -> Content:
        counts = ", ".join(f"{count} {name}" for name, count in self.counts.items() if count)
        return [
            f"RobotMotion({len(self.state_t)} states every {self.period:g} s,"
            f" {len(self.t)} rows; no effort in {self.missed_share:.2%} of the periods"
            f"{'; diverged' if self.diverged else ''})",
            *([f"  {counts}"] if counts else []),
        ]

    @property
    def missed_share(self) -> float:
        """Share of the periods in which no effort arrived [1]."""
        intervals = np.round(np.diff(self.effort_t) / self.period)
        if intervals.size == 0:
            return math.nan
        return float(np.sum(np.maximum(intervals - 1.0, 0.0)) / max(np.sum(intervals), 1.0))

    def timing(self) -> dict[str, float]:
        """Latency, lateness and jitter [s], and the share of missed periods [1].

        `latency`: from the publication of a state to the next effort; `lateness`: from the nominal
        instant of a state to its publication; `jitter`: distance of the interval between two
        efforts from the period; `gap`: the longest such interval.
        """
        intervals = np.diff(self.effort_t)
        found = {"missed": self.missed_share, "gap": float(np.max(intervals, initial=0.0))}
        jitter = np.abs(intervals - self.period)
        series = {"latency": self.latency, "lateness": self.lateness, "jitter": jitter}
        for name, values in series.items():
            finite = values[np.isfinite(values)]
            for label, share in (("median", 50.0), ("99 %", 99.0), ("longest", 100.0)):
                key = f"{name}, {label}"
                found[key] = math.nan
                if finite.size:
                    found[key] = float(np.percentile(finite, share))
        return found

    def rollout(self, scenario: Scenario, metrics: Sequence[Fold] | None = None) -> Rollout:
        """The run as a `Rollout`, with metrics, status and the signals of the law.

        Positions, velocities and torques are the robot's own.  Virtual control and estimate are
        those that the scenario's law computes from the published states; a law node that missed a
        state, or was restarted, has others.

        Args:
          scenario: whose law ran, with the joints of this robot.
          metrics: as in `cosimulate`.

        Returns:
          A `Rollout`, as `cosimulate` returns.

        Raises:
          ValueError: a scenario with another number of joints, or no motion.
        """
        scenario = canonical(with_period(check_single(scenario), self.period))
        joints = self.q.shape[1]
        if scenario.n != joints:
            remedy = "Take the scenario whose law ran."
            raise checks.fail("scenario", f"{scenario.n} joints", f"{joints} joints", remedy)
        if not np.any(self.instant):
            raise checks.fail("motion", "no time step", "a robot that has moved")
        scenario = dataclasses.replace(scenario, actuator=Ideal())
        folds = as_folds(metrics, scenario.initial.q.dtype, scenario)
        limited = np.zeros_like(self.tau, bool)
        columns = (self.t, self.instant, self.q, self.dq, self.ddq, self.tau, limited)
        rows = Rows(*columns, actuator=(), sample=self.sample, model_positions=self.q)
        dtype = scenario.initial.q.dtype
        measured = (self.state_t, self.measured_q, self.measured_dq)
        t, q, dq = (jnp.asarray(x, dtype) for x in measured)
        states = replay_law(scenario, t, q, dq, jnp.asarray(self.published))
        motion = RecordedMotion(rows, jax.tree.map(np.asarray, states), self.diverged)
        return rollout_of(scenario, folds, motion, self.dt, 1, "MuJoCo over ROS 2")


def recorded(
    robot: MujocoPlant,
    rows: Sequence[Row],
    samples: Sequence[Reading],
    **fields: Any,
) -> RobotMotion:
    """The motion of a robot that has been simulated; the remaining fields are given."""
    stack = stacked(list(rows))
    accelerations = np.zeros((len(rows), len(robot.speeds)))
    for i, row in enumerate(rows):
        if not row.is_braked:
            robot.restore(row.state)
            robot.apply(row.tau)
            accelerations[i] = robot.acceleration(row.t)
    start = robot.model.nq
    read = stacked(list(samples))
    return RobotMotion(
        t=stack.t,
        instant=stack.instant,
        q=stack.state[:, robot.positions],
        dq=stack.state[:, start + robot.speeds],
        ddq=accelerations,
        tau=stack.tau,
        sample=stack.sample,
        state_t=read.t,
        measured_q=read.q,
        measured_dq=read.dq,
        **fields,
    )
