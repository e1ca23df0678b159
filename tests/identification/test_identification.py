"""Parameters from logs that other programs made: values and their errors, what a log cannot tell,
and logs that are wrong.

The other programs, which share nothing with the package, are `independent_log`: the arm of
`independent.Loop` with friction in NumPy, moved by RK4 under a held torque, its encoders of 14
bits; and MuJoCo, which moves seven joints under a computed torque with wrong masses.
"""

import dataclasses
import json
import re

import jax
import jax.numpy as jnp
import loops_of_plants
import numpy as np
import pytest
import tomli_w
import xarray
from arm_cases import as_mjcf
from conftest import ROOT
from independent import Loop
from refused import assert_refused
from scipy.signal import savgol_filter

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.core.pytree import astype
from iblf_jax.files.identification import load_identification_file
from iblf_jax.files.study import study_from_dict
from iblf_jax.identification import statistics
from iblf_jax.identification.assessment import missing_terms_of_fit
from iblf_jax.identification.coordinates import coordinates, to_x, to_z, with_widths
from iblf_jax.identification.log import read
from iblf_jax.identification.missing_terms import missing_terms
from iblf_jax.identification.regression import _alternative_readings
from iblf_jax.identification.replay import inverse_dynamics
from iblf_jax.identification.shooting import ShootingProblem, windows
from iblf_jax.identification.smoothing import SmoothedMotion, smooth_logs
from iblf_jax.identification.standstill import free_torques_at_standstill
from iblf_jax.reports import shown
from iblf_jax.simulation.scenario import canonical

MASS, VISCOUS = np.array([2.0, 0.85]), np.array([0.15, 0.08])
COULOMB, WIDTH = np.array([0.2, 0.1]), 0.05
LENGTH, CENTRE, INERTIA = (0.35, 0.31), (0.175, 0.155), (0.06125, 0.02042125)
PATHS = ["robot.mass", "disturbance.viscous", "disturbance.coulomb"]
COUNT = 2.0 * np.pi / 2**14
ARM = Loop(mass=MASS, length=LENGTH, centre=CENTRE, inertia=INERTIA)


def smooth(dq, bristle):
    """Coulomb friction over a width; no bristle."""
    return COULOMB * np.tanh(dq / WIDTH), np.zeros(2)


def sticking(dq, bristle):
    """A bristle that gives way by 1 mrad and breaks away at 1.3 times the friction (LuGre)."""
    stiffness, most = COULOMB / 1e-3, COULOMB * (1.0 + 0.3 * np.exp(-((dq / 0.01) ** 2)))
    return stiffness * bristle, dq - np.abs(dq) * stiffness * bristle / most


def independent_log(duration=8.0, step=4e-3, seed=0, friction=smooth, substeps=2):
    """t, q in counts, tau: PD about a sum of sinusoids, from the counts."""
    rng = np.random.default_rng(seed)
    A, P = rng.uniform(0.2, 0.4, (3, 2)), rng.uniform(0, 6.28, (3, 2))
    W = np.array([[1.0, 1.4], [2.3, 3.1], [4.1, 5.3]])

    def reference(t):
        position = np.array([0.6, 0.5]) + np.sum(A * np.sin(W * t + P), axis=0)
        return position, np.sum(A * W * np.cos(W * t + P), axis=0)

    def rate(x):
        """Of q, q' and the bristle, (3, 2)."""
        q, dq, bristle = x
        rubbing, change = friction(dq, bristle)
        return np.array([dq, ARM.acceleration(q, dq, tau - VISCOUS * dq - rubbing), change])

    x, h = np.array([*reference(0.0), np.zeros(2)]), step / substeps
    before, speed, rows = x[0], x[1], []
    for k in range(round(duration / step)):
        y = COUNT * np.round(x[0] / COUNT)
        speed, before = 0.6 * speed + 0.4 * (y - before) / step if k else speed, y
        desired, desired_rate = reference(k * step)
        tau = np.array([8.0, 2.0]) * np.cos(np.cumsum(y)) + np.array([40.0, 8.0]) * (desired - y)
        tau = tau + np.array([4.0, 0.6]) * (desired_rate - speed)
        rows.append((k * step, y, tau))
        for _ in range(substeps):
            k1 = rate(x)
            k2 = rate(x + h / 2 * k1)
            k3 = rate(x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))
    return dict(zip(("t", "q", "tau"), map(np.array, zip(*rows, strict=True)), strict=True))


@pytest.fixture(scope="module")
def log():
    return independent_log()


@pytest.fixture(scope="module")
def scenario():
    """What is believed before: other masses, hardly any friction."""
    robot = ij.robots.TwoLink(mass=[1.6, 1.0], length=LENGTH, centre=CENTRE, inertia=INERTIA)
    friction = ij.disturbances.Friction(viscous=0.05, coulomb=0.05, width=0.05)
    return ij.with_parts(ij.presets.zhang_yan_2024(), robot=robot, disturbance=friction)


@pytest.fixture(scope="module")
def known(scenario, log):
    return ij.identify(scenario, log, PATHS)


@pytest.fixture(scope="module")
def heavier(scenario):
    return ij.with_parameters(scenario, {"plant.mass": MASS})


@pytest.fixture(scope="module")
def run(heavier):
    return ij.simulate(heavier, duration=6.0, dt=1e-3)


def counted(run, rows=slice(None)):
    t, q, tau = (np.asarray(x)[rows] for x in (run.t, run.q, run.tau))
    return {"t": t, "q": COUNT * np.round(q / COUNT), "tau": tau}


