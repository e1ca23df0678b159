"""Laws that adapt: parameters of the model, fuzzy systems and networks, against programs of their
own (`independent_adaptive`), and what theory says of their rates."""

from __future__ import annotations

import dataclasses
from functools import partial

import independent_adaptive as independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import barriers, controllers
from iblf_jax.certificates.level_terms import level_terms_at
from iblf_jax.certificates.proof_terms import terms_and_sample
from iblf_jax.simulation.closed_loop import LoopState, rate

PAPER = ij.presets.zhang_yan_2024(reading="corrected")
UNDISTURBED = dataclasses.replace(
    PAPER, observer=ij.observers.NoObserver(), disturbance=ij.disturbances.Nothing()
)
NAMES = ("mass[0]", "mass[1]", "payload")
POINTS = 20


def adapting(law, **changes):
    numbers = {"Gamma": [3.0, 2.0, 4.0], "lower": -0.5, "upper": [4.0, 2.0, 2.0], "sigma": 0.1}
    return controllers.AdaptiveParameters(law=law, parameters=NAMES, **(numbers | changes))


def pendulum(**changes):
    preset = ij.presets.motor_driven_pendulum()
    law = controllers.BarrierBackstepping(
        k=(2.0, 10.0, 30.0), barriers=(barriers.Quadratic(),), weights=(2.0, 0.5, 0.1)
    )
    numbers = {"Gamma": [3.0, 0.2], "lower": 0.0, "upper": [10.0, 2.0], "sigma": 0.01}
    adaptive = controllers.AdaptiveParameters(
        law=law, parameters=("H[0]", "Km[0]"), **(numbers | changes)
    )
    return dataclasses.replace(
        preset,
        controller=adaptive,
        observer=ij.observers.NoObserver(),
        disturbance=ij.disturbances.Nothing(),
        state_bounds=(),
    )


def network(law):
    return dataclasses.replace(UNDISTURBED, controller=law)


def numbers_of(law, names):
    return {name: np.asarray(vars(law)[name]) for name in names}


BOX = ("Gamma", "sigma", "lower", "upper", "band")


def arm_program(scenario):
    law = scenario.controller
    plant, model = scenario.plant, scenario.model
    return independent.AdaptiveArm(
        k1=np.asarray(law.law.k1),
        K2=np.asarray(law.law.K2),
        true=np.append(plant.mass, plant.payload),
        start=np.append(model.mass, model.payload),
        **numbers_of(law, BOX),
    )


def pendulum_program(scenario):
    law, plant, model = scenario.controller, scenario.plant, scenario.model
    known = {name: float(vars(plant)[name][0]) for name in ("D", "B", "N", "M", "H", "Km")}
    return independent.AdaptivePendulum(
        k=np.asarray(law.law.k)[:, 0],
        w=np.asarray(law.law.weights)[:, 0],
        start=np.array([model.H[0], model.Km[0]]),
        **known,
        **numbers_of(law, BOX),
    )


def network_program(kind, scenario):
    law, plant = scenario.controller, scenario.plant
    of_layers = {}
    if kind is independent.HiddenLayer:
        of_layers = {"Gamma_h": float(law.Gamma_h), "sigma_h": float(law.sigma_h)}
    return kind(
        nodes=law.nodes,
        mass=np.append(plant.mass, plant.payload),
        **numbers_of(law, ("k1", "K2", "Gamma", "sigma")),
        **of_layers,
    )


CASES = {
    "parameters": (
        dataclasses.replace(UNDISTURBED, controller=adapting(PAPER.controller)),
        arm_program,
        ("controller.Gamma", "controller.sigma", "plant.mass", "model.mass", "plant.payload"),
    ),
    "parameters of order 3": (
        pendulum(),
        pendulum_program,
        ("controller.Gamma", "plant.H", "plant.Km", "model.H", "controller.k"),
    ),
    "fuzzy system": (
        network(controllers.AdaptiveRBF(k1=2.0, K2=20.0, nodes=5, Gamma=30.0, normalised=True)),
        partial(network_program, independent.Fuzzy),
        ("controller.Gamma", "controller.sigma", "plant.mass", "controller.K2"),
    ),
    "hidden layer": (
        network(controllers.AdaptiveNetwork(k1=2.0, K2=20.0, nodes=3)),
        partial(network_program, independent.HiddenLayer),
        ("controller.Gamma", "controller.Gamma_h", "controller.sigma_h", "plant.mass"),
    ),
}


def random_numbers(scenario, paths, rng):
    """Values of some leaves, each within 30 % of it, for all points; up to 0.3 where it is 0."""
    values = {}
    for path in paths:
        nominal = np.asarray(ij.simulation.paths.get(scenario, path))
        spread = rng.uniform(0.7, 1.3, (POINTS, *nominal.shape))
        values[path] = np.where(nominal == 0.0, 0.5 * (spread - 0.7), nominal * spread)
    return values


