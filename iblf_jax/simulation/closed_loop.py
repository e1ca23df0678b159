"""The closed loop: the one place where plant, sensor, law, observer and actuator meet.

    state  x = (q, q', state of the law, state of the observer, state of the actuator)
    q" = M^-1 (tau + disturbance + friction - C q' - G)                 with the plant's M, C, G,
    friction at time t f  = M0 q" + C0 q' + G0 - tau                                       what the
    observer should have estimated      (2.1) V2 = sum V1 + 1/2 e2^T M0 e2 + 1/2 f_tilde^T f_tilde,
    without the second term where V1 `includes_e2`             (3.12)

`evaluate` gives the rate of the state and everything that can be looked at; where only the rate is
used (the inner stages of an integrator) the compiler drops the rest.

Where the law is sampled (`Sampling`), `sampled` runs sensor, law and observer at the start of a
period, and the rate is that of what moves between: q, q' and the actuator.  Then alpha, V1 and
  f_hat of a sample are what the law said last.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators import Ideal
from iblf_jax.control.controllers import Command
from iblf_jax.control.sensors import Measurement
from iblf_jax.core.linalg import inner, matvec, solve_spd
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.time import as_at
from iblf_jax.simulation.sampling import Instant, normals
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample
from iblf_jax.world.regions import margins
from iblf_jax.world.robots import at_time, friction_torque


class LawSignals(NamedTuple):
    """What a law says at an instant, besides its torque."""

    alpha: jax.Array
    V1: jax.Array
    f_hat: jax.Array
    guard_active: jax.Array
    saturated: jax.Array
    slack: Any = ()
    region_slack: Any = ()


def law_signals(command: Command, f_hat: jax.Array) -> LawSignals:
    """What a command says besides its torque."""
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
    """What a sampled loop keeps from sample to sample, besides the states of law and observer."""

    commands: jax.Array
    """Newest first, (queue + 1, n) [N m]."""
    sensor: Any
    """State of the sensor."""
    measured: Measurement
    """What the sensor told last."""
    said: LawSignals


class LoopState(NamedTuple):
    """The state of the loop; also the form of its rate."""

    q: jax.Array
    dq: jax.Array
    controller: Any
    observer: Any
    actuator: Any = ()
    held: Any = ()
    """A `SampledState` where the law is sampled."""


@partial(jax.jit, inline=True)  # so that it is traced once for all the places that ask for it
def initial_state(scenario: Scenario) -> LoopState:
    """The state at t = 0; torques that are under way then are those that hold the model still."""
    q, dq, n = scenario.initial.q, scenario.initial.dq, scenario.n
    state = LoopState(
        q,
        dq,
        scenario.controller.init(q, dq, scenario.context),
        stepping_observer(scenario).init(q, dq, scenario.model),
    )
    if scenario.sampling is None and isinstance(scenario.actuator, Ideal):
        return state
    still = scenario.model.gravity(q)
    state = state._replace(actuator=scenario.actuator.init(still))
    if scenario.sampling is None:
        return state
    zero, no = jnp.zeros_like(q), jnp.zeros((n,), bool)
    command = jax.eval_shape(
        scenario.controller.command, zero[0], q, dq, zero, scenario.context, state.controller
    )[0]
    slack, region_slack = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), (command.slack, command.region_slack)
    )
    commands = jnp.repeat(still[None], scenario.sampling.queue + 1, axis=0)
    sensor = scenario.sensor.init(q, dq, scenario.sampling.period)
    return state._replace(
        held=SampledState(
            commands,
            sensor,
            Measurement(q, dq),
            LawSignals(zero, zero, zero, no, no, slack, region_slack),
        )
    )


def moving(state: LoopState) -> LoopState:
    """What an integrator moves: all of the state, or what is not held between samples."""
    return state if state.held == () else state._replace(controller=(), observer=(), held=())


def still(state: LoopState, moved: LoopState) -> LoopState:
    """The state, with what has moved."""
    return (
        moved
        if state.held == ()
        else state._replace(q=moved.q, dq=moved.dq, actuator=moved.actuator)
    )


@jax.jit
def sampled(scenario: Scenario, t: jax.Array, state: LoopState, normal: jax.Array) -> LoopState:
    """The state after sensor, law and observer have run.

    Args:
      scenario: with a sampling.
      t: start of the period, () [s].
      state: at t.
      normal: what the sensor draws, (draws, n).
    """
    held = state.held
    assert scenario.sampling is not None
    measured, sensor = scenario.sensor.measure(
        state.q, state.dq, normal, scenario.sampling.period, held.sensor
    )
    answer = answered(scenario, t, measured, state.controller, state.observer)
    commands = jnp.concatenate([answer.command.tau[None], held.commands[:-1]])
    return state._replace(
        controller=answer.controller,
        observer=answer.observer,
        held=SampledState(commands, sensor, measured, law_signals(answer.command, answer.f_hat)),
    )


class Answer(NamedTuple):
    """What a sampled law and its observer make of a measurement."""

    command: Command
    f_hat: jax.Array
    controller: Any
    """State of the law at the next sample."""
    observer: Any
    """State of the observer there."""


def answered(
    scenario: Scenario, t: jax.Array, measured: Measurement, controller: Any, observer: Any
) -> Answer:
    """What law and observer make of what was measured at the start of a period: this is what runs
    on a robot's computer.

    Args:
      scenario: with a sampling.
      t: start of the period, () [s].
      measured: there.
      controller, observer: states there.
    """
    sampling: Any = scenario.sampling
    q, dq, stepping = measured.q, measured.dq, stepping_observer(scenario)
    f_hat = stepping.estimate(t, q, dq, scenario.model, observer)
    command, rate = scenario.controller.command(t, q, dq, f_hat, scenario.context, controller)
    after = _advanced(sampling, stepping, (t, q, dq, command.tau, scenario.model, observer))
    moved = jax.tree.map(lambda x, dx: x + sampling.period * dx, controller, rate)
    return Answer(command, f_hat, moved, after)


def stepping_observer(scenario: Scenario) -> Any:
    """The observer as it runs: in a sampled loop, the one whose step of Euler has the poles, where
    that is asked for.
    """
    sampling, observer = scenario.sampling, scenario.observer
    if sampling is not None and sampling.observer == "poles" and hasattr(observer, "at_period"):
        return observer.at_period(sampling.period)
    return observer


def _advanced(sampling: Any, observer: Any, told: tuple) -> Any:
    """The observer's state at the start of the next period."""
    if sampling.observer == "exact" and hasattr(observer, "advance"):
        return observer.advance(*told, sampling.period)
    return jax.tree.map(
        lambda x, dx: x + sampling.period * dx, told[-1], observer.derivative(*told)
    )


