"""Parameters from logs that another program made: values and their errors, what a log cannot tell,
and logs that are wrong.

The other program is `independent_log`: a two-link arm with friction in NumPy, from p1 ... p5, moved
by RK4 under a held torque, its encoders of 14 bits; it shares nothing with the package.
"""

from __future__ import annotations

import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w
import xarray
from conftest import ROOT
from scipy.signal import savgol_filter

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.core.pytree import astype
from iblf_jax.files.identification import load_identification_file
from iblf_jax.identification import statistics
from iblf_jax.identification.assessment import missing_terms_of_fit
from iblf_jax.identification.coordinates import coordinates, to_x, to_z, with_widths
from iblf_jax.identification.log import read
from iblf_jax.identification.replay import inverse_dynamics
from iblf_jax.identification.shooting import ShootingProblem, windows
from iblf_jax.identification.smoothing import smooth_logs
from iblf_jax.identification.standstill import free_torques_at_standstill
from iblf_jax.reports import shown
from iblf_jax.simulation.scenario import canonical

MASS, VISCOUS = np.array([2.0, 0.85]), np.array([0.15, 0.08])
COULOMB, WIDTH = np.array([0.2, 0.1]), 0.05
LENGTH, CENTRE, INERTIA = (0.35, 0.31), (0.175, 0.155), (0.06125, 0.02042125)
PATHS = ["robot.mass", "disturbance.viscous", "disturbance.coulomb"]
COUNT = 2.0 * np.pi / 2**14


def acceleration(q, dq, tau, rubbing):
    """Of the arm that is logged, from the five numbers of section 1 of the literature."""
    (m1, m2), (l1, _), (c1, c2), (I1, I2) = MASS, LENGTH, CENTRE, INERTIA
    p1, p2, p3, p4, p5 = (
        m1 * c1**2 + m2 * l1**2 + I1,
        m2 * c2**2 + I2,
        m2 * l1 * c2,
        m1 * c1 + m2 * l1,
        m2 * c2,
    )
    cosine, sine = np.cos(q[1]), np.sin(q[1])
    M = np.array([[p1 + p2 + 2 * p3 * cosine, p2 + p3 * cosine], [p2 + p3 * cosine, p2]])
    coriolis = p3 * sine * np.array([-dq[1] * (2 * dq[0] + dq[1]), dq[0] ** 2])
    outer = p5 * 9.81 * np.cos(q[0] + q[1])
    gravity = np.array([p4 * 9.81 * np.cos(q[0]) + outer, outer])
    return np.linalg.solve(M, tau - coriolis - gravity - VISCOUS * dq - rubbing)


def smooth(dq, bristle):
    """Coulomb friction over a width; no bristle."""
    return COULOMB * np.tanh(dq / WIDTH), np.zeros(2)


def sticking(dq, bristle):
    """Friction of a bristle, which gives way by 1 mrad and breaks away at 1.3 times what it needs
    to go on (LuGre)."""
    stiffness, most = COULOMB / 1e-3, COULOMB * (1.0 + 0.3 * np.exp(-((dq / 0.01) ** 2)))
    return stiffness * bristle, dq - np.abs(dq) * stiffness * bristle / most


def independent_log(duration=8.0, step=4e-3, seed=0, friction=smooth, substeps=2):
    """t, q in counts, tau: PD about a sum of sinusoids, from the counts."""
    rng = np.random.default_rng(seed)
    A, W, P = (
        rng.uniform(0.2, 0.4, (3, 2)),
        np.array([[1.0, 1.4], [2.3, 3.1], [4.1, 5.3]]),
        rng.uniform(0, 6.28, (3, 2)),
    )

    def reference(t):
        return np.array([0.6, 0.5]) + np.sum(A * np.sin(W * t + P), axis=0), np.sum(
            A * W * np.cos(W * t + P), axis=0
        )

    def rate(q, dq, bristle):
        rubbing, change = friction(dq, bristle)
        return dq, acceleration(q, dq, tau, rubbing), change

    (q, dq), bristle = reference(0.0), np.zeros(2)
    before, speed, rows = q, dq, []
    for k in range(round(duration / step)):
        y = COUNT * np.round(q / COUNT)
        speed, before = 0.6 * speed + 0.4 * (y - before) / step if k else speed, y
        wanted, wanted_rate = reference(k * step)
        tau = (
            np.array([8.0, 2.0]) * np.cos(np.cumsum(y))
            + np.array([40.0, 8.0]) * (wanted - y)
            + np.array([4.0, 0.6]) * (wanted_rate - speed)
        )
        rows.append((k * step, y, tau))
        for _ in range(substeps):
            x, h = (q, dq, bristle), step / substeps
            k1 = rate(*x)
            k2 = rate(*(a + h / 2 * b for a, b in zip(x, k1, strict=True)))
            k3 = rate(*(a + h / 2 * b for a, b in zip(x, k2, strict=True)))
            k4 = rate(*(a + h * b for a, b in zip(x, k3, strict=True)))
            q, dq, bristle = (
                a + h / 6 * (b + 2 * c + 2 * d + e)
                for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)
            )
    t, y, tau = map(np.array, zip(*rows, strict=True))
    return {"t": t, "q": y, "tau": tau}


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
    """The scenario with the plant's true masses."""
    return ij.with_parameters(scenario, {"plant.mass": MASS})


