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
from claim_terms import terms_at

import iblf_jax as ij
from iblf_jax import barriers, controllers
from iblf_jax.simulation.closed_loop import LoopState, rate

PAPER = ij.presets.zhang_yan_2024(variant="corrected")
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
        bounds=preset.bounds[0],
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
        lambda: network(adapting(PAPER.controller)),
        arm_program,
        ("controller.Gamma", "controller.sigma", "plant.mass", "model.mass", "plant.payload"),
    ),
    "parameters of order 3": (
        pendulum,
        pendulum_program,
        ("controller.Gamma", "plant.H", "plant.Km", "model.H", "controller.k"),
    ),
    "fuzzy system": (
        lambda: network(
            controllers.AdaptiveRBF(k1=2.0, K2=20.0, nodes=5, Gamma=30.0, normalised=True)
        ),
        partial(network_program, independent.Fuzzy),
        ("controller.Gamma", "controller.sigma", "plant.mass", "controller.K2"),
    ),
    "hidden layer": (
        lambda: network(controllers.AdaptiveNetwork(k1=2.0, K2=20.0, nodes=3)),
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
    others = rng.normal(size=(POINTS, *start.x.shape))[:, 1:]
    x = jnp.concatenate([q[:, None], others], axis=1)

    def perturbed(x):
        return jnp.asarray(x + 0.3 * rng.normal(size=(POINTS, *x.shape)))

    memory = jax.tree.map(perturbed, start.controller)
    return jnp.asarray(t), LoopState(x, memory, ())


def flat(state, i=None):
    parts = [state.x, *jax.tree.leaves(state.controller)]
    taken = [x if i is None else x[i] for x in parts]
    return np.concatenate([np.ravel(x) for x in taken])


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_vector_field_is_that_of_an_independent_program(name, rng):
    make, program, paths = CASES[name]
    scenario = ij.simulation.scenario.canonical(make())
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
    make, program, _ = CASES[name]
    changed = {"parameters": {"plant.payload": 0.4}, "parameters of order 3": {"plant.H": 7.0}}
    scenario = ij.with_parameters(make(), changed.get(name, {}))
    run = ij.simulate(scenario, duration=1.0, dt=2.5e-4, record_every=4000)
    start = ij.simulation.closed_loop.initial_state(run.scenario)
    expected = independent.end(program(run.scenario), flat(start), 1.0)
    last = jax.tree.map(lambda x: x[-1], run.controller_state)
    found = np.concatenate([np.ravel(x) for x in [run.x[-1], *jax.tree.leaves(last)]])
    np.testing.assert_allclose(found, expected, atol=1e-7)


# ------------------------------------------------------------------------- the claim (R.3)


MAPPED = controllers.Backstepping(
    k1=2.0, K2=20.0, barrier=barriers.TransformedError(), variant="corrected"
)
ARM = dataclasses.replace(PAPER, observer=ij.observers.NoObserver(), controller=adapting(MAPPED))


def chain():
    """The pendulum with the disturbance of its preset."""
    disturbance = ij.presets.motor_driven_pendulum().disturbance
    return dataclasses.replace(pendulum(), disturbance=disturbance)


@ij.component
class PassOn(controllers.Law):
    """A law of x that commands what the law that it wraps commands."""

    law: controllers.TrackingLaw
    wraps = "law"

    def init(self, x, context):
        return controllers.law_of_x(self.law).init(x, context)

    def command(self, t, x, d_hat, context, state):
        return controllers.law_of_x(self.law).command(t, x, d_hat, context, state)

    def energy(self, t, x, context):
        return controllers.law_of_x(self.law).energy(t, x, context)

    def energy_decay(self, t, x, context):
        return controllers.law_of_x(self.law).energy_decay(t, x, context)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "paths"),
    [
        (
            lambda: dataclasses.replace(ARM, controller=adapting(PassOn(ARM.controller.law))),
            ("plant.mass", "plant.payload", "model.mass"),
        ),
        (chain, ("plant.H", "plant.Km", "model.H")),
    ],
    ids=["law of x around one of robots", "order 3"],
)
def test_the_rate_of_the_lyapunov_function_is_what_is_claimed(make, paths, rng):
    scenario = ij.simulation.scenario.canonical(make())
    values = random_numbers(scenario, paths, rng)
    # Half of the points without a leak, where the claim is an equality.
    values["controller.sigma"] = np.where(np.arange(POINTS) % 2, 0.3, 0.0)
    t, states = random_states(scenario, rng)

    @jax.jit
    @jax.vmap
    def terms_of(values, t, state):
        return terms_at(ij.with_parameters(scenario, values), t, state).claims["own"]

    found = terms_of(values, t, states)
    excess = found.dV + found.dissipation - found.disturbance_terms
    assert np.all(excess <= 1e-12 * found.size)
    assert np.all(found.V > 0)
    # The projection makes it an inequality where it acts.
    box, theta = scenario.controller, np.asarray(states.controller.theta)
    inner = (theta > box.lower + box.band) & (theta < box.upper - box.band)
    exact = np.all(inner, axis=1) & (values["controller.sigma"] == 0.0)
    assert np.count_nonzero(exact) >= 3
    assert np.all(np.abs(excess[exact]) <= 1e-12 * found.size[exact])