def z_scores(known, truth):
    errors = known.standard_errors
    return np.concatenate([(known.values[path] - x) / errors[path] for path, x in truth.items()])


TRUTH = {"robot.mass": MASS, "disturbance.viscous": VISCOUS, "disturbance.coulomb": COULOMB}


@pytest.mark.slow
def test_true_values_are_within_their_errors_which_are_drawn_together(known, scenario):
    """The draws of a study have the covariance of the identification, also between leaves."""
    assert np.max(np.abs(z_scores(known, TRUTH))) < 4.0
    assert np.max(np.abs(known.values["robot.mass"] / MASS - 1.0)) < 1e-3
    # An error that is too large covers anything.
    assert np.max(known.standard_errors["robot.mass"]) < 1e-3
    assert all(number.verdict == "told" for number in known.numbers[:6])
    assert abs(known.delay) < 4.0 * known.delay_error < 1e-3
    for one in known.fit:
        for left in (one.after, one.held_back):
            assert 0.9 < left / (COUNT / np.sqrt(12)) < 1.15
        assert one.before > 30 * one.after and one.explained > 0.99
    assert 0 < np.sum(~known.kept) < np.sum(known.kept)
    for robot in (known.scenario.plant, known.scenario.model):
        np.testing.assert_allclose(robot.mass, known.values["robot.mass"])
    coulomb = known.values["disturbance.coulomb"]
    np.testing.assert_allclose(known.scenario.disturbance.coulomb, coulomb)
    assert known.scenario.initial.q.dtype == scenario.initial.q.dtype
    np.testing.assert_array_equal(known.scenario.controller.K2, scenario.controller.K2)
    assert set(known.perturbations) == {"plant.mass", "disturbance.viscous", "disturbance.coulomb"}
    study = ij.monte_carlo(known.scenario, known.perturbations, runs=2000, duration=0.01, dt=1e-3)
    drawn = np.concatenate([study.samples[path] for path in known.perturbations], axis=1)
    size, correlation = np.sqrt(np.diag(known.covariance)[:6]), known.correlation[:6, :6]
    np.testing.assert_allclose(drawn.std(axis=0), size, rtol=0.1)
    np.testing.assert_allclose(np.corrcoef(drawn.T), correlation, atol=0.1)
    assert np.max(np.abs(correlation - np.eye(6))) > 0.3  # else the line above says nothing
    means = np.concatenate(list(known.values.values()))[:6]
    np.testing.assert_allclose(drawn.mean(axis=0), means, atol=0.1 * size.max())


@pytest.mark.slow
def test_friction_that_sticks_is_left_to_the_log(scenario):
    """A bristle is no tanh: about standstill torques are free, which does not spoil the rest."""
    known = ij.identify(scenario, independent_log(seed=1, friction=sticking, substeps=10), PATHS)
    verdicts = [number.verdict for number in known.numbers]
    assert (set(verdicts[:6]), set(verdicts[6:])) == ({"told"}, {"left free"})
    assert np.max(np.abs(z_scores(known, TRUTH))) < 4.0
    assert np.max(np.abs(known.values["robot.mass"] / MASS - 1.0)) < 1e-3
    assert np.max(known.standard_errors["robot.mass"]) < 1e-3
    assert all(one.lacking < 1.1 for one in known.fit)
    assert np.all(np.isnan(known.values["disturbance.width"]))
    for words in ("6 of 6 numbers told", "the friction of all joints: with coulomb tanh"):
        assert words in repr(known)
    np.testing.assert_array_equal(known.scenario.disturbance.width, scenario.disturbance.width)


@pytest.mark.slow
def test_what_a_log_cannot_tell_is_not_the_start_as_an_answer(scenario, log):
    """m1, lc1 and I1 enter as two numbers, p1 and p4, which are right in the scenario."""
    start = ij.with_parameters(scenario, {"robot.mass[1]": MASS[1]})
    three = ["robot.mass[0]", "robot.centre[0]", "robot.inertia[0]"]
    known = ij.identify(start, log, [*three, *PATHS[1:]], widths=False)
    for number in known.numbers[:3]:
        assert (number.value, number.error, number.verdict) == (None, None, "cannot be told")
        assert np.isnan(known.values[number.name]) and np.isinf(known.standard_errors[number.name])
    assert len(known.untold) == 1 and all(name in known.untold[0] for name in three)
    assert set(known.perturbations) == set(PATHS[1:])
    model = known.scenario.model
    m, lc, J = (float(x[0]) for x in (model.mass, model.centre, model.inertia))
    assert abs(m - MASS[0]) > 0.01  # it was not found by chance
    np.testing.assert_allclose(m * lc, MASS[0] * CENTRE[0], rtol=1e-3)
    np.testing.assert_allclose(m * lc**2 + J, MASS[0] * CENTRE[0] ** 2 + INERTIA[0], rtol=1e-3)


@pytest.mark.slow
def test_a_delay_of_the_torque_is_found_and_that_of_the_command_is_a_leaf(scenario, log):
    # Positions of 8 ms later.
    late = {"t": log["t"][:-2], "q": log["q"][2:], "tau": log["tau"][:-2]}
    known = ij.identify(scenario, late, PATHS, widths=False)
    assert abs(known.delay + 8e-3) < 5 * known.delay_error
    assert np.max(np.abs(z_scores(known, TRUTH))) < 5.0
    commanded = part_of(log | {"tau": np.roll(log["tau"], -1, axis=0)}, slice(0, -1))
    lab = ij.with_parts(scenario, sampling=ij.Sampling(4e-3, delay=1e-3))
    known = ij.identify(lab, commanded, [*PATHS, "sampling.delay"], widths=False)
    assert abs(float(known.scenario.sampling.delay) - 4e-3) < 5 * known.delay_error < 1e-3
    assert set(known.values) == set(PATHS)


