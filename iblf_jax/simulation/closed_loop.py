"""The closed loop: the one place where plant, sensor, law, observer and actuator meet.

    state  x = (x_1 ... x_r), of a robot (q, q'), with the states of law, observer and actuator
    q" = M^-1 (tau + disturbance + friction - C q' - G)      M, C, G, friction of the plant at t
    f  = M0 q" + C0 q' + G0 - tau                            the uncertain term             (2.1)
    V2 = sum V1 + 1/2 e2^T M0 e2 + 1/2 f_tilde^T f_tilde                                   (3.12)

The equations are those of a robot; another plant has its own (`plants`). The second term of V2 is
left out for a law whose V1 `includes_e2`. `Scenario.loop` wraps every robot part once, so below
everything takes x, (r, n).

`evaluate` returns the rate of the state and a `Sample` of every signal. Where a caller uses the
rate only, as in the later stages of an integrator, the compiler removes the rest.

A law with a `Sampling` runs in discrete time. `run_sampled_law` runs sensor, law and observer once
at the start of a period. Within the period the integrator advances the plant and the actuator, and
the signals of the law (alphas, V1, estimate) keep the values of its last run.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators import Ideal
from iblf_jax.control.controllers import Command
from iblf_jax.control.observers import Observer
from iblf_jax.control.sensors import Measurement
from iblf_jax.control.sensors._base import measurement_of
from iblf_jax.core import checks
from iblf_jax.core.pytree import Absent, Pytree, is_absent, unwrapped
from iblf_jax.simulation.delays import initial_commands
from iblf_jax.simulation.levels import (
    EstimatedLevels,
    estimated_levels,
    has_speed_limits,
    motion,
    start_levels,
    steady_input,
    with_estimates,
)
from iblf_jax.simulation.noise import normals
from iblf_jax.simulation.sampling import Instant, SentCommand, nothing_sent
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample
from iblf_jax.world.bounds import Tube, bounds_at
from iblf_jax.world.regions import margins

# --- the state ---------------------------------------------------------------------------------


class LawSignals(NamedTuple):
    """Signals of a law at one instant, besides its command; (n,) unless noted."""

    alphas: jax.Array
    """Virtual controls of the levels from the second on, (k, n); of a law of robots the virtual
    velocity [rad/s] alone."""
    V1: jax.Array
    """Lyapunov function of the position error, joint by joint."""
    estimate: jax.Array
    """Estimate that the law received: f_hat, (n,) [N m], or d_hat, (r, n)."""
    guard_active: jax.Array
    saturated: jax.Array
    slack: jax.Array | Absent = ()
    region_slack: jax.Array | Absent = ()
    joint_torque: jax.Array | Absent = ()
    """The torque that a law of a robot commanded through another input, (n,) [N m]; `()` where the
    input is the torque."""
    estimated: EstimatedLevels | Absent = ()
    """`EstimatedLevels` under an observer that completes a measurement; `()` under others."""
    auxiliary: jax.Array | Absent = ()
    events: jax.Array | Absent = ()


def law_signals(
    output: Command,
    estimate: jax.Array,
    estimated: EstimatedLevels | Absent = (),
    sent: SentCommand | Absent = (),
) -> LawSignals:
    """The signals of a law with this output for an estimate; `estimated` are the levels that it
    received from an observer, and `sent` is the `SentCommand` of an event trigger, or `()`.
    """
    alphas = output.alpha[None]
    if not is_absent(output.alpha_higher):
        alphas = jnp.concatenate([alphas, output.alpha_higher])
    return LawSignals(
        alphas=alphas,
        V1=output.V1,
        estimate=estimate,
        guard_active=output.guard_active,
        saturated=output.saturated,
        slack=output.slack,
        region_slack=output.region_slack,
        joint_torque=() if is_absent(output.input) else output.tau,
        estimated=estimated,
        auxiliary=output.auxiliary,
        events=() if is_absent(sent) else sent.number,
    )


def plant_input(output: Command) -> jax.Array:
    """The input of the plant that a law commands, (n,): its torque, unless it has another input."""
    return output.tau if is_absent(output.input) else output.input


class SampledState(NamedTuple):
    """State of a sampled loop between samples, besides the states of law and observer."""

    commands: jax.Array
    """Commands in transit to the actuator, newest first, (queue + 1, n) [N m]."""
    sensor: Pytree
    """State of the sensor."""
    received: Measurement
    """What the law received at its last run: the measurement, with the observer's estimates of
    levels that are not measured."""
    signals: LawSignals
    """Signals of the law at its last run."""
    sent: SentCommand | Absent = ()
    """Of a loop with an event trigger."""


class LoopState(NamedTuple):
    """State of the closed loop, its rate, or its `integrated_part`, which has the structure of the
    rate.
    """

    x: jax.Array
    """State of the plant, (r, n): of a robot q and q'."""
    controller: Pytree
    observer: Pytree
    actuator: Pytree = ()
    sampled: Any = ()
    """A `SampledState` where the law is sampled."""
    delayed: Any = ()
    """Commands of the last steps, newest first, (history, stages, n) [N m], of the state of a
    continuous loop whose input has a delay; `()` without one."""
    command: Any = ()
    """Of the rate of such a loop the command of the law, (n,); of its integrated part the integral
    of it over the step."""

    @property
    def q(self) -> jax.Array:
        """Position level, (..., n)."""
        return self.x[..., 0, :]

    @property
    def dq(self) -> jax.Array:
        """Velocity level, (..., n)."""
        return self.x[..., 1, :]


