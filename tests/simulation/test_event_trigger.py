"""Event-triggered commands: against the independent program, and what a trigger must do."""

import dataclasses
from types import SimpleNamespace

import chain_cases
import independent_chains as chains
import independent_inputs as other
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refused import refused

import iblf_jax as ij
from iblf_jax import controllers
from iblf_jax.certificates import _certify
from iblf_jax.control.controllers.event_compensated import TANH_GAP, excess
from iblf_jax.simulation.closed_loop import initial_state, run_sampled_law
from iblf_jax.simulation.metrics import Events
from iblf_jax.simulation.scenario import canonical
from iblf_jax.testing.metrics import folded, samples

PERIOD = 4e-3
PAPER = ij.with_parts(ij.presets.zhang_yan_2024(variant="corrected"), sampling=ij.Sampling(1e-3))
TRIGGER = ij.EventTrigger(relative=0.1, absolute=[0.3, 0.1])
TRIGGERED = ij.with_parts(PAPER, sampling=ij.Sampling(1e-3, trigger=TRIGGER))


@pytest.mark.slow
@pytest.mark.parametrize(
    "compensated", [False, pytest.param(True, marks=pytest.mark.release)], ids=["plain", "smooth"]
)
def test_a_chain_of_order_three_is_that_of_the_independent_program(compensated):
    """The pendulum with a bound of its first level only: states, commands and events."""
    case = chains.CASES["pendulum"]
    case = dataclasses.replace(
        case,
        bounds=(case.bounds[0], None, None),
        barriers=(chains.mapping, chains.quadratic, chains.quadratic),
        k=((2.0,), (5.0,), (10.0,)),
    )
    law = controllers.BarrierBackstepping(k=case.k, c=case.c, weights=case.w)
    delta, m, options = 0.01, 0.002, {}
    if compensated:
        delta, m, m_bar, epsilon = 0.05, 0.02, 0.03, 0.5
        law = controllers.EventCompensated(law, relative=delta, absolute=m_bar, epsilon=epsilon)
        options["adjust"] = lambda z, v: other.compensated(z, v, delta, m_bar, epsilon)
    scenario = chain_cases.scenario(
        "pendulum",
        controller=law,
        bounds=chain_cases.bounds_of(case),
        disturbance=ij.disturbances.Nothing(),
        sampling=ij.Sampling(PERIOD, trigger=ij.EventTrigger(relative=delta, absolute=m)),
    )
    states, commands, sent = other.triggered_chain(case, PERIOD, delta, m, count=250, **options)
    run = ij.simulate(scenario, duration=PERIOD * len(commands), dt=5e-4, throw=True)
    every = round(PERIOD / 5e-4)
    np.testing.assert_allclose(run.x[::every], states, atol=1e-7)
    np.testing.assert_allclose(run.tau[:-1:every], commands, rtol=1e-6, atol=1e-6)
    number = np.asarray(run.events)[:-1:every]
    np.testing.assert_array_equal(np.flatnonzero(np.diff(number, prepend=0.0)), sent)
    between = other.intervals(sent, PERIOD)
    np.testing.assert_allclose(run.metrics.shortest_interval, min(between))
    if float(run.events[-1]) == len(sent):
        np.testing.assert_allclose(run.metrics.mean_interval, np.mean(between))
    assert 5 < len(sent) < 0.8 * len(commands)


@ij.component
class Given:
    v: ij.Leaf
    z: ij.Leaf

    def command(self, t, q, dq, f_hat, context, state):
        never = jnp.zeros_like(self.v, bool)
        return controllers.Command(self.v, q, q, never, never)._replace(input_slope=self.z), ()


def test_the_compensation_bounds_what_a_held_command_adds(rng):
    """(E.3) at random z, v and held commands within the threshold."""
    size = (20_000,)
    z, v = rng.normal(size=size) * 10.0 ** rng.uniform(-3, 1, size), rng.normal(size=size) * 5
    delta, m, epsilon = rng.uniform(0, 0.9, (3, *size))
    m_bar = m / (1 - delta) * rng.uniform(1.0, 2.0, size)
    law = controllers.EventCompensated(Given(v, z), delta, m_bar, epsilon)
    context = ij.presets.zhang_yan_2024().context
    u = np.asarray(law.command(0.0, jnp.zeros((2, 2)), jnp.zeros(2), context, ())[0].tau)
    np.testing.assert_allclose(u, other.compensated(z, v, delta, m_bar, epsilon), rtol=1e-12)
    a, b = rng.uniform(-1, 1, (2, *size))
    held = (u - b * m) / (1 + a * delta)
    # u = (1 + a delta) u_held + b m is within the threshold for all |a|, |b| <= 1.
    assert np.all(np.abs(u - held) <= delta * np.abs(held) + m + 1e-12)
    grows = z * held - z * v
    assert np.all(grows <= 2 * TANH_GAP * epsilon + 1e-12)
    np.testing.assert_allclose(excess(law), np.sum(2 * TANH_GAP * epsilon))
    assert np.max(grows / epsilon) > TANH_GAP


