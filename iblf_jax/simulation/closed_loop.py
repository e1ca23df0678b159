"""The closed loop: the one place where plant, sensor, law, observer and actuator meet.

    state  x = (q, q', state of the law, state of the observer, state of the actuator)
    q" = M^-1 (tau + disturbance + friction - C q' - G)      M, C, G, friction of the plant at t
    f  = M0 q" + C0 q' + G0 - tau                            the uncertain term             (2.1)
    V2 = sum V1 + 1/2 e2^T M0 e2 + 1/2 f_tilde^T f_tilde                                   (3.12)

The second term of V2 is left out for a law whose V1 `includes_e2`.

`evaluate` returns the rate of the state and a `Sample` of every signal. Where a caller uses the
rate only, as in the later stages of an integrator, the compiler removes the rest.

A law with a `Sampling` runs in discrete time. `run_sampled_law` runs sensor, law and observer once
at the start of a period. Within the period the integrator advances the plant and the actuator, and
the signals of the law (alpha, V1, f_hat) keep the values of its last run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators import Ideal
from iblf_jax.control.actuators._base import unlimited
from iblf_jax.control.controllers import Command
from iblf_jax.control.controllers._base import law_member
from iblf_jax.control.observers._base import observer_member
from iblf_jax.control.sensors import Measurement
from iblf_jax.control.sensors._base import unrounded
from iblf_jax.core.linalg import inner, matvec, solve_spd
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.time import as_at
from iblf_jax.simulation.noise import normals
from iblf_jax.simulation.sampling import Instant
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample
from iblf_jax.world.regions import margins
from iblf_jax.world.robots import at_time, friction_torque

# --- the state ---------------------------------------------------------------------------------


class LawSignals(NamedTuple):
    """Signals of a law at one instant, besides its torque; (n,) unless noted."""

    alpha: jax.Array
    """Virtual velocity [rad/s]."""
    V1: jax.Array
    """Lyapunov function of the position error, joint by joint."""
    f_hat: jax.Array
    """Estimate of the uncertain term that the law used [N m]."""
    guard_active: jax.Array
    saturated: jax.Array
    slack: Any = ()
    region_slack: Any = ()


def law_signals(command: Command, f_hat: jax.Array) -> LawSignals:
    """The signals of a law that answered with `command` to the estimate `f_hat`."""
    return LawSignals(
        command.alpha,
        command.V1,
        f_hat,
        command.guard_active,
        command.saturated,
        command.slack,
        command.region_slack,
    )


class SampledState(NamedTuple):
    """State of a sampled loop between samples, besides the states of law and observer."""

    commands: jax.Array
    """Commands in transit to the actuator, newest first, (queue + 1, n) [N m]."""
    sensor: Any
    """State of the sensor."""
    measured: Measurement
    """The last measurement."""
    signals: LawSignals
    """Signals of the law at its last run."""


class LoopState(NamedTuple):
    """State of the closed loop; its rate has the same structure."""

    q: jax.Array
    dq: jax.Array
    controller: Any
    observer: Any
    actuator: Any = ()
    sampled: Any = ()
    """A `SampledState` where the law is sampled."""


# inline, so that JAX traces it once for all of its call sites
@partial(jax.jit, inline=True)
def initial_state(scenario: Scenario) -> LoopState:
    """The state at t = 0; an actuator starts with the torque that balances the model's gravity."""
    q, dq = scenario.initial.q, scenario.initial.dq
    state = LoopState(
        q,
        dq,
        scenario.controller.init(q, dq, scenario.context),
        discrete_observer(scenario).init(q, dq, scenario.model),
    )
    if scenario.sampling is None and isinstance(scenario.actuator, Ideal):
        return state
    balance = scenario.model.gravity(q)
    state = state._replace(actuator=scenario.actuator.init(balance))
    if scenario.sampling is None:
        return state
    return state._replace(sampled=_initial_sampled_state(scenario, state, balance))


