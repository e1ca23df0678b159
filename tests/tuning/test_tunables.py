"""What can be tuned beside the gains: limits per joint, weights, filters, period and delay."""

import jax
import loops_of_plants
import numpy as np
import pytest
from proof_cases import pendulum
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.simulation.paths import get
from iblf_jax.simulation.scenario import canonical
from iblf_jax.tuning import evaluation, ranges
from iblf_jax.tuning.objectives import complete
from iblf_jax.tuning.parameters import along, by_values, in_units, layout, values_at
from iblf_jax.tuning.problem import TuningProblem

DT = 5e-4
SHORT = {"duration": 0.05, "dt": DT}
TOGETHER = [
    *("controller.k1", "controller.K2", "controller.weight", "observer.kf"),
    *("sensor.velocity.cutoff", "actuator.bandwidth", "sampling.period"),
]


@pytest.fixture(scope="module")
def lab():
    """The paper's arm with a loop as a robot has it, at rest beside its reference."""
    gains = {"controller.K2": [4.0, 3.0], "observer.kf": 4.0, "initial.q": [0.6, 0.7]}
    paper = ij.with_parameters(ij.presets.zhang_yan_2024(variant="corrected"), gains)
    velocity = ij.sensors.FilteredDifference(cutoff=400.0)
    parts = {
        "sampling": ij.Sampling(period=2e-3, delay=1.2e-3, queue=2),
        "sensor": ij.sensors.Encoder(counts=2.0**16, velocity=velocity),
        "actuator": ij.actuators.Motor(bandwidth=600.0, rate_limit=5000.0, limit=[40.0, 20.0]),
    }
    return canonical(ij.with_parts(paper, **parts))


def ends(scenario, parameter):
    """The range of a parameter in its unit, and its reasons."""
    blocks, box = layout(scenario, [parameter], DT, "rk4")
    return in_units(blocks, box.low), in_units(blocks, box.high), box.reasons[0]


def test_limits_are_for_each_entry_periods_have_no_derivative_and_some_scales_are_announced(lab):
    given = np.array([[1.0, 2.0], [np.inf, 9.0]])
    np.testing.assert_allclose(ends(lab, ij.tunable("controller.K2", *given))[:2], given)
    # One number for all joints keeps the limits of each.
    tied = ij.tunable("controller.K2", [0.1, 1.0], [9.0, 7.0], tied=True)
    np.testing.assert_allclose(ends(lab, tied)[:2], [[1], [7]])
    for low, words in (
        ([1.0, 3.5], r"controller.K2.*between its limits.*Widen"),
        ([1.0, 3.5, 2.0], r"K2.*low.*one number, or shape \(2,\)"),
    ):
        assert_refused(words, ends, lab, ij.tunable("controller.K2", low, 9.0))
    with pytest.warns(UserWarning, match="no derivative by it"):
        blocks, box = layout(lab, [ij.tunable("sampling.period", 0.8e-3, 3.2e-3)], DT, "rk4")
    assert by_values(blocks) == [0]
    np.testing.assert_allclose(in_units(blocks, box.low), 1e-3)
    np.testing.assert_allclose(in_units(blocks, box.high), 3e-3)
    found = [float(values_at(blocks, z)["sampling.period"]) for z in along(blocks, box, box.z, 9)]
    np.testing.assert_allclose(found, [2.5e-3, 1.5e-3, 3e-3, 1e-3])
    slope = jax.jacfwd(lambda z: values_at(blocks, z)["sampling.period"])(box.z)
    assert np.all(np.asarray(slope) == 0)
    with pytest.raises(ValueError, match="at least two multiples of dt"):
        layout(lab, [ij.tunable("sampling.period", 1.8e-3, 2.2e-3)], DT, "rk4")
    goal = ij.objectives.tracking() + ij.objectives.effort(scale=1.0)
    with pytest.warns(UserWarning, match=r"scale of tracking is its value .* by 0.2 rad"):
        complete(goal, [4.0, 3.0], margin=-0.2)
    assert complete(goal, [4.0, 3.0], margin=0.1).terms[0].scale == 4.0


