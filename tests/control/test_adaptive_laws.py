"""Laws that adapt, against `independent_adaptive`, and the rate of V that theory claims (R.3)."""

import dataclasses
from functools import partial

import independent_adaptive as independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from claim_terms import terms_at
from independent import Loop
from matplotlib.figure import Figure
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import barriers, controllers
from iblf_jax.simulation.closed_loop import LoopState, initial_state, rate
from iblf_jax.simulation.scenario import canonical

PAPER = ij.presets.zhang_yan_2024(variant="corrected")
UNDISTURBED = dataclasses.replace(
    PAPER, observer=ij.observers.NoObserver(), disturbance=ij.disturbances.Nothing()
)
NAMES = ("mass[0]", "mass[1]", "payload")
POINTS = 20


def adapting(law):
    numbers = {"Gamma": [3.0, 2.0, 4.0], "lower": -0.5, "upper": [4.0, 2.0, 2.0], "sigma": 0.1}
    return controllers.AdaptiveParameters(law=law, parameters=NAMES, **numbers)


def pendulum(**parts):
    preset = ij.presets.motor_driven_pendulum()
    law = controllers.BarrierBackstepping(
        k=(2.0, 10.0, 30.0), barriers=(barriers.Quadratic(),), weights=(2.0, 0.5, 0.1)
    )
    numbers = {"Gamma": [3.0, 0.2], "lower": 0.0, "upper": [10.0, 2.0], "sigma": 0.01}
    adaptive = controllers.AdaptiveParameters(law=law, parameters=("H[0]", "Km[0]"), **numbers)
    parts = {"observer": ij.observers.NoObserver(), "bounds": preset.bounds[0]} | parts
    return ij.with_parts(preset, controller=adaptive, **parts)


def undisturbed(law):
    return dataclasses.replace(UNDISTURBED, controller=law)


def numbers_of(law, names=("Gamma", "sigma", "lower", "upper", "band")):
    return {name: np.asarray(vars(law)[name]) for name in names}


def arm_program(scenario):
    law = scenario.controller
    plant, model = scenario.plant, scenario.model
    return independent.AdaptiveArm(
        loop=Loop(k1=np.asarray(law.law.k1), K2=np.asarray(law.law.K2)),
        true=np.append(plant.mass, plant.payload),
        start=np.append(model.mass, model.payload),
        **numbers_of(law),
    )


def pendulum_program(scenario):
    law, plant, model = scenario.controller, scenario.plant, scenario.model
    known = {name: float(vars(plant)[name][0]) for name in ("D", "B", "N", "M", "H", "Km")}
    return independent.AdaptivePendulum(
        k=np.asarray(law.law.k)[:, 0],
        w=np.asarray(law.law.weights)[:, 0],
        start=np.array([model.H[0], model.Km[0]]),
        **known,
        **numbers_of(law),
    )


def network_program(kind, names, scenario):
    law, plant = scenario.controller, scenario.plant
    numbers = numbers_of(law, ("k1", "K2", "Gamma", "sigma", *names))
    return kind(nodes=law.nodes, mass=np.append(plant.mass, plant.payload), **numbers)