def _initial_sampled_state(scenario: Scenario, state: LoopState, tau: jax.Array) -> SampledState:
    """State of a sampled loop before its first sample: every command in transit is `tau`."""
    sampling: Any = scenario.sampling
    q, dq = state.q, state.dq
    zero, no = jnp.zeros_like(q), jnp.zeros(q.shape, bool)
    command, _ = jax.eval_shape(
        scenario.controller.command, zero[0], q, dq, zero, scenario.context, state.controller
    )
    slacks = (command.slack, command.region_slack)
    slack, region_slack = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), slacks)
    return SampledState(
        commands=jnp.repeat(tau[None], sampling.queue + 1, axis=0),
        sensor=scenario.sensor.init(q, dq, sampling.period),
        measured=Measurement(q, dq),
        signals=LawSignals(zero, zero, zero, no, no, slack, region_slack),
    )


def integrated_part(state: LoopState) -> LoopState:
    """The part of the state that the integrator advances.

    This is the whole state of a continuous loop. Of a sampled loop it is the plant and the
    actuator; law, observer and sensor change at samples only.
    """
    if state.sampled == ():
        return state
    return state._replace(controller=(), observer=(), sampled=())


def with_integrated_part(state: LoopState, part: LoopState) -> LoopState:
    """The state with its `integrated_part` replaced."""
    if state.sampled == ():
        return part
    return state._replace(q=part.q, dq=part.dq, actuator=part.actuator)


# --- continuous time: the rate of the state ------------------------------------------------------


def acceleration(
    scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array, tau: jax.Array
) -> jax.Array:
    """Acceleration of the plant under the torque `tau`, (n,) [rad/s^2]."""
    plant = at_time(scenario.plant, t)
    external = scenario.disturbance.torque(t, q, dq, plant, scenario.model)
    applied = tau + external + friction_torque(plant, dq)
    return solve_spd(plant.mass_matrix(q), applied - plant.coriolis(q, dq, dq) - plant.gravity(q))


def torque_needed(
    scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array, ddq: jax.Array
) -> jax.Array:
    """The torque for which the plant has the acceleration `ddq`, (n,) [N m]: the inverse of
    `acceleration`.
    """
    plant = at_time(scenario.plant, t)
    external = scenario.disturbance.torque(t, q, dq, plant, scenario.model)
    passive = external + friction_torque(plant, dq)
    inertial = matvec(plant.mass_matrix(q), ddq)
    return inertial + plant.coriolis(q, dq, dq) + plant.gravity(q) - passive


# jit, so that JAX traces it once for all of its call sites and `kernels` compiles one function
@jax.jit
def evaluate(
    scenario: Scenario,
    t: jax.Array,
    state: LoopState,
    dt: jax.Array | float = 0.0,
    torque: jax.Array | None = None,
) -> tuple[LoopState, Sample]:
    """The rate of the state and the sample at time t.

    Args:
      scenario: the scenario.
      t: time, () [s].
      state: state at t.
      dt: weight of the sample in an integral over time, () [s].
      torque: command at the actuator, (n,) [N m], where the law is sampled; the newest command if
        not given.
    """
    model, q, dq = scenario.model, state.q, state.dq
    controller_rate: Any = ()
    observer_rate: Any = ()
    if scenario.sampling is None:
        f_hat = scenario.observer.estimate(t, q, dq, model, state.observer)
        law, context = scenario.controller, scenario.context
        answer, controller_rate = law.command(t, q, dq, f_hat, context, state.controller)
        command, signals = answer.tau, law_signals(answer, f_hat)
    else:
        command = state.sampled.commands[0] if torque is None else torque
        signals = state.sampled.signals
    delivered = as_at(scenario.actuator, t).deliver(command, dq, state.actuator)
    ddq = acceleration(scenario, t, q, dq, delivered.tau)
    if scenario.sampling is None:
        observer_rate = scenario.observer.derivative(t, q, dq, command, model, state.observer)
    rate = LoopState(dq, ddq, controller_rate, observer_rate, delivered.rate)
    sample = sample_at(scenario, t, dt, q, dq, ddq, delivered.tau, delivered.limited, signals)
    return rate, sample


def rate(scenario: Scenario, t: jax.Array, state: LoopState) -> LoopState:
    """The rate of the state at time t: the vector field of the closed loop."""
    return evaluate(scenario, t, state)[0]


