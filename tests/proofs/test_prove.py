"""`ij.prove`: its verdicts, and what they mean for runs and for points of the level set."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from proof_cases import MASS, pendulum, within
from refused import assert_refused
from test_chains import LEVER, lever
from test_chains import within as lever_within

import iblf_jax as ij
from iblf_jax.cli import main
from iblf_jax.cli.prove import perturbations
from iblf_jax.proofs import Verdict
from iblf_jax.proofs._prove import _refuted
from iblf_jax.proofs.arms import arm_problem
from iblf_jax.proofs.largest import scaled
from iblf_jax.proofs.points import Sampled
from iblf_jax.proofs.undecided import SMALLER_LEVEL, _at_smaller_level

LEVEL = 1.0


@functools.cache
def proof(K2=3.0, kf=100.0, percent=3.0, level=LEVEL, **options):
    parameters = within(percent) if percent else {}
    options |= {"level": level, "parameters": parameters, "progress": False}
    return ij.prove(pendulum(K2=K2, kf=kf), **options)


def paper(**gains):
    scenario = ij.presets.zhang_yan_2024(variant="corrected")
    scenario = ij.with_parts(scenario, disturbance=ij.disturbances.Nothing())
    return ij.with_parameters(scenario, gains)


def check_proof(found, points, runs, seeds=(11,), duration=None):
    """Nothing contradicts a proof: no point of the level set at which V_w grows, and no run that
    leaves the tube of the level set or the bounds."""
    assert found.proved
    problem, tube = found.problem, found.tube
    constants = problem.constants(found.weight, found.level)
    for seed in seeds:
        assert problem.rate(problem.sample(seed, points), constants).max() < 0.0
    for run in found.adversarial_runs(runs, duration=duration):
        t, q = np.asarray(run.t), np.asarray(run.q)
        inside = t <= tube.t[-1]
        for i in range(q.shape[1]):
            low = np.interp(t, tube.t, tube.lower[:, i])
            high = np.interp(t, tube.t, tube.upper[:, i])
            assert np.all(((q[:, i] >= low - 1e-4) & (q[:, i] <= high + 1e-4))[inside])
        assert not int(run.status) & ij.Status.BOUND_VIOLATED


@pytest.mark.slow
def test_a_proof_says_what_it_proves_is_repeatable_and_nothing_contradicts_it():
    found = proof()
    assert found.verdict == Verdict.PROVED and found.proved
    assert found.is_period and found.duration == pytest.approx(2 * math.pi)
    assert found.ranges == {"plant.mass[0]": pytest.approx((1.94, 2.06))}
    assert found.worst_box is None and found.point is None and found.violation is None
    assert repr(found).startswith("PROVED: {V_w <= 1} is invariant for all t and every plant")
    assert "Assumed:" in repr(found)
    # V1 = -log(1 - xi^2) of the integral barrier with k_l = k_u scaled to the side
    assert found.tube.xi == pytest.approx(math.sqrt(1.0 - math.exp(-LEVEL)), rel=1e-9)
    assert np.all(found.tube.lower > found.tube.lower_bound)
    assert np.all(found.tube.upper < found.tube.upper_bound)
    check_proof(found, 10_000, 4)
    assert "proved" in found.plot(runs=2).get_suptitle()
    data = found.to_xarray()
    assert data.attrs["verdict"] == "proved" and data["range"].shape == (1, 2)
    again = proof(threads=1, seed=0)
    assert (again.weight, again.boxes, again.rates) == (found.weight, found.boxes, found.rates)


@pytest.mark.slow
def test_points_refute_the_lyapunov_function_and_a_run_that_leaves_the_bounds_refutes_them():
    found = proof(K2=20.0, kf=20.0, percent=20.0)
    assert found.verdict == Verdict.NOT_PROVED
    assert len(found.growth_points) == len(found.rates) > 10
    assert all(point.rate > 0.0 for point in found.growth_points)
    assert "This refutes the Lyapunov function, not the bounds." in repr(found)
    with pytest.raises(ValueError, match="refuted"):
        found.replay()
    wide = {MASS: ij.factor(ij.interval(0.3, 5.0))}
    found = ij.prove(pendulum(K2=20.0, kf=20.0), level=3.0, parameters=wide, progress=False)
    assert found.verdict == Verdict.REFUTED
    run = found.replay(100)
    assert int(run.status) & ij.Status.BOUND_VIOLATED
    assert not int(run.status) & ij.Status.INACCURATE
    margin = float(np.min(np.asarray(run.metrics["margin"])))
    assert margin == pytest.approx(found.violation.margin, rel=1e-6)
    assert "replay() returns it" in repr(found)


@pytest.mark.slow
def test_runs_start_at_the_beginning_where_a_reference_cannot_be_moved_in_time():
    scenario = pendulum(
        reference=ij.references.Quintic(start=[0.45], end=[0.6], duration=2.0),
        bounds=ij.Bounds(lower=ij.bounds.Constant([0.1]), upper=ij.bounds.Constant([1.0])),
    )
    problem = arm_problem(scenario, within(3.0), duration=4.0)
    constants = problem.constants(2e-3, LEVEL)
    points = problem.sample(0, 1)
    assert_refused("Quintic cannot be moved in time", problem.scenario_at, points[0], constants)
    sampled = Sampled(2e-3, points, np.zeros(1))
    with pytest.warns(UserWarning, match="start at t = 0: Quintic cannot be moved in time"):
        assert _refuted(problem, LEVEL, sampled, 1) is None
    points[0, 0] = 0.0
    state = problem.state_of(points[0], constants)
    run = ij.simulate(problem.scenario_at(points[0], constants), duration=1e-3, dt=1e-3)
    np.testing.assert_allclose(run.q[0], state.q, rtol=1e-12)
    np.testing.assert_allclose(run.dq[0], state.dq, rtol=1e-12)


@pytest.mark.slow
def test_a_small_budget_leaves_it_undecided():
    found = proof(K2=20.0, kf=20.0, percent=WIDE, max_boxes=2_000)
    assert found.verdict == Verdict.UNDECIDED and 0.0 < found.done < 1.0
    box = found.worst_box
    assert set(box.intervals) == set(found.problem.names)
    assert list(box.narrowed) == ["plant.mass[0]"] and box.narrowed["plant.mass[0]"] <= box.bound
    left, units = found.units_left
    assert 0 < left <= units
    assert found.left_value < 0.0
    # A proof with more boxes exists, so that the narrowest ones are all negative.
    shares = list(found.negative_shares.values())
    assert shares == sorted(shares) and shares[0] < 1.0 and shares[-1] == 1.0
    assert found.smaller_level_share == 1.0
    smaller = _at_smaller_level(found.problem, found.problem.constants(found.weight, LEVEL))
    expected = found.problem.constants(found.weight, SMALLER_LEVEL * LEVEL)
    assert all(np.array_equal(a, b) for a, b in zip(smaller, expected, strict=True))
    assert set(found.left_intervals) == {"t", *found.problem.names[1:-1]}
    low, high = found.left_intervals["plant.mass[0]"]
    assert 0.95 <= low < high <= 1.05
    text = repr(found)
    assert "of the volume" in text and "units of work" in text and "increase max_boxes" in text
    few = {"negative_shares": dict.fromkeys(found.negative_shares, 0.5)}
    for share, words in {
        1.0: "All of them are negative with level=0.25, which is likely to be proved",
        0.75: "With level=0.25, 75 % of them are negative",
        0.5: "No more of them are negative with level=0.25",
    }.items():
        assert words in repr(dataclasses.replace(found, smaller_level_share=share, **few))


WIDE = 5.0
"""Percent: V_w' < 0 at all points that are sampled, and more boxes are needed than in the test."""


