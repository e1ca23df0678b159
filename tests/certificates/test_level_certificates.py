"""The claim (S.3) about plants in strict-feedback form: at random states, along runs, and where it
fails or does not apply.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from claim_terms import terms_at

import iblf_jax as ij
from iblf_jax.certificates import certify, counterexample
from iblf_jax.certificates.claims.levels import LEVEL_ROUNDING
from iblf_jax.certificates.terms import rounding
from iblf_jax.simulation.closed_loop import LoopState, evaluate
from iblf_jax.simulation.scenario import canonical
from iblf_jax.world import plants
from iblf_jax.world.bounds import Tube

MAPPING, PERFORMANCE = ij.barriers.TransformedError(), ij.barriers.PrescribedPerformance()
RUN = {"duration": 0.4, "dt": 5e-3}
"""A run whose length does not matter; so few steps need one kernel, not two."""


N = 2
STATES = 32


@ij.component
class RandomPlant:
    """f_i = sin(A_i (x_1..x_i) + 0.3 t), G_i = I + 0.3 sin(B_i (x_1..x_i) + 0.2 t)."""

    A: ij.Leaf = ij.leaf("1", shape="any")
    B: ij.Leaf = ij.leaf("1", shape="any")
    order: int = ij.static()
    n: ClassVar[int] = N

    def _inner(self, numbers, i, x):
        return jnp.tensordot(numbers[i, ..., : i + 1, :], x[: i + 1], axes=2)

    def drift(self, t, x):
        return jnp.stack([jnp.sin(self._inner(self.A, i, x) + 0.3 * t) for i in range(self.order)])

    def gain(self, t, x):
        rows = [jnp.sin(self._inner(self.B, i, x) + 0.2 * t) for i in range(self.order)]
        return jnp.eye(N) + 0.3 * jnp.stack(rows)


def bounds_between(lower, upper):
    """Bounds that oscillate, each side with its own frequency."""
    return ij.bounds.Bounds(
        lower=ij.bounds.Sinusoid(offset=-lower, amplitude=0.04 * lower, frequency=0.9),
        upper=ij.bounds.Sinusoid(offset=upper, amplitude=0.05 * upper, frequency=1.4),
    )


def tube_widths(order):
    """Both sides of every level's bounds, (order, 2)."""
    return np.array([(1.5, 2.5), *[(60.0 * 30.0**i, 90.0 * 30.0**i) for i in range(order - 1)]])


def energy_scales(barriers, widths):
    """e/s of every barrier at the middle of its tube, (order, 1), so that w_i V_i is about e^2."""
    zero = jnp.zeros(1)
    ratios = [
        barrier.error_over_slope(Tube(zero, zero, zero - lower, zero + upper, zero, zero), zero)
        for barrier, (lower, upper) in zip(barriers, widths, strict=True)
    ]
    return np.stack(ratios)


def random_scenario(order: int, barriers: Any, seed: int) -> ij.Scenario:
    """A loop with a random plant, weights, gains, disturbances and estimates."""
    rng, widths = np.random.default_rng(seed), tube_widths(order)
    A = rng.normal(0.0, 0.5, (order, N, order, N))
    plant = RandomPlant(A, B=rng.normal(0.0, 0.3, (order, N, N, order, N)), order=order)
    controller = ij.controllers.BarrierBackstepping(
        k=rng.uniform(1.0, 3.0, (order, N)),
        barriers=barriers,
        c=rng.uniform(0.0, 0.3, (order, N)),
        weights=10 ** rng.uniform(-1.0, 0.5, (order, N)) * energy_scales(barriers, widths),
    )
    waves = [(rng.normal(0.0, 0.5, N), rng.uniform(0.5, 2.0, N)) for _ in range(order)]
    parts = tuple(ij.disturbances.Sinusoids(*wave) for wave in waves)
    scenario = ij.Scenario(
        plant=plant,
        reference=ij.references.Sinusoid(offset=[0.2, -0.1], amplitude=[0.3, 0.2]),
        bounds=tuple(bounds_between(*sides) for sides in widths),
        controller=controller,
        observer=ij.observers.LevelObserver(gain=rng.uniform(1.0, 5.0, (order, N))),
        disturbance=ij.disturbances.Levels(parts),
        initial=ij.Initial(x=np.zeros((order, N))),
    )
    return canonical(scenario)


