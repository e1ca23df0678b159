"""Laws with the same budget of tuning: what is equal, which laws have a rank, and the page."""

import json
import sys
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT

import iblf_jax as ij

FIELD = ROOT / "benchmarks" / "field"
sys.path[:0] = [str(FIELD), str(ROOT / "docs")]
sys.path.append(str(ROOT / "benchmarks"))
import entry
import equal_budget
import field_budget
import run_numbers
import task_laws
from test_field import task_of

FILES = sorted(entry.RESULTS.glob("*.json"))


def a_task(name):
    """The task of an entry without its published run."""
    return task_of(entry.definition(entry.ENTRIES / name).scenario)


@pytest.mark.parametrize("name", equal_budget.TASKS)
def test_every_law_of_a_task_has_two_or_three_gains_in_the_same_range(name):
    task = a_task(name)
    published = task.scenario.controller
    chosen, uncertain = equal_budget.chosen_laws(name, task), ("plant.mass",)
    choices = equal_budget.laws_on(task, published, chosen, {}, uncertain)
    scenarios = {equal_budget.OWN: task.scenario} | {
        law: ij.with_parts(task.scenario, controller=one.law, **one.parts)
        for law, one in choices.items()
        if not isinstance(one, str)
    }
    assert len(scenarios) >= 5
    for law, scenario in scenarios.items():
        controller = scenario.controller
        paths = equal_budget.gains_of(name, controller, law == equal_budget.OWN)
        assert len(paths) in (2, 3), law
        assert len(set(paths)) == len(paths), law
        for one in equal_budget.tunables(scenario, paths):
            assert np.all(np.asarray(one.low) > 0.0), law
            ratio = np.asarray(one.high) / np.asarray(one.low)
            np.testing.assert_allclose(ratio, equal_budget.RANGE**2, err_msg=law)


def test_a_law_that_is_the_published_one_has_no_second_row():
    task, names = a_task("zhang_yan_2024"), ("ComputedTorque", "PDGravity")
    law = task_laws.laws_of(task, ())["ComputedTorque"].law
    found = equal_budget.laws_on(task, law, names, {"PDGravity": "no gravity"})
    assert found["ComputedTorque"] == "it is the law of the entry with other gains"
    assert found["PDGravity"] == "no gravity"
    with pytest.raises(entry.EntryError, match=r"--laws: \['no law'\] are unknown"):
        equal_budget.laws_on(task, law, ("no law",), {})


def test_the_rank_leaves_out_laws_outside_the_effort():
    def law(low, high):
        return {"front": [{"level": 0.7, **low}, {"level": 1.0, **high}]}

    above = {"left": "its effort is above the limit"}
    inside = [{"left": "", "error": error} for error in (0.3, 0.2, 0.1)]
    laws = {"A": law(above, inside[0]), "B": law(inside[2], inside[1]), "C": law(inside[2], above)}
    assert equal_budget.ranks({"laws": laws}) == {"B": 1, "A": 2}
    # Errors that differ by less than `TIE` have one rank.
    assert equal_budget.ranks({"laws": laws}, 0.7) == {"B": 1, "C": 1}
    nearly = law(above, {"left": "", "error": 0.201})
    order = equal_budget.ranks({"laws": {**laws, "D": nearly}})
    assert order == {"B": 1, "D": 1, "A": 3}


def test_laws_with_the_same_errors_are_refused():
    def law(error):
        return {"front": [{"level": 1.0, "error": error}, {"level": 2.0, "left": "diverges"}]}

    laws = {"A": law(0.1), "B": law(0.1 * (1.0 + 1e-10)), "C": law(0.1 * (1.0 + 1e-8))}
    assert equal_budget.equal_laws(laws) == ["'A' and 'B' agree to 9 digits"]
    one, other = sorted(equal_budget.ONE_LAW)
    assert equal_budget.equal_laws({one: law(0.1), other: law(0.1)}) == []


def test_two_barriers_give_one_law_up_to_a_weight():
    tube = a_task("goel_2020").scenario.context.tube(jnp.zeros(()))
    q = jnp.array([0.3])
    integral, log = (task_laws.BARRIERS[name].slope(tube, q) for name in ("Integral", "Log"))
    np.testing.assert_allclose(integral, 2.0 * log, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "command", "expected"),
    [
        ("shaw_cortez_2022", [20.0, -20.0], [18.0, -10.0]),
        # The vessel has no force in sway.
        ("wang_2023", [300.0, 5.0, -50.0], [227.355, 0.0, -43.85615]),
    ],
)
def test_limits_of_the_input_clip_every_command(name, command, expected):
    folder = entry.ENTRIES / name
    scenario = equal_budget.limited(entry.definition(folder).scenario, entry.load(folder))
    delivered = scenario.actuator.deliver(jnp.array(command), jnp.zeros(len(command)), ())
    np.testing.assert_allclose(delivered.tau, expected)
    assert delivered.limited.all()