@pytest.mark.slow
def test_a_time_interval_that_is_no_period_and_a_chosen_level_whose_set_contains_the_start():
    found = proof(weight=2e-3, duration=2.0)
    assert found.proved and not found.is_period
    assert list(found.rates) == [2e-3] and "for 0 <= t <= 2 s" in repr(found)
    assert found.tube.t[-1] == 2.0
    found = proof(level=None)
    assert found.proved
    start, largest = found.level_choice
    assert start <= found.level <= largest
    # With f_hat = 0 the start has the error f(0), the largest for the heaviest plant.
    run = ij.simulate(ij.with_parameters(pendulum(), {MASS: 2.06}), duration=1e-3, dt=1e-3)
    f_tilde = float((run.disturbance - run.disturbance_estimate)[0, 0])
    e2 = float(run.e2[0, 0])
    M0 = 2.0 * 0.175**2 + 0.06
    V1 = -math.log1p(-(float(run.xi[0, 0]) ** 2))
    assert start == pytest.approx(V1 + 0.5 * M0 * e2**2 + 0.5 * found.weight * f_tilde**2, rel=1e-6)
    assert "The level was chosen: the start has V_w <=" in repr(found)


@pytest.mark.release  # a program of its own
def test_constant_reference_and_bounds():
    scenario = pendulum(
        reference=ij.references.Sinusoid(offset=[0.5], amplitude=0.0, frequency=1.0),
        bounds=ij.Bounds(lower=ij.bounds.Constant([0.1]), upper=ij.bounds.Constant([1.0])),
    )
    found = ij.prove(scenario, level=0.5, parameters=within(3.0), progress=False)
    assert found.is_period and found.duration == 0.0
    check_proof(found, 10_000, 4)


@pytest.mark.slow
def test_the_largest_level_and_box_and_gains_for_a_guarantee_are_proved():
    common = {"accuracy": 0.5, "max_boxes": 30_000, "progress": False, "weight": 2e-3}
    loop = pendulum(K2=20.0, kf=20.0)
    found = ij.largest_level(loop, parameters=within(3.0), between=(0.2, 6.0), **common)
    assert found.proved and found.history[0].value == 0.2
    assert found.level == max(x.value for x in found.history if x.verdict == Verdict.PROVED)
    box = ij.largest_parameters(loop, level=LEVEL, parameters=within(20.0), **common)
    assert box.proved
    low, high = box.ranges["plant.mass[0]"]
    assert 1.6 < low < 2.0 < high < 2.4
    ranges = {"controller.K2": (1.0, 40.0), "observer.kf": (10.0, 100.0)}
    options = {"level": LEVEL, "parameters": within(20.0), "tries": 60, "progress": False}
    found = ij.gains_for_guarantee(loop, ranges, **options)
    assert found.rate_before > 0.0 > found.rate and found.proof.proved
    assert set(found.gains) == {*ranges}


