"""`BarrierBackstepping` against the independent program."""

import chain_cases
import independent_chains as other
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, plants, references
from iblf_jax.engine.switching import surfaces
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.scenario import canonical

DATA = np.load(other.FILE)


@pytest.mark.slow
@pytest.mark.parametrize("name", other.CASES)
def test_input_and_virtual_controls_at_random_states(name):
    points = {key: DATA[f"{name}.points.{key}"] for key in ("t", "x", "d_hat", "alpha", "u", "V")}
    is_filtered = other.CASES[name].filter is not None
    if is_filtered:
        points["beta"] = DATA[f"{name}.points.beta"]
    found = chain_cases.commands(chain_cases.scenario(name), points)
    np.testing.assert_allclose(found.tau, points["u"], rtol=1e-10)
    np.testing.assert_allclose(np.sum(found.V1, axis=1), points["V"], rtol=1e-11)
    if not is_filtered:
        alphas = np.concatenate([found.alpha[:, None], found.alpha_higher], axis=1)
        np.testing.assert_allclose(alphas, points["alpha"][:, :-1], rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_a_torque_estimate_is_held_and_not_the_acceleration_that_it_causes():
    """The estimate of a robot's observer is f_hat; d_hat_2 = M^-1(q) f_hat moves with q."""
    scenario = chain_cases.scenario("flexible")
    plant, t = scenario.plant, jnp.asarray(0.4)
    x = jnp.asarray(DATA["flexible.points.x"][0])
    f_hat = jnp.asarray([0.7, -0.4])

    @ij.component
    class WithTorque:
        inner: plants.FlexibleJoint
        f_hat: ij.Leaf = ij.leaf("N m")
        n, order = 2, 4

        def drift(self, t, x):
            return self.inner.drift(t, x) + plants.torque_as_rates(self.inner, x, self.f_hat)

        def gain(self, t, x):
            return self.inner.gain(t, x)

    law = scenario.controller
    context = scenario.context._replace(model=WithTorque(plant, f_hat))
    expected, _ = law.command(t, x, jnp.zeros((4, 2)), context, ())
    found, _ = law.command(t, x, f_hat, scenario.context, ())
    np.testing.assert_allclose(found.tau, expected.tau, rtol=1e-9)


def law(**fields):
    given = {"k": (3.0, 20.0, 60.0), "barriers": (barriers.TransformedError(),)}
    return controllers.BarrierBackstepping(**(given | fields))


def within(size):
    return ij.Bounds(lower=bounds.Constant(-size), upper=bounds.Constant(size))


def third_order(**parts):
    given = {
        "plant": chain_cases.pendulum(),
        "reference": references.Sinusoid(offset=0.1, amplitude=0.5),
        "bounds": (within(1.0), within(20.0), within(20.0)),
        "controller": law(),
        "initial": ij.Initial(x=[[0.0], [0.0], [0.0]]),
    }
    return ij.Scenario(**(given | parts))


MAPPING = barriers.TransformedError()
INTEGRAL, LOG = barriers.Integral(), barriers.Log()


def under(*given):
    return {"controller": law(barriers=given)}


QUINTIC = references.Quintic(start=0.0, end=0.5, duration=2.0)


@ij.component
class Rounded:
    """A bound whose second derivative jumps at t = 0.3 s."""

    value: ij.Leaf = ij.leaf("rad")
    continuous_derivatives = 1

    def at(self, t, q_d):
        late = jnp.maximum(t - 0.3, 0.0)
        return jnp.broadcast_to(self.value * (1.0 + 0.1 * late**2), q_d.shape)


def with_a_rounded_bound(*levels, barriers=(MAPPING,) * 3):
    """Constant bounds of all levels, of some of them with a side that has one derivative."""
    sides = (Rounded(20.0) if i in levels else bounds.Constant(20.0) for i in (1, 2, 3))
    pairs = tuple(ij.Bounds(lower=bounds.Constant(-20.0), upper=side) for side in sides)
    return under(*barriers) | {"bounds": pairs}


ROUNDED = (
    r"\[{}\].upper: got Rounded, which has 1, expected a side with {} continuous"
    ".*Funnel are smooth"
)
REFUSED = {
    "slope with a kink": (under(INTEGRAL, MAPPING, MAPPING), r"\[0\].*Integral.*Log\(p=2\)"),
    "ratio that jumps": (under(MAPPING, INTEGRAL, MAPPING), r"\[1\].*Integral.*TransformedError"),
    "logarithmic form between": (
        under(MAPPING, LOG, MAPPING),
        r"barriers\[1\].*Log.* e/s does not jump at e = 0.*level 2, about alpha_1.*filter=",
    ),
    "no ratio": (under(MAPPING, MAPPING, barriers.Log(p=2)), r"\[2\].*error_over_slope"),
    "no bounds": (under(*(MAPPING,) * 3) | {"bounds": within(1.0)}, r"bounds\[1\]"),
    "a reference with two continuous derivatives": (
        {"reference": QUINTIC},
        "reference: got Quintic, which has 2, .* 3 continuous derivatives.*derivatives=3.*filter=",
    ),
    "bounds of level 1 with one derivative": (with_a_rounded_bound(1), ROUNDED.format(0, 3)),
    "bounds of level 2 with one derivative": (with_a_rounded_bound(2), ROUNDED.format(1, 2)),
    "gains of another order": ({"controller": law(k=(3.0, 20.0))}, "controller.k.*3 levels"),
    "a start outside the bounds of a level": (
        {"initial": ij.Initial(x=[[0.0], [0.0], [25.0]])},
        r"initial.x\[2\]\[0\].*level 3",
    ),
    "a start without x": ({"initial": ij.Initial(q=0.0)}, r"Initial\(x=\.\.\.\)"),
    "a law of robots": ({"controller": controllers.Backstepping(1.0, 1.0)}, "BarrierBackstepping"),
    "an observer of robots": ({"observer": ij.observers.Momentum(10.0)}, "observer.*LevelObserver"),
    "a singular gain": (
        {"plant": plants.StrictFeedback(lambda t, x: 0.0 * x, lambda t, x: x, n=1, order=3)},
        r"gain\(t, x\)\[0\].*invertible",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refused_with_a_remedy(what):
    parts, message = REFUSED[what]
    assert_refused(message, lambda: canonical(third_order(**parts)))


def test_allowed():
    """Integral has no kink where both sides are at the same distance; bounds of the last level need
    one derivative, those of a level without a barrier none, and filters take any reference."""
    canonical(third_order(**under(barriers.Log(p=2), MAPPING, MAPPING)))
    canonical(third_order(**under(MAPPING, MAPPING, INTEGRAL)))
    canonical(third_order(**with_a_rounded_bound(3)))
    quadratic = barriers.Quadratic()
    canonical(third_order(**with_a_rounded_bound(2, barriers=(MAPPING, quadratic, quadratic))))
    filtered = law(barriers=(INTEGRAL, MAPPING, MAPPING), filter=0.01)
    canonical(third_order(controller=filtered, reference=QUINTIC))
    funnels = [[bounds.Funnel(s * x, s * x, 0.0) for s in (-1.0, 1.0)] for x in (0.6, 5.0, 60.0)]
    integral = law(barriers=(INTEGRAL,) * 3, weights=(1.0, 10.0, 1000.0))
    canonical(third_order(bounds=[ij.Bounds(*pair) for pair in funnels], controller=integral))


@pytest.mark.slow
def test_the_input_jumps_where_the_last_error_is_zero():
    """The error contains the estimates of the observer, as the command does."""
    scenario = third_order(
        controller=law(barriers=(MAPPING, MAPPING, INTEGRAL)),
        observer=ij.observers.LevelObserver(gain=(0.0, 5.0, 5.0), eta0=(0.3, -2.0, 4.0)),
    )
    state, t = initial_state(scenario), jnp.asarray(0.2)
    sample = evaluate(scenario, t, state)[1]
    np.testing.assert_allclose(surfaces(scenario, t, state), sample.e[-1], rtol=1e-12)


@pytest.mark.slow
def test_a_derivation_by_sympy_gives_the_same_input():
    import independent_sympy as derived  # SymPy takes long to import

    def rows(t, x):
        drift, gain = derived.drift_and_gain(x[:, 0], jnp.cos, jnp.sin, jnp.exp)
        return jnp.stack(drift)[:, None], jnp.stack(gain)[:, None]

    functions = (lambda t, x: rows(t, x)[0]), (lambda t, x: rows(t, x)[1])
    sides = map(derived.sides, range(derived.ORDER))
    case = ij.Scenario(
        plant=plants.StrictFeedback(*functions, n=1, order=derived.ORDER),
        reference=references.Sinusoid(offset=0.0, amplitude=0.5),
        bounds=[ij.Bounds(*(bounds.Sinusoid(*side) for side in pair)) for pair in sides],
        controller=law(k=derived.K, barriers=(MAPPING,) * 3, c=derived.C, weights=derived.WEIGHTS),
        initial=ij.Initial(x=[[0.1], [0.0], [0.0]]),
    )
    rng = np.random.default_rng(3)
    command = jax.jit(lambda t, x: case.controller.command(t, x, 0.0 * x, case.context, ())[0])
    for _ in range(20):
        t = rng.uniform(0.0, 10.0)
        x = rng.uniform([-0.7, -2.0, -8.0], [0.7, 2.0, 8.0])
        found = command(jnp.asarray(t), jnp.asarray(x)[:, None])
        alphas = [found.alpha[0], found.alpha_higher[0, 0], found.tau[0]]
        np.testing.assert_allclose(alphas, derived.derived_input(t, x), rtol=1e-9)