# inline, so that JAX traces it once for all of its call sites
@partial(jax.jit, inline=True)
def initial_state(scenario: Scenario) -> LoopState:
    """The state at t = 0; an actuator starts with the torque that balances the model's gravity."""
    x, loop = start_levels(scenario), scenario.loop
    x_model = x[: loop.model.order]
    state = LoopState(
        x,
        loop.law.init(x_model, scenario.context),
        discrete_observer(scenario).init(x_model, loop.model),
    )
    if scenario.sampling is None and isinstance(scenario.actuator, Ideal):
        return state
    steady = steady_input(scenario, x[0])
    state = state._replace(actuator=scenario.actuator.init(steady))
    if scenario.sampling is None:
        return state._replace(delayed=initial_commands(scenario, steady))
    return state._replace(sampled=_initial_sampled_state(scenario, state, steady))


def _initial_sampled_state(scenario: Scenario, state: LoopState, steady: jax.Array) -> SampledState:
    """State of a sampled loop before its first sample: every command in transit is the steady
    input.
    """
    sampling = checks.given(scenario.sampling)
    loop, x = scenario.loop, state.x
    x_model, t = x[: loop.model.order], jnp.zeros_like(x[0, 0])
    law_estimate = jax.eval_shape(loop.observer.estimate, t, x_model, loop.model, state.observer)
    output, _ = jax.eval_shape(
        loop.law.command, t, x_model, law_estimate, scenario.context, state.controller
    )
    here = measurement_of(x)
    estimated = jax.eval_shape(
        partial(estimated_levels, scenario, loop.observer), t, here, here, x, state.observer
    )
    sent = () if sampling.trigger is None else nothing_sent(steady)
    signals = jax.eval_shape(law_signals, output, law_estimate, estimated, sent)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), signals)
    return SampledState(
        commands=jnp.repeat(steady[None], sampling.queue + 1, axis=0),
        sensor=loop.sensor.init(x, sampling.period),
        received=here,
        signals=blank,
        sent=sent,
    )


def has_delay(state: LoopState) -> bool:
    """Whether a state contains past commands, because the input has a delay."""
    return not is_absent(state.delayed)


