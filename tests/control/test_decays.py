"""Decays against the independent program, and in their limits."""

import dataclasses
from types import SimpleNamespace

import chain_cases
import independent_chains
import independent_decays as other
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refused import refused

import iblf_jax as ij
from iblf_jax import barriers, controllers, decays, disturbances, observers
from iblf_jax.certificates.claims import settling
from iblf_jax.certificates.claims.theorem import THEOREM
from iblf_jax.core import notices
from iblf_jax.core.status import Status
from iblf_jax.simulation import stability
from iblf_jax.simulation.scenario import canonical
from iblf_jax.tuning import ranges

FINITE = other.Powers(((2.5, 0.45),), 0.02)
FIXED = other.Powers(((1.5, 0.4), (0.8, 1.6)), 0.015)
PRESCRIBED = other.Prescribed(0.8, 3.0, 25.0)
SECOND = other.Prescribed(0.9, 2.0, 15.0)
PAIRS = {
    "finite": (FINITE, other.Powers(((3.0, 0.6),), 0.05)),
    "fixed": (FIXED, other.Powers(((2.0, 0.5), (1.0, 1.4)), 0.04)),
    "prescribed": (PRESCRIBED, SECOND),
    "mixed": (FINITE, SECOND),
}


def of_package(decay):
    if isinstance(decay, other.Prescribed):
        return decays.PrescribedTime(T=decay.T, gain=decay.order, cap=decay.cap)
    (k_a, a), *rest = decay.terms
    if not rest:
        return decays.FiniteTime(k_a=k_a, a=a, delta=decay.delta)
    ((k_b, b),) = rest
    return decays.FixedTime(k_a=k_a, k_b=k_b, a=a, b=b, delta=decay.delta)


def arm_scenario(pair, **parts):
    """The paper's arm without disturbance, under TransformedError with two decays."""
    law = controllers.Backstepping(
        k1=2.0,
        K2=20.0,
        barrier=barriers.TransformedError(),
        variant="corrected",
        decays=tuple(map(of_package, pair)),
    )
    parts = {"controller": law, "observer": observers.NoObserver()} | parts
    return ij.with_parts(ij.presets.zhang_yan_2024(), disturbance=disturbances.Nothing(), **parts)


@jax.jit
def torque(scenario, t, q, dq):
    return scenario.controller.command(t, q, dq, jnp.zeros_like(q), scenario.context, ())[0].tau


@pytest.mark.parametrize("name", PAIRS)
def test_torque_of_an_arm_at_random_states(name, rng):
    first, second = PAIRS[name]
    scenario, arm = arm_scenario(PAIRS[name]), other.Arm(first=first, second=second)
    for t in rng.uniform(0.0, 1.1, 40):
        (_, _), (low, _), (up, _) = arm.tube(t)
        q = low + (up - low) * rng.uniform(0.05, 0.95, 2)
        dq = rng.normal(size=2)
        expected = arm.torque(t, q, dq)
        found = torque(scenario, t, q, dq)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * max(abs(expected)))


SLOWER = other.Prescribed(2.5, 3.0, 20.0)
CHAINS = {"surface": (FINITE, SLOWER, FIXED), "flexible": (SLOWER, FIXED, FINITE, SLOWER)}


def chain_with(name, levels):
    case = dataclasses.replace(independent_chains.CASES[name], decays=levels)
    scenario = chain_cases.scenario(name)
    law = dataclasses.replace(scenario.controller, decays=tuple(map(of_package, levels)))
    return case, ij.with_parts(scenario, controller=law)


@pytest.mark.slow
@pytest.mark.parametrize("name", CHAINS)
def test_input_of_a_chain_at_random_states(name):
    case, scenario = chain_with(name, CHAINS[name])
    tables = (independent_chains.SPREAD, independent_chains.NOISE)
    data = independent_chains.points(case, *(table.get(name) for table in tables))
    found = chain_cases.commands(scenario, data)
    size = np.max(np.abs(data["u"]), axis=1, keepdims=True)
    assert np.max(np.abs(found.tau - data["u"]) / size) < 1e-12


ON_THE_FIRST = (barriers.PrescribedPerformance(), barriers.Quadratic(), barriers.Quadratic())
PRESCRIBED_CHAIN = (SLOWER, other.Prescribed(2.0, 3.0, 15.0), other.Prescribed(1.5, 3.0, 12.0))


@pytest.mark.slow
def test_settling_time_of_order_three():
    """The pendulum with its motor without a disturbance, bounded on its first level."""
    scenario, chosen = chain_cases.scenario("pendulum"), tuple(map(of_package, PRESCRIBED_CHAIN))
    law = dataclasses.replace(scenario.controller, barriers=ON_THE_FIRST, decays=chosen)
    parts = {"bounds": (scenario.bounds[0], None, None), "controller": law}
    parts["disturbance"] = disturbances.Nothing()
    certificate = ij.certify(ij.with_parts(scenario, **parts), duration=3.0, dt=1e-3)
    assert certificate["equality"].verdict == "holds"
    assert certificate["prescribed time"].verdict == "holds" and certificate.holds