def random_states(scenario: ij.Scenario, seed: int):
    """Times, (STATES,), and states of the loop inside the tubes of all levels, batched."""
    rng, order = np.random.default_rng(seed), scenario.model.order
    t = rng.uniform(0.0, 10.0, STATES)
    xi = rng.uniform(-0.6, 0.6, (STATES, order, N))
    d_hat = rng.normal(0.0, 0.5, (STATES, order, N))

    @jax.jit
    @jax.vmap
    def states(t, xi, d_hat):
        law, x = scenario.controller, jnp.zeros((order, N))
        for i in range(order):
            tube = law.levels(t, x, d_hat, scenario.context, ())[1][i]
            x = x.at[i].set(tube.q_d + xi[i] * jnp.where(xi[i] > 0, tube.k_u, tube.k_l))
        return LoopState(x, (), d_hat - scenario.observer.gain * x)

    return t, states(t, xi, d_hat)


def lyapunov(scenario, t, x, d_hat):
    """Sum w_i V_i, from the law's levels."""
    law = scenario.controller
    _, tubes = law.levels(t, x, d_hat, scenario.context, ())
    return sum(
        jnp.sum(law.weights[i] * law.barriers[i].value(tubes[i], x[i])) for i in range(law.order)
    )


def rate_along_the_flow(scenario, t, state):
    """V' by jvp of the sum along the true flow of plant, disturbance and observer."""
    rates, _ = evaluate(scenario, t, state)

    def value(t, state):
        d_hat = scenario.observer.estimate(t, state.x, scenario.model, state.observer)
        return lyapunov(scenario, t, state.x, d_hat)

    return jax.jvp(value, (t, state), (jnp.ones_like(t), rates))[1]


def right_side(scenario, t, state):
    """The right side of (S.3), level by level as it is printed."""
    law, context, kappa = scenario.controller, scenario.context, scenario.observer.gain
    x = state.x
    d_hat = scenario.observer.estimate(t, x, scenario.model, state.observer)
    d_tilde = scenario.disturbance.rates(t, x, scenario.plant, scenario.model) - d_hat
    _, tubes = law.levels(t, x, d_hat, context, ())
    total = 0.0
    for i in range(law.order):
        w, barrier = law.weights[i], law.barriers[i]
        s = barrier.slope(tubes[i], x[i])
        decay = barrier.decay_rate(law.k[i]) * barrier.value(tubes[i], x[i])
        total += jnp.sum(w * (-decay - law.c[i] * s**2 + s * d_tilde[i]))
        if i == 0:
            continue
        bounds = context.bounds[i]

        def value(centre, i=i, barrier=barrier, bounds=bounds):
            lower, upper = (side.at(t, centre) for side in (bounds.lower, bounds.upper))
            tube = tubes[i]._replace(q_d=centre, lower=lower, upper=upper)
            return barrier.value(tube, x[i])

        def alpha(below, d_hat, i=i):
            at = x.at[:i].set(below)
            return law.levels(t, at, d_hat, context, ())[0][i - 1].alpha

        moved = jnp.zeros_like(d_hat).at[:i].set((kappa * d_tilde)[:i])
        _, dalpha = jax.jvp(alpha, (x[:i], d_hat), (d_tilde[:i], moved))
        _, dV = jax.jvp(value, (tubes[i].q_d,), (dalpha,))
        total += jnp.sum(w * dV)
    return total


def both_sides(scenario, seed):
    """Left and right side of (S.3) at random states, and the terms of the certificate there."""

    @jax.jit
    @jax.vmap
    def at(t, state):
        terms = terms_at(scenario, t, state)
        return rate_along_the_flow(scenario, t, state), right_side(scenario, t, state), terms

    found = jax.tree.map(np.asarray, at(*random_states(scenario, seed)))
    # The claim excludes states at which alpha leaves its bounds.
    claimed = ~found[2].excluded
    assert np.mean(claimed) > 0.9
    return jax.tree.map(lambda x: x[claimed], found)


