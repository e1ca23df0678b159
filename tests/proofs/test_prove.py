"""`ij.prove`: its verdicts, and what they mean for runs and for points of the level set."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from proof_cases import MASS, pendulum, within
from test_chains import LEVER, lever
from test_chains import within as lever_within

import iblf_jax as ij
from iblf_jax.cli import main
from iblf_jax.cli.prove import perturbations
from iblf_jax.proofs import Verdict
from iblf_jax.proofs.largest import scaled

LEVEL = 1.0


@functools.cache
def proof(K2=3.0, kf=100.0, percent=3.0, level=LEVEL, **options):
    parameters = within(percent) if percent else {}
    return ij.prove(
        pendulum(K2=K2, kf=kf), level=level, parameters=parameters, progress=False, **options
    )


def paper(**gains):
    scenario = ij.with_parts(
        ij.presets.zhang_yan_2024(variant="corrected"), disturbance=ij.disturbances.Nothing()
    )
    return ij.with_parameters(scenario, gains)


def largest_rate(found, count, seed=11):
    """The largest V_w' of random points of the level set."""
    constants = found.problem.constants(found.weight, found.level)
    return found.problem.rate(found.problem.sample(seed, count), constants).max()


def contradictions(found, count, duration=None):
    """Runs that leave the tube of the level set or the bounds."""
    failed = []
    for run in found.adversarial_runs(count, duration=duration):
        tube = found.tube
        t, q = np.asarray(run.t), np.asarray(run.q)
        for i in range(q.shape[1]):
            low = np.interp(t, tube.t, tube.lower[:, i])
            high = np.interp(t, tube.t, tube.upper[:, i])
            inside = t <= tube.t[-1]
            failed.append(np.any((q[:, i] < low - 1e-4)[inside] | (q[:, i] > high + 1e-4)[inside]))
        failed.append(bool(int(run.status) & ij.Status.BOUND_VIOLATED))
    return int(np.sum(failed))


@pytest.mark.slow
def test_a_proof_says_what_it_proves():
    found = proof()
    assert found.verdict == Verdict.PROVED and found.proved
    assert found.is_period and found.duration == pytest.approx(2 * math.pi)
    assert found.ranges == {"plant.mass[0]": pytest.approx((1.94, 2.06))}
    assert found.worst_box is None and found.point is None and found.violation is None
    assert repr(found).startswith("PROVED: {V_w <= 1} is invariant for all t and every plant")
    assert "Assumed:" in repr(found)


@pytest.mark.slow
def test_the_tube_is_where_the_barrier_has_the_level():
    found = proof()
    # V1 = -log(1 - xi^2) of the integral barrier with k_l = k_u scaled to the side
    assert found.tube.xi == pytest.approx(math.sqrt(1.0 - math.exp(-LEVEL)), rel=1e-9)
    assert np.all(found.tube.lower > found.tube.lower_bound)
    assert np.all(found.tube.upper < found.tube.upper_bound)


@pytest.mark.slow
def test_nothing_contradicts_a_proof():
    found = proof()
    assert largest_rate(found, 10_000) < 0.0
    assert contradictions(found, 4) == 0


@pytest.mark.release  # a program of its own
def test_the_nominal_plant_is_proved():
    found = proof(percent=0.0, level=0.5)
    assert found.proved and found.ranges == {}
    assert "the plant as given" in repr(found)


@pytest.mark.slow
def test_a_proof_is_repeatable():
    a = proof()
    b = ij.prove(pendulum(), level=LEVEL, parameters=within(3.0), progress=False, threads=1, seed=0)
    assert (a.weight, a.boxes, a.rates) == (b.weight, b.boxes, b.rates)


@pytest.mark.slow
def test_every_weight_has_a_point_that_refutes_the_lyapunov_function():
    found = proof(K2=20.0, kf=20.0, percent=20.0)
    assert found.verdict == Verdict.NOT_PROVED and found.seconds < 60.0
    assert len(found.growth_points) == len(found.rates) > 10
    assert all(point.rate > 0.0 for point in found.growth_points)
    assert "This refutes the Lyapunov function, not the bounds." in repr(found)
    with pytest.raises(ValueError, match="refuted"):
        found.replay()