@pytest.mark.slow
def test_settling_time_of_an_arm_and_the_case_in_which_it_is_broken():
    scenario = arm_scenario(PAIRS["fixed"])
    certificate = ij.certify(scenario, duration=0.6, dt=1e-3)
    assert certificate.holds and certificate["inequality, decays"].verdict == "holds"
    line = certificate["settling time"]
    assert line.verdict == "holds" and 0.1 < line.value < line.value + line.margin < 0.6

    t = np.linspace(0.0, 1.0, 1001)
    slow = settling.Course(t, 0.3 * np.exp(-2.0 * t), 0.0 * t, 0.0 * t, np.zeros(1001, bool))
    summary = SimpleNamespace(
        run=SimpleNamespace(scenario=scenario),
        law=canonical(scenario).controller,
        claims=(THEOREM, settling.SETTLING),
        reductions=SimpleNamespace(mu=20.0),
        why_never="",
        why_invalid="",
        jumps=np.zeros(0),
        excluded=0,
        samples=1001,
    )
    (broken,) = settling.SETTLING.run_lines(summary, [slow], {})
    assert broken.verdict == "fails"


@pytest.mark.slow
def test_the_least_decay_of_a_sum_is_that_of_the_worst_distribution(rng):
    """D(t, E) against random distributions of E over the parts, and against their best."""
    law = canonical(arm_scenario(PAIRS["fixed"])).controller
    first, second = law.decays
    mu, E, t = 20.0, 0.7, jnp.asarray(0.3)
    least = float(settling.least_decay(law, jnp.asarray(mu), t, jnp.asarray(E)))

    @jax.jit
    @jax.vmap
    def decay(shares):
        V1, W = E * shares[:2], E * shares[2]
        g = jnp.mean(second.effective_gain(t, jnp.zeros(2), jnp.full(2, W)))
        gain = first.effective_gain(t, law.k1, V1)
        return jnp.sum(2.0 * gain * V1) + 2.0 * (mu + g) * W

    found = np.asarray(decay(jnp.asarray(rng.dirichlet([0.4, 0.4, 0.05], 20_000))))
    assert least <= np.min(found) * (1.0 + settling.RELATIVE_ERROR)
    assert least >= np.min(found) * 0.98


def test_units():
    units = {p.path: p.unit for p in ij.parameters(arm_scenario(PAIRS["mixed"]))}
    assert units["controller.decays[0].delta"] == "rad"
    assert units["controller.decays[1].T"] == "s"
    law = controllers.BarrierBackstepping(
        k=(2.0, 20.0, 60.0), barriers=ON_THE_FIRST, decays=decays.FiniteTime(k_a=0.1)
    )
    preset = ij.presets.motor_driven_pendulum()
    scenario = ij.with_parts(preset, controller=law, bounds=preset.bounds[:1])
    units = {p.path: p.unit for p in ij.parameters(scenario)}
    found = [units[f"controller.decays[{i}].delta"] for i in range(3)]
    levels = [ij.plants.units_of(scenario.plant)[i] for i in (1, 2)]
    assert found == ["1", *levels]


def under(given, **numbers):
    return controllers.Backstepping(2.0, 20.0, decays=given, **numbers)


def of_order_six():
    plant = ij.plants.StrictFeedback(
        lambda t, x: 0.0 * x, lambda t, x: jnp.ones_like(x), n=1, order=6
    )
    law = controllers.BarrierBackstepping(
        k=(1.0,) * 6, barriers=barriers.Quadratic(), decays=decays.PrescribedTime(T=1.0)
    )
    parts = {"controller": law, "initial": ij.Initial(x=[[0.1]] * 6)}
    parts["reference"] = ij.references.Sinusoid(offset=0.0, amplitude=0.1)
    walls = ij.Bounds(ij.bounds.Constant(-1.0), ij.bounds.Constant(1.0))
    canonical(ij.Scenario(plant=plant, bounds=walls, **parts))


test_refusals = refused(
    (lambda: under((decays.Exponential(),) * 3), "2 decays, one a level"),
    (lambda: under(barriers.Log()), r"Backstepping\.decays\[0\]"),
    (of_order_six, "5 continuous derivatives"),
)


def test_ranges_of_the_powers_end_at_one():
    scenario = canonical(arm_scenario(PAIRS["fixed"]))
    a, b = (f"controller.decays[0].{name}" for name in "ab")
    starts = {path: np.full(2, value) for path, value in ((a, 0.4), (b, 1.6))}
    lows, highs = (
        ends(scenario, {path: starts[path]}, 1e-3, "rk4")[path]
        for ends, path in ((ranges.default_lows, b), (ranges.default_highs, a))
    )
    assert lows.value == highs.value == 1.0 and "power" in lows.reason


@pytest.mark.slow
def test_growth_that_no_period_changes_is_not_reported_as_sampling():
    """Derivatives grow slowly at the start; a period that is too long is still reported."""
    law = dataclasses.replace(
        arm_scenario((FINITE, FINITE)).controller, k1=1.0, decays=decays.FiniteTime(k_a=1.0)
    )
    growth, reported = [], []
    for period in (1e-3, 1e-4, 4e-3):
        scenario = arm_scenario((), controller=law, sampling=ij.Sampling(period=period))
        with notices.muted():
            run = ij.simulate(scenario, duration=0.04, dt=period)
        growth.append(np.log(float(run.metrics.sampling_radius)) / period)
        reported.append(bool(int(run.status) & int(Status.SAMPLING_TOO_SLOW)))
    assert 0.5 < growth[1] < stability.TRANSIENT_GROWTH
    np.testing.assert_allclose(growth[0], growth[1], rtol=0.02)
    assert reported == [False, False, True]
    assert ij.recommended_period(scenario, duration=2.0) >= 2e-4