def sampled_if_due(
    scenario: Scenario, t: jax.Array, state: LoopState, now: Instant, noise: jax.Array
) -> LoopState:
    """The state after an instant's sample, if it is the start of a period."""
    normal = normals(noise, now.sample, scenario.sensor.draws, scenario.n).astype(state.q.dtype)
    return jax.lax.cond(
        now.phase == 0,
        lambda state: sampled(scenario, t, state, normal),
        lambda state: state,
        state,
    )


class Surroundings(NamedTuple):
    """What may be moved a little in a sampled loop to see what it does: the plant, its torque, and
    what its law remembers.
    """

    plant: LoopState
    torque: jax.Array
    memory: Any


def surroundings(state: LoopState) -> Any:
    """What decides how a loop goes on: its state, or the `Surroundings` of a sampled one."""
    if state.held == ():
        return state
    return Surroundings(
        moving(state), state.held.commands[0], (state.controller, state.observer, state.held.sensor)
    )


def change(
    scenario: Scenario,
    t: jax.Array,
    around: Any,
    dt: jax.Array | None = None,
    piece: Callable = lambda function: function,
) -> Any:
    """How what `surroundings` gives changes: its rate, or of a sampled loop the plant's rate, the
    next command and what is remembered then.

    Rounding of a sensor (`unrounded`) and limits of an actuator (`unlimited`) are left out: their
    derivatives are 0, as without a law.

    Args:
      scenario: what runs.
      t: time, () [s].
      around: at t.
      dt: of the step, () [s]: nothing depends on it, but what is called alike is traced once.
      piece: what is made of a function that is compiled on its own.
    """
    if not isinstance(around, Surroundings):
        return piece(evaluate)(scenario, t, around, *(() if dt is None else (dt,)))[0]
    sensor, actuator = scenario.sensor, scenario.actuator
    sensor, actuator = (
        getattr(sensor, "unrounded", sensor),
        getattr(actuator, "unlimited", actuator),
    )
    scenario = dataclasses.replace(scenario, sensor=sensor, actuator=actuator)
    state = still(initial_state(scenario), around.plant)
    controller, observer, sensor = around.memory
    state = state._replace(
        controller=controller, observer=observer, held=state.held._replace(sensor=sensor)
    )
    after = piece(sampled)(
        scenario, t, state, jnp.zeros((scenario.sensor.draws, scenario.n), t.dtype)
    )
    rate = piece(evaluate)(scenario, t, state, 0.0 if dt is None else dt, around.torque)[0]
    return Surroundings(
        rate, after.held.commands[0], (after.controller, after.observer, after.held.sensor)
    )