def integrated_part(state: LoopState) -> LoopState:
    """The part of the state that the integrator advances.

    Of a continuous loop this is the whole state. Where the input has a delay, it has the integral
    of the command over the step and not the past commands. Of a sampled loop it is the plant and
    the actuator; law, observer and sensor change at samples only.
    """
    if has_delay(state):
        return state._replace(delayed=(), command=jnp.zeros_like(state.x[0]))
    if is_absent(state.sampled):
        return state
    return state._replace(controller=(), observer=(), sampled=())


def with_integrated_part(state: LoopState, part: LoopState) -> LoopState:
    """The state with its `integrated_part` replaced."""
    if is_absent(state.sampled):
        return part._replace(delayed=state.delayed, command=())
    return state._replace(x=part.x, actuator=part.actuator)


# --- continuous time: the rate of the state ------------------------------------------------------


# jit, so that JAX traces it once for all of its call sites and `kernels` compiles one function
@jax.jit
def evaluate(
    scenario: Scenario,
    t: jax.Array,
    state: LoopState,
    command: jax.Array | None = None,
) -> tuple[LoopState, Sample]:
    """The rate of the state and the sample at time t; the weight of the sample is 0.

    Args:
      scenario: the scenario.
      t: time, () [s].
      state: state at t.
      command: at the actuator, (n,) [N m], where the law is sampled or its command has a delay;
        the newest command of the law if not given.
    """
    x = state.x
    if scenario.sampling is None:
        law = continuous_law(scenario, t, state)
    else:
        law = _LawOutput(state.sampled.commands[0], state.sampled.signals)
    applied = law.input if command is None else command
    delivered = scenario.actuator.at(t).deliver(applied, x[1], state.actuator)
    x_rate = motion(scenario, t, x, delivered.tau)
    rate = LoopState(
        x_rate,
        controller=law.controller_rate,
        observer=law.observer_rate,
        actuator=delivered.rate,
        command=law.input if has_delay(state) else (),
    )
    sample = sample_at(scenario, t, x, x_rate, delivered.tau, delivered.limited, law.signals)
    return rate, sample


class _LawOutput(NamedTuple):
    """What the law gives at one instant."""

    input: jax.Array
    """Of the plant, (n,)."""
    signals: LawSignals
    controller_rate: Pytree = ()
    """Rate of the law's state; `()` for a sampled law."""
    observer_rate: Pytree = ()


def continuous_law(scenario: Scenario, t: jax.Array, state: LoopState) -> _LawOutput:
    """What the law gives for a measurement of the state that the observer completes."""
    loop, x = scenario.loop, state.x
    observer = loop.observer
    x_model = x[: loop.model.order]
    law_estimate = observer.estimate(t, x_model, loop.model, state.observer)
    measurement = measurement_of(x)
    received = with_estimates(scenario, observer, t, measurement, state.observer)
    output, controller_rate = loop.law.command(
        t, received.x[: loop.model.order], law_estimate, scenario.context, state.controller
    )
    estimated = estimated_levels(scenario, observer, t, measurement, received, x, state.observer)
    return _LawOutput(
        plant_input(output),
        law_signals(output, law_estimate, estimated),
        controller_rate,
        observer.derivative(t, x_model, output.tau, loop.model, state.observer),
    )


def rate(scenario: Scenario, t: jax.Array, state: LoopState) -> LoopState:
    """The rate of the state at time t: the vector field of the closed loop."""
    return evaluate(scenario, t, state)[0]


def with_process_noise(
    scenario: Scenario,
    t: jax.Array,
    state: LoopState,
    rate: LoopState,
    noise_rate: jax.Array | None,
) -> LoopState:
    """The rate of the state with sigma(t, x) dW/dt of (P.1) added.

    Args:
      scenario: its process noise acts on m levels.
      t: time, () [s].
      state: state at t; law and observer may be missing.
      rate: its rate without noise.
      noise_rate: dW/dt, (m, n) [1/s^0.5]; None for a plant without process noise.
    """
    if noise_rate is None:
        return rate
    noise = checks.given(scenario.process_noise)
    added = noise.diffusion(t, state.x) * noise_rate
    rows = list(rate.x)
    for row, level in zip(added, noise.levels, strict=True):
        rows[level - 1] = rows[level - 1] + row
    return rate._replace(x=jnp.stack(rows))