def random_states(scenario, rng):
    """States of the plant inside the bounds, and random states of the law, for all points."""
    start = ij.simulation.closed_loop.initial_state(scenario)
    t = rng.uniform(0.0, 6.0, POINTS)
    tubes = jax.vmap(scenario.context.tube)(jnp.asarray(t))
    xi = rng.uniform(-0.8, 0.8, (POINTS, scenario.n))
    q = tubes.q_d + xi * jnp.minimum(tubes.k_l, tubes.k_u)
    dq = rng.normal(size=(POINTS, scenario.n))
    higher = ()
    if not isinstance(start.higher, tuple):
        higher = jnp.asarray(rng.normal(size=(POINTS, *start.higher.shape)))

    def perturbed(x):
        return jnp.asarray(x + 0.3 * rng.normal(size=(POINTS, *x.shape)))

    memory = jax.tree.map(perturbed, start.controller)
    return jnp.asarray(t), LoopState(q, jnp.asarray(dq), memory, (), (), (), higher)


def flat(state, i=None):
    parts = [state.q, state.dq, state.higher, *jax.tree.leaves(state.controller)]
    taken = [x if i is None else x[i] for x in parts if not isinstance(x, tuple)]
    return np.concatenate([np.ravel(x) for x in taken])


@pytest.mark.parametrize("name", CASES)
def test_the_vector_field_is_that_of_an_independent_program(name, rng):
    scenario, program, paths = CASES[name]
    scenario = ij.simulation.scenario.canonical(scenario)
    values = random_numbers(scenario, paths, rng)
    t, states = random_states(scenario, rng)

    @jax.jit
    @jax.vmap
    def field(values, t, state):
        return rate(ij.with_parameters(scenario, values), t, state)

    found = field(values, t, states)
    for i in range(POINTS):
        one = ij.with_parameters(scenario, {path: value[i] for path, value in values.items()})
        expected = program(one).rate(float(t[i]), flat(states, i))
        scale = np.max(np.abs(expected))
        np.testing.assert_allclose(flat(found, i), expected, rtol=1e-12, atol=1e-12 * scale)


@pytest.mark.release
@pytest.mark.parametrize("name", CASES)
def test_a_run_is_that_of_an_independent_program(name):
    scenario, program, _ = CASES[name]
    changed = {"parameters": {"plant.payload": 0.4}, "parameters of order 3": {"plant.H": 7.0}}
    scenario = ij.with_parameters(scenario, changed.get(name, {}))
    run = ij.simulate(scenario, duration=1.0, dt=2.5e-4, record_every=4000)
    start = ij.simulation.closed_loop.initial_state(run.scenario)
    expected = independent.end(program(run.scenario), flat(start), 1.0)
    last = jax.tree.map(lambda x: x[-1], run.controller_state)
    parts = [run.q[-1], run.dq[-1]]
    if run.scenario.plant.n == 1:
        parts.append(run.higher[-1])
    found = np.concatenate([np.ravel(x) for x in [*parts, *jax.tree.leaves(last)]])
    np.testing.assert_allclose(found, expected, atol=1e-7)


# ------------------------------------------------------------------------- the claim (A.3)


MAPPED = controllers.Backstepping(k1=2.0, K2=20.0, barrier=barriers.Mapping(), reading="corrected")
ARM = dataclasses.replace(PAPER, observer=ij.observers.NoObserver(), controller=adapting(MAPPED))
CHAIN = dataclasses.replace(pendulum(), disturbance=ij.presets.motor_driven_pendulum().disturbance)


def own_terms_of_arm(scenario, t, state):
    return terms_and_sample(scenario, t, state)[0]["own"]


def own_terms_of_chain(scenario, t, state):
    return level_terms_at(scenario, t, state).own


@pytest.mark.parametrize(
    ("scenario", "paths", "own_terms"),
    [
        (ARM, ("plant.mass", "plant.payload", "model.mass"), own_terms_of_arm),
        (CHAIN, ("plant.H", "plant.Km", "model.H"), own_terms_of_chain),
    ],
    ids=["arm", "order 3"],
)
def test_the_rate_of_the_lyapunov_function_is_what_is_claimed(scenario, paths, own_terms, rng):
    scenario = ij.simulation.scenario.canonical(scenario)
    values = random_numbers(scenario, paths, rng)
    # Half of the points without a leak, where the claim is an equality.
    values["controller.sigma"] = np.where(np.arange(POINTS) % 2, 0.3, 0.0)
    t, states = random_states(scenario, rng)

    @jax.jit
    @jax.vmap
    def terms_of(values, t, state):
        return own_terms(ij.with_parameters(scenario, values), t, state)

    found = terms_of(values, t, states)
    excess = found.dV + found.decay - found.disturbance_terms
    assert np.all(excess <= 1e-12 * found.size)
    assert np.all(found.V > 0)
    # The projection makes it an inequality where it acts.
    box, theta = scenario.controller, np.asarray(states.controller.theta)
    inner = (theta > box.lower + box.band) & (theta < box.upper - box.band)
    exact = np.all(inner, axis=1) & (values["controller.sigma"] == 0.0)
    assert np.count_nonzero(exact) >= 3
    assert np.all(np.abs(excess[exact]) <= 1e-12 * found.size[exact])