@pytest.fixture(scope="module")
def run(heavier):
    """The paper's motion of it."""
    return ij.simulate(heavier, duration=6.0, dt=1e-3)


def counted(run, rows=slice(None)):
    """A log of rows of a run, in counts."""
    return {
        "t": np.asarray(run.t)[rows],
        "q": COUNT * np.round(np.asarray(run.q)[rows] / COUNT),
        "tau": np.asarray(run.tau)[rows],
    }


def z_scores(known, truth):
    return np.concatenate(
        [(known.values[path] - x) / known.standard_errors[path] for path, x in truth.items()]
    )


TRUTH = {"robot.mass": MASS, "disturbance.viscous": VISCOUS, "disturbance.coulomb": COULOMB}


@pytest.mark.slow
def test_true_values_are_within_their_errors_and_masses_within_a_percent(known):
    assert np.max(np.abs(z_scores(known, TRUTH))) < 4.0
    assert np.max(np.abs(known.values["robot.mass"] / MASS - 1.0)) < 1e-3
    assert (
        np.max(known.standard_errors["robot.mass"]) < 1e-3
    )  # an error that is too large covers anything
    assert all(number.verdict == "told" for number in known.numbers[:6])
    assert abs(known.delay) < 4.0 * known.delay_error < 1e-3


@pytest.mark.slow
def test_the_fit_is_as_good_as_the_encoder_also_on_what_was_held_back(known):
    for one in known.fit:
        for left in (one.after, one.held_back):
            assert 0.9 < left / (COUNT / np.sqrt(12)) < 1.15
        assert one.before > 30 * one.after and one.explained > 0.99
    assert 0 < np.sum(~known.kept) < np.sum(known.kept)


@pytest.mark.slow
def test_friction_that_sticks_is_left_to_the_log(scenario):
    """A bristle's friction is no tanh: about standstill torques are free, what the rest tells is
    not spoilt, and the report says so."""
    known = ij.identify(scenario, independent_log(seed=1, friction=sticking, substeps=10), PATHS)
    assert {number.verdict for number in known.numbers[6:]} == {"left free"} and {
        number.verdict for number in known.numbers[:6]
    } == {"told"}
    assert np.max(np.abs(z_scores(known, TRUTH))) < 4.0
    assert (
        np.max(np.abs(known.values["robot.mass"] / MASS - 1.0))
        < 1e-3
        > np.max(known.standard_errors["robot.mass"])
    )
    assert all(one.lacking < 1.1 for one in known.fit) and np.all(
        np.isnan(known.values["disturbance.width"])
    )
    assert "6 of 6 numbers told" in repr(
        known
    ) and "the friction of all joints: with coulomb tanh" in repr(known)
    np.testing.assert_array_equal(known.scenario.disturbance.width, scenario.disturbance.width)


@pytest.mark.slow
def test_the_scenario_has_the_new_numbers_in_plant_and_model(known, scenario):
    for robot in (known.scenario.plant, known.scenario.model):
        np.testing.assert_allclose(robot.mass, known.values["robot.mass"])
    np.testing.assert_allclose(
        known.scenario.disturbance.coulomb, known.values["disturbance.coulomb"]
    )
    assert known.scenario.initial.q.dtype == scenario.initial.q.dtype
    np.testing.assert_array_equal(known.scenario.controller.K2, scenario.controller.K2)