def sample_at(
    scenario: Scenario,
    t: jax.Array,
    x: jax.Array,
    x_rate: jax.Array,
    tau: jax.Array,
    limited: jax.Array,
    signals: LawSignals,
) -> Sample:
    """The sample at time t of a loop with a given motion, torque and signals of the law, without
    its weight.

    Args:
      scenario: its reference, bounds and model are used.
      t: time, () [s].
      x: state of the plant, (r, n).
      x_rate: x', (r, n).
      tau: input of the plant, (n,): of a robot the torque on the joints [N m].
      limited: whether the actuator delivered less than the command, (n,) bool.
      signals: of the law.
    """
    tube = scenario.context.tube(t)
    virtual = jnp.concatenate([tube.q_d[None], signals.alphas])
    terms = _uncertain_signals(scenario, t, x, x_rate, tau, signals)
    lower, upper = _bounds_of_levels(scenario, t, tube, x, signals)
    optional: dict[str, Any] = {}
    robot = scenario.loop.plant.robot
    if scenario.regions and robot is not None:
        optional["region_margin"] = margins(scenario.regions, robot, x[0])
    if not is_absent(signals.estimated):
        optional |= signals.estimated._asdict()
    return Sample(
        t=t,
        dt=jnp.zeros_like(t),
        step=jnp.zeros_like(t),
        x=x,
        tau=tau,
        e=x[: len(virtual)] - virtual,
        xi=tube.xi(x[0]),
        q_d=tube.q_d,
        dq_d=tube.dq_d,
        level_lower=lower,
        level_upper=upper,
        alpha=signals.alphas[0],
        gravity=terms.steady_input,
        disturbance=terms.disturbance,
        disturbance_estimate=terms.estimate,
        V=terms.V,
        guard_active=signals.guard_active,
        saturated=signals.saturated | limited,
        slack=signals.slack,
        region_slack=signals.region_slack,
        auxiliary=signals.auxiliary,
        events=signals.events,
        **optional,
    )


class _UncertainSignals(NamedTuple):
    """Signals of a sample that depend on the model's equation of motion."""

    steady_input: jax.Array
    disturbance: jax.Array
    estimate: jax.Array
    V: jax.Array


def _uncertain_signals(
    scenario: Scenario,
    t: jax.Array,
    x: jax.Array,
    x_rate: jax.Array,
    tau: jax.Array,
    signals: LawSignals,
) -> _UncertainSignals:
    """The uncertain term of the model, f of (2.1) or d of (S.1), and V: V2 of (3.12), or the law's
    sum w_i V_i.
    """
    model = scenario.loop.model
    x, x_rate = x[: model.order], x_rate[: model.order]
    steady = model.steady_input(x[0])
    if not is_absent(signals.joint_torque):
        # The plant has another input than the torque of the law.
        tau = signals.joint_torque
        steady = None
    if steady is None:
        steady = steady_input(scenario, x[0])
    found = model.uncertain(t, x, x_rate, tau)
    estimated = model.as_uncertain(x, signals.estimate)
    includes_e2 = unwrapped(scenario.controller).includes_e2
    e2 = None if includes_e2 else x[1] - signals.alphas[0]
    V = jnp.sum(signals.V1)
    added = model.energy_of_errors(x, e2, found - estimated)
    return _UncertainSignals(steady, found, estimated, V if added is None else V + added)