def test_deviations_are_scaled_about_the_value_that_changes_nothing_and_parsed_from_words():
    scenario = pendulum()
    factor = scaled(scenario, MASS, ij.factor(ij.interval(0.9, 1.3)), 0.5)
    offset = scaled(scenario, MASS, ij.offset(ij.interval(-0.2, 0.4)), 0.5)
    given = scaled(scenario, MASS, ij.value(ij.interval(1.0, 4.0)), 0.5)
    ends = [np.ravel(x.distribution.support()) for x in (factor, offset, given)]
    np.testing.assert_allclose(ends, [[0.95, 1.15], [-0.1, 0.2], [1.5, 3.0]])
    (path, given) = perturbations(["plant.mass[0], plant.inertia[0]=offset:-0.1:0.2"]).popitem()
    assert path == "plant.mass[0], plant.inertia[0]" and given.kind == "offset"
    for word in ("plant.mass", "plant.mass=factor:1", "plant.mass=scale:1:2"):
        assert_refused("PATH=KIND:LOW:HIGH", perturbations, [word])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"parameters": {"plant.mas": ij.factor(ij.interval(0.9, 1.1))}}, "plant.mas"),
        ({"level": 20.0}, "Lower the level"),
        ({"level": -1.0}, "level"),
        ({"weight": 0.0}, "weight"),
        ({"max_boxes": 0}, "max_boxes"),
        ({"disturbance_rate": -1.0}, "disturbance_rate"),
        ({"parameters": None}, r"parameters: got None.*ij\.interval.*{}"),
        (
            {"scenario": lever(), "level": None, "parameters": {}},
            r"level: got None.*V\[0\].*ij\.largest_level",
        ),
        (
            {"parameters": {MASS: ij.factor(ij.uniform(0.9, 1.1))}},
            r"Write ij\.factor\(ij\.interval\(0\.9, 1\.1\)\)",
        ),
    ],
)
def test_bad_input_is_named(options, words):
    given = {"scenario": pendulum(), "level": LEVEL, "parameters": within(1.0)} | options
    assert_refused(words, ij.prove, **given)


@pytest.mark.slow
def test_the_command_proves(tmp_path, capsys):
    path = tmp_path / "pendulum.toml"
    ij.save_scenario(pendulum(), path)
    words = ["prove", str(path), "--level", "1.0", "--quiet", "--weight", "0.002"]
    assert main([*words, "--parameter", "plant.mass=factor:0.97:1.03"]) == 0
    assert "PROVED" in capsys.readouterr().out


@pytest.mark.release  # a program of its own
def test_a_plant_in_strict_feedback_form_is_proved():
    options = {"level": 0.3, "parameters": lever_within(0.05, *LEVER), "weight": 0.56}
    check_proof(ij.prove(lever(), progress=False, **options), 10_000, 2)


@pytest.mark.release
@pytest.mark.parametrize(
    ("K2", "kf", "percent"), [(3.0, 100.0, 1.0), (10.0, 200.0, 1.0), (3.0, 100.0, 2.0)]
)
def test_two_links_are_proved_and_nothing_contradicts(K2, kf, percent):
    scenario = paper(**{"controller.K2": K2, "observer.kf": kf})
    found = ij.prove(scenario, level=1.0, parameters=within(percent), progress=False)
    check_proof(found, 100_000, 10_000, seeds=range(10), duration=2.0)


@pytest.mark.release
@pytest.mark.parametrize(("percent", "most"), [(0.1, 2_000_000), (0.2, 12_000_000)])
def test_the_gains_of_the_paper_are_proved_for_narrow_intervals(percent, most):
    inertia = percent / 100.0
    masses = {"plant.mass, plant.inertia": ij.factor(ij.interval(1.0 - inertia, 1.0 + inertia))}
    options = {"level": 0.5, "parameters": masses, "weight": 2e-3, "progress": False}
    found = ij.prove(paper(), max_boxes=most, **options)
    boxes, error = found.expected_boxes
    assert boxes == pytest.approx(found.boxes, abs=5.0 * error + 0.1 * found.boxes)
    check_proof(found, 100_000, 1_000, seeds=range(10), duration=2.0)


@pytest.mark.release
@pytest.mark.parametrize("level", [0.5, 1.0])
def test_the_gains_of_the_paper_are_not_proved_for_wide_intervals(level):
    found = ij.prove(paper(), level=level, parameters=within(3.0), progress=False)
    assert found.verdict == Verdict.NOT_PROVED
    assert all(point.rate > 0.0 for point in found.growth_points)