@pytest.mark.slow
def test_what_a_log_leaves_open_is_drawn_together(known):
    """The draws of a study have the covariance of the identification, also between leaves."""
    assert set(known.perturbations) == {"plant.mass", "disturbance.viscous", "disturbance.coulomb"}
    study = ij.monte_carlo(known.scenario, known.perturbations, runs=2000, duration=0.01, dt=1e-3)
    drawn = np.concatenate(
        [np.asarray(study.samples[path]) for path in known.perturbations], axis=1
    )
    size = np.sqrt(np.diag(known.covariance)[:6])
    np.testing.assert_allclose(drawn.std(axis=0), size, rtol=0.1)
    np.testing.assert_allclose(np.corrcoef(drawn.T), known.correlation[:6, :6], atol=0.1)
    assert (
        np.max(np.abs(known.correlation[:6, :6] - np.eye(6))) > 0.3
    )  # else the line above says nothing
    np.testing.assert_allclose(
        drawn.mean(axis=0), np.concatenate(list(known.values.values()))[:6], atol=0.1 * size.max()
    )


@pytest.mark.slow
def test_what_a_log_cannot_tell_is_not_the_start_as_an_answer(scenario, log):
    """m1, lc1 and I1 enter as two numbers, p1 and p4: these are right in the scenario, and the
    three are not told."""
    start = ij.with_parameters(scenario, {"robot.mass[1]": MASS[1]})
    three = ["robot.mass[0]", "robot.centre[0]", "robot.inertia[0]"]
    known = ij.identify(start, log, [*three, *PATHS[1:]], widths=False)
    for number in known.numbers[:3]:
        assert (number.value, number.error, number.verdict) == (None, None, "cannot be told")
        assert np.isnan(known.values[number.name]) and np.isinf(known.standard_errors[number.name])
    assert len(known.untold) == 1 and all(name in known.untold[0] for name in three)
    assert set(known.perturbations) == set(PATHS[1:])
    (m, _), (lc, _), (J, _) = (
        np.asarray(getattr(known.scenario.model, name)) for name in ("mass", "centre", "inertia")
    )
    assert abs(m - MASS[0]) > 0.01  # it was not found by chance
    np.testing.assert_allclose(m * lc, MASS[0] * CENTRE[0], rtol=1e-3)
    np.testing.assert_allclose(m * lc**2 + J, MASS[0] * CENTRE[0] ** 2 + INERTIA[0], rtol=1e-3)


@pytest.mark.slow
def test_a_delay_between_torque_and_position_is_found(scenario, log):
    late = log | {
        "t": log["t"][:-2],
        "q": log["q"][2:],
        "tau": log["tau"][:-2],
    }  # positions of 8 ms later
    known = ij.identify(scenario, late, PATHS, widths=False)
    assert abs(known.delay + 8e-3) < 5 * known.delay_error
    assert np.max(np.abs(z_scores(known, TRUTH))) < 5.0


@pytest.mark.slow
def test_irregular_times_and_a_gap(scenario, run, rng):
    """Rows left out at random, and a third of a second at once; the torque of a continuous loop is
    interpolated."""
    rows = np.sort(rng.choice(6000, 3500, replace=False))
    log = counted(run, rows[(rows < 2000) | (rows > 2300)])
    assert [len(one.segments) for one in read(log, 2)] == [2]
    known = ij.identify(scenario, log, ["robot.mass"], torque="interpolated", held_out=0)
    assert np.max(np.abs(z_scores(known, {"robot.mass": MASS}))) < 4.0
    assert np.max(np.abs(known.values["robot.mass"] / MASS - 1.0)) < 1e-3
    assert all(np.isnan(one.held_back) for one in known.fit)


@pytest.mark.slow
def test_a_run_is_a_log(scenario, run):
    """A Rollout of a continuous loop: without noise, the numbers come back."""
    known = ij.identify(scenario, run, ["robot.mass"])
    np.testing.assert_allclose(known.values["robot.mass"], MASS, rtol=1e-5)


@pytest.mark.slow
def test_several_logs_and_one_that_is_held_back(scenario, log):
    first, second = (
        {name: x[part] for name, x in log.items()} for part in (slice(0, 700), slice(760, None))
    )
    both = ij.identify(
        scenario, [first, second], PATHS, held_out={name: x[:600] for name, x in log.items()}
    )
    assert np.max(np.abs(z_scores(both, TRUTH))) < 4.0
    assert np.sum(~both.kept) == 4 and len(both.logs) == 3


@pytest.mark.slow
def test_a_delay_of_the_command_is_a_leaf(scenario, log):
    commanded = {
        name: (np.roll(x, -1, axis=0) if name == "tau" else x)[:-1] for name, x in log.items()
    }  # one sample before it acts
    lab = ij.with_parts(scenario, sampling=ij.Sampling(4e-3, delay=1e-3))
    known = ij.identify(lab, commanded, [*PATHS, "sampling.delay"], widths=False)
    assert abs(float(known.scenario.sampling.delay) - 4e-3) < 5 * known.delay_error < 1e-3
    assert set(known.values) == set(PATHS)