def _bounds_of_levels(
    scenario: Scenario, t: jax.Array, tube: Tube, x: jax.Array, signals: LawSignals
) -> tuple[jax.Array, jax.Array]:
    """Lower and upper bounds of the levels up to the last one that has some, (m, n) each.

    The bounds of the velocities of a robot may follow q_d'; those of the levels of another plant
    may follow the virtual control alpha_{i-1} of the law.
    """
    bounds_of_levels = [(tube.lower, tube.upper)]
    last = max(i for i, bounds in enumerate(scenario.bounds) if bounds is not None)
    centres = [*signals.alphas, *jnp.zeros_like(x[1 + len(signals.alphas) :])]
    infinite = jnp.full_like(x[0], jnp.inf)
    others = zip(scenario.bounds[1 : last + 1], centres, strict=False)
    for level, (bounds, centre) in enumerate(others, start=2):
        if bounds is None:
            bounds_of_levels.append((-infinite, infinite))
        elif level == 2 and has_speed_limits(scenario):
            bounds_of_levels.append(scenario.context.speed_limits(t))
        else:
            bounds_of_levels.append(bounds_at(bounds, t, centre))
    lower, upper = zip(*bounds_of_levels, strict=True)
    return jnp.stack(lower), jnp.stack(upper)


# --- discrete time: a sampled law ----------------------------------------------------------------


class LawUpdate(NamedTuple):
    """Result of one run of a sampled law and its observer."""

    received: Measurement
    """What the law received: the measurement, with the observer's estimates of levels that are not
    measured."""
    output: Command
    """That of the law; with an event trigger its torque and its input are those that were sent."""
    estimate: jax.Array
    """Estimate that the law received: f_hat, (n,) [N m], or d_hat, (r, n)."""
    controller: Pytree
    """State of the law at the next sample."""
    observer: Pytree
    """State of the observer at the next sample."""
    sent: SentCommand | Absent = ()
    """Of a loop with an event trigger."""


def discrete_observer(scenario: Scenario) -> Observer:
    """The observer as the loop runs it.

    For `Sampling(observer="poles")` it is the observer whose Euler step has the poles that the
    continuous observer has over a period.
    """
    sampling, observer = scenario.sampling, scenario.loop.observer
    if sampling is None or sampling.observer != "poles":
        return observer
    return observer.at_period(sampling.period)


def law_update(
    scenario: Scenario,
    t: jax.Array,
    measurement: Measurement,
    controller: Pytree,
    observer: Pytree,
    sent: SentCommand | Absent = (),
    applied: jax.Array | None = None,
) -> LawUpdate:
    """Command and next states of law and observer for one measurement: the program that runs on
    the robot's computer.

    Args:
      scenario: with a sampling.
      t: start of the period, () [s].
      measurement: at t.
      controller, observer: their states at t.
      sent: the `SentCommand` before t of a loop with an event trigger.
      applied: torque of the period that the observer receives, (n,) [N m]; that of the law if not
        given.
    """
    sampling = checks.given(scenario.sampling)
    running = discrete_observer(scenario)
    received = with_estimates(scenario, running, t, measurement, observer)
    loop = scenario.loop
    law, model = loop.law, loop.model
    x = received.x[: model.order]
    law_estimate = running.estimate(t, x, model, observer)
    output, controller_rate = law.command(t, x, law_estimate, scenario.context, controller)
    if sampling.trigger is not None:
        assert not is_absent(sent)
        sent = sampling.trigger.sent(plant_input(output), output.tau, sent)
        output = output._replace(tau=sent.torque)
        if not is_absent(output.input):
            output = output._replace(input=sent.input)
    torque = output.tau if applied is None else applied
    if sampling.observer == "exact" and running.advances:
        next_observer = running.advance(t, x, torque, model, observer, sampling.period)
    else:
        observer_rate = running.derivative(t, x, torque, model, observer)
        next_observer = _euler(observer, observer_rate, sampling.period)
    next_controller = _euler(controller, controller_rate, sampling.period)
    return LawUpdate(received, output, law_estimate, next_controller, next_observer, sent)


def _euler(state: Pytree, rate: Pytree, period: jax.Array) -> Pytree:
    """One step of Euler's method on a pytree."""
    return jax.tree.map(lambda x, dx: x + period * dx, state, rate)