@pytest.mark.slow
def test_a_run_that_leaves_the_bounds_refutes_them():
    found = ij.prove(
        pendulum(K2=20.0, kf=20.0),
        level=3.0,
        parameters={MASS: ij.factor(ij.interval(0.3, 5.0))},
        progress=False,
    )
    assert found.verdict == Verdict.REFUTED
    run = found.replay(100)
    assert int(run.status) & ij.Status.BOUND_VIOLATED
    assert not int(run.status) & ij.Status.INACCURATE
    assert float(np.min(np.asarray(run.metrics["margin"]))) == pytest.approx(
        found.violation.margin, rel=1e-6
    )
    assert "replay() returns it" in repr(found)


@pytest.mark.slow
def test_a_small_budget_leaves_it_undecided():
    found = proof(K2=20.0, kf=20.0, percent=WIDE, max_boxes=2_000)
    assert found.verdict == Verdict.UNDECIDED
    assert 0.0 < found.done < 1.0
    box = found.worst_box
    assert set(box.intervals) == set(found.problem.names)
    assert list(box.narrowed) == ["plant.mass[0]"]
    assert box.narrowed["plant.mass[0]"] <= box.bound
    left, units = found.units_left
    assert 0 < left <= units
    assert found.left_value < 0.0
    # A proof with more boxes exists, so that the narrowest ones are all negative.
    shares = list(found.negative_shares.values())
    assert shares == sorted(shares) and shares[0] < 1.0 and shares[-1] == 1.0
    assert set(found.left_intervals) == {"t", *found.problem.names[1:-1]}
    low, high = found.left_intervals["plant.mass[0]"]
    assert 0.95 <= low < high <= 1.05
    text = repr(found)
    assert "of the volume" in text and "units of work" in text and "increase max_boxes" in text


WIDE = 5.0
"""Percent: V_w' < 0 at all points that are sampled, and more boxes are needed than in the test."""


@pytest.mark.slow
def test_a_time_interval_that_is_no_period():
    found = proof(weight=2e-3, duration=2.0)
    assert found.proved and not found.is_period
    assert "for 0 <= t <= 2 s" in repr(found)
    assert found.tube.t[-1] == 2.0


@pytest.mark.release  # a program of its own
def test_constant_reference_and_bounds():
    scenario = pendulum(
        reference=ij.references.Sinusoid(offset=[0.5], amplitude=0.0, frequency=1.0),
        bounds=ij.Bounds(lower=ij.bounds.Constant([0.1]), upper=ij.bounds.Constant([1.0])),
    )
    found = ij.prove(scenario, level=0.5, parameters=within(3.0), progress=False)
    assert found.proved and found.is_period and found.duration == 0.0
    assert contradictions(found, 4) == 0


@pytest.mark.slow
def test_a_given_weight_is_the_only_one():
    found = proof(weight=2e-3)
    assert found.proved and list(found.rates) == [2e-3]


@pytest.mark.slow
def test_the_largest_level_and_box_are_proved_next_to_what_is_not():
    common = {"accuracy": 0.5, "max_boxes": 30_000, "progress": False, "weight": 2e-3}
    found = ij.largest_level(
        pendulum(K2=20.0, kf=20.0), parameters=within(3.0), between=(0.2, 6.0), **common
    )
    assert found.proved and found.history[0].value == 0.2
    assert found.level == max(x.value for x in found.history if x.verdict == Verdict.PROVED)
    box = ij.largest_parameters(
        pendulum(K2=20.0, kf=20.0), level=LEVEL, parameters=within(20.0), **common
    )
    assert box.proved
    low, high = box.ranges["plant.mass[0]"]
    assert 1.6 < low < 2.0 < high < 2.4