def sample_at(
    scenario: Scenario,
    t: jax.Array,
    dt: jax.Array | float,
    q: jax.Array,
    dq: jax.Array,
    ddq: jax.Array,
    tau: jax.Array,
    limited: jax.Array,
    signals: LawSignals,
) -> Sample:
    """The sample at time t of a loop with a given motion, torque and signals of the law.

    Args:
      scenario: its reference, bounds and model are used.
      t: time, () [s].
      dt: weight of the sample in an integral over time, () [s].
      q, dq, ddq: motion, (n,) each.
      tau: torque on the joints, (n,) [N m].
      limited: whether the actuator delivered less than the command, (n,) bool.
      signals: of the law.
    """
    model, tube = scenario.model, scenario.context.tube(t)
    M0, G0 = model.mass_matrix(q), model.gravity(q)
    f = matvec(M0, ddq) + model.coriolis(q, dq, dq) + G0 - tau
    e2, f_tilde = dq - signals.alpha, f - signals.f_hat
    if law_member(unwrapped(scenario.controller), "includes_e2"):
        V = jnp.sum(signals.V1) + 0.5 * inner(f_tilde, f_tilde)
    else:
        V = jnp.sum(signals.V1) + 0.5 * (inner(e2, matvec(M0, e2)) + inner(f_tilde, f_tilde))
    optional: dict[str, Any] = {}
    if scenario.velocity_bounds is not None:
        optional["dq_lower"], optional["dq_upper"] = scenario.context.speed_limits(t)
    if scenario.regions:
        optional["region_margin"] = margins(scenario.regions, scenario.plant, q)
    return Sample(
        t=t,
        dt=jnp.asarray(dt, t.dtype),
        step=jnp.zeros_like(t),
        q=q,
        dq=dq,
        tau=tau,
        e1=q - tube.q_d,
        e2=e2,
        xi=tube.xi(q),
        q_d=tube.q_d,
        dq_d=tube.dq_d,
        lower=tube.lower,
        upper=tube.upper,
        alpha=signals.alpha,
        gravity=G0,
        disturbance=f,
        disturbance_estimate=signals.f_hat,
        V=V,
        guard_active=signals.guard_active,
        saturated=signals.saturated | limited,
        slack=signals.slack,
        region_slack=signals.region_slack,
        **optional,
    )


# --- discrete time: a sampled law ----------------------------------------------------------------


class LawUpdate(NamedTuple):
    """Result of one run of a sampled law and its observer."""

    command: Command
    f_hat: jax.Array
    controller: Any
    """State of the law at the next sample."""
    observer: Any
    """State of the observer at the next sample."""


def discrete_observer(scenario: Scenario) -> Any:
    """The observer as the loop runs it.

    For `Sampling(observer="poles")` it is the observer whose Euler step has the poles that the
    continuous observer has over a period.
    """
    sampling, observer = scenario.sampling, scenario.observer
    if sampling is None or sampling.observer != "poles":
        return observer
    at_period = observer_member(observer, "at_period")
    if at_period is None:
        return observer
    return at_period(sampling.period)


def law_update(
    scenario: Scenario, t: jax.Array, measured: Measurement, controller: Any, observer: Any
) -> LawUpdate:
    """Command and next states of law and observer for one measurement: the program that runs on
    the robot's computer.

    Args:
      scenario: with a sampling.
      t: start of the period, () [s].
      measured: measurement at t.
      controller, observer: their states at t.
    """
    sampling: Any = scenario.sampling
    q, dq = measured.q, measured.dq
    running = discrete_observer(scenario)
    f_hat = running.estimate(t, q, dq, scenario.model, observer)
    command, controller_rate = scenario.controller.command(
        t, q, dq, f_hat, scenario.context, controller
    )
    arguments = (t, q, dq, command.tau, scenario.model, observer)
    next_observer = _next_observer_state(sampling, running, arguments)
    next_controller = _euler(controller, controller_rate, sampling.period)
    return LawUpdate(command, f_hat, next_controller, next_observer)


def _next_observer_state(sampling: Any, observer: Any, arguments: tuple) -> Any:
    """The observer's state one period later; `arguments` are those of `Observer.derivative`."""
    advance = observer_member(observer, "advance")
    if sampling.observer == "exact" and advance is not None:
        return advance(*arguments, sampling.period)
    return _euler(arguments[-1], observer.derivative(*arguments), sampling.period)