def acceleration(
    scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array, tau: jax.Array
) -> jax.Array:
    """q" of the plant under a torque that acts, (n,) [rad/s^2]."""
    plant = at_time(scenario.plant, t)
    pushed = (
        tau
        + scenario.disturbance.torque(t, q, dq, plant, scenario.model)
        + friction_torque(plant, dq)
    )
    return solve_spd(plant.mass_matrix(q), pushed - plant.coriolis(q, dq, dq) - plant.gravity(q))


def torque_needed(
    scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array, ddq: jax.Array
) -> jax.Array:
    """The torque under which the plant moves like this, (n,) [N m]: the inverse of
    `acceleration`.
    """
    plant = at_time(scenario.plant, t)
    against = scenario.disturbance.torque(t, q, dq, plant, scenario.model) + friction_torque(
        plant, dq
    )
    return (
        matvec(plant.mass_matrix(q), ddq) + plant.coriolis(q, dq, dq) + plant.gravity(q) - against
    )


# so that it is traced once for all the places that call it, and `lowering` sees that they call one
# function
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
      scenario: what runs.
      t: time, () [s].
      state: state at t.
      dt: weight of the sample in an integral over time, () [s].
      torque: what arrives at the actuator, (n,) [N m], where the law is sampled; the last command
        if not given.
    """
    model, q, dq = scenario.model, state.q, state.dq
    if scenario.sampling is None:
        f_hat = scenario.observer.estimate(t, q, dq, model, state.observer)
        command, controller_rate = scenario.controller.command(
            t, q, dq, f_hat, scenario.context, state.controller
        )
        asked, said = command.tau, law_signals(command, f_hat)
    else:
        asked, said = state.held.commands[0] if torque is None else torque, state.held.said
    delivered = as_at(scenario.actuator, t).deliver(asked, dq, state.actuator)
    ddq = acceleration(scenario, t, q, dq, delivered.tau)
    rate = LoopState(dq, ddq, (), (), delivered.rate)
    if scenario.sampling is None:
        told = scenario.observer.derivative(t, q, dq, asked, model, state.observer)
        rate = rate._replace(controller=controller_rate, observer=told)
    return rate, observed(scenario, t, dt, q, dq, ddq, delivered.tau, delivered.limited, said)


def observed(
    scenario: Scenario,
    t: jax.Array,
    dt: jax.Array | float,
    q: jax.Array,
    dq: jax.Array,
    ddq: jax.Array,
    tau: jax.Array,
    limited: jax.Array,
    said: LawSignals,
) -> Sample:
    """The sample at time t of a loop whose robot moves like this, whatever moves it.

    Args:
      scenario: its reference, bounds and model are looked at.
      t: time, () [s].
      dt: weight of the sample in an integral over time, () [s].
      q, dq, ddq: motion, (n,) each.
      tau: torque that acts, (n,) [N m].
      limited: whether the actuator gave less than was asked, (n,) bool.
      said: what the law says.
    """
    model, tube = scenario.model, scenario.context.tube(t)
    M0, G0 = model.mass_matrix(q), model.gravity(q)
    f = matvec(M0, ddq) + model.coriolis(q, dq, dq) + G0 - tau
    e2, f_tilde = dq - said.alpha, f - said.f_hat
    if getattr(unwrapped(scenario.controller), "includes_e2", False):
        V = jnp.sum(said.V1) + 0.5 * inner(f_tilde, f_tilde)
    else:
        V = jnp.sum(said.V1) + 0.5 * (inner(e2, matvec(M0, e2)) + inner(f_tilde, f_tilde))
    limits = () if scenario.velocity_bounds is None else scenario.context.speed_limits(t)
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
        alpha=said.alpha,
        gravity=G0,
        disturbance=f,
        disturbance_estimate=said.f_hat,
        V=V,
        guard_active=said.guard_active,
        saturated=said.saturated | limited,
        slack=said.slack,
        region_slack=said.region_slack,
        region_margin=margins(scenario.regions, scenario.plant, q) if scenario.regions else (),
        **dict(zip(("dq_lower", "dq_upper"), limits, strict=False)),
    )


def rate(scenario: Scenario, t: jax.Array, state: LoopState) -> LoopState:
    """The rate of the state at time t: the vector field of the closed loop."""
    return evaluate(scenario, t, state)[0]
