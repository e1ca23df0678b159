"""`cosimulate`: a scenario's sampled law against a robot that MuJoCo simulates.

Sensor, law, observer, actuator, delay and disturbance are those of `simulate`; plant and integrator
are MuJoCo's.  A Python loop advances the run step by step; samples, metrics and flags are computed
from the recorded motion afterwards.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Ideal
from iblf_jax.control.actuators.delay import WHOLE_TOLERANCE
from iblf_jax.core import checks, notices
from iblf_jax.core.attributes import attributes
from iblf_jax.core.devices import on_device
from iblf_jax.core.first_use import mujoco
from iblf_jax.core.progress import announced
from iblf_jax.core.status import Status
from iblf_jax.deployment.mujoco_plant import INTEGRATORS, MujocoPlant, Stages
from iblf_jax.deployment.transit import CommandsInTransit
from iblf_jax.engine import folded, sample_status
from iblf_jax.engine.simulate import report
from iblf_jax.simulation.closed_loop import (
    LoopState,
    initial_state,
    run_sampled_law_if_due,
    sample_at,
)
from iblf_jax.simulation.discontinuities import JUMP_SEPARATION
from iblf_jax.simulation.levels import disturbance_torque
from iblf_jax.simulation.metrics import Fold, as_folds, metric_units
from iblf_jax.simulation.noise import has_noise, noise_key
from iblf_jax.simulation.results import Metrics, Rollout
from iblf_jax.simulation.sampling import Instant, Sampling, commands_in_transit
from iblf_jax.simulation.scenario import Scenario, canonical, check_step
from iblf_jax.simulation.signals import FIELDS
from iblf_jax.world import plants
from iblf_jax.world.disturbances import Nothing


@notices.each_warning_once
@announced("simulating the plant and the law side by side")
def cosimulate(
    scenario: Scenario,
    plant: str | Path | mujoco.MjSpec | mujoco.MjModel,
    *,
    duration: float,
    period: float | None = None,
    dt: float | None = None,
    integrator: str | None = "RK4",
    locked: Mapping[str, float] | None = None,
    record_every: int = 1,
    metrics: Sequence[Fold] | None = None,
    throw: bool = False,
    seed: int = 0,
    film: str | Path | None = None,
) -> Rollout:
    """Runs a scenario's law against a robot that MuJoCo simulates, with contacts and mechanical
    stops.

        tau_k = law(t_k, sensor(q, q'))  once a period,   x' = MuJoCo(x, tau + disturbance)  between

    The law uses the scenario's `model`; further effects in MuJoCo's model (a payload, friction, a
    stop, a table) are uncertainty.  The scenario's `plant` gives only the names of its joints and
    what the disturbance needs.  The torque changes when a command arrives, within a step as well.
    Disturbance and actuator are evaluated at the stages of MuJoCo's integrator.  The joints are
    found in MuJoCo's model by the scenario's names, or by their order where these have no names.
    Other joints of the same arm are locked at their reference positions, and the model's own
    actuators of the arm are switched off.

    Args:
      scenario: the scenario, of n joints.
      plant: path of an MJCF or URDF, a `mujoco.MjSpec` or a `mujoco.MjModel`.  A URDF's shapes
        whose mesh files are missing are left out.
      duration: length of the run [s], a whole number of steps.
      period: of the law [s]; the scenario's `sampling.period` if not given.
      dt: step of MuJoCo [s], which divides the period.  If not given, the model's own step, or the
        next shorter one that divides the period.
      integrator: "RK4", "Euler", "implicit" or "implicitfast"; None for the model's own.
      locked: joint name -> position [rad or m], for joints of the model that are locked.
      record_every: record every so-many-th step; metrics and status cover every step whatever is
        recorded.
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      throw: raise instead of warn when the run failed.
      seed: fixes the noise of a sensor, as in `simulate`.
      film: file to write the motion to, ".gif" or ".html": MuJoCo's picture where it can draw one
        and the arm has shapes, the arm's skeleton otherwise.

    Returns:
      A `Rollout` as `simulate` returns.  Only the motion of MuJoCo's robot is available:
      `fastest_mode` is NaN, there is no `numerical_error`, and no flag reports a step or a period
      that is too long.

    Raises:
      ValueError: bad arguments, a plant or a model that is no robot, process noise, or joints that
        are not in MuJoCo's model; the message names the field, the value and the remedy.
      SimulationError: with `throw`, when a bound was violated or the state ran away.
      ImportError: the extra `robots` is not installed.

    Source: design of this package; E. Todorov, T. Erez, Y. Tassa, MuJoCo, IROS 2012.
    """
    if integrator is not None:
        checks.one_of("integrator", integrator, INTEGRATORS)
    check_single(scenario)
    _check_robots(scenario)
    if scenario.process_noise is not None:
        came = type(scenario.process_noise).__name__
        expected = "None, as MuJoCo integrates the motion without noise"
        remedy = "Take ij.with_parts(scenario, process_noise=None), or ij.simulate with the noise."
        raise checks.fail("scenario.process_noise", came, expected, remedy)
    scenario = canonical(with_period(scenario, period))
    seed, throw = checks.seed(seed), checks.boolean("throw", throw)
    names = scenario.plant.joints
    if locked is None:
        locked = {}
    checks.mapping("locked", locked, '{"gripper_joint": 0.02}')
    robot = MujocoPlant(plant, names, scenario.n, locked, integrator)
    if dt is None:
        dt = own_step(float(scenario.sampling.period), robot)  # type: ignore[union-attr]
    dt = checks.time_span("dt", dt)
    check_step(scenario, dt)
    steps = checks.whole_steps(duration, dt, dt_is_free=False)
    record_every = checks.recorded_every(record_every, steps)
    if film is not None:
        # A film needs matplotlib, which is imported only for it.
        from iblf_jax.deployment.film import film_run
        from iblf_jax.plotting.animation import film_path

        film = film_path(film, "film")
    folds = as_folds(metrics, scenario.initial.q.dtype, scenario)
    motion = _Run(scenario, robot, dt, seed).motion(steps)
    rows = motion.rows
    result = rollout_of(scenario, folds, motion, dt, record_every, f"MuJoCo {integrator or 'own'}")
    report(result, steps, throw)
    if film is not None:
        film_run(result, robot, rows.model_positions[rows.instant], dt, Path(film))
    return result


def _check_robots(scenario: Scenario) -> None:
    """Raises ValueError for a plant or a model in strict-feedback form: MuJoCo's robot has the
    torques of its joints as inputs, and no levels beyond positions and velocities.
    """
    for name, part in (("plant", scenario.plant), ("model", scenario.model)):
        robot = plants.as_plant(part).robot
        if robot is part:
            continue
        remedy = "MuJoCo simulates the joints only, without drives or springs."
        if robot is not None:
            remedy += f" Take {name}=scenario.{name}.robot, and a law for robots."
        expected = "a robot, whose inputs are torques"
        raise checks.fail(f"scenario.{name}", type(part).__name__, expected, remedy)


def own_step(period: float, robot: MujocoPlant) -> float:
    """The model's own step, or the next shorter one that divides the period of the law [s]."""
    return period / max(1, math.ceil(period / robot.timestep - WHOLE_TOLERANCE))


def check_single(scenario: Scenario) -> Scenario:
    """The scenario; raises ValueError for another object, for a batch and for traced values."""
    if not isinstance(scenario, Scenario):
        remedy = "Make one with ij.presets or ij.Scenario."
        raise checks.fail("scenario", scenario, "a Scenario", remedy)
    if np.ndim(scenario.initial.q) != 1:
        came = f"a batch, initial.q of shape {np.shape(scenario.initial.q)}"
        raise checks.fail("scenario", came, "one scenario", "Call it once for each.")
    if not checks.is_concrete(scenario):
        remedy = "Call this outside of jit, vmap and grad."
        raise checks.fail("scenario", "traced values", "numbers", remedy)
    return scenario


def with_period(scenario: Scenario, period: float | None) -> Scenario:
    """The scenario with this period of the law; None keeps the scenario's own period."""
    sampling = scenario.sampling
    if period is None and sampling is None:
        remedy = "A law outside of the package is sampled: period=1e-3."
        raise checks.fail("period", None, "the period of the law [s]", remedy)
    if period is None:
        return scenario
    period = checks.time_span("period", period)
    if sampling is None:
        return dataclasses.replace(scenario, sampling=Sampling(period))
    queue = max(sampling.queue, commands_in_transit(float(sampling.delay), period))
    sampling = dataclasses.replace(sampling, period=period, queue=queue)
    return dataclasses.replace(scenario, sampling=sampling)


class Rows(NamedTuple):
    """One row of the recorded motion, or R rows stacked.

    Each time step has a row at its start.  Where torque or law signals jump, there is one row
    before the jump and one after it.
    """

    t: Any
    """Time, (R,) [s]."""
    instant: Any
    """Whether the row is the one of a time step, and not of one side of a jump, (R,) bool."""
    q: Any
    dq: Any
    ddq: Any
    tau: Any
    limited: Any
    actuator: Any
    sample: Any
    """Index of the last sample at each row, (R,)."""
    model_positions: Any
    """Positions of all joints of MuJoCo's model."""


class RecordedMotion(NamedTuple):
    """The recorded motion of a run."""

    rows: Rows
    states: LoopState
    """The state after each sample of the law."""
    diverged: bool
    """Whether the state diverged; it is constant from there on."""


@jax.jit
def _law(scenario: Scenario, t, state: LoopState, index, noise) -> LoopState:
    """The state after a sample."""
    return run_sampled_law_if_due(scenario, t, state, Instant(index, jnp.zeros_like(index)), noise)


@jax.jit
def _delivered(scenario: Scenario, t, q, dq, command, state):
    """The actuator's output, and its torque plus that of the disturbance."""
    delivered = scenario.actuator.at(t).deliver(command, dq, state)
    return delivered, delivered.tau + disturbance_torque(scenario, t, q, dq)


class _Run:
    """A run in progress: the law's state, the commands in transit and the recorded rows."""

    def __init__(self, scenario: Scenario, robot: MujocoPlant, dt: float, seed: int) -> None:
        sampling: Any = scenario.sampling
        self.scenario = scenario
        self.robot = robot
        self.dt = dt
        self.period = float(sampling.period)
        self.steps_per_period = round(self.period / dt)
        self.noise = jnp.zeros(4, jnp.float32)
        if has_noise(scenario):
            self.noise = noise_key(jax.random.PRNGKey(seed))
        self.state = initial_state(scenario)
        self.command = np.asarray(scenario.model.gravity(scenario.initial.q))
        self.commands = CommandsInTransit(float(sampling.delay))
        self.jump_times = np.sort(np.asarray(scenario.jump_times(), float))
        eps = np.finfo(scenario.initial.q.dtype).eps
        self.jump_widths = JUMP_SEPARATION * eps * np.abs(self.jump_times)
        self.jumped = 0
        """Number of jumps of the scenario in the past."""
        no_actuator = isinstance(scenario.actuator, Ideal)
        self.applies_command = no_actuator and isinstance(scenario.disturbance, Nothing)
        """Whether the robot receives the command unchanged."""
        self.stages = Stages(self.torque_and_rate, jax.tree.map(np.asarray, self.state.actuator))
        self.states: list[LoopState] = []
        self.rows: list[Rows] = []

    def motion(self, steps: int) -> RecordedMotion:
        """Runs this number of steps and returns the recorded motion."""
        diverged = False
        self.robot.place(np.asarray(self.state.q), np.asarray(self.state.dq))
        with self.robot.driven(self.stages):
            for index in range(steps + 1):
                t = index * self.dt
                diverged = diverged or self.robot.has_diverged()
                if diverged:
                    self.rows.append(self.rows[-1]._replace(t=t, instant=True))
                    continue
                self.begin_step(index, t)
                if index < steps:
                    self.integrate(t, t + self.dt)
        return RecordedMotion(stacked(self.rows), stacked(self.states), diverged)

    def begin_step(self, index: int, t: float) -> None:
        """Samples the law if it is due, applies what changes at t, and records the instant."""
        tolerance = WHOLE_TOLERANCE * self.dt
        is_due = index % self.steps_per_period == 0
        changes = is_due or self.command_arrives(t + tolerance) or self.jumps(t + tolerance)
        if index > 0 and changes:
            self.record(t, instant=False)
        if is_due:
            self.sample_law(t)
        self.apply_changes(t + tolerance)
        self.record(t, instant=True)

    def integrate(self, t: float, end: float) -> None:
        """Advances MuJoCo from t to `end`; a step in which a command arrives or the scenario jumps
        is divided there.
        """
        tolerance = WHOLE_TOLERANCE * self.dt
        while t < end - tolerance:
            h = min(self.commands.next_arrival(end), self.next_jump(end), end) - t
            self.stages.begin(t)
            self.robot.step(t, h)
            self.stages.finish(h)
            t += h
            if t < end - tolerance:
                self.record(t, instant=False)
                self.apply_changes(t + tolerance)
                self.record(t, instant=False)

    def sample_law(self, t: float) -> None:
        """One sample of the law; its command is in transit from here on."""
        state = self.state._replace(x=jnp.stack([self.robot.q, self.robot.dq]))
        self.state = _law(self.scenario, t, state, len(self.commands), self.noise)
        self.states.append(self.state)
        command = np.asarray(self.state.sampled.commands[0])
        self.commands.send(len(self.commands) * self.period, command)

    def torque_and_rate(self, t, q, dq, actuator) -> tuple[np.ndarray, Any]:
        """The torque on the joints, and the rate of the actuator's state."""
        if self.applies_command:
            return self.command, ()
        side = self.side_of_jumps(t)
        delivered, torque = _delivered(self.scenario, side, q, dq, self.command, actuator)
        return np.asarray(torque), jax.tree.map(np.asarray, delivered.rate)

    def record(self, t: float, instant: bool) -> None:
        """Appends the row of a time."""
        q, dq = self.robot.q, self.robot.dq
        self.stages.begin(t)
        ddq = self.robot.acceleration(t)
        tau, limited = self.command, np.zeros(self.scenario.n, bool)
        actuator = self.stages.state
        if not self.applies_command:
            side = self.side_of_jumps(t)
            delivered, _ = _delivered(self.scenario, side, q, dq, self.command, actuator)
            tau, limited = np.asarray(delivered.tau), np.asarray(delivered.limited)
        model_positions = self.robot.data.qpos.copy()
        sample = len(self.commands) - 1
        self.rows.append(
            Rows(t, instant, q, dq, ddq, tau, limited, actuator, sample, model_positions)
        )

    # Commands in transit, and jumps of the scenario

    def next_jump(self, otherwise: float) -> float:
        """Time of the next jump of the scenario [s]; `otherwise` if there is none."""
        if self.jumped < self.jump_times.size:
            return float(self.jump_times[self.jumped])
        return otherwise

    def command_arrives(self, until: float) -> bool:
        """Whether the next command arrives by then."""
        return self.commands.next_arrival(math.inf) <= until

    def jumps(self, until: float) -> bool:
        """Whether the scenario jumps by then."""
        return self.next_jump(math.inf) <= until

    def apply_changes(self, until: float) -> None:
        """Applies the commands that arrive, and the jumps that occur, by then."""
        command = self.commands.received(until)
        if command is not None:
            self.command = command
        while self.jumps(until):
            self.jumped += 1

    def side_of_jumps(self, t: float) -> float:
        """The time, moved away from the jumps: after those of the past and before the next one."""
        if self.jumped > 0:
            last = self.jumped - 1
            t = max(t, self.jump_times[last] + self.jump_widths[last])
        if self.jumped < self.jump_times.size:
            t = min(t, self.jump_times[self.jumped] - self.jump_widths[self.jumped])
        return t


def stacked(trees: Sequence[Any]) -> Any:
    """One pytree whose arrays stack those of the given pytrees along a new first axis."""
    return jax.tree.map(lambda *x: np.stack(x), *trees)


@jax.jit
def _observed(scenario: Scenario, folds, dt, motion: RecordedMotion, is_gap):
    """Samples, metrics and flags of a motion."""
    rows = motion.rows
    t = rows.t.astype(dt.dtype)
    half, zero = jnp.where(is_gap, 0.0, 0.5 * jnp.diff(t)), jnp.zeros((1,), dt.dtype)
    weight = jnp.concatenate([zero, half]) + jnp.concatenate([half, zero])
    step = jnp.where(rows.instant & (t > 0), dt, 0.0)
    signals = jax.tree.map(lambda x: x[rows.sample], motion.states.sampled.signals)
    x, moved = (jnp.stack(levels, axis=1) for levels in ((rows.q, rows.dq), (rows.dq, rows.ddq)))
    samples = jax.vmap(partial(sample_at, scenario))(t, x, moved, rows.tau, rows.limited, signals)
    samples = dataclasses.replace(samples, dt=weight, step=step)
    raised = jax.vmap(sample_status)(samples)
    return samples, folded(folds, samples), raised


def rollout_of(
    scenario: Scenario,
    folds: tuple[Fold, ...],
    motion: RecordedMotion,
    dt: float,
    record_every: int,
    method: str,
    is_gap: np.ndarray | None = None,
) -> Rollout:
    """The result of a motion.

    Args:
      scenario: sampled and canonical.
      folds: the metrics.
      motion: R rows.
      dt: time step [s].
      record_every: record every so-many-th step.
      method: name of the integrator.
      is_gap: whether the time between two rows is not part of integrals over time, (R - 1,) bool;
        none of it if not given.
    """
    step_size = jnp.asarray(dt, scenario.initial.q.dtype)
    if is_gap is None:
        is_gap = np.zeros(len(motion.rows.t) - 1, bool)
    samples, results, raised = _observed(scenario, folds, step_size, motion, is_gap)
    status = np.bitwise_or.reduce(np.asarray(raised))
    if motion.diverged:
        status |= int(Status.NOT_FINITE)
    rows = motion.rows
    at = np.flatnonzero(rows.instant)[::record_every]
    # On the host: JAX compiles programs for the index of each new shape.
    recorded = jax.tree.map(lambda x: on_device(np.asarray(x)[at]), samples)
    states = jax.tree.map(lambda x: on_device(x[rows.sample[at]]), motion.states)
    return Rollout(
        scenario=scenario,
        controller_state=states.controller,
        observer_state=states.observer,
        metrics=Metrics(results, metric_units(folds, scenario)),
        status=jnp.int32(status),
        fastest_mode=jnp.full_like(step_size, jnp.nan),
        dt=step_size,
        actuator_state=jax.tree.map(lambda x: jnp.asarray(x[at]), rows.actuator),
        measured=states.sampled.received,
        method=method,
        steps=int(np.sum(rows.instant)) - 1,
        **attributes(recorded, FIELDS),
    )