@pytest.mark.parametrize(
    "order",
    [pytest.param(k, marks=pytest.mark.slow if k == 2 else pytest.mark.release) for k in (2, 3, 4)],
)
def test_both_sides_of_the_claim_are_equal(order):
    barriers = (MAPPING, PERFORMANCE, MAPPING, PERFORMANCE)[:order]
    left, right, terms = both_sides(random_scenario(order, barriers, seed=order), order)
    claim, estimate = terms.claims["levels"], terms.claims["estimate"]
    assert np.all(np.abs(left - right) <= 1e-10 * np.max(np.abs(left)))
    # Every state has terms of its own size: the terms of V' are the scale of rounding.
    assert np.all(np.abs(left - right) <= 1e-13 * terms.size)
    share = LEVEL_ROUNDING * rounding("float64")
    assert np.median(share * terms.size / np.abs(left)) < 1e-10
    certified = claim.disturbance_terms - claim.dissipation - claim.by_slopes
    assert np.all(np.abs(right - certified) <= 1e-13 * terms.size)
    assert np.all(np.abs(left - terms.dV) <= 1e-13 * terms.size)
    assert np.all(np.abs(terms.dV - certified) <= 0.2 * share * terms.size)
    # The disturbance terms decide: without them nothing is equal.
    assert np.median(np.abs(claim.disturbance_terms) / (share * terms.size)) > 1e6
    assert np.all(np.abs(estimate.error) <= 0.2 * share * estimate.size)


STATE = ij.barriers.StateBarrier()


@pytest.mark.slow
@pytest.mark.parametrize("barriers", [(ij.barriers.Integral(), MAPPING), (STATE, STATE)])
def test_other_barriers_give_an_inequality(barriers):
    left, right, _ = both_sides(random_scenario(2, barriers, seed=5), 5)
    assert np.all(left < right)


def drift(t, x):
    return jnp.stack([-0.3 * jnp.sin(x[0]), -x[1] - 2.0 * jnp.sin(x[0]), -0.5 * x[2] - 0.2 * x[1]])


def gain(t, x):
    return jnp.ones_like(x) * jnp.array([[1.0], [1.0], [4.0]])


def between(lower, upper):
    return ij.bounds.Bounds(lower=ij.bounds.Constant(lower), upper=ij.bounds.Constant(upper))


UNITS = ("rad", "rad/s", "A", "V")
PENDULUM = ij.plants.StrictFeedback(drift=drift, gain=gain, n=1, order=3, units=UNITS)
WAVES = ((0.1, 1.0), (0.3, 2.0), (1.0, 1.5))
DISTURBANCES = ij.disturbances.Levels(tuple(ij.disturbances.Sinusoids(*wave) for wave in WAVES))
GAINS = {"k": (2.0, 5.0, 10.0), "barriers": (MAPPING,) * 3, "c": 0.1}


def pendulum(law=None, **parts):
    """A loop of order 3 with bounds on all levels."""
    chosen = {
        "plant": PENDULUM,
        "reference": ij.references.Sinusoid(offset=0.1, amplitude=0.4),
        "bounds": (between(-0.8, 1.0), between(-8.0, 9.0), between(-60.0, 60.0)),
        "controller": ij.controllers.BarrierBackstepping(**GAINS) if law is None else law,
        "initial": ij.Initial(x=[[0.3], [0.0], [0.0]]),
    }
    return ij.Scenario(**(chosen | parts))