@pytest.mark.slow
def test_irregular_times_a_gap_outliers_and_a_log_that_is_held_back(scenario, log, run, rng):
    """Rows left out at random, and a third of a second at once; the torque is interpolated."""
    rows = np.sort(rng.choice(6000, 3500, replace=False))
    gap = counted(run, rows[(rows < 2000) | (rows > 2300)])
    assert [len(one.segments) for one in read(gap, 2)] == [2]
    known = ij.identify(scenario, gap, ["robot.mass"], torque="interpolated", held_out=0)
    assert np.max(np.abs(z_scores(known, {"robot.mass": MASS}))) < 4.0
    assert np.max(np.abs(known.values["robot.mass"] / MASS - 1.0)) < 1e-3
    assert all(np.isnan(one.held_back) for one in known.fit)
    q = log["q"].copy()
    hit = rng.choice(q.size, 40, replace=False)
    q.ravel()[hit] += rng.choice([-0.05, 0.05], 40)
    spoilt = log | {"q": q}
    parts = [part_of(spoilt, slice(0, 700)), part_of(spoilt, slice(760, None))]
    options = {"held_out": part_of(log, slice(0, 600)), "loss": "huber", "widths": False}
    both = ij.identify(scenario, parts, PATHS, **options)
    assert np.max(np.abs(both.values["robot.mass"] / MASS - 1.0)) < 2e-3
    assert np.sum(~both.kept) == 4 and len(both.logs) == 3


def part_of(log, rows):
    return {name: x[rows] for name, x in log.items()}


def test_the_end_of_each_log_is_held_back_as_its_share_says(rng):
    t = 0.01 * np.arange(200)
    one = {"t": t, "q": rng.normal(size=(200, 2)), "tau": rng.normal(size=(200, 2))}
    cut = windows(read([one, one, one], 2), 0.2, [0.0, 0.25, 0.5], hold=True)
    kept = [cut.kept[cut.log == i] for i in range(3)]
    assert len({len(x) for x in kept}) == 1 and len(kept[0]) >= 8
    count = len(kept[0])
    assert [int(x.sum()) for x in kept] == [count - round(s * count) for s in (0, 0.25, 0.5)]
    for i in range(3):
        assert not np.any(np.diff(kept[i].astype(int)) > 0)  # the end, and nothing before it
        np.testing.assert_array_equal(cut.t[cut.log == i], cut.t[cut.log == 0])
    np.testing.assert_allclose(np.diff(cut.t, axis=1), 0.01)
    np.testing.assert_array_equal(cut.y[0], one["q"][np.searchsorted(t, cut.t[0] - 1e-9)])


@pytest.mark.slow
def test_priors_and_limits(scenario, log):
    """What was known before is believed for what it is worth; what is at a limit is said to be."""
    fixed = ij.identify(scenario, log, PATHS, widths=False, priors={"robot.mass": (MASS, 1e-7)})
    np.testing.assert_allclose(fixed.values["robot.mass"], MASS, atol=5e-7)
    assert np.max(fixed.standard_errors["robot.mass"]) < 5e-7
    # At the second one, the misfit is so large that nothing else is told.
    limits = {"disturbance.coulomb": (0.0, [0.199, 0.15]), "robot.mass": (None, [1.8, 1.2])}
    for path, ends in limits.items():
        bound = ij.identify(scenario, log, PATHS, widths=False, limits={path: ends})
        name, at = f"{path}[0]", ends[1][0]
        number = bound.numbers[bound.names.index(name)]
        assert (number.verdict, number.value) == ("at its limit", at)
        assert name not in "".join(bound.perturbations)
        (words,) = (note for note in bound.notes if name in note)
        assert f"{at:g} " in words and f"The upper end of limits['{path}']" in words
        free = float(re.search(r"asks for about ([\d.]+\d)", words)[1])
        assert free == pytest.approx(TRUTH[path][0], rel=0.02)


def with_friction(scenario, viscous, coulomb):
    """The scenario with the masses of the robot that was logged, and friction."""
    friction = ij.disturbances.Friction(viscous=viscous, coulomb=coulomb, width=WIDTH)
    return ij.with_parameters(ij.with_parts(scenario, disturbance=friction), {"robot.mass": MASS})


def lacking(scenario, log, paths):
    """The terms that a fit lacks which ended at the scenario's numbers."""
    with jax.enable_x64(True):
        replayed, c = coordinates(canonical(astype(canonical(scenario), "float64")), paths, {})
        seen, z = smooth_logs(read(log, 2), True), np.append(to_z(c, c.x), 0.0)
        return missing_terms_of_fit(replayed, c, seen, z, np.ones(len(z), bool))


@pytest.fixture(scope="module")
def other_logs():
    return [independent_log(duration=5.0, seed=seed) for seed in (11, 12)]