@pytest.mark.slow
def test_outliers_are_borne_by_huber(scenario, log):
    rng, q = np.random.default_rng(2), log["q"].copy()
    hit = rng.choice(q.size, 40, replace=False)
    q.ravel()[hit] += rng.choice([-0.05, 0.05], 40)
    known = ij.identify(scenario, {**log, "q": q}, PATHS, loss="huber", widths=False)
    assert np.max(np.abs(known.values["robot.mass"] / MASS - 1.0)) < 2e-3


@pytest.mark.slow
def test_priors_and_limits(scenario, log):
    """What was known before is believed for what it is worth; what is at a limit is said to be."""
    fixed = ij.identify(scenario, log, PATHS, widths=False, priors={"robot.mass": (MASS, 1e-7)})
    np.testing.assert_allclose(fixed.values["robot.mass"], MASS, atol=5e-7)
    assert np.max(fixed.standard_errors["robot.mass"]) < 5e-7
    for limits, name, at in (
        ({"disturbance.coulomb": (0.0, [0.199, 0.15])}, "disturbance.coulomb[0]", 0.199),
        (
            {"robot.mass": (None, [1.8, 1.2])},
            "robot.mass[0]",
            1.8,
        ),  # the others' misfit is so large that nothing is told
    ):
        bound = ij.identify(scenario, log, PATHS, widths=False, limits=limits)
        number = bound.numbers[bound.names.index(name)]
        assert (number.verdict, number.value) == ("at its limit", at) and name not in "".join(
            bound.perturbations
        )
        (words,) = (note for note in bound.notes if name in note)
        path, truth = next(iter(limits)), TRUTH[next(iter(limits))][0]
        assert f"{at:g} " in words and f"The upper end of limits['{path}']" in words
        assert abs(float(re.search(r"asks for about ([\d.]+\d)", words)[1]) / truth - 1.0) < 0.02
    with pytest.raises(ValueError, match=r"priors: got 'plant.g', expected one of the paths"):
        ij.identify(scenario, log, PATHS, priors={"plant.g": (9.81, 0.1)})
    with pytest.raises(ValueError, match=r"limits\['robot.mass'\].*a start between"):
        ij.identify(scenario, log, PATHS, limits={"robot.mass": (3.0, 4.0)})


# ---------------------------------------------- terms that were left out of the fit


def with_friction(scenario, viscous, coulomb):
    """The scenario with the masses of the robot that was logged, and friction."""
    friction = ij.disturbances.Friction(viscous=viscous, coulomb=coulomb, width=WIDTH)
    return ij.with_parameters(ij.with_parts(scenario, disturbance=friction), {"robot.mass": MASS})


def lacking(scenario, log, paths):
    """The terms that a fit lacks which ended at the scenario's numbers."""
    with jax.enable_x64(True):
        replayed, c = coordinates(canonical(astype(canonical(scenario), "float64")), paths, {})
        seen = smooth_logs(read(log, 2), True)
        return missing_terms_of_fit(
            replayed, c, seen, np.append(to_z(c, c.x), 0.0), np.ones(len(c.x) + 1, bool)
        )


@pytest.fixture(scope="module")
def other_logs():
    """Logs of other motions."""
    return [independent_log(duration=5.0, seed=seed) for seed in (11, 12)]


@pytest.mark.slow
def test_coulomb_friction_that_was_left_out_is_found_and_what_makes_up_for_it_is_marked(
    scenario, other_logs
):
    """Viscous friction is found about twice too large then: not "told", but biased, by about what
    it is too large."""
    start = ij.with_parameters(scenario, {"disturbance.coulomb": 0.0})
    known = ij.identify(start, other_logs[0], PATHS[:2])
    found = [note for note in known.notes if "depends on the sign of its velocity" in note]
    assert len(found) == 2
    sizes = {
        re.search(r"joint (\d)", note)[1]: float(re.search(r"has ([\d.]+) ", note)[1])
        for note in found
    }
    np.testing.assert_allclose([sizes["0"], sizes["1"]], COULOMB, rtol=0.2)
    assert all("Add 'disturbance.coulomb' to the paths" in note for note in found)
    for number, truth in zip(known.numbers[2:], VISCOUS, strict=True):
        assert number.verdict in ("biased", "cannot be told")
        if number.value is not None and number.value > 1.2 * truth:
            assert 0.3 < number.bias / (number.value - truth) < 3.0
    assert any(number.verdict == "biased" for number in known.numbers)
    assert "biased" in repr(known) and "compensate for missing terms" in repr(known)
    assert "biased" in shown(known).tables["Numbers"]
    assert not any("viscous" in path for path in known.perturbations)
    assert json.dumps(known.to_dict(), allow_nan=False)