def test_a_run_says_what_it_does_not_keep():
    for status, violation, regions, words in (
        (0, -1.0, False, ""),
        (ij.Status.BOUND_VIOLATED, -1.0, False, "leaves the bounds"),
        (ij.Status.BOUND_VIOLATED | ij.Status.NOT_FINITE, -1.0, False, "diverges"),
        (0, 0.1, False, "violates a constraint or the bounds of a further level"),
        (ij.Status.REGION_VIOLATED, -1.0, False, ""),
        (ij.Status.REGION_VIOLATED, -1.0, True, "enters a region"),
        (ij.Status.STEP_TOO_LARGE, -1.0, False, "the time step is too large"),
    ):
        run = SimpleNamespace(status=int(status))
        assert run_numbers.failure_of(run, violation, regions) == words


@pytest.mark.slow
def test_the_numbers_of_a_run_are_those_of_its_samples():
    scenario = ij.presets.zhang_yan_2024()
    fold = run_numbers.Numbers(0.05, 0.5, (lambda t, x: 3.0 - x[0],))
    run = ij.simulate(scenario, duration=1.0, dt=1e-3, metrics=(fold,))
    gravity = np.stack([scenario.plant.gravity(jnp.asarray(q)) for q in run.q])
    square = np.sum((np.asarray(run.tau) - gravity) ** 2, axis=1)
    error = np.mean(np.asarray(run.e1) ** 2, axis=1)

    def rms(values, part):
        time = run.t[part]
        return np.sqrt(np.trapezoid(values[part], time) / (time[-1] - time[0]))

    for name, expected, rtol in (
        ("error", rms(error, run.t >= 0.0), 1e-6),
        ("late_error", rms(error, run.t >= 0.5), 1e-2),
        ("effort", rms(square, run.t >= 0.0), 1e-6),
        ("start_effort", rms(square, run.t <= 0.05), 0.03),
        ("rest_effort", rms(square, run.t >= 0.05), 0.03),
        ("peak_input", np.abs(run.tau).max(), 1e-6),
        ("violation", run.q.max() - 3.0, 1e-6),
    ):
        np.testing.assert_allclose(run.metrics[name], expected, rtol=rtol, err_msg=name)


@pytest.mark.slow
def test_the_quick_comparison(tmp_path, monkeypatch, capsys):
    law = "BarrierBackstepping(Integral)"
    words = ["equal_budget.py", "--task", "no_entry_2000", "liu_2018", "--laws", law, "--quick"]
    monkeypatch.setattr(sys, "argv", [*words, "--out", str(tmp_path)])
    assert equal_budget.main() == 1
    assert "no_entry_2000: failed: there is no entry.toml" in capsys.readouterr().out
    result = json.loads((tmp_path / "liu_2018.json").read_text())
    assert set(result["laws"]) == {equal_budget.OWN, law}
    published = result["laws"][equal_budget.OWN]
    for row in filter(lambda row: row["level"] >= 1.0, published["front"]):
        limit = row["level"] * result["own"]["effort"]
        assert row["left"] == "" and row["effort"] <= 1.001 * limit
        assert row["error"] <= result["own"]["error"] * (1.0 + 1e-9)
    assert set(published["robustness"]) == {"masses", "periods", "noise"}
    assert len(published["robustness"]["noise"]) == equal_budget.SEEDS
    check_page({"liu_2018": result})


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_result_of_the_repository_keeps_what_the_page_says(path):
    result = json.loads(path.read_text(encoding="utf-8"))
    budget = equal_budget.BUDGET
    counts = {"points": budget.values, "starts": budget.starts, "steps": budget.iterations}
    assert result["budget"] == counts
    assert "uncommitted" not in result["machine"]["commit"]
    assert equal_budget.equal_laws(result["laws"]) == []
    for name, law in result["laws"].items():
        assert len(law["gains"]) in (2, 3), name
        assert [row["level"] for row in law["front"]] == list(equal_budget.LEVELS), name
        errors = []
        for row in law["front"]:
            # Some searches begin again, and some look at further points.
            assert budget.values < row["points"] <= 6 * (budget.values + 1), name
            if row["left"]:
                assert "error" not in row, name
                continue
            limit = row["level"] * result["own"]["effort"]
            assert row["effort"] <= limit * (1.0 + equal_budget.TOLERANCE), name
            errors.append(row["error"])
        assert errors == sorted(errors, reverse=True), name


def test_readme_article_and_page_have_the_numbers_of_the_results():
    """The page has all tasks, and what a law does not keep."""
    found = field_budget.results()
    check_page(found)
    for key in ("processor", "cores", "python", "jax", "iblf_jax"):
        assert len({result["machine"][key] for result in found.values()}) == 1, key
    words = field_budget.in_words(found)
    for path in (FIELD / "README.md", ROOT / "paper" / "paper.md"):
        assert words in " ".join(path.read_text(encoding="utf-8").split()), path


def check_page(found):
    page = field_budget.page(found)
    for name, result in found.items():
        assert f"]({field_budget.NAME}_{name}.png)" in page
        axes, *_ = field_budget.figure(result).axes
        assert axes.get_xlabel() and axes.get_ylabel()
        labels = axes.get_legend_handles_labels()[1]
        assert len(labels) == len(result["laws"]) + 1