def _euler(state: Any, rate: Any, period: jax.Array) -> Any:
    """One step of Euler's method on a pytree."""
    return jax.tree.map(lambda x, dx: x + period * dx, state, rate)


@jax.jit
def run_sampled_law(
    scenario: Scenario, t: jax.Array, state: LoopState, normal: jax.Array
) -> LoopState:
    """The state after one run of sensor, law and observer.

    Args:
      scenario: with a sampling.
      t: start of the period, () [s].
      state: at t.
      normal: standard normal numbers for the sensor, (draws, n).
    """
    before, sampling = state.sampled, scenario.sampling
    assert sampling is not None
    measured, sensor = scenario.sensor.measure(
        state.q, state.dq, normal, sampling.period, before.sensor
    )
    update = law_update(scenario, t, measured, state.controller, state.observer)
    commands = jnp.concatenate([update.command.tau[None], before.commands[:-1]])
    signals = law_signals(update.command, update.f_hat)
    return state._replace(
        controller=update.controller,
        observer=update.observer,
        sampled=SampledState(commands, sensor, measured, signals),
    )


def run_sampled_law_if_due(
    scenario: Scenario, t: jax.Array, state: LoopState, now: Instant, noise: jax.Array
) -> LoopState:
    """The state after `run_sampled_law` if the instant is the start of a period, else the state."""
    normal = normals(noise, now.sample, scenario.sensor.draws, scenario.n).astype(state.q.dtype)
    return jax.lax.cond(
        now.phase == 0,
        lambda state: run_sampled_law(scenario, t, state, normal),
        lambda state: state,
        state,
    )


# --- variables of the linearisation --------------------------------------------------------------


class PerturbedState(NamedTuple):
    """The variables of a sampled loop that `stability` perturbs to linearise it."""

    plant: LoopState
    """The `integrated_part`."""
    torque: jax.Array
    """The newest command, (n,) [N m]."""
    memory: Any
    """States of law, observer and sensor."""


def perturbed_state(state: LoopState) -> Any:
    """The variables by which the loop is linearised: its state, or the `PerturbedState` of a
    sampled loop.
    """
    if state.sampled == ():
        return state
    memory = (state.controller, state.observer, state.sampled.sensor)
    return PerturbedState(integrated_part(state), state.sampled.commands[0], memory)


def perturbed_rate(
    scenario: Scenario,
    t: jax.Array,
    perturbed: Any,
    dt: jax.Array | None = None,
    compiled: Callable = lambda function: function,
) -> Any:
    """The function whose derivative linearises the loop.

    For a continuous loop it is the rate of the state. For a sampled loop it is the rate of the
    plant, the next command, and the next states of law, observer and sensor. Rounding of a sensor
    and limits of an actuator are left out (`Sensor.unrounded`, `Actuator.unlimited`), because their
    derivatives vanish and would show an open loop.

    Args:
      scenario: the scenario.
      t: time, () [s].
      perturbed: a `perturbed_state` at t.
      dt: of the step, () [s]. The result does not depend on it; a caller that passes the same
        arguments to `evaluate` elsewhere shares the traced function.
      compiled: wrapper of functions that are compiled on their own.
    """
    if not isinstance(perturbed, PerturbedState):
        arguments = [scenario, t, perturbed]
        if dt is not None:
            arguments.append(dt)
        return compiled(evaluate)(*arguments)[0]
    scenario = dataclasses.replace(
        scenario, sensor=unrounded(scenario.sensor), actuator=unlimited(scenario.actuator)
    )
    controller, observer, sensor = perturbed.memory
    state = with_integrated_part(initial_state(scenario), perturbed.plant)
    state = state._replace(
        controller=controller, observer=observer, sampled=state.sampled._replace(sensor=sensor)
    )
    normal = jnp.zeros((scenario.sensor.draws, scenario.n), t.dtype)
    after = compiled(run_sampled_law)(scenario, t, state, normal)
    weight = 0.0 if dt is None else dt
    plant_rate = compiled(evaluate)(scenario, t, state, weight, perturbed.torque)[0]
    memory = (after.controller, after.observer, after.sampled.sensor)
    return PerturbedState(plant_rate, after.sampled.commands[0], memory)
