"""Fronts, attacks on tuned gains, saved results, the command line and the figures of tuning."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT
from matplotlib.figure import Figure
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.files.tuning import load_tuning
from iblf_jax.simulation.paths import get
from iblf_jax.tuning import evaluation
from iblf_jax.tuning._pareto import non_dominated
from iblf_jax.tuning.problem import TuningProblem
from iblf_jax.tuning.result import TuneResult

GAINS = ["controller.k1", "controller.K2"]
SHORT = {"duration": 0.3, "dt": 1e-3, "method": "euler"}
SETS = {
    "plant.mass[1]": ij.factor(ij.uniform(0.5, 1.5)),
    "initial.q": ij.offset(ij.uniform(-0.05, 0.02)),
    "initial.dq": ij.value(ij.uniform(-3.0, 3.0)),
    "disturbance.acceleration_amplitude": ij.value(ij.uniform(-20.0, 20.0)),
}


def test_non_dominated_points_and_the_text_of_an_attack_whose_loop_is_unstable(paper):
    points = np.array([[1.0, 5.0], [2.0, 4.0], [2.0, 3.0], [3.0, 3.5], [4.0, 1.0]])
    assert non_dominated(points).tolist() == [0, 2, 4]
    timing = {"duration": 0.01, "dt": 1e-3, "method": "rk4"}
    attack = ij.WorstCase(paper, {}, 0.1, 0.1, 0, np.ones((2, 2)), 4, timing)
    assert repr(attack).startswith("WorstCase(not falsified: smallest margin 0.1 rad")
    unstable = dataclasses.replace(attack, status=int(ij.Status.SAMPLING_TOO_SLOW))
    words = "bounds kept, but the sampled loop is unstable at this draw: smallest margin 0.1"
    assert repr(unstable).startswith(f"WorstCase({words}")
    flags = ij.Status.SAMPLING_TOO_SLOW | ij.Status.BOUND_VIOLATED
    assert repr(dataclasses.replace(attack, status=int(flags))).startswith("WorstCase(FALSIFIED")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::iblf_jax.SimulationWarning")
def test_falsify_finds_worse_than_random_runs_and_returns_what_can_be_run(paper):
    """As the second, of starts and references beyond the bounds."""
    attack = ij.falsify(paper, SETS, starts=4, iterations=8, **SHORT)
    budget = 6 * attack.runs  # a value with its derivatives costs less than six values
    study = ij.monte_carlo(paper, SETS, runs=budget, seed=1, progress=False, **SHORT)
    assert attack.margin < float(np.min(study.metrics.margin))
    assert attack.margin < attack.first_margin
    assert attack.margin == pytest.approx(float(np.min(attack.replay().metrics.margin)), abs=1e-9)
    for path, perturbation in SETS.items():
        low, high = perturbation.range(np.asarray(get(paper, path)))
        assert np.all(attack.values[path] >= low - 1e-9)
        assert np.all(attack.values[path] <= high + 1e-9)
    ends = {"initial.q": (0.2, 1.2), "reference.amplitude": (0.0, 0.8)}
    sets = {path: ij.value(ij.uniform(*pair)) for path, pair in ends.items()}
    attack = ij.falsify(paper, sets, starts=3, iterations=4, **SHORT)
    again = attack.replay()
    assert attack.margin == pytest.approx(float(np.min(again.metrics.margin)), abs=1e-9)
    assert attack.margin <= np.nanmin(attack.history) and attack.margin < attack.first_margin
    assert np.all((again.q[0] > again.lower[0]) & (again.q[0] < again.upper[0]))


def area(points, corner):
    """What a front beats, of the logarithms below a corner: the hypervolume."""
    a, b = np.log(points[non_dominated(points)]).T
    return float(np.sum(np.diff(np.append(a, np.log(corner[0]))) * (np.log(corner[1]) - b)))


@pytest.mark.slow
def test_a_front_has_its_ends_and_no_gaps(paper):
    """Beside a dense grid over both gains; a limit on the margin cuts both fronts alike."""
    ends = {"controller.k1": 0.3, "controller.K2": 0.6}
    gains = [ij.tunable(path, low, 60.0, tied=True) for path, low in ends.items()]
    margin = float(np.min(ij.simulate(paper, **SHORT).metrics.margin))
    limit = ij.objectives.margin_above(0.9 * margin)
    pair = (ij.objectives.tracking(), ij.objectives.effort() + limit)
    front = ij.pareto(paper, gains, pair, iterations=12, progress=False, **SHORT)
    built = TuningProblem.build(paper, gains, pair[0] + pair[1], **SHORT)
    axes = np.linspace(built.box.low, built.box.high, 40).T
    z = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    seen = evaluation.value(built, built.candidates(z))
    kept = np.asarray(seen.valid & (seen.margin > 0) & (seen.exact_excess[:, 0] <= 0))
    assert 0 < np.sum(kept) < len(z)
    grid = np.asarray(seen.terms)[kept]
    dense = grid[non_dominated(grid)]
    corner = 1.1 * np.maximum(dense.max(axis=0), front.objectives.max(axis=0))
    assert area(front.objectives, corner) > 0.99 * area(dense, corner)
    np.testing.assert_array_less(front.objectives.min(axis=0), 1.001 * dense.min(axis=0))
    assert np.max(np.abs(np.diff(np.log(front.objectives), axis=0))) < np.log(1.5)
    assert front.evaluations <= 8 * 12
    metrics = ij.simulate(front.scenario(len(front) - 1), **SHORT).metrics
    assert float(np.min(metrics.margin)) > -float(limit.limit) - 1e-12
    with pytest.raises(ValueError, match="one term each"):
        ij.pareto(paper, GAINS, (pair[0], ij.objectives.peak_torque()), **SHORT)


TUNING = """
preset = "zhang_yan_2024"
[run]
duration = 0.3
method = "euler"
[tune]
parameters = ["controller.k1", { path = "controller.K2", low = 0.6, high = 30.0, tied = true }]
runs = 4
risk = "cvar"
level = 0.75
[tune.effort]
iterations = 4
[tune.report]
runs = 64
[[objective]]
kind = "tracking"
[[objective]]
kind = "peak_torque"
weight = 0.5
[[requirement]]
kind = "margin_above"
limit = 0.02
[perturbations]
"plant.mass[1]" = { factor = "uniform", low = 0.7, high = 1.3 }
"""


@pytest.mark.slow
def test_the_command_line_tunes_and_a_saved_result_reproduces_its_report(tmp_path, capsys):
    from iblf_jax.cli import main

    file = tmp_path / "tune.toml"
    file.write_text(TUNING)
    assert main(["tune", str(file), "--out", str(tmp_path / "out"), "--quiet"]) in (0, 1)
    text = capsys.readouterr().out
    assert "requirement margin > 0.02 rad" in text and "fresh runs" in text
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {"scenario.toml", "tuning.npz", "report.txt", "tuning.png"}
    loaded = ij.load(tmp_path / "out" / "tuning.npz")
    assert str(loaded.report) in text
    tuned = ij.load_scenario(tmp_path / "out" / "scenario.toml")
    np.testing.assert_array_equal(tuned.controller.K2, loaded.scenario.controller.K2)
    assert loaded.values["controller.K2"].shape == (2,) and loaded.names[-1] == "controller.K2"
    assert loaded.setup.limits[-1] == pytest.approx((0.6, 30.0))
    assert "peak torque of all runs, joint by joint" in text
    file.write_text(TUNING.replace("margin_above", "margin_abve"))
    assert main(["tune", str(file), "--quiet"]) == 2
    assert "requirement[0].kind" in capsys.readouterr().err


def test_ends_of_ranges_are_found_at_zero_and_where_there_is_none():
    """1 % of the limit, or of the range where it is 0; an infinite limit is never reached."""
    limits = ((0.0, 100.0), (1.01, np.inf), (-np.inf, 50.0), (1.0, 9.0))
    values = {"a": np.array(0.5), "b": np.array(1.011), "c": np.array(49.8), "d": np.array(5.0)}
    search = ("newton", "forward", 0.0, SimpleNamespace(limits=limits, reasons=()))
    result = TuneResult(None, None, values, tuple(values), {}, 0, "", *search)
    sides = {name: end.side for name, end in result.at_limits.items()}
    assert sides == {"a": "lower", "b": "lower", "c": "upper"}
    assert dataclasses.replace(result, setup=SimpleNamespace(limits=(), reasons=())).at_limits == {}


@pytest.mark.slow
def test_the_path_of_a_tuning_across_what_is_allowed(paper):
    """Two gains, each one number for all joints; what the limit forbids is where runs break it."""
    gains = [ij.tunable(GAINS[0], 1.0, 2.5, tied=True), ij.tunable(GAINS[1], tied=True)]
    goal = ij.objectives.tracking() + ij.objectives.peak_torque_below(12.0)
    options = SHORT | {"effort": ij.tuning.Effort(iterations=3), "progress": False}
    best = ij.tune(paper, gains, goal, **options)
    k1, K2 = np.array([1.0, 4.0]), np.array([3.0, 10.0, 40.0])
    loss, excess = best.on_slice(*best.names, k1, K2)
    start = np.sum(ij.simulate(paper, **SHORT).metrics.ise)
    for i, j in ((0, 0), (1, 2)):
        values = {"controller.k1": np.full(2, k1[i]), "controller.K2": np.full(2, K2[j])}
        metrics = ij.simulate(ij.with_parameters(paper, values), **SHORT).metrics
        assert excess[i, j] == pytest.approx(float(np.max(metrics.peak_torque)) / 12 - 1, rel=1e-9)
        assert loss[i, j] == pytest.approx(float(np.sum(metrics.ise) / start), rel=1e-9)
    figure = best.plot(points=3)
    assert len(figure.axes) == 8
    figure._repr_png_()
    assert "at the end of their range: controller.k1" in figure.get_suptitle().replace("\n", " ")
    panels = {axes.get_ylabel(): axes for axes in figure.axes}
    runs = [ij.simulate(scenario, **SHORT) for scenario in (paper, best.scenario)]
    peaks = (", ".join(f"{x:.5g}" for x in run.metrics.peak_torque.tolist()) for run in runs)
    assert f"peak torque, joint by joint: {' -> '.join(peaks)} N m" in str(best.report)
    signed = [tau[np.argmax(np.abs(tau))] for run in runs for tau in np.asarray(run.tau).T]
    shown = [text.get_text() for text in panels["peak torque [N m]"].texts]
    assert shown == [f"{x:.3g}".replace("-", "\N{MINUS SIGN}") for x in signed]
    gains = panels["gain, relative to start"]
    assert not gains.get_legend().get_window_extent().overlaps(gains.get_window_extent())
    a, b, loss = best.landscape(*best.names, points=3, span=0.2)
    assert loss[1, 1] == pytest.approx(best.report.changes[0].after, rel=1e-9)
    assert (a[1], b[1]) == tuple(best.tuned)
    assert_refused("landscape", best.landscape, best.names[0], "controller.o[0]")
    figure = Figure()
    others = {"grid": [[1.0, 3.0], [4.0, 40.0]]}
    assert ij.plotting.paths(best, others, points=5, figure=figure) is figure
    (axes,) = figure.axes
    names = {text.get_text() for text in axes.figure.legends[0].get_texts()}
    steps = f"tune, {len(best.history['loss'])} values"
    assert names == {"grid, 2 values", "start", steps, "tuned"}
    assert axes.get_xlim()[1] > 4.0 and axes.get_ylim()[1] > 40.0 and axes.get_xscale() == "log"
    with pytest.raises(ValueError, match="names of two tuned numbers"):
        ij.plotting.paths(best, gains=("controller.k1", "controller.o"))


def short_tuning(paper, checkpoint, weight=1.0):
    goal = weight * ij.objectives.tracking(scale=1.0)
    options = {"duration": 0.01, "progress": False}
    options |= {"effort": ij.tuning.Effort(iterations=1), "report": ij.tuning.Report(runs=2)}
    return ij.tune(paper, ["controller.k1"], goal, checkpoint=checkpoint, **options)


EARLIER = ROOT / "tests" / "data" / "tuning_before_weights.json"


@pytest.mark.slow
def test_files_that_are_torn_or_others(paper, tmp_path):
    """Checkpoints and results of earlier versions: of another problem, cut anywhere, of another
    kind, with keys that are missing or of another type."""
    np.save(tmp_path / "array.npy", np.ones(3))
    short_tuning(paper, tmp_path / "state.npz")
    assert_refused("this very problem", short_tuning, paper, tmp_path / "state.npz", weight=2.0)
    state, saved = (tmp_path / "state.npz").read_bytes(), EARLIER.read_text()
    cut = [b"", state[:10], state[: len(state) // 2], state[:-30]]
    bad = tmp_path / "bad.npz"
    for data in (*cut, (tmp_path / "array.npy").read_bytes(), b"PK" + state[40:]):
        bad.write_bytes(data)
        assert_refused(r"checkpoint: got .*delete it or name another", short_tuning, paper, bad)
        assert_refused(r"bad.npz: ", ij.load, bad)
    complete = json.loads(saved)
    # Earlier versions lack these, and may be without the others.
    free = {"report", "tried", "tuned_objective"}
    unchecked = free | {"best_start", "seconds", "probes"}
    others = [{key: complete[key] for key in complete.keys() - {x}} for x in complete.keys() - free]
    for key in complete.keys() - unchecked:
        others += [complete | {key: value} for value in (None, 3, [[1]])]
    for text in (*map(json.dumps, others), saved[:200], "[]", "[" * 100_000):
        (tmp_path / "bad.json").write_text(text)
        assert_refused(r"path: got .*TuneResult\.save", load_tuning, tmp_path / "bad.json")
    assert load_tuning(EARLIER).names == ("controller.k1[0]", "controller.k1[1]")