@pytest.mark.slow
def test_coulomb_friction_that_was_left_out_biases_what_makes_up_for_it(scenario, other_logs):
    """Viscous friction is then about twice too large: biased, by about what it is too large."""
    start = ij.with_parameters(scenario, {"disturbance.coulomb": 0.0})
    known = ij.identify(start, other_logs[0], PATHS[:2])
    found = sorted(note for note in known.notes if "depends on the sign of its velocity" in note)
    assert [i for i, note in enumerate(found) if f"joint {i}" in note] == [0, 1]
    sizes = [float(re.search(r"has ([\d.]+) ", note)[1]) for note in found]
    np.testing.assert_allclose(sizes, COULOMB, rtol=0.2)
    assert all("Add 'disturbance.coulomb' to the paths" in note for note in found)
    for number, truth in zip(known.numbers[2:], VISCOUS, strict=True):
        assert number.verdict in ("biased", "cannot be told")
        if number.value is not None and number.value > 1.2 * truth:
            assert 0.3 < number.bias / (number.value - truth) < 3.0
    assert any(number.verdict == "biased" for number in known.numbers)
    assert "biased" in repr(known) and "compensate for missing terms" in repr(known)
    assert "biased" in shown(known).tables["Numbers"]
    assert not any("viscous" in path for path in known.perturbations)


@pytest.mark.slow
def test_left_out_gravity_and_inertia_are_named_and_nothing_else(known, scenario, other_logs):
    """Those of a payload and a rotor, of the torques that are logged: nothing else is wrong."""
    assert not any("The residual torque of" in note or "biased" in note for note in known.notes)
    assert all(number.bias is None for number in known.numbers)
    truth = with_friction(scenario, VISCOUS, COULOMB)
    for log in other_logs:
        assert not lacking(truth, log, PATHS).findings
    rate = np.gradient(np.gradient(log["q"], log["t"], axis=0), log["t"], axis=0)
    gravity = np.array([0.0, 0.4]) * np.cos(log["q"])
    rotor = np.array([0.05, 0.0]) * savgol_filter(rate, 31, 2, axis=0)
    for torque, expected in ((gravity, (1, "cosine")), (rotor, (0, "acceleration"))):
        found = lacking(truth, log | {"tau": log["tau"] + torque}, PATHS[1:]).findings
        assert {(one.joint, one.kind) for one in found} == {expected}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("viscous", "coulomb", "known", "kind", "sizes"),
    [
        (VISCOUS, 0.0, 2, "sign", COULOMB),
        (0.0, COULOMB, 1, "velocity", VISCOUS),
        (VISCOUS, 2.0 * COULOMB, 2, "sign", -COULOMB),
    ],
)
def test_what_was_left_out_is_named(viscous, coulomb, known, kind, sizes, scenario, other_logs):
    found = lacking(with_friction(scenario, viscous, coulomb), other_logs[0], PATHS[:known])
    expected = {(j, kind) for j, size in enumerate(sizes) if size is not None}
    assert {(one.joint, one.kind) for one in found.findings} == expected
    for one in found.findings:
        np.testing.assert_allclose(one.size, sizes[one.joint], rtol=0.25)
        assert one.error < 0.2 * abs(one.size) and one.gain > 0.3


def test_terms_that_a_regression_lacks_are_found_with_the_bias_that_they_cause(rng):
    t = np.arange(0.0, 40.0, 0.01)
    q = np.stack([np.sin(1.3 * t) + 0.5 * np.sin(3.1 * t), 0.7 * np.cos(2.2 * t) + 0.1 * t], axis=1)
    dq = np.gradient(q, 0.01, axis=0)
    ddq = np.gradient(dq, 0.01, axis=0)
    friction = np.stack([0.3 * np.tanh(dq[:, 0] / 0.05), 0.5 * q[:, 1] ** 0], axis=1)
    tau = 2.0 * ddq + friction + 0.01 * rng.normal(size=q.shape)
    motion = SmoothedMotion(t, q, dq, ddq, tau, np.zeros_like(q), np.zeros(2), dq)
    # The columns of an inertia and of a viscous friction of both joints.
    by_x, fitted = np.stack([ddq, dq], axis=-1), np.array([True, True, False])
    found = missing_terms(motion, 2.0 * ddq, by_x, 0.0, fitted)
    sizes = {(one.joint, one.kind): one.size for one in found.findings}
    assert sizes == {
        (0, "sign"): pytest.approx(0.3, rel=0.05),
        (1, "constant"): pytest.approx(0.5, rel=0.05),
    }
    expected = np.linalg.lstsq(by_x.reshape(-1, 2), friction.ravel(), rcond=None)[0]
    np.testing.assert_allclose(found.bias, expected, rtol=0.1, atol=0.02)
    assert all(0.5 < one.gain <= 1.0 and one.error < 0.1 * one.size for one in found.findings)


def scaled(name, factor):
    return lambda x: x | {name: factor * x[name]}


def exchanged(*names):
    return lambda x: x | {name: x[name][:, ::-1] for name in names}


def with_rows(name, index, value):
    return lambda x: x | {name: np.concatenate([x[name][:index], [value], x[name][index + 1 :]])}


MOTION = ("q", "dq", "ddq")
READINGS = {
    "with q in degrees": (MOTION, np.degrees),
    "with tau in kgf m": (("tau",), lambda x: x / 9.80665),
    "with tau[1] of the other sign": (("tau",), lambda x: x * [1.0, -1.0]),
    "with q[1] of the other sign": (MOTION, lambda x: x * [1.0, -1.0]),
    "with q[1] and tau[1] of the other sign": ((*MOTION, "tau"), lambda x: x * [1.0, -1.0]),
    "with tau[0] and tau[1] exchanged": (("tau",), lambda x: x[:, ::-1]),
    "with q[0] and q[1] exchanged": (MOTION, lambda x: x[:, ::-1]),
    "with joints 0 and 1 exchanged, q and tau": ((*MOTION, "tau"), lambda x: x[:, ::-1]),
}
"""How a message reads a log -> the signals of a log of which it is true, and what spoilt them."""