@pytest.mark.slow
def test_V_decays_at_its_rate_and_with_a_disturbance_by_the_true_terms():
    long = {"duration": 2.0, "dt": 2e-3}
    undisturbed = certify(pendulum(), **long)
    assert undisturbed.holds and undisturbed.numbers["rho"] == 4.0
    assert undisturbed.numbers["rho2"] == 0.0
    assert undisturbed.numbers["V_end"] < undisturbed.numbers["V_start"] * np.exp(-4.0 * 2.0)
    for name in ("inequality, levels", "equality", "envelope", "smooth", "alpha_2 inside"):
        assert undisturbed[name].verdict == "holds"
    assert "no observer" in undisturbed["estimate"].note
    # The error at the end is below what V <= V(0) exp(-rho t) leaves.
    for level in (1, 2, 3):
        assert undisturbed[f"xi, level {level}"].verdict == "holds"
        assert 0 < undisturbed[f"xi, level {level}"].margin < 0.1
    assert undisturbed["level 3 inside"].unit == "A" and "(S.3)" in repr(undisturbed)
    assert "of the claim (S.3) does not apply" in undisturbed.omitted
    scenario = pendulum(disturbance=DISTURBANCES)
    certificate = certify(scenario, ij.simulate(scenario, **long))
    assert certificate.holds
    terms = certificate.traces.disturbance_terms
    assert np.max(terms) == pytest.approx(certificate["observer terms"].value)
    assert np.max(terms) > 0.1
    np.testing.assert_allclose(certificate.numbers["d_largest"], [0.1, 0.3, 1.0], rtol=1e-4)
    # Without the terms V would have to decay, which it does not.
    assert np.max(certificate.traces.left + terms) > 0.1 and certificate.numbers["rho2"] > 0
    assert certificate["envelope"].verdict == "holds"


@pytest.mark.slow
def test_an_altered_signal_is_refused_and_alpha_outside_the_bounds_of_its_level_fails():
    run = ij.simulate(pendulum(), **RUN)
    signals = {name: getattr(run, name) for name in ("e", "level_lower", "level_upper")}
    for name, signal in signals.items():
        altered = dataclasses.replace(run, **{name: signal.at[7, 2, 0].add(1e-3)})
        with pytest.raises(ValueError, match=rf"^run.*{name} of sample 7.*Simulate it again"):
            certify(run.scenario, altered)
    # Other programs may round differently.
    rounded = {name: signal * (1 + 1e-13) for name, signal in signals.items()}
    assert certify(run.scenario, dataclasses.replace(run, **rounded)).holds
    scenario = double_integrator(
        ij.controllers.BarrierBackstepping(k=(2.0, 5.0), barriers=(MAPPING, MAPPING)),
        reference=ij.references.Sinusoid(offset=0.0, amplitude=0.4),
        bounds=(between(-3.0, 3.0), between(-0.38, 0.38)),
        initial=ij.Initial(x=[[0.05], [0.0]]),
    )
    with pytest.warns(ij.SimulationWarning):
        certificate = certify(scenario, duration=1.0)
    assert certificate["level 2 starts inside"].verdict == "holds"
    assert certificate["alpha_1 inside"].verdict == "fails"
    assert certificate["alpha_1 inside"].margin < 0 and certificate.verdict == "fails"
    assert "not valid" in certificate["inequality, levels"].note


@ij.component
class WrongObserver(ij.observers.LevelObserver):
    """States twice the gain with which it estimates."""

    @property
    def error_gain(self):
        return 2.0 * self.gain


@ij.component
class WithoutExchange(ij.controllers.BarrierBackstepping):
    """A law whose input does not cancel the effect of e_r on V_{r-1}."""

    def _added(self, plant, t, x, levels, tubes):
        last = self.order - 1
        ratio = self.barriers[last].error_over_slope(tubes[last], x[last])
        exchanged = plants.transposed_gain(plant, last, t, x, levels[last - 1].slope)
        return ratio / self.weights[last] * exchanged

    def levels(self, t, x, d_hat, context, state):
        levels, tubes = super().levels(t, x, d_hat, context, state)
        plant, order = context.model, self.order
        rate = self._added(plant, t, x, levels, tubes)
        zero = plants.level_input(plant, order, t, x, 0.0 * rate)
        u = levels[-1].alpha + plants.level_input(plant, order, t, x, rate) - zero
        return [*levels[:-1], levels[-1]._replace(alpha=u)], tubes


@ij.component
class TwoLevels:
    """u = -x_1 - x_2 for a double integrator around 0, with V = 3/2 x_1^2 + x_1 x_2 + x_2^2."""

    k: ij.Leaf = ij.leaf("1/s", default=1.0)
    receives_x: ClassVar[bool] = True
    uses_observer: ClassVar[bool] = False
    includes_e2: ClassVar[bool] = True

    def command(self, t, x, d_hat, context, state):
        zero = jnp.zeros_like(x[0])
        no = zero > 1.0
        return ij.controllers.Command(-x[0] - x[1], zero, 0.0 * zero, no, no), ()