@pytest.mark.slow
def test_a_fit_that_lacks_nothing_has_no_finding(known, scenario, other_logs):
    assert not any("The residual torque of" in note or "biased" in note for note in known.notes)
    assert all(number.bias is None for number in known.numbers)
    for log in other_logs:
        assert not lacking(with_friction(scenario, VISCOUS, COULOMB), log, PATHS).findings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("viscous", "coulomb", "paths", "kind", "sizes"),
    [
        (VISCOUS, 0.0, PATHS[:2], "sign", COULOMB),
        (0.0, COULOMB, PATHS[:1], "velocity", VISCOUS),
        (VISCOUS, [0.2, 0.0], PATHS[:2], "sign", [None, 0.1]),
        (VISCOUS, 2.0 * COULOMB, PATHS[:2], "sign", -COULOMB),
    ],
)
def test_what_was_left_out_is_named_by_joint_and_size(
    viscous, coulomb, paths, kind, sizes, scenario, other_logs
):
    found = lacking(with_friction(scenario, viscous, coulomb), other_logs[0], paths)
    assert {(one.joint, one.kind) for one in found.findings} == {
        (j, kind) for j, size in enumerate(sizes) if size is not None
    }
    for one in found.findings:
        np.testing.assert_allclose(one.size, sizes[one.joint], rtol=0.25)
        assert one.error < 0.2 * abs(one.size) and one.gain > 0.3


@pytest.mark.slow
def test_gravity_and_inertia_that_were_left_out_are_named(scenario, other_logs):
    """Another payload's worth of gravity, and a rotor: of the torques that are logged, so that
    nothing else is wrong."""
    truth, log = with_friction(scenario, VISCOUS, COULOMB), other_logs[0]
    rate = np.gradient(np.gradient(log["q"], log["t"], axis=0), log["t"], axis=0)
    gravity = {**log, "tau": log["tau"] + np.array([0.0, 0.4]) * np.cos(log["q"])}
    assert {(one.joint, one.kind) for one in lacking(truth, gravity, PATHS[1:]).findings} == {
        (1, "cosine")
    }
    rotor = {**log, "tau": log["tau"] + np.array([0.05, 0.0]) * savgol_filter(rate, 31, 2, axis=0)}
    assert {(one.joint, one.kind) for one in lacking(truth, rotor, PATHS[1:]).findings} == {
        (0, "acceleration")
    }


# ----------------------------------------------------------------- logs that are wrong