@pytest.mark.parametrize("words", READINGS)
def test_another_reading_of_a_log_mends_what_is_wrong_with_it(words, rng):
    true = SmoothedMotion(*rng.normal(size=(8, 5, 2)))
    names, spoil = READINGS[words]
    spoilt = true._replace(**{name: spoil(getattr(true, name)) for name in names})
    for name, x in dict(_alternative_readings(spoilt))[words]._asdict().items():
        np.testing.assert_allclose(x, getattr(true, name), rtol=1e-12)


def standing(x):
    flicker = COUNT * (np.arange(len(x["q"]))[:, None] % 3 == 0)
    return x | {"q": x["q"][:1] + flicker}


WRONG = {
    "degrees": (scaled("q", np.degrees(1.0)), "It would fit in degrees"),
    "newton_millimetres": (scaled("tau", 1e3), "times what .* robot needs .* Convert it to N m"),
    "joints_exchanged": (exchanged("q", "tau"), "with joints 0 and 1 exchanged, q and tau"),
    "one_sign": (scaled("tau", np.array([1.0, -1.0])), r"with tau\[1\] of the other sign, they"),
    "milliseconds": (scaled("t", 1e3), "got .* rad of motion in .* Divide times in ms by 1000"),
    "no_numbers": (with_rows("q", 7, [np.nan] * 2), r"1 of 2000, the first is row 7 \(in q\)"),
    "standing": (standing, "a robot that stands still"),
    "times_turn_back": (with_rows("t", 9, 0.0), "times that increase"),
    "no_torque": (lambda x: {"t": x["t"], "q": x["q"]}, r"no tau, expected t, q and tau: tau\[0\]"),
    "joints": (lambda x: x | {"q": x["q"][:, :1]}, "got 1 joints, expected .* as .* has 2 joints"),
    "short": (lambda x: part_of(x, slice(60)), "0 windows of 0.5 s to fit"),
    "shorter": (lambda x: part_of(x, slice(9)), "got 9 samples, expected at least 50"),
    "velocities": (
        lambda x: x | {"dq": np.degrees(np.gradient(x["q"], x["t"], axis=0))},
        r"expected the rate of q\[\d\]",
    ),
    "nothing": (lambda x: 3.0, "expected a Dataset, a Rollout, the path"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_log_is_told(name, scenario, log):
    spoil, words = WRONG[name]
    assert_refused(words, ij.identify, scenario, spoil(log), PATHS)


@pytest.mark.parametrize(
    ("paths", "options", "words"),
    [
        (["controller.K2"], {}, "a leaf of robot, plant, model or disturbance"),
        (["model.mass", "plant.mass"], {}, "plant or model"),
        (["robot.mass", "plant.mass[0]"], {}, "paths that do not overlap"),
        (["robot.masss"], {}, "Did you mean"),
        ([], {}, "a list such as"),
        (["robot.mass", "sampling.delay"], {}, "a scenario with a sampling"),
        (PATHS, {"priors": {"plant.g": (9.81, 0.1)}}, "priors: got 'plant.g', expected one of the"),
        (PATHS, {"limits": {"robot.mass": (3.0, 4.0)}}, r"limits\['robot.mass'\].*a start between"),
    ],
)
def test_a_wrong_path_is_told(paths, options, words, scenario, log):
    assert_refused(words, ij.identify, scenario, log, paths, **options)


def dataset(log):
    dims = {"t": ("time",), "q": ("time", "joint"), "tau": ("time", "joint")}
    return xarray.Dataset({name: (dims[name], x) for name, x in log.items()})


def test_units_that_a_dataset_states_are_read_and_a_run_is_a_log(log, short_run):
    np.testing.assert_array_equal(read(short_run, 2)[0].q, short_run.q)
    data = dataset(log)
    data["q"].attrs["units"] = "deg"
    assert_refused(r"units of q: got 'deg', expected rad", read, data, 2)
    data["q"].attrs["units"] = "rad"
    np.testing.assert_array_equal(read(data.transpose("joint", "time"), 2)[0].q, log["q"])


@pytest.fixture
def lines(log):
    rows = np.column_stack([log["t"], log["q"], log["tau"]])
    numbers = (", ".join(f"{x:.17g}" for x in row) for row in rows)
    return ["t, q[0], q[1], tau[0], tau[1]", *numbers]


@pytest.mark.parametrize("name", ["log.csv", "marked.csv", "log.nc"])
def test_files_of_logs_are_read(name, tmp_path, log, lines):
    if name == "log.nc":
        dataset(log).to_netcdf(tmp_path / name, engine="scipy")
    else:  # numpy.savetxt marks the first line by itself
        mark = "# " if name == "marked.csv" else ""
        (tmp_path / name).write_text(mark + "\n".join(lines))
    (found,) = read(tmp_path / name, 2)
    for key in ("t", "q", "tau"):
        np.testing.assert_array_equal(getattr(found, key), log[key])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda x: "\n".join([*x[:99], x[99].rpartition(",")[0]]).encode(),
            "got 4 columns in row 98, expected 5",
        ),
        (lambda x: "\n".join(x).encode("utf-16"), "got .*, expected a text in UTF-8"),
        (lambda x: "\n".join([*x, "\xb5"]).encode("latin-1"), "got .*, expected a text in UTF-8"),
        (lambda x: b"t" * 200_000, "got field larger"),
        (lambda x: b"t, q[0], q[2], tau[0]\n" + b"0, 1, 2, 3\n" * 60, r"expected a column q\[1\]"),
    ],
    ids=["cut", "utf-16", "latin-1", "wide", "columns"],
)
def test_damaged_files_of_logs_are_refused(spoil, words, tmp_path, lines):
    (tmp_path / "log.csv").write_bytes(spoil(lines))
    assert_refused(rf"log\.csv: .*{words}", read, tmp_path / "log.csv", 2)