# ------------------------------------------------------------------------- limits of the rates


@pytest.mark.slow
def test_without_an_error_the_law_is_the_wrapped_one_and_nothing_adapts():
    scenario = ARM
    law, context, q = scenario.controller, scenario.context, scenario.initial.q
    t = jnp.asarray(0.4)
    alpha = MAPPED.command(t, q, q, jnp.zeros(2), context, ())[0].alpha
    x = jnp.stack([q, alpha])
    state = law.init(x, context)
    command, rates = law.command(t, x, jnp.ones(2), context, state)
    expected, _ = MAPPED.command(t, q, alpha, jnp.zeros(2), context, ())
    np.testing.assert_array_equal(command.tau, expected.tau)
    leak_free = dataclasses.replace(law, sigma=0.0)
    _, rates = leak_free.command(t, x, jnp.ones(2), context, state)
    np.testing.assert_array_equal(rates.theta, 0.0)


@pytest.mark.slow
def test_one_rule_is_the_integral_of_the_velocity_error_with_a_leak(rng):
    law = controllers.AdaptiveRBF(k1=2.0, K2=20.0, nodes=1, normalised=True, Gamma=3.0, sigma=0.1)
    scenario = network(law)
    W = jnp.asarray(rng.normal(size=(1, 2)))
    q, dq = scenario.initial.q, jnp.array([0.3, -0.2])
    command, dW = law.command(jnp.asarray(0.3), q, dq, dq, scenario.context, W)
    e2 = dq - command.alpha
    np.testing.assert_allclose(dW, -3.0 * (e2 + 0.1 * W), rtol=1e-14)


def test_a_fuzzy_system_is_a_mean_of_its_rules_far_from_all_of_them():
    law = controllers.AdaptiveRBF(k1=2.0, K2=20.0, nodes=8, normalised=True, width=0.01)
    far = jnp.full(2, 40.0)
    for kind in (jnp.float32, jnp.float64):
        small = jax.tree.map(lambda x, kind=kind: x.astype(kind), law)
        S = small.basis(*[far.astype(kind)] * 4)
        assert float(jnp.sum(S)) == pytest.approx(1.0, rel=1e-6)


# ------------------------------------------------------------------------- what is refused