@ij.component
class WithClaim(TwoLevels):
    """With V' = -x_1^2 - x_2^2 without disturbance, of which it states a multiple."""

    factor: ij.Leaf = ij.leaf("1", shape="scalar", default=1.0)

    def lyapunov(self, t, x, d_tilde, context, state):
        return 1.5 * x[0] ** 2 + x[0] * x[1] + x[1] ** 2

    def decay(self, t, x, d_tilde, context, state):
        return self.factor * (x[0] ** 2 + x[1] ** 2)


def no_drift(t, x):
    return jnp.zeros_like(x)


def unit_gain(t, x):
    return jnp.ones_like(x)


DOUBLE = ij.plants.StrictFeedback(drift=no_drift, gain=unit_gain, n=1, order=2)


def double_integrator(law, **parts):
    chosen = {
        "plant": DOUBLE,
        "reference": ij.references.Sinusoid(offset=0.0, amplitude=0.0),
        "bounds": between(-3.0, 3.0),
        "controller": law,
        "disturbance": ij.disturbances.Levels((None, ij.disturbances.Sinusoids(0.2, 1.0))),
        "initial": ij.Initial(x=[[1.0], [0.5]]),
    }
    return ij.Scenario(**(chosen | parts))


LINK = ij.robots.PlanarChain(mass=[1.3], length=[0.4], centre=[0.2], inertia=[0.02])


def robot_scenario(plant, order, robot_law=None, **parts):
    """A loop of a robot, of a robot with drives or with flexible joints, under disturbance."""
    n = plant.n
    law = ij.controllers.BarrierBackstepping(k=(3.0, 15.0, 40.0, 100.0)[:order], barriers=MAPPING)
    chosen = {
        "plant": plant,
        "reference": ij.references.Sinusoid(offset=[0.3] * n, amplitude=[0.3] * n),
        "bounds": between(-0.5, 1.0),
        "controller": law if robot_law is None else robot_law,
        "observer": ij.observers.Momentum(kf=20.0),
        "disturbance": ij.disturbances.Sinusoids(0.4, 2.0),
        "initial": ij.Initial(q=[0.4] * n, dq=[0.0] * n),
    }
    return ij.Scenario(**(chosen | parts))


MOTOR = {"torque_constant": 0.5, "inductance": 0.01, "resistance": 0.5, "back_emf": 0.1}
DRIVE = ij.plants.ElectricDrive(LINK, **MOTOR)


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, pytest.param(3, marks=pytest.mark.release)])
def test_a_robot_is_certified_with_its_observer(order):
    certificate = certify(robot_scenario(LINK if order == 2 else DRIVE, order), **RUN)
    assert certificate.holds and certificate["equality"].verdict == "holds"
    assert certificate["estimate"].verdict == "holds" and certificate["estimate"].unit == "N m/s"
    assert certificate.numbers["d_tilde_largest"][1] > 0.1
    assert certificate[f"e, level {order}"].margin > 0


@pytest.mark.slow
def test_a_search_for_counterexamples_finds_one_of_a_wrong_law_only():
    gains = {"k": (0.5, 1.0), "barriers": (MAPPING, ij.barriers.Quadratic())}
    ends = {"initial.q": 1.0, "initial.dq": 2.0}
    start = {path: ij.offset(ij.uniform(-x, x)) for path, x in ends.items()}

    def searched(law):
        return counterexample(double_integrator(law), start, starts=2)

    exact = searched(ij.controllers.BarrierBackstepping(**gains))
    assert exact.growth == pytest.approx(-1.0, abs=1e-9)
    found = searched(WithoutExchange(**gains))
    assert found.growth > 0
    assert certify(found.scenario, duration=0.01)["inequality, levels"].verdict == "fails"
    with pytest.raises(ValueError, match="TwoLevels has no claim"):
        searched(TwoLevels())
