"""The auxiliary state of a limited torque: independent programs, Lyapunov rate and limits."""

import dataclasses

import chain_cases
import independent_chains as chains
import independent_inputs as other
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from claim_terms import terms_at
from independent import Loop
from members import two_barriers

import iblf_jax as ij
from iblf_jax import controllers
from iblf_jax.control.controllers.saturated import AuxiliaryState
from iblf_jax.simulation.closed_loop import LoopState, evaluate, initial_state
from iblf_jax.simulation.scenario import canonical

PAPER = ij.presets.zhang_yan_2024(variant="corrected")
LIMIT = np.array([9.0, 3.0])
K = 6.0
LIMITED = ij.with_parts(
    PAPER, controller=controllers.Saturated(PAPER.controller, limit=LIMIT, auxiliary=K)
)
LAWS = {
    "two_barriers": two_barriers(),
    "dynamic_surface": controllers.DynamicSurface(k1=2.0, K2=20.0, filter=0.02),
    "adaptive_network": controllers.AdaptiveNetwork(k1=2.0, K2=20.0, nodes=4),
    "computed_torque": controllers.ComputedTorque(Kp=25.0, Kd=10.0),
}
"""Laws besides those of the independent programs; the last one does not take the shift."""


def with_numbers(scenario, limit, k, **gains):
    inner = dataclasses.replace(scenario.controller.law, **gains)
    law = controllers.Saturated(inner, limit=limit, auxiliary=k)
    return canonical(ij.with_parts(scenario, controller=law))


@pytest.mark.slow
def test_the_vector_field_of_an_arm_is_that_of_the_independent_program(rng):
    field = jax.jit(evaluate)
    for _ in range(40):
        numbers = {"k1": rng.uniform(1, 4, 2), "K2": rng.uniform(5, 30, 2)}
        kf, k, limit = rng.uniform(5, 30, 2), rng.uniform(1, 30), rng.uniform(1, 15, 2)
        t = rng.uniform(0, 10)
        scenario = with_numbers(LIMITED, limit, k, **numbers)
        scenario = ij.with_parameters(scenario, {"observer.kf": kf})
        tube = scenario.context.tube(jnp.asarray(t))
        q = tube.lower + rng.uniform(0.1, 0.9, 2) * (tube.upper - tube.lower)
        dq, eta, aux = rng.normal(size=(3, 2))
        state = LoopState(np.stack([q, dq]), AuxiliaryState((), aux), eta)
        rate, sample = field(scenario, t, jax.tree.map(jnp.asarray, state))
        loop = Loop(corrected=True, kf=kf, **numbers)
        y = np.concatenate([q, dq, eta, aux])
        expected, signals = other.limited_arm(loop, limit, k, t, y)
        found = [rate.q, rate.dq, rate.observer, rate.controller.auxiliary, sample.tau]
        size = np.max(np.abs(expected))
        expected = np.concatenate([expected, signals["tau"]])
        np.testing.assert_allclose(np.concatenate(found), expected, rtol=1e-12, atol=1e-12 * size)
        np.testing.assert_allclose(sample.V, signals["V"], rtol=1e-12)