def test_deviations_are_scaled_about_the_value_that_changes_nothing():
    scenario = pendulum()
    factor = scaled(scenario, MASS, ij.factor(ij.interval(0.9, 1.3)), 0.5)
    offset = scaled(scenario, MASS, ij.offset(ij.interval(-0.2, 0.4)), 0.5)
    given = scaled(scenario, MASS, ij.value(ij.interval(1.0, 4.0)), 0.5)
    ends = [np.ravel(x.distribution.support()) for x in (factor, offset, given)]
    np.testing.assert_allclose(ends, [[0.95, 1.15], [-0.1, 0.2], [1.5, 3.0]])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"parameters": {MASS: ij.factor(ij.uniform(0.9, 1.1))}}, "interval"),
        ({"parameters": {"plant.mas": ij.factor(ij.interval(0.9, 1.1))}}, "plant.mas"),
        ({"parameters": {"model.mass": ij.factor(ij.interval(0.9, 1.1))}}, "model.mass"),
        ({"parameters": {MASS: ij.factor(ij.interval(-0.1, 1.1))}}, "mass"),
        ({"parameters": 3}, "parameters"),
        ({"level": 20.0}, "Lower the level"),
        ({"level": -1.0}, "level"),
        ({"weight": 0.0}, "weight"),
        ({"max_boxes": 0}, "max_boxes"),
        ({"disturbance_rate": -1.0}, "disturbance_rate"),
    ],
)
def test_bad_input_is_named(options, words):
    given = {"level": LEVEL, "parameters": within(1.0)} | options
    with pytest.raises(ValueError, match=words):
        ij.prove(pendulum(), **given)


def test_a_call_without_level_or_parameters_says_how_to_choose_them():
    with pytest.raises(ValueError, match=r"level: got None.*V\[0\].*ij\.largest_level"):
        ij.prove(lever(), parameters={})
    with pytest.raises(ValueError, match=r"parameters: got None.*ij\.interval.*{}"):
        ij.prove(pendulum(), level=LEVEL)
    of_study = {MASS: ij.factor(ij.uniform(0.9, 1.1))}
    with pytest.raises(ValueError, match=r"Write ij\.factor\(ij\.interval\(0\.9, 1\.1\)\)"):
        ij.prove(pendulum(), level=LEVEL, parameters=of_study)


@pytest.mark.slow
def test_without_a_level_the_set_contains_the_start():
    found = proof(level=None)
    assert found.proved
    start, largest = found.level_choice
    assert start <= found.level <= largest
    # With f_hat = 0 the start has the error f(0), the largest for the heaviest plant.
    scenario = ij.with_parameters(pendulum(), {MASS: 2.06})
    run = ij.simulate(scenario, duration=1e-3, dt=1e-3)
    f_tilde = float((run.disturbance - run.disturbance_estimate)[0, 0])
    e2 = float(run.e2[0, 0])
    M0 = 2.0 * 0.175**2 + 0.06
    V1 = -math.log1p(-(float(run.xi[0, 0]) ** 2))
    expected = V1 + 0.5 * M0 * e2**2 + 0.5 * found.weight * f_tilde**2
    assert start == pytest.approx(expected, rel=1e-6)
    assert "The level was chosen: the start has V_w <=" in repr(found)


@pytest.mark.parametrize(
    "parts",
    [
        {"sampling": ij.Sampling(1e-3)},
        {"actuator": ij.actuators.Motor(limit=10.0, bandwidth=1e3)},
        {"observer": ij.observers.NoObserver()},
        {"controller": ij.controllers.Backstepping(k1=2.0, K2=[3.0], o=0.1)},
    ],
)
def test_a_scenario_without_a_proof_is_refused(parts):
    name = next(iter(parts))
    with pytest.raises(ValueError, match=f"scenario.{name}"):
        ij.prove(pendulum(**parts), level=LEVEL, parameters=within(1.0))


def test_an_interval_with_a_singular_mass_matrix_is_refused():
    robot = ij.robots.PlanarChain(mass=[2.0], length=0.35, centre=0.175, inertia=0.0)
    scenario = pendulum(plant=robot, model=robot)
    with pytest.raises(ValueError, match="positive definite"):
        ij.prove(
            scenario, level=LEVEL, parameters={"plant.centre": ij.factor(ij.interval(0.0, 1.1))}
        )