@pytest.mark.slow
def test_a_plant_that_is_no_robot_is_refused_with_the_remedy():
    with pytest.raises(ValueError, match=r"scenario\.plant: got 'FlexibleJoint'.*plant\.robot"):
        ij.excitation(loops_of_plants.flexible_joint(), ["plant.stiffness"])
    with pytest.raises(ValueError, match=r"scenario\.plant: got 'MotorPendulum', expected a robot"):
        ij.identify(loops_of_plants.user_class(), {"t": [0.0]}, ["plant.D"])


@pytest.mark.slow
def test_inertias_stay_those_of_bodies(rng):
    """Any z is a body, and z, x and their derivative belong together."""
    paths = ["plant.mass", "plant.inertia", "plant.link[iiwa_link_3].centre"]
    _, c = coordinates(ij.presets.iiwa14(), paths, {})
    z = to_z(c, c.x)
    np.testing.assert_allclose(to_x(c, z)[0], c.x, rtol=1e-9, atol=1e-12)
    wild = z + rng.normal(size=z.shape) * (np.arange(len(z)) >= 7)
    x, slope = to_x(c, wild)
    for at in c.bodies:
        xx, yy, zz, xy, xz, yz = x[at : at + 6]
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert moments[0] > 0 and moments[0] + moments[1] > moments[2]
    step = 1e-6 * rng.normal(size=z.shape)
    change = (to_x(c, wild + step)[0] - to_x(c, wild - step)[0]) / 2
    np.testing.assert_allclose(change, slope @ step, rtol=1e-5, atol=1e-9)


def test_standard_errors_are_those_of_repeated_noise_and_whiteness_tells_noise(scenario, rng):
    """Windows of a linear model, white and coloured: the errors are the spread of the estimates;
    what has no information is named.  Widths are looked for beside each friction, also where one
    of them was asked for by itself."""
    K, p = 30, 3

    def uncertainty(information, scores, **more):
        return statistics.uncertainty(information, scores, np.zeros((p, p)), np.ones(p), **more)

    def model(W):
        Y = rng.normal(size=(W, K, p)) + 2.0 * rng.normal(size=(W, 1, p))
        Y[..., 2] = 2.0 * Y[..., 1]  # the log sees x1 + 2 x2 only
        return Y, np.swapaxes(Y, 1, 2) @ Y

    def estimate(colour):
        W = len(Y)
        noise = rng.normal(size=(W, K)) + colour * rng.normal(size=(W, 1))
        g = -np.einsum("wka,wk->wa", Y, noise)
        x = np.linalg.lstsq(A.sum(axis=0), -g.sum(axis=0), rcond=1e-9)[0]
        rest = noise - Y @ x
        scores, variance = -np.einsum("wka,wk->wa", Y, rest), np.mean(rest**2)
        return x, uncertainty(A / variance, scores / variance)

    for W, colour in ((6, 3.0), (40, 2.0), (40, 0.0)):
        Y, A = model(W)
        found = [estimate(colour) for _ in range(300)]
        spread = np.std([x[0] for x, _ in found])
        assert 0.8 < np.median([k.errors[0] for _, k in found]) / spread < 1.35, (W, colour)
    known = found[0][1]
    assert np.isinf(known.errors[1:]).all() and np.isfinite(known.errors[0])
    noise = rng.normal(size=(W, K))
    wider = uncertainty(A, -np.einsum("wka,wk->wa", Y, noise), lacking=3.0)
    usual = uncertainty(A, np.zeros((W, p)))
    assert wider.errors[0] >= 3.0 * usual.errors[0] * (1 - 1e-9)
    np.testing.assert_allclose(3.0 * wider.singular[:2], usual.singular[:2])
    words = statistics.describe_direction(known.directions[:, -1], ("a", "b", "c"))
    assert words == "0.89 b - 0.45 c"
    noise, drift = rng.normal(size=(30, 200)), 0.3 * rng.normal(size=(30, 200))
    assert statistics.whiteness(noise).p > 1e-3
    assert statistics.whiteness(noise + np.cumsum(drift, axis=1)).p < 1e-6
    believed, asked = canonical(scenario), ["disturbance.coulomb", "disturbance.width[0]"]
    assert with_widths(believed, asked) == [*asked, "disturbance.width[1]"]


@pytest.mark.slow
def test_an_excitation_is_inside_its_bounds_tells_more_and_needs_room(scenario, heavier, run):
    best = ij.excitation(scenario, PATHS, duration=6.0, iterations=15)
    rich = ij.simulate(ij.with_parts(heavier, reference=best), duration=6.0, dt=1e-3)
    assert int(rich.status) == 0 and float(np.min(rich.metrics.margin)) > 0
    options = {"widths": False, "delay": 0.0, "torque": "interpolated"}
    known = (ij.identify(scenario, counted(x), PATHS, **options) for x in (rich, run))
    of_best, of_run = (np.sum(np.log(one.singular_values)) for one in known)
    assert of_best > of_run + 1.0  # seven times the determinant of the information
    start = np.asarray(scenario.initial.q)
    lower = ij.bounds.Sinusoid(offset=start - 0.3, amplitude=0.29, frequency=3.0)
    parts = {"bounds": ij.Bounds(lower=lower, upper=ij.bounds.Constant(start + 0.02))}
    parts |= {"reference": ij.references.Sinusoid(offset=start, amplitude=0.0)}
    with pytest.raises(ValueError, match=r"bounds: got .* expected room for a motion"):
        ij.excitation(ij.with_parts(scenario, **parts), PATHS, duration=4.0)