@pytest.mark.slow
def test_the_input_of_a_chain_is_that_of_the_independent_program_and_V_has_its_rate(rng):
    """Of order 3 with coupled gains and bounds of all levels; the auxiliary state moves the last
    level."""
    case, chain = chains.CASES["coupled"], chain_cases.scenario("coupled")
    law = controllers.Saturated(chain.controller, limit=0.5, auxiliary=K)
    coupled = ij.with_parts(chain, controller=law)
    field, terms = jax.jit(evaluate), jax.jit(terms_at)
    states = chains.random_states(case, (0.0,) * case.order, [0.0] * case.order, count=20)
    nothing = [[0.0] * case.n] * case.order
    for t, x, _, _ in states:
        aux, limit, k = 0.1 * rng.normal(size=case.n), rng.uniform(0.1, 20), rng.uniform(1, 30)
        x = [*x[:-1], [a + b for a, b in zip(x[-1], aux, strict=True)]]
        scenario = with_numbers(coupled, limit, k)
        state = jax.tree.map(jnp.asarray, LoopState(np.asarray(x), AuxiliaryState((), aux), ()))
        rate, sample = field(scenario, t, state)
        _, applied, aux_rate, control = other.limited_chain(case, limit, k, t, x, nothing, aux)
        np.testing.assert_allclose(sample.tau, applied, rtol=1e-12, atol=1e-12)
        found, size = rate.controller.auxiliary, np.max(np.abs(aux_rate))
        np.testing.assert_allclose(found, aux_rate, rtol=1e-11, atol=1e-12 * size)
        np.testing.assert_allclose(sample.V, control.V, rtol=1e-11)
        proof = terms(scenario, jnp.asarray(t), state)
        claim = proof.claims["levels"]
        assert not proof.excluded
        left = proof.dV + claim.dissipation - claim.disturbance_gain
        np.testing.assert_allclose(left, 0.0, atol=1e-12 * proof.size)


@pytest.mark.slow
def test_a_certificate_covers_the_limited_torque():
    scenario = ij.with_parts(LIMITED, observer=ij.observers.Momentum(kf=20.0))
    run = ij.simulate(scenario, duration=1.5, dt=1e-3)
    line = ij.certify(scenario, run)["inequality, limited torque"]
    share = np.mean(np.abs(run.tau) >= LIMIT * (1.0 - 1e-12), axis=0)
    assert np.all(share > 0.004)
    np.testing.assert_allclose(run.metrics.saturated_share, share, atol=1e-3)
    assert line.verdict == "holds"
    largest = np.max(np.abs(run.auxiliary), axis=0)
    assert f"max |lambda| = {float(np.max(largest)):.4g}" in line.note
    np.testing.assert_array_equal(run.metrics.largest_auxiliary, largest)


def limited_by(limit, law):
    return controllers.Saturated(law, limit=limit, auxiliary=K)


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_without_a_reached_limit_it_is_the_law_without_it(name):
    speeds = ij.Bounds(ij.bounds.Constant(-9.0), ij.bounds.Constant(9.0))
    levels = PAPER.bounds[0], speeds if name == "two_barriers" else None
    scenario = canonical(ij.with_parts(PAPER, controller=LAWS[name], bounds=levels))
    limited = canonical(ij.with_parts(scenario, controller=limited_by(1e4, LAWS[name])))
    field, t = jax.jit(evaluate), jnp.asarray(0.0)
    rate, sample = field(scenario, t, initial_state(scenario))
    limited_rate, limited_sample = field(limited, t, initial_state(limited))
    np.testing.assert_allclose(limited_sample.tau, sample.tau, rtol=1e-13)
    np.testing.assert_array_equal(limited_rate.controller.auxiliary, 0.0)
    jax.tree.map(np.testing.assert_array_equal, rate.controller, limited_rate.controller.law)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [controllers.AdaptiveRBF, controllers.AdaptiveNetwork])
def test_the_command_of_a_network_with_an_auxiliary_state_needs_no_model(kind):
    network = kind(k1=2.0, K2=20.0, nodes=4)
    scenario = canonical(ij.with_parts(PAPER, controller=limited_by(1e4, network)))
    law, x = scenario.controller, jnp.array([[0.5, 0.6], [0.1, 0.2]])
    state = law.init(x, scenario.context)._replace(auxiliary=jnp.array([0.3, -0.2]))
    commands = []
    for mass in (1.0, 3.0):
        model = ij.with_parameters(scenario, {"model.mass": mass}).model
        context = scenario.context._replace(model=model)
        commands.append(law.command(jnp.asarray(0.0), x, jnp.zeros(2), context, state)[0])
    np.testing.assert_array_equal(commands[0].tau, commands[1].tau)
    np.testing.assert_array_equal(commands[0].input_slope, x[1] - commands[0].alpha)