@ij.component
class Failing:
    law: controllers.TrackingLaw

    def init(self, *arguments):
        return self.law.init(*arguments)

    def command(self, t, *arguments):
        command, rate = self.law.command(t, *arguments)
        return command._replace(tau=jnp.where(t > 0.01, jnp.nan, command.tau)), rate


@pytest.mark.slow
def test_a_command_that_is_not_finite_is_not_held():
    """A run whose law computes NaN stops with a trigger as it does without one."""
    scenario = ij.with_parts(TRIGGERED, controller=Failing(TRIGGERED.controller))
    with pytest.warns(ij.SimulationWarning, match="ran away"):
        run = ij.simulate(scenario, duration=0.05, dt=1e-3)
    assert int(run.status) & int(ij.Status.NOT_FINITE)


@pytest.mark.slow
def test_commands_are_held_within_the_threshold():
    """Between events the torque is constant and near the law's, and the observer receives it."""
    run = ij.simulate(TRIGGERED, duration=0.3, dt=1e-3)
    number, tau = np.asarray(run.events), np.asarray(run.tau)
    sent = np.diff(number) > 0
    assert 0.05 < np.mean(sent) < 0.9
    np.testing.assert_array_equal(np.any(np.diff(tau, axis=0) != 0, axis=1), sent)
    free, step = canonical(PAPER), jax.jit(run_sampled_law)
    noise = jnp.zeros((free.sensor.draws, free.n))
    for k in np.flatnonzero(~sent)[:5] + 1:
        state = initial_state(free)._replace(x=run.x[k], observer=run.observer_state[k - 1])
        # The observer's state of a record is the one after its sample.
        wanted = np.asarray(step(free, run.t[k], state, noise).sampled.commands[0])
        threshold = 0.1 * np.abs(tau[k]) + [0.3, 0.1]
        assert np.all(np.abs(wanted - tau[k]) <= threshold)


@pytest.mark.slow
def test_the_derivative_of_a_held_command():
    """Between the instants of events a run is smooth in a gain."""

    def end(K2):
        scenario = ij.with_parameters(TRIGGERED, {"controller.K2": K2})
        return ij.simulate(scenario, duration=0.05, dt=1e-3).metrics.ise

    K2, move = jnp.array([20.0, 20.0]), jnp.array([1e-6, 0.0])
    differences = (end(K2 + move) - end(K2 - move)) / 2e-6
    np.testing.assert_allclose(jax.jacfwd(end)(K2)[:, 0], differences, rtol=1e-4, atol=1e-10)


def test_a_run_with_one_event_has_no_interval():
    first = jax.tree.map(lambda x: x[:1], samples(np.random.default_rng(0), 1))
    found = folded((Events(),), first)
    assert float(found["event_count"]) == 1.0
    assert np.isinf(found["mean_interval"]) and np.isinf(found["shortest_interval"])


def compensated_pd():
    """It has no Lyapunov function."""
    law = controllers.PDGravity(Kp=6.0, Kd=2.0)
    law = controllers.EventCompensated(law, relative=0.1, absolute=0.2, epsilon=0.5)
    ij.simulate(ij.with_parts(PAPER, controller=law), duration=0.1, dt=1e-3)


test_what_does_not_fit_is_refused = refused(
    (compensated_pd, "input_slope"),
    (lambda: ij.EventTrigger(relative=1.0), "EventTrigger.relative"),
    (lambda: ij.EventTrigger(absolute=-0.1), "EventTrigger.absolute"),
)


@pytest.mark.release
def test_a_certificate_states_what_held_commands_may_add():
    run = ij.simulate(TRIGGERED, duration=0.1, dt=1e-3)
    line = ij.certify(TRIGGERED, run)["event trigger"]
    threshold = 0.1 * np.abs(run.tau) + np.array([0.3, 0.1])
    np.testing.assert_allclose(line.value, np.max(np.sum(np.abs(run.e2) * threshold, axis=1)))


def test_a_certificate_says_nothing_of_held_commands_behind_a_lag():
    motor = ij.actuators.Motor(bandwidth=500.0)
    run = SimpleNamespace(scenario=ij.with_parts(TRIGGERED, actuator=motor))
    assert _certify._trigger_lines(run) == ()