@pytest.mark.slow
def test_ranges_of_gains_and_filters_keep_the_theorem_and_the_loop_stable(lab):
    paper = canonical(ij.presets.zhang_yan_2024())
    for path in ("controller.k1", "controller.K2", "observer.kf"):
        start = np.asarray(get(lab, path))
        low, _, (below, _) = ends(lab, path)
        assert below == ranges.BY_SMALL_FACTOR
        np.testing.assert_allclose(low, start / ranges.MAX_FACTOR)
        assert ends(paper, path)[2][0] == ranges.BY_THEOREM
    light = ij.with_parameters(paper, {"controller.weight": [1.0, 0.1]})
    low, _, (below, _) = ends(light, "controller.K2")
    assert below == ranges.BY_SIGN and np.all(low == 0)
    assert ends(light, "observer.kf")[2][0] == ranges.BY_THEOREM
    for path in ("sensor.velocity.cutoff", "actuator.bandwidth"):
        low, high, (below, above) = ends(lab, path)
        assert below == ranges.BY_PERIOD
        start = np.asarray(get(lab, path))
        assert np.all((low < start) & (start < high))
        assert not ranges.sampled_too_slowly(ij.with_parameters(lab, {path: low}))
        assert ranges.sampled_too_slowly(ij.with_parameters(lab, {path: 0.9 * low}))
        assert above == {"s": ranges.BY_NYQUIST, "a": ranges.BY_STEP}[path[0]]
    # A cutoff above the Nyquist frequency starts at the upper end.
    fast = ij.with_parameters(lab, {"sensor.velocity.cutoff": [400.0, 2000.0]})
    _, high, (_, above) = ends(fast, "sensor.velocity.cutoff")
    assert above == ranges.BY_NYQUIST
    np.testing.assert_allclose(high, [np.pi / 2e-3, 2020.0])
    unstable = ij.with_parameters(lab, {"controller.K2": 20.0})
    assert ranges.sampled_too_slowly(unstable)
    _, high, (_, above) = ends(unstable, "controller.k1")
    np.testing.assert_allclose(high, 1.01 * np.asarray(get(unstable, "controller.k1")))
    assert above == ranges.AT_START[ranges.BY_PERIOD] and "unstable already at the start" in above
    assert ends(lab, "controller.k1")[2][1] == ranges.BY_PERIOD
    _, box = layout(paper, ["controller.k1"], 0.1, "rk4")
    assert box.reasons[0][1] == ranges.AT_START[ranges.BY_STEP]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:sampling.period is a whole number")
def test_period_and_delay_are_within_what_loop_and_queue_allow(lab):
    low, high, (below, above) = ends(lab, "sampling.period")
    low, high = low[0], high[0]
    assert below == ranges.BY_QUEUE and above == ranges.BY_PERIOD
    np.testing.assert_allclose(low / DT, np.round(low / DT))
    np.testing.assert_allclose(high / DT, np.round(high / DT))
    assert 1.2e-3 / low < 2 <= 1.2e-3 / (low - DT)
    assert not ranges.sampled_too_slowly(ij.with_parameters(lab, {"sampling.period": high}))
    assert ranges.sampled_too_slowly(ij.with_parameters(lab, {"sampling.period": high + DT}))
    no_delay = ij.with_parameters(lab, {"sampling.delay": 0.0})
    assert ends(no_delay, "sampling.period")[2][0] == ranges.BY_ONE_STEP
    low, high, (below, _) = ends(lab, "sampling.delay")
    assert (low, below) == (0.0, ranges.BY_SIGN)
    assert 1.2e-3 < high < 4e-3
    at_once = canonical(ij.with_parts(lab, sampling=ij.Sampling(period=2e-3)))
    assert_refused(r"Sampling.queue: got 0.*queue=1", ends, at_once, "sampling.delay")


def test_ranges_of_bounds_contain_the_start():
    bounds = tuple(ij.Bounds(ij.bounds.Constant(-x), ij.bounds.Constant(x)) for x in (1.5, 5.0))
    start = ij.Initial(q=[0.8], dq=[0.6])
    loop = canonical(pendulum(bounds=bounds, initial=start))
    paths = [f"bounds[1].{side}.value" for side in ("upper", "upper", "lower")]
    paths[1] += "[0]"
    low = ranges.default_lows(loop, dict.fromkeys(paths[:2], np.array([5.0])), DT, "rk4")
    high = ranges.default_highs(loop, {paths[2]: np.array([-5.0])}, DT, "rk4")
    for path, expected in zip(paths, (5.0, 5.0, -5.0), strict=True):
        value, reason = (low | high)[path]
        np.testing.assert_allclose(value, 0.6 + ranges.LEAST_SHARE * (expected - 0.6))
        assert reason == ranges.BY_LEVEL