@jax.jit
def run_sampled_law(
    scenario: Scenario,
    t: jax.Array,
    state: LoopState,
    normal: jax.Array,
    applied: jax.Array | None = None,
) -> LoopState:
    """The state after one run of sensor, law and observer.

    Args:
      scenario: with a sampling.
      t: start of the period, () [s].
      state: at t.
      normal: standard normal numbers for the sensor, (draws, n).
      applied: as in `law_update`.
    """
    before, sampling = state.sampled, checks.given(scenario.sampling)
    measurement, sensor = scenario.loop.sensor.measure(
        state.x, normal, sampling.period, before.sensor
    )
    parts = (state.controller, state.observer, before.sent)
    update = law_update(scenario, t, measurement, *parts, applied)
    commands = jnp.concatenate([plant_input(update.output)[None], before.commands[:-1]])
    estimated = estimated_levels(
        scenario,
        discrete_observer(scenario),
        t,
        measurement,
        update.received,
        state.x,
        state.observer,
    )
    signals = law_signals(update.output, update.estimate, estimated, update.sent)
    return state._replace(
        controller=update.controller,
        observer=update.observer,
        sampled=SampledState(commands, sensor, update.received, signals, update.sent),
    )


def run_sampled_law_if_due(
    scenario: Scenario, t: jax.Array, state: LoopState, now: Instant, noise_key: jax.Array
) -> LoopState:
    """The state after `run_sampled_law` if the instant is the start of a period, else the state."""
    normal = normals(noise_key, now.sampling_index, scenario.sensor.draws, scenario.n).astype(
        state.x.dtype
    )
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
    command: jax.Array
    """The newest one, (n,) [N m]."""
    memory: tuple[Pytree, Pytree, Pytree]
    """States of law, observer and sensor."""


def perturbed_state(state: LoopState) -> LoopState | PerturbedState:
    """The variables by which the loop is linearised: its state without past commands, or the
    `PerturbedState` of a sampled loop.
    """
    if is_absent(state.sampled):
        return state._replace(delayed=())
    memory = (state.controller, state.observer, state.sampled.sensor)
    return PerturbedState(integrated_part(state), state.sampled.commands[0], memory)


def perturbed_rate(
    scenario: Scenario,
    t: jax.Array,
    perturbed: LoopState | PerturbedState,
) -> LoopState | PerturbedState:
    """The function whose derivative linearises the loop.

    For a continuous loop it is the rate of the state. For a sampled loop it is the rate of the
    plant, the next command, and the next states of law, observer and sensor. Rounding of a sensor,
    limits of an actuator or of a law and an event trigger are left out (`Sensor.unrounded`,
    `Actuator.unlimited`, `TrackingLaw.unlimited`), because their derivatives vanish and would show
    an open loop; so are dead zone, play and rounding of an actuator in every loop
    (`Actuator.smooth`), and the delay of the input of a continuous loop.

    Args:
      scenario: the scenario.
      t: time, () [s].
      perturbed: a `perturbed_state` at t.
    """
    if not isinstance(perturbed, PerturbedState):
        actuator = scenario.actuator.smooth
        if actuator is not scenario.actuator:
            scenario = dataclasses.replace(scenario, actuator=actuator)
        return evaluate(scenario, t, perturbed)[0]
    sampling = checks.given(scenario.sampling)
    scenario = dataclasses.replace(
        scenario,
        sensor=scenario.sensor.unrounded,
        controller=scenario.controller.unlimited,
        actuator=scenario.actuator.unlimited.smooth,
        sampling=dataclasses.replace(sampling, trigger=None),
    )
    controller, observer, sensor = perturbed.memory
    state = with_integrated_part(initial_state(scenario), perturbed.plant)
    state = state._replace(
        controller=controller, observer=observer, sampled=state.sampled._replace(sensor=sensor)
    )
    normal = jnp.zeros((scenario.sensor.draws, scenario.n), t.dtype)
    after = run_sampled_law(scenario, t, state, normal)
    plant_rate = evaluate(scenario, t, state, perturbed.command)[0]
    memory = (after.controller, after.observer, after.sampled.sensor)
    return PerturbedState(plant_rate, after.sampled.commands[0], memory)
