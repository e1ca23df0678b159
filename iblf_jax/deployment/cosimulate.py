"""`cosimulate`: a scenario's law, sampled, against a robot that MuJoCo moves.

Sensor, law, observer, actuator, delay and disturbance are those of `simulate`; plant and integrator
are MuJoCo's.  The run goes step by step in Python; its samples, metrics and flags follow from the
motion when it is over.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Ideal
from iblf_jax.core import checks, notices
from iblf_jax.core.status import VELOCITY_LIMIT, Status
from iblf_jax.core.time import as_at
from iblf_jax.deployment.mujoco_plant import INTEGRATORS, MujocoPlant, Stages
from iblf_jax.engine import folded, sample_status
from iblf_jax.engine.simulate import report
from iblf_jax.simulation.closed_loop import (
    LoopState,
    initial_state,
    run_sampled_law_if_due,
    sample_at,
)
from iblf_jax.simulation.jumps import APART
from iblf_jax.simulation.metrics import Fold, as_folds, metric_units
from iblf_jax.simulation.results import Metrics, Rollout
from iblf_jax.simulation.sampling import (
    DELAY_TOLERANCE,
    Instant,
    Sampling,
    check_step,
    commands_in_transit,
    has_noise,
    noise_key,
)
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.simulation.signals import SIGNALS
from iblf_jax.world.disturbances import Nothing
from iblf_jax.world.robots import at_time


@notices.each_warning_once
def cosimulate(
    scenario: Scenario,
    plant: Any,
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
    """Runs a scenario's law against a robot that MuJoCo moves, contacts and mechanical stops
    included.

        tau_k = law(t_k, sensor(q, q'))  once a period,   x' = MuJoCo(x, tau + disturbance)  between

    The law knows the scenario's `model`; what MuJoCo knows besides (a payload, friction, a stop, a
    table) is uncertainty to it.  Of the scenario's `plant` only the names of its joints and what a
    disturbance asks of it are used.  Torque changes when a command arrives, also within a step.  A
    disturbance and an actuator go along with the stages of MuJoCo's integrator.  Joints have the
    scenario's names in MuJoCo's model, or its order where the scenario's have none; other joints of
    the same arm are locked at their reference, and a model's own drives of the arm are switched
    off.

    Args:
      scenario: the law and all around it, of n joints.
      plant: path of an MJCF or URDF, a `mujoco.MjSpec` or a `mujoco.MjModel`.  A URDF's shapes
        whose mesh is not there are left out.
      duration: length of the run [s], a whole number of steps.
      period: of the law [s]; the scenario's `sampling.period` if not given.
      dt: step of MuJoCo [s], which divides the period; the model's own, or the next shorter one
        that does, if not given.
      integrator: "RK4", "Euler", "implicit" or "implicitfast"; None for the model's own.
      locked: joint name -> position [rad or m], for joints of the model that are not to move.
      record_every: record every so-many-th step; metrics and status cover every step whatever is
        recorded.
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      throw: raise instead of warn when the run failed.
      seed: fixes the noise of a sensor, as in `simulate`.
      film: file to write the motion to, ".gif" or ".html": MuJoCo's picture where it can draw one
        and the arm has shapes, the arm's skeleton otherwise.

    Returns:
      A `Rollout` as `simulate` gives.  Of MuJoCo's robot nothing is known but how it moves:
      `fastest_mode` is NaN, there is no `numerical_error`, and no flag tells of too large a step or
      too long a period.

    Raises:
      ValueError: bad arguments, or joints that are not in MuJoCo's model; the message names the
        field, the value and the remedy.
      SimulationError: with `throw`, when a bound was violated or the state ran away.
      ImportError: the extra `robots` is not installed.

    Source: design of this package; E. Todorov, T. Erez, Y. Tassa, MuJoCo, IROS 2012.
    """
    if integrator is not None:
        checks.one_of("integrator", integrator, INTEGRATORS)
    check_single(scenario)
    scenario = canonical(with_period(scenario, period))
    seed, throw = checks.seed(seed), checks.flag("throw", throw)
    names = tuple(getattr(scenario.plant, "joints", ()))
    locked = checks.mapping("locked", {} if locked is None else locked, '{"gripper_joint": 0.02}')
    robot = MujocoPlant(plant, names, scenario.n, locked, integrator)
    sampling: Any = scenario.sampling
    own = float(sampling.period) / max(
        1, math.ceil(float(sampling.period) / robot.timestep - DELAY_TOLERANCE)
    )
    dt = own if dt is None else checks.time_span("dt", dt)
    check_step(scenario, dt)
    steps = checks.whole_steps(duration, dt, dt_is_free=False)
    record_every = checks.recorded_every(record_every, steps)
    write = None if film is None else _film_writer(film)
    folds = as_folds(metrics, scenario.initial.q.dtype, scenario)
    motion = _run(scenario, robot, dt, steps, seed)
    result = _rollout(scenario, folds, motion, dt, record_every, f"MuJoCo {integrator or 'own'}")
    report(result, steps, throw)
    if write is not None:
        write(result, robot, motion.whole[motion.instant], dt)
    return result


def _film_writer(path: str | Path) -> Callable:
    """What writes a film there.  Matplotlib comes with it, so it is imported where a film is asked
    for.
    """
    from iblf_jax.deployment.film import film_run
    from iblf_jax.plotting.animation import film_path

    return partial(film_run, path=film_path(path, "film"))


def check_single(scenario: Scenario) -> Scenario:
    """The scenario; ValueError for no scenario, a batch of them, or one of traced values."""
    if not isinstance(scenario, Scenario):
        raise checks.fail(
            "scenario", scenario, "a Scenario", "Make one with ij.presets or ij.Scenario."
        )
    if np.ndim(scenario.initial.q) != 1:
        raise checks.fail(
            "scenario",
            f"a batch, initial.q of shape {np.shape(scenario.initial.q)}",
            "one scenario",
            "Call it once for each.",
        )
    if not checks.is_concrete(scenario):
        raise checks.fail(
            "scenario", "traced values", "numbers", "Call this outside of jit, vmap and grad."
        )
    return scenario


def with_period(scenario: Scenario, period: float | None) -> Scenario:
    """The scenario, its law sampled with this period."""
    if period is None:
        if scenario.sampling is None:
            raise checks.fail(
                "period",
                None,
                "the period of the law [s]",
                "Outside of the package a law is sampled: period=1e-3.",
            )
        return scenario
    period = checks.time_span("period", period)
    if scenario.sampling is None:
        return dataclasses.replace(scenario, sampling=Sampling(period))
    queue = max(
        scenario.sampling.queue, commands_in_transit(float(scenario.sampling.delay), period)
    )
    return dataclasses.replace(
        scenario, sampling=dataclasses.replace(scenario.sampling, period=period, queue=queue)
    )


class _Motion(NamedTuple):
    """What has happened, row by row (R first), and sample by sample.

    There is a row for each instant, and where torque or law signals jump one before the jump and
    one after it.
    """

    t: Any
    """(R,) [s]."""
    instant: Any
    """Whether the row is that of an instant, (R,) bool."""
    q: Any
    dq: Any
    ddq: Any
    tau: Any
    limited: Any
    actuator: Any
    sample: Any
    """Number of the last sample at each row, (R,)."""
    whole: Any
    """Positions of everything in MuJoCo's model."""
    states: LoopState
    """After each sample of the law."""
    broken: bool
    """Whether the state ran away; it stands still from there."""


@jax.jit
def _law(scenario: Scenario, t, state: LoopState, index, noise) -> LoopState:
    """The state after a sample."""
    return run_sampled_law_if_due(scenario, t, state, Instant(index, jnp.zeros_like(index)), noise)


@jax.jit
def _delivered(scenario: Scenario, t, q, dq, asked, state):
    """What the actuator delivers, and the torque with what disturbs."""
    delivered = as_at(scenario.actuator, t).deliver(asked, dq, state)
    return delivered, delivered.tau + scenario.disturbance.torque(
        t, q, dq, at_time(scenario.plant, t), scenario.model
    )


def _run(scenario: Scenario, robot: MujocoPlant, dt: float, steps: int, seed: int) -> _Motion:
    """Moves the robot."""
    sampling: Any = scenario.sampling
    period, delay, every = (
        float(sampling.period),
        float(sampling.delay),
        round(float(sampling.period) / dt),
    )
    noise = (
        noise_key(jax.random.PRNGKey(seed)) if has_noise(scenario) else jnp.zeros(4, jnp.float32)
    )
    state, asked = initial_state(scenario), np.asarray(scenario.model.gravity(scenario.initial.q))
    plain = isinstance(scenario.actuator, Ideal) and isinstance(scenario.disturbance, Nothing)
    commands: list[np.ndarray] = []
    states: list[LoopState] = []
    arrived = 0

    times = np.sort(np.asarray(scenario.jump_times(), float))
    apart = APART * np.finfo(scenario.initial.q.dtype).eps * np.abs(times)
    jumped = 0

    def beside(t: float) -> float:
        """A time, on the side of the jumps on which the run is."""
        if jumped > 0:
            t = max(t, times[jumped - 1] + apart[jumped - 1])
        if jumped < times.size:
            t = min(t, times[jumped] - apart[jumped])
        return t

    def rate(t, q, dq, actuator):
        if plain:
            return asked, ()
        delivered, torque = _delivered(scenario, beside(t), q, dq, asked, actuator)
        return np.asarray(torque), jax.tree.map(np.asarray, delivered.rate)

    stages = Stages(rate, jax.tree.map(np.asarray, state.actuator))
    rows: list[tuple] = []
    broken = False

    def arrives(until: float) -> bool:
        """Whether the next command has arrived by then."""
        return arrived < len(commands) and arrived * period + delay <= until

    def jumps(until: float) -> bool:
        """Whether the next jump of the scenario is over by then."""
        return jumped < times.size and times[jumped] <= until

    def row(t: float, instant: bool) -> tuple:
        """What there is to see at a time."""
        q, dq = robot.q, robot.dq
        stages.begin(t)
        ddq = robot.acceleration(t)
        tau, limited = asked, np.zeros(scenario.n, bool)
        if not plain:
            delivered, _ = _delivered(scenario, beside(t), q, dq, asked, stages.state)
            tau, limited = np.asarray(delivered.tau), np.asarray(delivered.limited)
        return (
            t,
            instant,
            q,
            dq,
            ddq,
            tau,
            limited,
            stages.state,
            len(commands) - 1,
            robot.data.qpos.copy(),
        )

    def change(until: float) -> None:
        """Takes up the commands that have arrived and the jumps that are over by then."""
        nonlocal asked, arrived, jumped
        while arrives(until):
            asked, arrived = commands[arrived], arrived + 1
        while jumps(until):
            jumped += 1

    robot.place(np.asarray(state.q), np.asarray(state.dq))
    with robot.driven(stages):
        for index in range(steps + 1):
            t = index * dt
            q, dq = robot.q, robot.dq
            broken = broken or not (np.all(np.isfinite(q)) and np.all(np.abs(dq) < VELOCITY_LIMIT))
            if broken:
                rows.append((t, True, *rows[-1][2:]))
                continue
            # Where a command arrives or the scenario jumps within the step, MuJoCo makes two of it.
            now, end, near = t, t + dt, DELAY_TOLERANCE * dt
            due = index % every == 0
            if index > 0 and (due or arrives(now + near) or jumps(now + near)):
                rows.append(row(now, False))
            if due:
                state = _law(
                    scenario,
                    t,
                    state._replace(q=jnp.asarray(q), dq=jnp.asarray(dq)),
                    len(commands),
                    noise,
                )
                states.append(state)
                commands.append(np.asarray(state.sampled.commands[0]))
            change(now + near)
            rows.append(row(now, True))
            while index < steps and now < end - near:
                arrival = arrived * period + delay if arrived < len(commands) else end
                jump = times[jumped] if jumped < times.size else end
                h = min(arrival, jump, end) - now
                stages.begin(now)
                robot.step(now, h)
                stages.finish(h)
                now += h
                if now < end - near:
                    rows.append(row(now, False))
                    change(now + near)
                    rows.append(row(now, False))
    columns: list[Any] = [
        jax.tree.map(lambda *x: np.stack(x), *column) for column in zip(*rows, strict=True)
    ]
    return _Motion._make([*columns, jax.tree.map(lambda *x: np.stack(x), *states), broken])


@jax.jit
def _observed(scenario: Scenario, folds, dt, motion: _Motion):
    """Samples, metrics and flags of a motion."""
    t = motion.t.astype(dt.dtype)
    half, zero = 0.5 * jnp.diff(t), jnp.zeros((1,), dt.dtype)
    weight = jnp.concatenate([zero, half]) + jnp.concatenate([half, zero])
    step = jnp.where(motion.instant & (t > 0), dt, 0.0)
    said = jax.tree.map(lambda x: x[motion.sample], motion.states.sampled.signals)
    see = jax.vmap(partial(sample_at, scenario))
    samples = see(t, weight, motion.q, motion.dq, motion.ddq, motion.tau, motion.limited, said)
    samples = dataclasses.replace(samples, step=step)
    raised = jax.vmap(sample_status)(samples)
    return samples, folded(folds, samples), raised


def _rollout(
    scenario: Scenario, folds: Any, motion: _Motion, dt: float, record_every: int, method: str
) -> Rollout:
    """The motion as a run."""
    step_size = jnp.asarray(dt, scenario.initial.q.dtype)
    samples, results, raised = _observed(scenario, folds, step_size, motion)
    status = np.bitwise_or.reduce(np.asarray(raised)) | (
        int(Status.NOT_FINITE) if motion.broken else 0
    )
    at = np.flatnonzero(motion.instant)[::record_every]
    recorded = jax.tree.map(lambda x: x[at], samples)
    states = jax.tree.map(lambda x: jnp.asarray(x[motion.sample[at]]), motion.states)
    return Rollout(
        scenario=scenario,
        controller_state=states.controller,
        observer_state=states.observer,
        metrics=Metrics(results, metric_units(folds)),
        status=jnp.int32(status),
        fastest_mode=jnp.full_like(step_size, jnp.nan),
        dt=step_size,
        actuator_state=jax.tree.map(lambda x: jnp.asarray(x[at]), motion.actuator),
        measured=states.sampled.measured,
        method=method,
        steps=int(np.sum(motion.instant)) - 1,
        **{name: getattr(recorded, name) for name in SIGNALS},
    )