@pytest.mark.slow
def test_joint_draws_in_a_file_and_in_a_design(tmp_path):
    """In the table of any perturbation; groups without a name, or other rows, are refused."""
    rows = {"plant.mass[0]": [0.1, 0.0], "plant.mass[1]": [0.05, 0.02]}
    one = {"value": "joint_normal", "mean": 1.0, "group": "g"}
    run = {"duration": 0.01, "dt": 1e-3}
    data = {"preset": "zhang_yan_2024", "run": run, "study": {"runs": 1024}}
    perturbed = {path: one | {"rows": row} for path, row in rows.items()}
    file = study_from_dict(data | {"perturbations": perturbed}, "study")
    options = run | {"runs": 1024, "sampler": "sobol"}
    study = ij.monte_carlo(file.scenario, file.perturbations, **options)
    found, L = np.cov(np.stack([study.samples[path] for path in rows])), np.array([*rows.values()])
    np.testing.assert_allclose(found, L @ L.T, atol=8e-4)
    wrong = {"plant.mass[0]": one | {"rows": [0.1, 0.0], "group": 3}}
    with pytest.raises(ValueError, match="group: got 3, expected a name"):
        study_from_dict(data | {"perturbations": wrong}, "study")
    assert_refused("joint_normal: rows", ij.joint_normal, [1.0, 2.0], [1.0, 2.0], "g")


@pytest.mark.slow
def test_the_command_line_identifies_and_writes_what_it_found(tmp_path, capsys):
    out = tmp_path / "known"
    words = ["identify", str(ROOT / "examples" / "identify.toml"), "--out", str(out)]
    assert cli.main(words) == 0, capsys.readouterr().err
    assert "6 of 6 numbers told" in capsys.readouterr().out
    results = {f"identification.{kind}" for kind in ("npz", "json", "html", "png")}
    assert {path.name for path in out.iterdir()} == {"scenario.toml", *results}
    found = ij.load_scenario(out / "scenario.toml")
    np.testing.assert_allclose(found.model.mass, MASS, rtol=2e-3)
    numbers = json.loads((out / "identification.json").read_text())["numbers"]
    np.testing.assert_allclose(numbers[1]["value"], found.plant.mass[1])


FITTED = {"log": "log.csv", "parameters": ["robot.mass"]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"identify": {"parameters": ["robot.mass"]}},
            "identify.log: got None, expected the path of a .csv or .nc file",
        ),
        ({"identify": {"log": "log.csv"}}, r"identify.parameters: got nothing"),
        ({"identify": FITTED | {"windw": 1.0}}, r"identify.windw: got an unknown key"),
        ({"identify": FITTED, "limits": {"robot": {"mass": 3.0}}}, r"limits.robot.mass: got 3.0"),
    ],
)
def test_a_wrong_file_is_told(change, words, tmp_path):
    (tmp_path / "identify.toml").write_text(tomli_w.dumps({"preset": "zhang_yan_2024"} | change))
    assert_refused(words, load_identification_file, tmp_path / "identify.toml")


def test_the_tangents_of_a_replay_are_those_of_finite_differences(scenario, log):
    """By the start, free torques, a mass, friction and the torque's offset in time."""
    paths = ["plant.mass[1]", "disturbance.coulomb", "disturbance.width"]
    plant, c = coordinates(scenario, paths, {})
    (one,) = read({name: x[:200] for name, x in log.items()}, 2)
    cut = windows([one], 0.25, [0.0], hold=True)
    free = free_torques_at_standstill(plant, c, cut, [one], np.ones(2), 0.1)
    replay = ShootingProblem(plant, c, cut, [one], True, "squares", 1, free)
    z, m = np.append(c.x, 5e-4), free.torque.shape[-1]
    assert m > 3
    starts = np.concatenate([cut.q, cut.dq, np.full((len(cut.q), m), 0.05)], axis=1)
    segments, q, dq = replay.simulate(z, starts)
    J, along = replay._sensitivities(z, segments, q, dq)
    s = starts.shape[1]
    for i in [*range(4), *range(s - min(m, 3), J.shape[-1])]:
        step = 1e-4 * (np.arange(J.shape[-1]) == i)
        moved = (replay.simulate(z + h * step[s:], starts + h * step[:s]) for h in (1.0, -1.0))
        (_, after, _), (_, before, _) = moved
        # The offset's is taken over a sample, as a held torque is a staircase.
        share = 2e-3 if i < J.shape[-1] - 1 else 0.05
        allowed = share * np.max(np.abs(J[..., i]))
        np.testing.assert_allclose(J[..., i], (after - before) / 2e-4, atol=allowed)
    np.testing.assert_allclose(along.torque, np.asarray(segments.tau).reshape(-1, 2), atol=1e-9)