WRONG = {
    "degrees": (lambda x: {**x, "q": np.degrees(x["q"])}, "It would fit in degrees"),
    "newton_millimetres": (
        lambda x: {**x, "tau": 1e3 * x["tau"]},
        "times what the scenario's robot needs .* Convert it to N m",
    ),
    "kilopond_metres": (
        lambda x: {**x, "tau": x["tau"] / 9.81},
        "with tau in kgf m, they would explain",
    ),
    "torques_exchanged": (
        lambda x: {**x, "tau": x["tau"][:, ::-1]},
        r"with tau\[0\] and tau\[1\] exchanged",
    ),
    "positions_exchanged": (
        lambda x: {**x, "q": x["q"][:, ::-1]},
        r"with q\[0\] and q\[1\] exchanged",
    ),
    "other_sign": (lambda x: {**x, "tau": -x["tau"]}, "with tau of the other sign"),
    "one_sign": (
        lambda x: {**x, "tau": x["tau"] * [1.0, -1.0]},
        r"with tau\[1\] of the other sign, they would explain",
    ),
    "joints_exchanged": (
        lambda x: {**x, "q": x["q"][:, ::-1], "tau": x["tau"][:, ::-1]},
        "with joints 0 and 1 exchanged, q and tau",
    ),
    "milliseconds": (
        lambda x: {**x, "t": 1e3 * x["t"]},
        r"log: t: got .* rad of motion in .* Divide times in ms by 1000",
    ),
    "rows_without_numbers": (
        lambda x: {**x, "q": np.where(np.arange(len(x["q"]))[:, None] == 7, np.nan, x["q"])},
        r"got 1 of 2000, the first is row 7 \(in q\)",
    ),
    "standing": (
        lambda x: {**x, "q": x["q"][:1] + COUNT * (np.arange(len(x["q"]))[:, None] % 3 == 0)},
        "a robot that stands still",
    ),
    "times_turn_back": (
        lambda x: {**x, "t": np.where(np.arange(len(x["t"])) == 9, 0.0, x["t"])},
        "times that increase",
    ),
    "no_torque": (
        lambda x: {"t": x["t"], "q": x["q"]},
        r"got no tau, expected t, q and tau: tau\[0\]",
    ),
    "joints": (
        lambda x: {**x, "q": x["q"][:, :1]},
        "got 1 joints, expected .* as the scenario has 2 joints",
    ),
    "short": (lambda x: {name: y[:60] for name, y in x.items()}, "0 windows of 0.5 s to fit"),
    "shorter": (
        lambda x: {name: y[:9] for name, y in x.items()},
        "got 9 samples, expected at least 50",
    ),
    "velocities": (
        lambda x: {**x, "dq": np.degrees(np.gradient(x["q"], x["t"], axis=0))},
        r"expected the rate of q\[\d\]",
    ),
    "nothing": (lambda x: 3.0, "expected a Dataset, a Rollout, the path"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_log_is_told(name, scenario, log):
    spoil, words = WRONG[name]
    with pytest.raises(ValueError, match=words):
        ij.identify(scenario, spoil(log), PATHS)


@pytest.mark.parametrize(
    ("paths", "words"),
    [
        (["controller.K2"], "a leaf of robot, plant, model or disturbance"),
        (["model.mass", "plant.mass"], "plant or model"),
        (["robot.mass", "plant.mass[0]"], "paths that do not overlap"),
        (["robot.masss"], "Did you mean"),
        ([], "a list such as"),
        (["robot.mass", "sampling.delay"], "a scenario with a sampling"),
    ],
)
def test_a_wrong_path_is_told(paths, words, scenario, log):
    with pytest.raises(ValueError, match=words):
        ij.identify(scenario, log, paths)


def test_units_that_a_dataset_states_are_read(log):
    data = xarray.Dataset(
        {name: (("time",) if x.ndim == 1 else ("time", "joint"), x) for name, x in log.items()}
    )
    data["q"].attrs["units"] = "deg"
    with pytest.raises(ValueError, match=r"units of q: got 'deg', expected rad"):
        read(data, 2)
    data["q"].attrs["units"] = "rad"
    np.testing.assert_array_equal(read(data.transpose("joint", "time"), 2)[0].q, log["q"])


def test_files(tmp_path, log):
    table = np.column_stack([log["t"], log["q"], log["tau"]])
    np.savetxt(
        tmp_path / "log.csv",
        table,
        delimiter=",",
        header="t, q[0], q[1], tau[0], tau[1]",
        comments="",
        fmt="%.17g",
    )
    xarray.Dataset(
        {name: (("time",) if x.ndim == 1 else ("time", "joint"), x) for name, x in log.items()}
    ).to_netcdf(tmp_path / "log.nc", engine="scipy")
    lines = (tmp_path / "log.csv").read_text().splitlines()
    (tmp_path / "marked.csv").write_text(
        "\n".join(["# " + lines[0], *lines[1:]])
    )  # as numpy.savetxt does by itself
    (tmp_path / "cut.csv").write_text("\n".join([*lines[:99], lines[99].rpartition(",")[0]]))
    with pytest.raises(ValueError, match=r"cut\.csv: got 4 columns in row 98, expected 5"):
        read(tmp_path / "cut.csv", 2)
    for name in ("log.csv", "marked.csv", "log.nc"):
        (found,) = read(tmp_path / name, 2)
        for key in ("t", "q", "tau"):
            np.testing.assert_array_equal(getattr(found, key), log[key])
    (tmp_path / "utf16.csv").write_text("\n".join(lines), encoding="utf-16")
    with pytest.raises(ValueError, match=r"utf16\.csv: got .*, expected a text in UTF-8"):
        read(tmp_path / "utf16.csv", 2)
    (tmp_path / "latin.csv").write_text("\n".join([*lines, "\xb5"]), encoding="latin-1")
    with pytest.raises(ValueError, match=r"latin\.csv: got .*, expected a text in UTF-8"):
        read(tmp_path / "latin.csv", 2)
    (tmp_path / "wide.csv").write_text("t" * 200_000)
    with pytest.raises(ValueError, match=r"wide\.csv: got field larger"):
        read(tmp_path / "wide.csv", 2)
    (tmp_path / "bad.csv").write_text("t, q[0], q[2], tau[0]\n" + "0, 1, 2, 3\n" * 60)
    with pytest.raises(ValueError, match=r"expected a column q\[1\]"):
        read(tmp_path / "bad.csv", 2)
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none.csv", 2)


# ----------------------------------------------------------------- report, parts


@pytest.mark.slow
def test_the_report_is_words_json_and_a_page(known, tmp_path):
    text = repr(known)
    assert "robot.mass[0]" in text and "held back" in text and "6 of" not in text.split("\n")[2]
    data = json.loads(json.dumps(known.to_dict(), allow_nan=False))
    assert data["numbers"][0]["value"] == known.numbers[0].value
    ij.report(known, tmp_path / "known.html")
    page = (tmp_path / "known.html").read_text()
    assert (
        page.startswith("<!DOCTYPE html>")
        and "data:image/png;base64," in page
        and "robot.mass[1]" in page
    )


@pytest.mark.slow
def test_inertias_stay_those_of_bodies(rng):
    """Any z is a body, and z, x and their derivative belong together."""
    scenario = ij.presets.iiwa14()
    _, c = coordinates(
        scenario, ["plant.mass", "plant.inertia", "plant.link[iiwa_link_3].centre"], {}
    )
    z = to_z(c, c.x)
    np.testing.assert_allclose(to_x(c, z)[0], c.x, rtol=1e-9, atol=1e-12)
    wild = z + rng.normal(size=z.shape) * (np.arange(len(z)) >= 7)
    x, slope = to_x(c, wild)
    for at in c.bodies:
        xx, yy, zz, xy, xz, yz = x[at : at + 6]
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert moments[0] > 0 and moments[0] + moments[1] > moments[2]
    step = 1e-6 * rng.normal(size=z.shape)
    np.testing.assert_allclose(
        (to_x(c, wild + step)[0] - to_x(c, wild - step)[0]) / 2, slope @ step, rtol=1e-5, atol=1e-9
    )


def test_standard_errors_are_those_of_repeated_noise(rng):
    """Windows of a linear model, white and coloured: the errors are the spread of the estimates;
    what has no information is named."""
    K, p = 30, 3

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
        return x, statistics.uncertainty(
            A / np.mean(rest**2),
            -np.einsum("wka,wk->wa", Y, rest) / np.mean(rest**2),
            np.zeros((p, p)),
            np.ones(p),
        )

    for W, colour in ((6, 3.0), (40, 2.0), (40, 0.0)):
        Y, A = model(W)
        found = [estimate(colour) for _ in range(300)]
        spread = np.std([x[0] for x, _ in found])
        assert 0.8 < np.median([k.errors[0] for _, k in found]) / spread < 1.35, (W, colour)
    known = found[0][1]
    assert np.isinf(known.errors[1:]).all() and np.isfinite(known.errors[0])
    wider = statistics.uncertainty(
        A,
        -np.einsum("wka,wk->wa", Y, rng.normal(size=(W, K))),
        np.zeros((p, p)),
        np.ones(p),
        lacking=3.0,
    )
    usual = statistics.uncertainty(A, np.zeros((W, p)), np.zeros((p, p)), np.ones(p))
    assert wider.errors[0] >= 3.0 * usual.errors[0] * (1 - 1e-9)
    np.testing.assert_allclose(3.0 * wider.singular[:2], usual.singular[:2])
    words = statistics.describe_direction(known.directions[:, -1], ("a", "b", "c"))
    assert words == "0.89 b - 0.45 c"


def test_whiteness_tells_noise_from_what_a_model_lacks(rng):
    noise = rng.normal(size=(30, 200))
    assert statistics.whiteness(noise).p > 1e-3
    assert (
        statistics.whiteness(noise + np.cumsum(0.3 * rng.normal(size=noise.shape), axis=1)).p < 1e-6
    )


@pytest.mark.slow
def test_an_excitation_is_inside_its_bounds_and_tells_more(scenario, heavier, run):
    best = ij.excitation(scenario, PATHS, duration=6.0, iterations=15)
    rich = ij.simulate(ij.with_parts(heavier, reference=best), duration=6.0, dt=1e-3)
    assert int(rich.status) == 0 and float(np.min(rich.metrics.margin)) > 0
    options = {"widths": False, "delay": 0.0, "torque": "interpolated"}
    found = [
        ij.identify(scenario, counted(x), PATHS, **options).singular_values for x in (rich, run)
    ]
    assert np.sum(np.log(found[0])) > np.sum(np.log(found[1])) + 1.0  # seven times the determinant
    with pytest.raises(ValueError, match=r"bounds: got .* expected room for a motion"):
        _narrow(scenario)


def _narrow(scenario):
    start = np.asarray(scenario.initial.q)
    narrow = ij.Bounds(
        lower=ij.bounds.Sinusoid(offset=start - 0.3, amplitude=0.29, frequency=3.0),
        upper=ij.bounds.Constant(start + 0.02),
    )
    ij.excitation(
        ij.with_parts(
            scenario, bounds=narrow, reference=ij.references.Sinusoid(offset=start, amplitude=0.0)
        ),
        PATHS,
        duration=4.0,
    )


@pytest.mark.slow
def test_joint_draws_in_a_file_and_in_a_design(tmp_path):
    """The same table as any perturbation; a group without a name, or rows that do not fit, are
    refused."""
    from iblf_jax.files.study import study_from_dict

    rows = {"plant.mass[0]": [0.1, 0.0], "plant.mass[1]": [0.05, 0.02]}
    table = {
        path: {"value": "joint_normal", "mean": 1.0, "rows": row, "group": "g"}
        for path, row in rows.items()
    }
    data = {
        "preset": "zhang_yan_2024",
        "run": {"duration": 0.01, "dt": 1e-3},
        "study": {"runs": 1024},
        "perturbations": table,
    }
    file = study_from_dict(data, "study")
    options = {"runs": 1024, "duration": 0.01, "dt": 1e-3}
    study = ij.monte_carlo(file.scenario, file.perturbations, sampler="sobol", **options)
    found = np.cov(np.stack([np.asarray(study.samples[path]) for path in rows]))
    L = np.array(list(rows.values()))
    np.testing.assert_allclose(found, L @ L.T, atol=8e-4)
    with pytest.raises(ValueError, match="group: got 3, expected a name"):
        study_from_dict(
            {**data, "perturbations": {"plant.mass[0]": {**table["plant.mass[0]"], "group": 3}}},
            "study",
        )
    with pytest.raises(ValueError, match="joint_normal: rows"):
        ij.joint_normal([1.0, 2.0], [1.0, 2.0], "g")


@pytest.mark.slow
def test_the_command_line_identifies_and_writes_what_it_found(tmp_path, capsys):
    out = tmp_path / "known"
    assert (
        cli.main(["identify", str(ROOT / "examples" / "identify.toml"), "--out", str(out)]) == 0
    ), capsys.readouterr().err
    assert "6 of 6 numbers told" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {
        "scenario.toml",
        "identification.npz",
        "identification.json",
        "identification.html",
        "identification.png",
    }
    found = ij.load_scenario(out / "scenario.toml")
    np.testing.assert_allclose(found.model.mass, MASS, rtol=2e-3)
    np.testing.assert_allclose(
        json.loads((out / "identification.json").read_text())["numbers"][1]["value"],
        found.plant.mass[1],
    )


FITTED = {"log": "log.csv", "parameters": ["robot.mass"]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"identify": {"parameters": ["robot.mass"]}},
            r"identify.log: got None, expected the path of a .csv or .nc file",
        ),
        ({"identify": {"log": "log.csv"}}, r"identify.parameters: got nothing"),
        ({"identify": FITTED | {"windw": 1.0}}, r"identify.windw: got an unknown key"),
        ({"identify": FITTED, "limits": {"robot": {"mass": 3.0}}}, r"limits.robot.mass: got 3.0"),
    ],
)
def test_a_wrong_file_is_told(change, words, tmp_path):
    (tmp_path / "identify.toml").write_text(tomli_w.dumps({"preset": "zhang_yan_2024"} | change))
    with pytest.raises(ValueError, match=words):
        load_identification_file(tmp_path / "identify.toml")