CASES = {
    "parameters": (
        lambda: undisturbed(adapting(PAPER.controller)),
        arm_program,
        ("controller.Gamma", "controller.sigma", "plant.mass", "model.mass", "plant.payload"),
    ),
    "parameters of order 3": (
        lambda: pendulum(disturbance=ij.disturbances.Nothing()),
        pendulum_program,
        ("controller.Gamma", "plant.H", "plant.Km", "model.H", "controller.k"),
    ),
    "fuzzy system": (
        lambda: undisturbed(
            controllers.AdaptiveRBF(2.0, 20.0, nodes=5, Gamma=30.0, normalised=True, width=1.5)
        ),
        partial(network_program, independent.Fuzzy, ("width",)),
        ("controller.Gamma", "controller.sigma", "plant.mass", "controller.K2"),
    ),
    "hidden layer": (
        lambda: undisturbed(controllers.AdaptiveNetwork(k1=2.0, K2=20.0, nodes=3)),
        partial(network_program, independent.HiddenLayer, ("Gamma_h", "sigma_h")),
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
    start = initial_state(scenario)
    t = rng.uniform(0.0, 6.0, POINTS)
    tubes = jax.vmap(scenario.context.tube)(jnp.asarray(t))
    xi = rng.uniform(-0.8, 0.8, (POINTS, scenario.n))
    q = tubes.q_d + xi * jnp.minimum(tubes.k_l, tubes.k_u)
    others = rng.normal(size=(POINTS, *start.x.shape))[:, 1:]
    memory = jax.tree.map(
        lambda x: jnp.asarray(x + 0.3 * rng.normal(size=(POINTS, *x.shape))), start.controller
    )
    return jnp.asarray(t), LoopState(jnp.concatenate([q[:, None], others], axis=1), memory, ())


def flat(state, i=None):
    parts = [state.x, *jax.tree.leaves(state.controller)]
    return np.concatenate([np.ravel(x if i is None else x[i]) for x in parts])


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_vector_field_is_that_of_an_independent_program(name, rng):
    make, program, paths = CASES[name]
    scenario = canonical(make())
    values = random_numbers(scenario, paths, rng)
    t, states = random_states(scenario, rng)

    field = jax.vmap(lambda values, *at: rate(ij.with_parameters(scenario, values), *at))
    found = jax.jit(field)(values, t, states)
    for i in range(POINTS):
        one = ij.with_parameters(scenario, {path: value[i] for path, value in values.items()})
        expected = program(one).rate(float(t[i]), flat(states, i))
        scale = np.max(np.abs(expected))
        np.testing.assert_allclose(flat(found, i), expected, rtol=1e-12, atol=1e-12 * scale)


MAPPED = controllers.Backstepping(
    k1=2.0, K2=20.0, barrier=barriers.TransformedError(), variant="corrected"
)
ARM = dataclasses.replace(PAPER, observer=ij.observers.NoObserver(), controller=adapting(MAPPED))


@ij.component
class PassOn(controllers.Law):
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


def around():
    """A law of x around one of robots."""
    return dataclasses.replace(ARM, controller=adapting(PassOn(MAPPED)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "paths"),
    [
        (around, ("plant.mass", "plant.payload", "model.mass")),
        (pendulum, ("plant.H", "plant.Km", "model.H")),
    ],
)
def test_the_rate_of_the_lyapunov_function_is_what_is_claimed(make, paths, rng):
    scenario = canonical(make())
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
    assert np.all(excess <= 1e-12 * found.size) and np.all(found.V > 0)
    # The projection makes it an inequality where it acts.
    box, theta = scenario.controller, np.asarray(states.controller.theta)
    inner = (theta > box.lower + box.band) & (theta < box.upper - box.band)
    exact = np.all(inner, axis=1) & (values["controller.sigma"] == 0.0)
    assert np.count_nonzero(exact) >= 3
    assert np.all(np.abs(excess[exact]) <= 1e-12 * found.size[exact])


def test_a_fuzzy_system_is_a_mean_of_its_rules_far_from_all_of_them(rng):
    law = controllers.AdaptiveRBF(k1=2.0, K2=20.0, nodes=8, normalised=True, width=0.01)
    far = jnp.full(2, 40.0)
    for kind in (jnp.float32, jnp.float64):
        small = jax.tree.map(lambda x, kind=kind: x.astype(kind), law)
        S = small.basis(*[far.astype(kind)] * 4)
        assert float(jnp.sum(S)) == pytest.approx(1.0, rel=1e-6)
    at = q, *others = rng.normal(size=(4, 2))
    z = np.concatenate([(q - 0.5) / 0.5, *others]) / ([1.0] * 6 + [3.0] * 2)
    fired = np.exp(-np.sum((z - independent.sobol(8, 8)) ** 2, axis=1) / 1.5**2)
    for normalised, expected in ((True, fired / np.sum(fired)), (False, fired)):
        near = dataclasses.replace(law, width=1.5, normalised=normalised)
        np.testing.assert_allclose(near.basis(*at), expected, rtol=1e-12)


SETTLING = dataclasses.replace(PAPER.controller, decays=ij.decays.FiniteTime(k_a=1.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": ("length[0]",)}, "affine"),
        ({"parameters": ("mass[2]",)}, "the path of a number"),
        ({"parameters": ("mass",)}, r"one number, such as mass\[0\]"),
        ({"parameters": ("mass[0]",), "lower": 2.5}, "between 2.5 and 4"),
        ({"law": controllers.BarrierBackstepping(k=(2.0, 20.0))}, "last level"),
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
    law = partial(controllers.AdaptiveParameters, **(numbers | changes))
    assert_refused(message, lambda: canonical(dataclasses.replace(ARM, controller=law())))


def test_units_of_the_adaptation_are_those_of_the_parameters():
    units = {p.path: p.unit for p in ij.parameters(pendulum())}
    assert units["controller.lower"] == "V/(N m), V s/rad"
    units = {p.path: p.unit for p in ij.parameters(ARM)}
    assert units["controller.Gamma"] == "kg^2/(N m rad)"


@pytest.mark.slow
def test_a_figure_shows_the_parameters_with_their_names_and_units(short_run):
    loaded = ij.with_parameters(ARM, {"plant.payload": 0.4})
    law = controllers.Saturated(loaded.controller, limit=15.0, auxiliary=5.0)
    limited = dataclasses.replace(loaded, controller=law)
    run = ij.simulate(loaded, duration=0.01, dt=1e-3)
    figure, runs = Figure(), {"free": run, "limited": ij.simulate(limited, duration=0.01, dt=1e-3)}
    assert ij.plotting.adaptation(runs, figure=figure) is figure
    labels = [axes.get_ylabel() for axes in figure.axes[::2]]
    assert labels == [f"{name}\n$\\hat\\theta$ [kg]" for name in NAMES]
    lines = {line.get_label(): line.get_ydata() for line in figure.axes[4].get_lines()}
    assert lines["value of the plant"][0] == 0.4
    np.testing.assert_allclose(lines["free"][-1], run.controller_state.theta[-1, 2])
    assert_refused("a run of Backstepping", ij.plotting.adaptation, short_run)
