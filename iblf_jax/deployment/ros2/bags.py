"""Recordings of a robot under ROS 2: a log for `identify`, and a `Rollout` for figures.

`identification.bag` reads the recording and describes how joint states and efforts are aligned.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Ideal
from iblf_jax.core import checks, notices
from iblf_jax.deployment.cosimulate import (
    RecordedMotion,
    Rows,
    check_single,
    rollout_of,
    with_period,
)
from iblf_jax.deployment.ros2.law_replay import replay_law
from iblf_jax.identification.bag import BagOptions, is_bag, read_bag_log
from iblf_jax.identification.log import Log
from iblf_jax.simulation.closed_loop import LoopState
from iblf_jax.simulation.metrics import Fold, as_folds
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.world import plants

SHORTEST_INTERVAL = 0.75
"""Shortest time between two samples of the law in a replay [periods]: joint states that arrive
faster than the law runs are not samples of it."""
MIN_ROWS = 2
REPRODUCED = 0.1
"""Largest median distance between recorded and computed torques, relative to the largest recorded
one, for which no warning is given."""


@notices.each_warning_once
def bag_log(
    path: str | os.PathLike,
    scenario: Scenario,
    *,
    joint_states: str = "joint_states",
    efforts: str | None = "efforts",
    joints: Sequence[str] | None = None,
    times: str = "stamp",
    time_origin: float | None = None,
    start: float = 0.0,
    duration: float | None = None,
) -> dict[str, np.ndarray]:
    """The log of a rosbag2 recording, for `identify`.

        tau_k = the last effort that was received before the joint state k + 1

    Joint states with an unknown effort are left out: those before the first effort and after the
    last one, and those in an interval between efforts of more than 3 times the 95 % quantile of
    these intervals.  The log has gaps there, and where joint states are missing.
    `ij.identify(scenario, "run_bag")` reads a recording with the default options.

    Args:
      path: the folder of the recording, or a `.db3` or `.mcap` file.
      scenario: on a robot of n joints; its joint names order the joint states, in which further
        joints may occur.  A robot without names has joint_1, joint_2, ..., as in an exported node,
        or is read in the order of the first message, with a warning.
      joint_states: topic of the `sensor_msgs/JointState`s; a relative name may be the end of one
        topic.
      efforts: topic of the `std_msgs/Float64MultiArray`s, in the order of the scenario's joints;
        None for the efforts in the joint states, which belong to the same instant.
      joints: n names of the joints in the messages, if they differ from the scenario's.
      times: "stamp", or "receive" for the times at which the recorder received the joint states.
      time_origin: stamp that is t = 0 [s]; that of the first joint state with an effort if not
        given.
      start: first time that is read, >= 0 [s].
      duration: length of the part that is read [s]; all that follows if not given.

    Returns:
      "t" (N,) [s], "q" (N, n) [rad], "tau" (N, n) [N m], and "dq" (N, n) [rad/s] if all joint
      states have velocities.

    Raises:
      ValueError: a damaged recording, a topic that is missing or has another type, other joints,
        another number of efforts, or times that decrease; the message states the remedy.
      ImportError: the extra `ros` is not installed.

    Source: design of this package; the message types of ROS 2.
    """
    options = BagOptions(joint_states, efforts, joints, times, time_origin, start, duration)
    return _log(path, scenario, options)


@notices.each_warning_once
def read_bag(
    path: str | os.PathLike,
    scenario: Scenario,
    *,
    period: float | None = None,
    metrics: Sequence[Fold] | None = None,
    joint_states: str = "joint_states",
    efforts: str | None = "efforts",
    joints: Sequence[str] | None = None,
    times: str = "stamp",
    time_origin: float | None = None,
    start: float = 0.0,
    duration: float | None = None,
) -> Rollout:
    """A rosbag2 recording of a scenario's law on a robot as a `Rollout`: metrics, status, figures.

    Positions, velocities and torques are those of the recording.  The signals of the law (virtual
    velocity, estimate, Lyapunov function) are computed: the scenario's law and observer run on the
    recorded joint states and torques with the gains of the scenario, and start at the first row.
    Accelerations are differences of the velocities to the next row, and so are velocities that are
    not recorded.  Gaps are not part of integrals over time.  A warning says if the law has other
    torques on these states than the recorded ones: the recording began after the law, or another
    law ran.

    Args:
      path: the folder of the recording, or a `.db3` or `.mcap` file.
      scenario: the scenario whose law ran, on a robot of n joints.
      period: of the law [s]; the scenario's `sampling.period` if not given.
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      joint_states, efforts, joints, times, start, duration: as in `bag_log`.
      time_origin: stamp at which the law started [s], from which on its reference and bounds run;
        that of the first joint state with an effort if not given.  An exported node publishes
        zeros before its start, and reports the stamp in its diagnostics.

    Returns:
      A `Rollout` of the given scenario, whose `initial` and `actuator` are not used.  `dt` is the
      median time between joint states; `fastest_mode` is NaN, and there is no `numerical_error`.

    Raises:
      ValueError: as `bag_log`, or a plant in strict-feedback form.
      ImportError: the extra `ros` is not installed.

    Source: design of this package.
    """
    check_single(scenario)
    _check_robots(scenario)
    scenario = canonical(with_period(scenario, period))
    options = BagOptions(joint_states, efforts, joints, times, time_origin, start, duration)
    found = _log(path, scenario, options)
    if len(found["t"]) < MIN_ROWS:
        came = checks.Words(f"{len(found['t'])} joint states")
        raise checks.fail(str(path), came, f"at least {MIN_ROWS}", "Select a longer part.")
    log = Log(str(path), found["t"], found["q"], found["tau"], found.get("dq"))
    dq = log.dq
    if dq is None:
        dq = _derivative(log, log.q)
    # The recorded torques are those after the actuator.
    scenario = dataclasses.replace(scenario, actuator=Ideal())
    rows = _rows(log, dq)
    states = _replayed(scenario, log, dq)
    computed = np.asarray(states.sampled.commands[:, 0])
    largest = np.max(np.abs(log.tau))
    distance = np.median(np.max(np.abs(computed - log.tau), axis=1))
    if not distance <= REPRODUCED * largest:
        notices.warn(
            f"{log.name}: the law of the scenario has other torques on the recorded states than"
            f" those recorded, by {distance:.3g} N m (median) of at most {largest:.3g} N m. Give"
            " time_origin if the recording began after the law, or the scenario whose law ran."
        )
    motion = RecordedMotion(rows, states, diverged=False)
    folds = as_folds(metrics, scenario.initial.q.dtype, scenario)
    # Two adjacent rows of joint states have no torque that was constant between them.
    is_gap = rows.instant[:-1] & rows.instant[1:]
    dt = float(np.median(np.diff(log.t)))
    return rollout_of(scenario, folds, motion, dt, 1, "recorded", is_gap)


def _log(path: str | os.PathLike, scenario: Scenario, options: BagOptions) -> dict[str, np.ndarray]:
    """The signals of a recording."""
    what = "a rosbag2 recording"
    place = checks.file_path("path", path, what)
    if not place.exists():
        checks.file_to_read("path", path, what)
    if not is_bag(place):
        raise checks.fail("path", str(place), "a folder, or a file that ends in .db3 or .mcap")
    check_single(scenario)
    return read_bag_log(place, scenario.n, plants.declared_joints(scenario.plant), options)


def _check_robots(scenario: Scenario) -> None:
    """Raises ValueError for a plant or a model in strict-feedback form, of which joint states do
    not have all levels.
    """
    for name, part in (("plant", scenario.plant), ("model", scenario.model)):
        if plants.as_plant(part).robot is not part:
            expected = "a robot, as joint states have positions and velocities only"
            remedy = "ij.deployment.bag_log reads the log without the signals of the law."
            raise checks.fail(f"scenario.{name}", type(part).__name__, expected, remedy)


def _derivative(log: Log, x: np.ndarray) -> np.ndarray:
    """The rate of a signal to the next row, over which the torque is constant, (N, n); before a gap
    that of the row before, and 0 between two gaps.
    """
    rate = np.zeros_like(x)
    for segment in log.segments:
        if segment.stop - segment.start > 1:
            forward = np.diff(x[segment], axis=0) / np.diff(log.t[segment])[:, None]
            rate[segment] = np.concatenate([forward, forward[-1:]])
    return rate


def _rows(log: Log, dq: np.ndarray) -> Rows:
    """The recorded motion: one row a joint state and, unless a gap precedes it, one row before it
    with the torque that was constant until then.
    """
    count = len(log.t)
    has_row_before = np.append(False, np.diff(log.t) <= log.gap)
    state = np.repeat(np.arange(count), 1 + has_row_before)
    instant = np.append(state[1:] != state[:-1], True)
    # The torque in the row before a joint state is that of the joint state before.
    sample = np.where(instant, state, state - 1)
    return Rows(
        t=log.t[state],
        instant=instant,
        q=log.q[state],
        dq=dq[state],
        ddq=_derivative(log, dq)[sample],
        tau=log.tau[sample],
        limited=np.zeros((len(state), log.q.shape[1]), bool),
        actuator=(),
        sample=sample,
        model_positions=log.q[state],
    )


def _replayed(scenario: Scenario, log: Log, dq: np.ndarray) -> LoopState:
    """The states of law and observer after each joint state."""
    is_due = _samples(log.t, float(scenario.sampling.period))  # type: ignore[union-attr]
    dtype = scenario.initial.q.dtype
    t, q, dq_read, tau = (jnp.asarray(x, dtype) for x in (log.t, log.q, dq, log.tau))
    states = replay_law(scenario, t, q, dq_read, jnp.asarray(is_due), tau)
    return jax.tree.map(np.asarray, states)


def _samples(t: np.ndarray, period: float) -> np.ndarray:
    """Whether the law runs at each row: a period after the last sample, or later, (N,) bool."""
    is_due = np.zeros(len(t), bool)
    last = -np.inf
    for k, time in enumerate(t):
        if time - last >= SHORTEST_INTERVAL * period:
            is_due[k] = True
            last = time
    return is_due