def test_the_tangents_of_a_replay_are_those_of_finite_differences(scenario, log):
    """By the start, free torques, a mass, friction and the torque's offset in time; and e is the
    inverse of the acceleration."""
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
        after, before = (
            replay.simulate(z + sign * step[s:], starts + sign * step[:s])[1]
            for sign in (1.0, -1.0)
        )
        share = (
            2e-3 if i < J.shape[-1] - 1 else 0.05
        )  # the offset's is taken over a sample, as a held torque is a staircase
        np.testing.assert_allclose(
            J[..., i], (after - before) / 2e-4, atol=share * np.max(np.abs(J[..., i]))
        )
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
        tau = np.asarray(
            inverse_dynamics(arm, *map(jnp.asarray, (np.zeros(0), t, q, dq, ddq)), places=()).torque
        )
    log = {"t": t, "q": q * np.where(np.arange(7) == 6, -1.0, 1.0), "tau": tau}
    with pytest.raises(ValueError, match=r"with q\[6\] of the other sign, they would explain 100%"):
        ij.identify(scenario, log, ["robot.mass"], torque="interpolated")


def test_the_width_of_each_friction_is_looked_for_beside_it(scenario):
    """Also where one of the widths was asked for by itself."""
    believed, asked = canonical(scenario), ["disturbance.coulomb", "disturbance.width[0]"]
    assert with_widths(believed, asked) == [*asked, "disturbance.width[1]"]