SETTLING = controllers.Backstepping(
    k1=2.0, K2=20.0, variant="corrected", decays=ij.decays.FiniteTime(k_a=1.0)
)
REFUSED = [
    ({"parameters": ("length[0]",)}, "affine"),
    ({"parameters": ("mass[2]",)}, "the path of a number"),
    ({"parameters": ("mass",)}, "one number, such as mass\\[0\\]"),
    ({"parameters": ("mass[0]",), "lower": 2.5}, "between 2.5 and 4"),
    ({"law": controllers.BarrierBackstepping(k=(2.0, 20.0))}, "last level"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_parameters_without_a_proof_are_refused(changes, message):
    numbers = {"law": MAPPED, "parameters": ("payload",), "Gamma": 1.0, "lower": -1.0, "upper": 4.0}
    law = controllers.AdaptiveParameters(**(numbers | changes))
    with pytest.raises(ValueError, match=message):
        ij.simulation.scenario.canonical(dataclasses.replace(ARM, controller=law))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"law": PAPER.controller, "upper": -2.0}, "more than lower"),
        ({"law": ij.presets.zhang_yan_2024().controller}, "corrected"),
        ({"law": controllers.PDGravity(Kp=60.0, Kd=20.0)}, "energy"),
        ({"law": SETTLING}, r"decays\[1\]: got 'FiniteTime', expected Exponential"),
        ({"law": controllers.BarrierBackstepping(k=(2.0, 20.0), filter=[0.1])}, "derivatives"),
        ({"Gamma": [1.0, 2.0]}, "one for each parameter"),
        ({"parameters": ("payload", "payload")}, "different paths"),
        ({"parameters": ()}, "a tuple of paths"),
        ({"band": 4.0}, "less than half"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(changes, message):
    numbers = {"law": MAPPED, "parameters": ("payload",), "Gamma": 1.0, "lower": -1.0, "upper": 4.0}
    with pytest.raises(ValueError, match=message):
        controllers.AdaptiveParameters(**(numbers | changes))


# ------------------------------------------------------------------------- the rest of the package


def test_units_of_the_adaptation_are_those_of_the_parameters():
    units = {p.path: p.unit for p in ij.parameters(pendulum())}
    assert units["controller.lower"] == "V/(N m), V s/rad"
    units = {p.path: p.unit for p in ij.parameters(ARM)}
    assert units["controller.Gamma"] == "kg^2/(N m rad)"


@pytest.mark.release
def test_operations_are_at_most_half_more_than_those_of_the_law_that_is_extended():
    def cost(scenario):
        return ij.explain(scenario, varied=["plant.mass[1]"])

    def operations(scenario):
        return sum(cost(scenario).counts["a step and run"].values())

    plain = operations(dataclasses.replace(UNDISTURBED, controller=PAPER.controller))
    two = controllers.AdaptiveParameters(
        law=PAPER.controller, parameters=NAMES[:2], Gamma=1.0, lower=-1.0, upper=4.0
    )
    assert operations(network(two)) < 1.5 * plain
    # Each parameter has a state of its own: beyond two, the limit is one of vector instructions.
    four = dataclasses.replace(two, parameters=(*NAMES, "inertia[1]"))
    assert cost(network(four)).slots < 1.5 * cost(UNDISTURBED).slots
    gaussian = operations(network(controllers.AdaptiveRBF(k1=2.0, K2=20.0)))
    fuzzy = controllers.AdaptiveRBF(k1=2.0, K2=20.0, normalised=True)
    assert operations(network(fuzzy)) < 1.1 * gaussian
    assert operations(network(controllers.AdaptiveNetwork(k1=2.0, K2=20.0))) < 0.6 * gaussian


@pytest.mark.release
def test_a_certificate_checks_the_claim_with_the_parameters_of_the_plant():
    loaded = ij.with_parameters(ARM, {"plant.payload": 0.4})
    certificate = ij.certify(loaded, duration=0.2, dt=1e-3)
    own = {line.name: line for line in certificate.lines if line.equation == "own"}
    assert {line.verdict for line in own.values()} == {"holds"}
    assert certificate.heading.startswith("AdaptiveParameters of 3, Backstepping")
    theorem = next(line for line in certificate.lines if line.name.startswith("K2"))
    assert "AdaptiveParameters changes it" in theorem.note


@pytest.mark.slow
def test_a_figure_shows_the_parameters_with_their_names_and_units():
    loaded = ij.with_parameters(ARM, {"plant.payload": 0.4})
    law = controllers.Saturated(loaded.controller, limit=15.0, auxiliary=5.0)
    limited = dataclasses.replace(loaded, controller=law)
    run = ij.simulate(loaded, duration=0.01, dt=1e-3)
    runs = {"free": run, "limited": ij.simulate(limited, duration=0.01, dt=1e-3)}
    figure = ij.plotting.adaptation(runs)
    labels = [axes.get_ylabel() for axes in figure.axes[::2]]
    assert labels == [f"{name}\n$\\hat\\theta$ [kg]" for name in NAMES]
    lines = {line.get_label(): line.get_ydata() for line in figure.axes[4].get_lines()}
    assert lines["value of the plant"][0] == 0.4
    np.testing.assert_allclose(lines["free"][-1], run.controller_state.theta[-1, 2])
    with pytest.raises(ValueError, match="a run of Backstepping"):
        ij.plotting.adaptation(ij.simulate(UNDISTURBED, duration=0.01, dt=1e-3))