@pytest.mark.release
def test_one_joint_of_seven_that_is_mounted_the_other_way_is_named():
    """The last joint of an arm has a small part of the torques: its sign is told all the same."""
    scenario = ij.with_parts(ij.presets.iiwa14(payload=0.0), disturbance=ij.disturbances.Nothing())
    t, rng = np.arange(200) * 0.01, np.random.default_rng(0)
    w, A, P = rng.uniform(2.0, 6.0, 7), rng.uniform(0.2, 0.4, 7), rng.uniform(0.0, 6.28, 7)
    q, dq, ddq = (A * w**k * np.sin(np.outer(t, w) + P + k * np.pi / 2) for k in range(3))
    q = q + np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.8, 0.0])
    with jax.enable_x64(True):
        arm = canonical(astype(canonical(scenario), "float64"))
        arguments = map(jnp.asarray, (np.zeros(0), t, q, dq, ddq))
        tau = np.asarray(inverse_dynamics(arm, *arguments, places=()).torque)
    log = {"t": t, "q": q * np.where(np.arange(7) == 6, -1.0, 1.0), "tau": tau}
    with pytest.raises(ValueError, match=r"with q\[6\] of the other sign, they would explain 100%"):
        ij.identify(scenario, log, ["robot.mass"], torque="interpolated")


DAMPING = np.array([1.0, 1.0, 0.8, 0.8, 0.4, 0.3, 0.2])
ARMATURE = np.array([0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05])
DRY = np.array([2.0, 2.0, 1.5, 1.5, 0.6, 0.6, 0.3])
"""Dry friction, which MuJoCo solves for as a soft constraint: a joint sticks, and gives way slowly
[N m]."""
FACTOR = np.array([1.0, 1.1, 0.9, 1.08, 0.93, 1.05, 1.4])
"""True masses by those of the file."""
MIDDLE = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.8, 0.0])


def described(arm, mass, dry):
    import mujoco

    fields = {"mass": mass, "damping": DAMPING, "armature": ARMATURE, "friction": dry}
    model = mujoco.MjModel.from_xml_string(as_mjcf(dataclasses.replace(arm, **fields)))
    model.opt.timestep, model.opt.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_RK4
    return model


def log_of_mujoco(arm, duration, dry, seed=0, step=2e-3):
    """t, q in counts and the held torque."""
    import mujoco

    rng = np.random.default_rng(seed)
    A, P = rng.uniform(0.1, 0.3, (3, 7)), rng.uniform(0, 6.28, (3, 7))
    W = np.array([[1.0], [2.2], [4.0]]) * rng.uniform(0.8, 1.2, (3, 7))
    nominal = np.asarray(arm.mass)
    true, known = described(arm, nominal * FACTOR, dry), described(arm, nominal, 0 * dry)
    moving, thinking = mujoco.MjData(true), mujoco.MjData(known)

    def reference(t):
        waves = [A * W**k * np.sin(W * t + P + 0.5 * np.pi * k) for k in range(3)]
        position, rate, push = np.sum(waves, axis=1)
        return MIDDLE + position, rate, push

    moving.qpos[:], moving.qvel[:], _ = reference(0.0)
    before, speed, M, rows = None, moving.qvel.copy(), np.zeros((7, 7)), []
    for k in range(round(duration / step)):
        t, y = k * step, COUNT * np.round(moving.qpos / COUNT)
        speed, before = speed if before is None else 0.7 * speed + 0.3 * (y - before) / step, y
        desired, rate, push = reference(t)
        thinking.qpos[:], thinking.qvel[:] = y, speed
        mujoco.mj_forward(known, thinking)
        mujoco.mj_fullM(known, thinking, M)
        push = push + 100.0 * (desired - y) + 20.0 * (rate - speed)
        tau = M @ push + thinking.qfrc_bias + DAMPING * rate
        rows.append((t, y, tau))
        moving.qfrc_applied[:] = tau
        mujoco.mj_step(true, moving, nstep=4)
    return dict(zip(("t", "q", "tau"), map(np.array, zip(*rows, strict=True)), strict=True))


@pytest.mark.release
@pytest.mark.parametrize("dry", [0.0 * DRY, DRY], ids=["viscous", "dry"])
def test_seven_joints_of_mujoco(dry):
    """Numbers within their errors, masses within a percent; the first mass and armature are one."""
    pytest.importorskip("mujoco")
    scenario = ij.with_parts(ij.presets.iiwa14(payload=0.0), disturbance=ij.disturbances.Nothing())
    start = ij.with_parameters(scenario, {"robot.damping": 0.5, "robot.armature": 0.05})
    truth = {"robot.mass": np.asarray(scenario.plant.mass) * FACTOR, "robot.damping": DAMPING}
    truth |= {"robot.armature": ARMATURE} | ({"robot.friction": dry} if dry.any() else {})
    known = ij.identify(start, log_of_mujoco(scenario.plant, 12.0, dry), list(truth))
    errors = known.standard_errors
    z = np.concatenate([(known.values[path] - x) / errors[path] for path, x in truth.items()])
    untold = {number.name for number in known.numbers if number.verdict == "cannot be told"}
    free = {number.name for number in known.numbers if number.verdict == "left free"}
    assert free == set(known.names[21 + np.sum(dry > 0) :])
    assert untold == {"robot.mass[0]", "robot.armature[0]"}
    assert np.nanmax(np.abs(z)) < 4.0 and np.mean(np.abs(z[np.isfinite(z)]) < 3.0) > 0.9
    assert np.nanmax(np.abs(known.values["robot.mass"] / truth["robot.mass"] - 1.0)) < 0.01
    assert all(one.after < 1.15 * COUNT / np.sqrt(12) for one in known.fit)