@pytest.mark.slow
def test_ranges_of_a_plant_keep_the_step_and_a_start_outside_of_its_bounds_is_refused():
    flexible = canonical(loops_of_plants.flexible_joint())
    stiffness, inertia = "model.stiffness", "plant.motor_inertia"
    low, high, (below, above) = ends(flexible, stiffness)
    assert (below, above) == (ranges.BY_SMALL_FACTOR, ranges.BY_STEP)
    np.testing.assert_allclose(low, 3.0)
    conditions = ranges.Conditions(flexible, DT, "rk4")
    assert not conditions.violated({stiffness: high})
    assert conditions.violated({stiffness: 1.05 * high}) == ranges.BY_STEP
    low, _, (below, above) = ends(flexible, inertia)
    assert (below, above) == (ranges.BY_STEP, ranges.BY_FACTOR)
    assert conditions.violated({inertia: 0.95 * low}) == ranges.BY_STEP
    assert ends(flexible, "plant.robot.mass")[2] == (ranges.BY_SIGN, ranges.UNLIMITED)
    drive = canonical(loops_of_plants.electric_drive())
    low = ends(drive, "bounds[2].upper.value")[0]
    # A start outside its bounds is refused.
    narrow = ij.with_parameters(drive, {"bounds[2].upper.value": low})
    assert float(ij.simulate(narrow, **SHORT).x[0, 2, 0]) < low[0]
    arm = ij.with_parameters(ij.presets.ur5(), {"plant.effort": np.inf})
    assert_refused(r"plant.effort.*finite numbers that tuning can start", ends, arm, "plant.effort")


def smooth(scenario):
    """The loop with an encoder that does not round, so that differences have a limit."""
    sensor = ij.sensors.Encoder(velocity=scenario.sensor.velocity)
    return canonical(ij.with_parts(scenario, sensor=sensor))


@pytest.mark.release
@pytest.mark.filterwarnings("ignore:sampling.period is a whole number")
def test_all_kinds_together_have_the_derivatives_of_simulate(lab):
    scenario = smooth(lab)
    goal = ij.objectives.tracking(scale=1e-4) + ij.objectives.effort(scale=1.0)
    goal += ij.objectives.peak_torque_below([30.0, 15.0])
    problem = TuningProblem.build(scenario, TOGETHER, goal, **SHORT)
    z = problem.box.z
    forward = evaluation.forward_derivatives(problem, problem.candidates(z[None]))
    found = np.asarray(forward.gradient[0])

    def loss_of(changed):
        metrics = ij.simulate(changed, **SHORT).metrics
        return float(np.sum(metrics.ise) / 1e-4 + metrics.effort)

    def loss(z):
        return loss_of(ij.with_parameters(scenario, values_at(problem.blocks, z)))

    h = 1e-4
    gradient = [(loss(z + h * e) - loss(z - h * e)) / (2 * h) for e in np.eye(len(z))]
    np.testing.assert_allclose(found, gradient, rtol=1e-3, atol=1e-6)
    period = by_values(problem.blocks)
    assert np.all(found[period] == 0) and np.all(np.abs(np.delete(found, period)) > 1e-6)

    twice = ij.tuning.Effort(iterations=2)
    best = ij.tune(scenario, TOGETHER, goal, effort=twice, progress=False, **SHORT)
    tuned = np.concatenate([np.ravel(best.values[block.path]) for block in problem.blocks])
    low, high = (in_units(problem.blocks, z) for z in (problem.box.low, problem.box.high))
    assert np.all((low * (1 - 1e-9) <= tuned) & (tuned <= high * (1 + 1e-9)))
    assert np.isclose(tuned[period] / DT, np.round(tuned[period] / DT))
    assert loss_of(best.scenario) < loss_of(scenario)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:sampling.period is a whole number")
def test_periods_are_compared_by_values(lab):
    parameters = ["controller.K2", ij.tunable("sampling.period", 1e-3, 4e-3)]
    goal = ij.objectives.tracking(scale=1e-4)
    options = {"duration": 0.2, "dt": DT}
    best = ij.tune(smooth(lab), parameters, goal, effort="quick", progress=False, **options)
    assert best.probes >= 7

    def loss(period):
        scenario = ij.with_parameters(best.scenario, {"sampling.period": period})
        return float(np.sum(ij.simulate(scenario, **options).metrics.ise))

    np.testing.assert_allclose(best.values["sampling.period"], min(DT * np.arange(2, 9), key=loss))