@pytest.mark.slow
def test_figure_file_and_report(tmp_path):
    found = proof()
    figure = found.plot(runs=2)
    assert "proved" in figure.get_suptitle()
    assert ij.load(found.save(tmp_path / "proof")).sentence() == found.sentence()
    data = found.to_xarray()
    assert data.attrs["verdict"] == "proved" and data["range"].shape == (1, 2)
    assert "PROVED" in ij.report(found, tmp_path / "proof.html").read_text()


def test_the_command_proves(tmp_path, capsys):
    path = tmp_path / "pendulum.toml"
    ij.save_scenario(pendulum(), path)
    words = ["prove", str(path), "--level", "1.0", "--quiet", "--weight", "0.002"]
    assert main([*words, "--parameter", "plant.mass=factor:0.97:1.03"]) == 0
    assert "PROVED" in capsys.readouterr().out


def test_the_parameters_of_the_command():
    found = perturbations(["plant.mass[0], plant.inertia[0]=offset:-0.1:0.2"])
    (path, given) = found.popitem()
    assert path == "plant.mass[0], plant.inertia[0]" and given.kind == "offset"
    for word in ("plant.mass", "plant.mass=factor:1", "plant.mass=scale:1:2"):
        with pytest.raises(ValueError, match="PATH=KIND:LOW:HIGH"):
            perturbations([word])


@pytest.mark.slow
def test_gains_for_a_guarantee_are_proved():
    found = ij.gains_for_guarantee(
        pendulum(K2=20.0, kf=20.0),
        {"controller.K2": (1.0, 40.0), "observer.kf": (10.0, 100.0)},
        level=LEVEL,
        parameters=within(20.0),
        tries=60,
        progress=False,
    )
    assert found.rate_before > 0.0 > found.rate
    assert found.proof.proved
    assert set(found.gains) == {"controller.K2", "observer.kf"}


@pytest.mark.release  # a program of its own
def test_a_plant_in_strict_feedback_form_is_proved():
    found = ij.prove(
        lever(), level=0.3, parameters=lever_within(0.05, *LEVER), weight=0.56, progress=False
    )
    assert found.proved
    assert largest_rate(found, 10_000) < 0.0
    assert contradictions(found, 2) == 0


@pytest.mark.release
@pytest.mark.parametrize(
    ("gains", "percent", "level"),
    [
        ({"controller.K2": 3.0, "observer.kf": 100.0}, 1.0, 1.0),
        ({"controller.K2": 10.0, "observer.kf": 200.0}, 1.0, 1.0),
        ({"controller.K2": 3.0, "observer.kf": 100.0}, 2.0, 1.0),
    ],
)
def test_two_links_are_proved_and_nothing_contradicts(gains, percent, level):
    found = ij.prove(paper(**gains), level=level, parameters=within(percent), progress=False)
    assert found.proved
    assert max(largest_rate(found, 100_000, seed) for seed in range(10)) < 0.0
    assert contradictions(found, 10_000, duration=2.0) == 0


@pytest.mark.release
@pytest.mark.parametrize(("percent", "most"), [(0.1, 2_000_000), (0.2, 12_000_000)])
def test_the_gains_of_the_paper_are_proved_for_narrow_intervals(percent, most):
    inertia = percent / 100.0
    masses = {"plant.mass, plant.inertia": ij.factor(ij.interval(1.0 - inertia, 1.0 + inertia))}
    options = {"level": 0.5, "parameters": masses, "weight": 2e-3, "progress": False}
    found = ij.prove(paper(), max_boxes=most, **options)
    assert found.proved
    boxes, error = found.expected_boxes
    assert boxes == pytest.approx(found.boxes, abs=5.0 * error + 0.1 * found.boxes)
    assert max(largest_rate(found, 100_000, seed) for seed in range(10)) < 0.0
    assert contradictions(found, 1_000, duration=2.0) == 0


@pytest.mark.release
@pytest.mark.parametrize("level", [0.5, 1.0])
def test_the_gains_of_the_paper_are_not_proved_for_wide_intervals(level):
    found = ij.prove(paper(), level=level, parameters=within(3.0), progress=False)
    assert found.verdict == Verdict.NOT_PROVED
    assert all(point.rate > 0.0 for point in found.growth_points)
