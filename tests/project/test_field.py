"""The benchmark of the field: the format of its entries, what their pages state, the checker, and
the programs that are written without the package."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.files.scenario import load_scenario_file

FIELD = ROOT / "benchmarks" / "field"
sys.path[:0] = [str(FIELD), str(ROOT / "docs")]
sys.path.append(str(ROOT / "benchmarks"))
import check
import entry
import entry_tables
import field
import gallery
import measure
import task_laws
import withdrawn

NAMES = [folder.name for folder in entry.folders()]
TEMPLATE = FIELD / "template"
FEWEST = 20


def test_there_are_entries_of_each_method():
    assert len(NAMES) >= FEWEST
    assert {entry.load(entry.ENTRIES / name).method for name in NAMES} == set(entry.METHODS)


@pytest.mark.parametrize("name", NAMES)
def test_the_format_of_an_entry(name):
    folder = entry.ENTRIES / name
    contents = entry.load(folder)
    assert not check._faults_of_name(folder)
    assert not check._faults_of_text(contents)
    assert not check._faults_of_script(folder / "example.py")


@pytest.mark.site
@pytest.mark.usefixtures("optimised_kernels")
@pytest.mark.parametrize("name", NAMES)
def test_an_entry_makes_its_page_and_is_correct(name):
    """Among others: every published number is reached, every claim holds, and the program that is
    written without the package gives the same motion.  The script runs once, for the page."""
    folder = entry.ENTRIES / name
    pictures = gallery.page(folder / "example.py")
    assert pictures and all(path.stat().st_size > 1000 for path in pictures)
    assert gallery.is_made(folder / "example.py")
    assert check.faults_of(folder) == []
    if name in FURTHER:
        FURTHER[name](entry.execute(folder).runs)


def test_scenario_files_name_their_command():
    files = sorted(entry.ENTRIES.glob("*/scenario.toml"))
    assert len(files) >= 6
    for path in files:
        assert not check._faults_of_scenario(path.parent, entry.load(path.parent))
        assert set(load_scenario_file(path).run) >= {"duration", "dt"}


@pytest.mark.slow
def test_the_command_of_a_scenario_file_runs(capsys):
    path = entry.ENTRIES / "mahmud_2021" / "scenario.toml"
    assert cli.main(["simulate", str(path), "--duration", "0.1"]) == 0
    assert "status: ok" in capsys.readouterr().out


@pytest.mark.parametrize("path", sorted(entry.CHECKS.glob("*.json")), ids=lambda path: path.stem)
def test_the_noted_checks_found_nothing_to_repair(path):
    entries = json.loads(path.read_text(encoding="utf-8"))["entries"]
    assert len(entries) >= FEWEST
    assert not [name for name, found in entries.items() if found["to repair"]]
    for name, found in entries.items():
        contents = entry.load(entry.ENTRIES / name)
        assert set(found["holds"]) == {claim.statement for claim in contents.claims}
        for number in contents.published:
            assert entry.is_reached(number, found["reached"][number.quantity])


def test_independent_programs_exist():
    assert len(sorted(entry.ENTRIES.glob("*/independent.py"))) >= 20


# ---------------------------------------------------------------------------- further statements


def dimanidis(runs):
    for run in runs.values():
        assert run.status == 0
    evidence = entry.execute(entry.ENTRIES / "dimanidis_2018").evidence
    assert evidence["best"] < 0.003
    assert evidence["gain"] > 0.1
    np.testing.assert_allclose(evidence["torque"], -0.287, atol=1e-3)
    np.testing.assert_allclose(evidence["sigma"], 7.295, atol=1e-3)
    assert abs(evidence["printed_sigma"] - 7.295) > 0.5


def shaw_cortez(runs):
    run = runs["filtered"]
    # The law requests more than the filter gives.
    assert int(run.status) == int(ij.Status.TORQUE_SATURATED)
    assert np.min(run.metrics.margin) > 0
    # The reference leaves the bounds, and is no fault of a filter's run.
    assert np.any(run.q_d > run.scenario.bounds[0].upper.value)
    evidence = entry.execute(entry.ENTRIES / "shaw_cortez_2022").evidence
    assert evidence["without_term"] > 3 * evidence["with_term"]


def zhang(runs):
    run = runs["published law"]
    assert run.status == 0
    late = np.flatnonzero(run.t < 6.99)[-1]
    M = np.asarray(run.scenario.plant.mass_matrix(run.q[late]))
    np.testing.assert_allclose(
        run.e1[late], np.linalg.solve(M, [0.15, 0.18, 0.12]) / 1500, rtol=0.03
    )
    assert np.abs(run.e1[run.t < 6.0]).max() < 1e-8


def mahmud(runs):
    (run,) = runs.values()
    assert run.status == 0
    # The least distance is that of the start, in a corner of the bounds.
    np.testing.assert_allclose(run.metrics.margin, 2.0, atol=1e-9)
    np.testing.assert_allclose(run.metrics.velocity_margin, 2.0, atol=1e-9)
    np.testing.assert_allclose(
        run.scenario.plant.mass_matrix(np.zeros(2)), [[3.957, 0.438], [0.438, 0.196]], rtol=1e-9
    )


def bartelt(runs):
    for run in runs.values():
        assert run.status == 0
        w = 1.4195117 * np.linalg.norm(run.dq - run.alpha, axis=1)
        assert w[0] > 1 > 0.05 > w[run.t > 8.0].max()


def goel(runs):
    assert all(run.status == 0 for run in runs.values())
    for name in ("exact derivatives", "filter of the package"):
        assert 2.4 < np.abs(runs[name].alpha).max() < 2.5
    evidence = entry.execute(entry.ENTRIES / "goel_2020").evidence
    np.testing.assert_allclose(evidence["corrected"], evidence["limit"], rtol=1e-6)
    assert evidence["branch"] > 5 * evidence["limit"]
    # The branch at z_1 = 0 has no effect on the runs.
    assert evidence["zeros"] == 0 < evidence["states"]


def xernicrose(runs):
    for name in ("published barrier", "Log"):
        assert runs[name].status == 0
        assert np.abs(runs[name].e1).max() < 0.06
        assert np.diff(runs[name].V).max() < 1e-10
    unbounded = runs["Quadratic, no barrier"]
    assert unbounded.status == int(ij.Status.BOUND_VIOLATED)
    assert unbounded.x[:, 0].max() > 0.56
    evidence = entry.execute(entry.ENTRIES / "xernicrose_2024").evidence
    assert evidence["wrong_V"] > 10 * evidence["wrong_least"]
    assert abs(evidence["hand"] - evidence["exact"]) > 0.1 * abs(evidence["exact"])


def liu(runs):
    for run in runs.values():
        assert run.status == 0
        assert np.abs(run.e1).max() < 0.51
        assert np.diff(run.V).max() < 1e-10


def zhang_yan(runs):
    assert all(run.status == 0 for run in runs.values())
    evidence = entry.execute(entry.ENTRIES / "zhang_yan_2024").evidence
    assert evidence["printed"] > 1.02 * evidence["start"]
    # Both start at the same state; the compiler rounds the two programs differently.
    assert evidence["corrected"] <= evidence["start"] * (1 + 1e-12)
    assert evidence["with_term"] < 1e-6 < 1e-3 < evidence["without_term"]
    assert evidence["equal_gains"] > evidence["equal_effort"] > 1.0
    assert evidence["weight_two"] < 1e-12
    assert evidence["K2"] > 0.5
    assert evidence["kf"] > 1.0


FURTHER = {
    "bartelt_2024": bartelt,
    "dimanidis_2018": dimanidis,
    "liu_2018": liu,
    "mahmud_2021": mahmud,
    "shaw_cortez_2022": shaw_cortez,
    "xernicrose_2024": xernicrose,
    "goel_2020": goel,
    "zhang_2022": zhang,
    "zhang_yan_2024": zhang_yan,
}
"""Entry -> what its page states beyond the published numbers and claims."""


# ---------------------------------------------------------------------------- the checker


QUICK = """
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

scenario = ij.presets.zhang_yan_2024()
runs = {"first": ij.simulate(scenario, duration=0.01, dt=1e-3)}
figure, axes = plt.subplots()
axes.plot(runs["first"].t, runs["first"].e1)
axes.set(xlabel="time [s]", ylabel="error [rad]")
reached = {"largest error [rad]": float(np.abs(runs["first"].e1).max())}
holds = {"the output stays inside its bounds": True}
evidence = {"printed": 0.1}
"""
SCRIPT = f'"""A title: one sentence."""\n{QUICK}'


OF_AN_AUTHOR = {
    "A bound on the output of a servo drive": "Bounds of a drive",
    "A. Author, B. Author": "C. Author",
    "Title of the publication": "Bounds",
    "Journal 1(2) (2020) 3-4, section 5": "Journal 2 (2020) 5-6",
    "10.1000/182": "10.1000/183",
    'printed = "k1 = 1"': 'printed = "k1 = 2"',
}
"""Words of the template that an author replaces."""


@pytest.fixture
def faults(tmp_path):
    """Writes an entry with replaced words; the function returns what the checker finds."""

    def found(text=(), script=(), files=(), name="author_2020"):
        folder = tmp_path / name
        folder.mkdir()
        contents = (TEMPLATE / "entry.toml").read_text(encoding="utf-8")
        contents = contents.replace("duration = 2.0", "duration = 0.01")
        contents = contents.replace("value = 0.5\n", "value = 0.3\n")
        for old, new in OF_AN_AUTHOR.items():
            contents = contents.replace(old, new)
        (folder / "entry.toml").write_text(replaced(contents, text), encoding="utf-8")
        (folder / "example.py").write_text(replaced(SCRIPT, script), encoding="utf-8")
        for file, words in dict(files).items():
            (folder / file).write_text(words, encoding="utf-8")
        return check.faults_of(folder)

    return found


def replaced(text, pairs):
    for old, new in dict(pairs).items():
        assert old in text
        text = text.replace(old, new)
    return text


IN_TEXT = {
    "unknown key": ({'plant = "servo': 'plant_ = "servo'}, "has the unknown key 'plant_'"),
    "missing key": ({'plant = "servo': 'plant_ = "servo'}, "lacks the key 'plant'"),
    "missing table": ({"[run]": "[runs]"}, "lacks the table [run]"),
    "missing key of a list": (
        {'where = "equation (40)"': ""},
        "[[printed]] number 1 lacks the key",
    ),
    "unknown family": ({'"drive"': '"car"'}, "family = 'car' must be one of robot, flexible joint"),
    "unknown method": ({'"barrier"': '"wall"'}, "method = 'wall' must be one of barrier"),
    "what was read": ({'read = "article"': 'read = "web"'}, "read = 'web' must be one of article"),
    "a text for a number": (
        {"year = 2020": 'year = "2020"'},
        "year = '2020' must be a whole number",
    ),
    "no list": ({"[[claims]]": "[claims]"}, "claims must be a list of tables"),
    "no TOML": ({"year = 2020": "year ="}, "entry.toml is not valid TOML: Invalid value (at line"),
    "no link": ({'doi = "10.1000/183"': ""}, '[source] needs doi = "10...." or url'),
    "address as DOI": ({'"10.1000/183"': '"https://doi.org/10.1000/182"'}, "must begin with 10."),
    "tolerance": ({"tolerance = 0.005": "tolerance = 0"}, "must be positive"),
    "time step": ({"dt = 1e-3": "dt = 0.0"}, "[run] needs 0 < dt < duration"),
    "number not reached": (
        {"value = 0.3\n": "value = 0.513\n"},
        "'largest error [rad]' is not reached: published 0.513, here 0.3",
    ),
    "number not computed": (
        {'"largest error [rad]"': '"peak [rad]"'},
        "reached lacks 'peak [rad]'",
    ),
    "unused evidence": ({"{printed}": "0.1"}, "no evidence of [[corrected]] contains {printed}"),
    "evidence not computed": ({"{printed}": "{printed} {other:.3g}"}, "evidence lacks 'other'"),
    "format": ({"{printed}": "{printed:.3q}"}, "{printed:.3q} must have the format of a number"),
    "another year": ({"year = 2020": "year = 2021"}, "must end in the year of entry.toml"),
    "title of the template": (
        {'"Bounds of a drive"': '"A bound on the output of a servo drive"'},
        "title is that of the template",
    ),
    "author of the template": (
        {'"C. Author"': '"A. Author, B. Author"'},
        "[source] authors is that of the template",
    ),
    "correction of the template": (
        {'printed = "k1 = 2"': 'printed = "k1 = 1"'},
        "[[corrected]] has the example of the template",
    ),
    "where the error is": (
        {'found_in = "publication"': 'found_in = "web"'},
        "found_in = 'web' must be one of publication, program",
    ),
    "no list of the correction": (
        {'found_in = "publication"': ""},
        "[[corrected]] number 1 lacks the key 'found_in'",
    ),
    "edition": ({'edition = "published version"': ""}, "[source] lacks the key 'edition'"),
    "whom to ask": ({'contact = "A. Author"': ""}, "[source] lacks the key 'contact'"),
    "evidence without a number": (
        {"the error after 0.5 s is {printed} rad, and figure 3 shows 0.001 rad.": "it is larger."},
        "[[corrected]] number 1: the evidence needs a number",
    ),
    "contacted": (
        {'contacted = "not contacted"': 'contacted = "no"'},
        "contacted = 'no' must be one of not contacted, asked, confirmed, disputed",
    ),
    "no answer": (
        {'contacted = "not contacted"': 'contacted = "asked"'},
        "answer = '' does not agree with contacted = 'asked'",
    ),
    "answer of nobody": (
        {'contacted = "not contacted"': 'answer = "yes"'},
        "answer = 'yes' does not agree with contacted = 'not contacted'",
    ),
    "equal rows of one law": (
        {"[run]": '[[equal_rows]]\nlaw = "A"\nother = "A"\nreason = "R"\n[run]'},
        "[[equal_rows]] needs two laws, not 'A' twice",
    ),
    "duration": ({"duration = 0.01": "duration = 3.0"}, "ends at 0.01 s, and entry.toml"),
}
IN_SCRIPT = {
    "claim is false": ('bounds": True', 'bounds": False', "does not hold"),
    "numbers of no claim": (
        "holds =",
        "details = {'x': '1 rad'}\nholds =",
        "no [[claims]] has the statement 'x' of details",
    ),
    "claim not decided": ("holds = {", "answers = {", "holds lacks"),
    "no figure": ("figure, axes", "picture, axes", "does not define 'figure'"),
    "no curves": ('axes.plot(runs["first"].t, runs["first"].e1)', "", "the figure has no curves"),
    "no label": ('xlabel="time [s]", ', "", "panel 1 of the figure has no label of its x axis"),
    "error": ("ij.presets.zhang", "ij.preset.zhang", "example.py does not run: line 8: Attribute"),
    "syntax": ("scenario = ij", "scenario = = ij", "example.py does not run: SyntaxError"),
    "docstring": ("A title: one", "A title, one", "must begin with a docstring"),
    "array": ("float(np.abs(", "(lambda x: np.ones(2))(np.abs(", "must be one number"),
    "too long": ("evidence =", "\n" * check.MOST_LINES + "evidence =", "shorten it to 150"),
    "time step": ("dt=1e-3", "dt=1e-4", "has the step 0.0001 s"),
    "no rollout": ('{"first": ij', '{"second": 1, "first": ij', "must be the Rollout"),
    "evidence in words": ('"printed": 0.1', '"printed": "0.1"', "evidence['printed'] must be one"),
    "details as a list": ("holds =", "details = ['x']\nholds =", "details must be a dict"),
    "unknown path": ("holds =", "uncertain = ('plant.m',)\nholds =", "uncertain has 'plant.m'"),
    "path of a law": (
        "holds =",
        "uncertain = ('controller.k1',)\nholds =",
        "'controller.k1', which is no parameter of the plant",
    ),
    "claim of an array": ('bounds": True', 'bounds": np.ones(2) > 0', "must be True or False"),
}


def test_a_correct_entry_has_no_faults(faults):
    assert faults() == []


@pytest.mark.parametrize("fault", IN_TEXT)
def test_the_checker_reports_a_fault_of_the_text(fault, faults):
    replacement, words = IN_TEXT[fault]
    assert any(words in line for line in faults(text=replacement))


@pytest.mark.parametrize("fault", IN_SCRIPT)
def test_the_checker_reports_a_fault_of_the_script(fault, faults):
    old, new, words = IN_SCRIPT[fault]
    assert any(words in line for line in faults(script={old: new}))


def test_the_checker_reports_faults_of_the_folder(faults, tmp_path):
    assert any("named after the first author" in line for line in faults(name="author"))
    assert any("must end in the year" in line for line in faults(name="author_1999"))
    assert "does not exist" in check.faults_of(tmp_path / "other_2020")[0]
    (tmp_path / "empty_2020").mkdir()
    assert check.faults_of(tmp_path / "empty_2020") == [
        "there is no entry.toml; copy the one of benchmarks/field/template"
    ]
    shutil.copy(TEMPLATE / "entry.toml", tmp_path / "empty_2020")
    found = check.faults_of(tmp_path / "empty_2020")
    assert found[-1] == "there is no example.py; copy the one of benchmarks/field/template"


FURTHER_FILES = {
    "scenario without its command": (
        {"scenario.toml": '# x\npreset = "zhang_yan_2024"\n[run]\nduration = 0.01\ndt = 1e-3\n'},
        "the first line must be a comment that ends in: python -m iblf_jax simulate",
    ),
    "scenario of another duration": (
        {"scenario.toml": 'preset = "zhang_yan_2024"\n[run]\nduration = 1.0\ndt = 1e-3\n'},
        "[run] must have the duration and dt of entry.toml",
    ),
    "invalid scenario": ({"scenario.toml": 'preset = "none"\n'}, "scenario.toml: "),
    "another motion": (
        {"independent.py": "def compare():\n    return 0.1\n"},
        "compare() gives 0.1, where 0.0001 is allowed",
    ),
    "no comparison": ({"independent.py": "x = 1\n"}, "must define compare() -> float"),
    "failed comparison": (
        {"independent.py": "def compare():\n    return 1 / 0\n"},
        "independent.py does not run: line 2: ZeroDivisionError",
    ),
}


@pytest.mark.parametrize("fault", FURTHER_FILES)
def test_the_checker_reports_a_fault_of_a_further_file(fault, faults):
    files, words = FURTHER_FILES[fault]
    assert any(words in line for line in faults(files=files))


@pytest.mark.slow
def test_the_template_is_correct(tmp_path):
    folder = tmp_path / "author_2020"
    shutil.copytree(TEMPLATE, folder)
    found = check.faults_of(folder)
    assert len(found) == 6
    assert all("of the template" in fault for fault in found)


# ---------------------------------------------------------------------------- the measurement


@pytest.mark.slow
def test_the_quick_measurement(tmp_path, monkeypatch, capsys):
    words = ["measure.py", "no_entry_2000", "liu_2018", "--quick", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    assert measure.main() == 1
    printed = capsys.readouterr().out
    assert "no_entry_2000: failed: EntryError: there is no entry.toml" in printed
    assert "liu_2018: measured" in printed
    result = json.loads((tmp_path / "liu_2018.json").read_text())
    published, other = result["rows"]
    assert published["law"] == measure.PUBLISHED
    assert published["factor"] == published["effort"] == 1.0
    assert set(other) == set(published)
    assert other["law"] == "BarrierBackstepping(Integral)"
    assert result["machine"]["jax"]
    assert result["command"].endswith("benchmarks/field/measure.py liu_2018 --quick")
    assert result["failed"] == {}
    assert [path.name for path in tmp_path.iterdir()] == ["liu_2018.json"]
    assert result["uncertain"] == ["plant.friction", "plant.input_gain"]
    for row in result["rows"]:
        assert not {measure.LEFT, measure.STEP} & {x for x in row.values() if isinstance(x, str)}
        assert row["margin"] <= 1.0


@pytest.mark.slow
def test_a_law_that_does_not_apply_is_refused(tmp_path, monkeypatch, capsys):
    words = ["measure.py", "liu_2018", "--quick", "--only", "no law", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    assert measure.main() == 1
    assert "--only: ['no law'] do not apply" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_published_law_that_fails_leaves_the_former_results(tmp_path, monkeypatch):
    def fails(*arguments):
        raise RuntimeError("no run")

    monkeypatch.setattr(measure, "row", fails)
    (tmp_path / "liu_2018.json").write_text("{}")
    with pytest.raises(entry.EntryError, match="published law could not be measured"):
        measure.write(
            entry.ENTRIES / "liu_2018", tmp_path, [], quick=True, only=[measure.PUBLISHED]
        )
    assert (tmp_path / "liu_2018.json").read_text() == "{}"


def a_row(law, error, factor=1.0, effort=1.0):
    return {"law": law, "factor": factor, "effort": effort, "error [rad]": error, "margin": 0.5}


def test_rows_that_agree_are_refused():
    rows = [a_row("published law", 0.3), a_row("A", 0.1, 2.0), a_row("B", 0.1 * (1 + 1e-13), 3.0)]
    (fault,) = measure.faults_of_rows(rows, ())
    assert "'A' and 'B' agree to 12 digits in error [rad]" in fault
    rows[2]["error [rad]"] = 0.1 * (1 + 1e-11)
    assert measure.faults_of_rows(rows, ()) == []
    # Margins of the start agree under every law, and words are no numbers.
    rows[1]["error [rad]"] = rows[2]["error [rad]"] = measure.LEFT
    assert measure.faults_of_rows(rows, ()) == []


def test_rows_may_agree_for_a_reason_that_the_entry_states():
    rows = [a_row("published law", 0.3), a_row("A", 0.1), a_row("B", 0.1)]
    pair = entry.EqualRows("B", "A", "the filter never acts")
    assert measure.faults_of_rows(rows, (pair,)) == []
    rows.append(a_row("C", 0.1))
    assert len(measure.faults_of_rows(rows, (pair,))) == 2
    rows[2]["error [rad]"] = 0.2
    faults = measure.faults_of_rows(rows[:3], (pair,))
    assert faults == [
        "'A' and 'B' differ, although an [[equal_rows]] of entry.toml gives a reason why they"
        " agree; remove it"
    ]


@pytest.mark.parametrize("effort", [0.989, 1.011, float("nan"), measure.LEFT])
def test_a_factor_without_equal_effort_is_refused(effort):
    rows = [a_row("published law", 0.3), a_row("A", 0.1, 2.0, effort)]
    (fault,) = measure.faults_of_rows(rows, ())
    assert f"'A' has the factor 2 and the effort {effort}, where 1 +- 0.01 is expected" in fault
    rows[1]["factor"] = measure.OWN
    assert measure.faults_of_rows(rows, ()) == []


def test_a_table_of_wrong_programs_is_not_written(tmp_path, monkeypatch, capsys):
    law = "BarrierBackstepping(Integral)"

    def one_program(name, choice, task, uncertain):
        effort = 1.02 if name == law else 1.0
        columns = measure.columns(task.scenario)
        return measure.Row([name, 1.0, effort, *([0.25] * (len(columns) - 3))], "")

    monkeypatch.setattr(measure, "row", one_program)
    words = ["measure.py", "liu_2018", "--quick", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    (tmp_path / "liu_2018.json").write_text("{}")
    assert measure.main() == 1
    printed = capsys.readouterr().out
    assert f"'published law' and '{law}' agree to 12 digits in RMS error" in printed
    assert f"'{law}' has the factor 1 and the effort 1.02" in printed
    assert "0 of 1 entries measured" in printed
    assert (tmp_path / "liu_2018.json").read_text() == "{}"


@pytest.mark.parametrize("path", sorted(entry.RESULTS.glob("*.json")), ids=lambda path: path.stem)
def test_the_tables_of_the_repository_are_not_refused(path):
    contents = entry.load(entry.ENTRIES / path.stem)
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
    assert measure.faults_of_rows(rows, contents.equal_rows) == []


def test_an_independent_integration_that_stops_is_an_error():
    run = SimpleNamespace(t=np.linspace(0.0, 2.0, 21), x=np.ones((21, 1, 1)), dt=0.1)
    assert entry.largest_difference(run, lambda t, x: 0.0 * x, end=0.5) == 0.0
    with pytest.raises(ValueError, match="the integration by SciPy failed"):
        entry.largest_difference(run, lambda t, x: x**2)


@pytest.mark.slow
def test_processes_report_entries_that_failed(tmp_path, monkeypatch, capsys):
    words = ["measure.py", "no_entry_2000", "no_entry_2001", "--processes", "2"]
    monkeypatch.setattr(sys, "argv", [*words, "--out", str(tmp_path)])
    assert measure.main() == 2
    printed = capsys.readouterr().out
    for name in ("no_entry_2000", "no_entry_2001"):
        assert f"{name}: failed: EntryError: there is no entry.toml" in printed
    assert "0 of 2 entries measured" in printed


def test_the_laws_of_a_robot_are_those_of_the_table_of_laws():
    task = task_of_preset(ij.presets.zhang_yan_2024())
    found = task_laws.laws_of(task, ("plant.mass",))
    assert list(found) == list(task_laws.laws.CHOICES)
    assert not [name for name, choice in found.items() if isinstance(choice, str)]
    adaptive = found["AdaptiveParameters(masses)"].law
    assert adaptive.parameters == ("mass[0]", "mass[1]")
    assert isinstance(task_laws.laws_of(task, ())["AdaptiveParameters(masses)"], str)


def test_the_laws_of_a_plant_have_each_barrier_with_and_without_filters():
    scenario = ij.presets.motor_driven_pendulum()
    found = task_laws.laws_of(task_of_preset(scenario), ())
    assert found[task_laws.OF_ROBOTS] == "the plant is no robot"
    for name in task_laws.BARRIERS:
        exact = found[f"BarrierBackstepping({name})"]
        filtered = found[f"BarrierBackstepping({name}), filters"]
        assert isinstance(exact, str) == isinstance(filtered, str)
        if not isinstance(exact, str):
            assert exact.law.filter is None
            assert filtered.law.filter is not None


def task_of_preset(scenario):
    n, r = scenario.plant.n, task_laws.plants.order_of(scenario.plant)
    return task_laws.Task(
        scenario, 1.0, 1e-3, 2.0, np.ones(n), np.ones((r, n)), np.zeros(n), np.ones(n)
    )


class ARun(NamedTuple):
    """What `measure.accuracy` reads of a run."""

    status: int
    t: np.ndarray
    e1: np.ndarray
    metrics: SimpleNamespace


def a_run(status=0):
    e1 = np.concatenate([np.full(50, 9.0), [-2.0], np.zeros(49)])[:, None]
    metrics = SimpleNamespace(peak_torque=np.array([4.0]), xi_margin=np.array([0.25]))
    return ARun(status, np.arange(100.0), e1, metrics)


def test_errors_are_those_of_the_second_half():
    task = task_of_preset(ij.presets.zhang_yan_2024())
    rms, error, peak, margin = measure.accuracy(a_run(), task)
    np.testing.assert_allclose([rms, error, peak, margin], [2 / np.sqrt(50), 2.0, 4.0, 0.25])
    left = measure.accuracy(a_run(int(ij.Status.BOUND_VIOLATED)), task)
    assert left == ["left", "left", 4.0, "left"]
    assert measure.accuracy(a_run(int(ij.Status.STEP_TOO_LARGE)), task)[0] == "step"
    # Velocities have no bounds in this task, and the bounds that a law was given do not count.
    assert measure.failure_of(a_run(int(ij.Status.VELOCITY_VIOLATED)), task) == ""
    assert measure.worst([[1.0, 0.5], [2.0, 0.7]]) == [2.0, 0.5]
    assert measure.worst([[1.0, 0.5], ["left", "left"]]) == ["left", "left"]
    assert measure.worst([]) == ["-", "-"]


def test_uncertain_parameters_are_those_of_the_plant_that_are_not_zero():
    scenario = ij.presets.zhang_yan_2024()
    made = entry.reproduction({"scenario": scenario, "runs": {}, "figure": None})
    assert measure.uncertain_of(made) == ("plant.mass", "plant.inertia")
    named = made._replace(uncertain=("plant.g", "plant.payload"))
    assert measure.uncertain_of(named) == ("plant.g",)
    changed = measure.scaled_parameters(scenario, ("plant.mass",), 0.8)
    np.testing.assert_allclose(changed["plant.mass"], [1.6, 0.68], rtol=1e-6)


# ---------------------------------------------------------------------------- the pages


RESULT = {
    "command": "python benchmarks/field/measure.py NAME",
    "machine": {"processor": "P", "cores": "2", "python": "3", "jax": "0", "date": "2026-01-01"},
    "duration": 1.0,
    "dt": 1e-3,
    "period": 2e-3,
    "noise": 1e-3,
    "uncertain": ["plant.mass"],
    "input": "torque",
    "rows": [
        {"law": "published law", "factor": 1.0, "error [rad]": 0.1, "error, noise [rad]": 0.2},
        {"law": "A", "factor": 2.0, "error [rad]": 0.05, "error, noise [rad]": 0.1},
        {"law": "B", "factor": "own", "error [rad]": 0.01, "error, noise [rad]": 0.01},
        {"law": "C", "factor": 0.5, "error [rad]": "left", "error, noise [rad]": "left"},
    ],
    "not_applicable": {"D": "it has |none|"},
}


@pytest.fixture
def parts(tmp_path):
    """All entries, with small results for one of them."""
    for name in NAMES:
        contents = entry.load(entry.ENTRIES / name)
        computed = {
            "reached": {number.quantity: number.value for number in contents.published},
            "holds": {claim.statement: True for claim in contents.claims},
            "evidence": {"gain": 0.51234},
            "levels": 2,
        }
        (tmp_path / f"{name}.json").write_text(json.dumps(computed))
    results = tmp_path / "results"
    results.mkdir()
    (results / "zhang_yan_2024.json").write_text(json.dumps(RESULT))
    return field.parts(results, tmp_path)


def test_the_page_of_the_benchmark(parts):
    page = field.benchmark_page(parts)
    numbers = sum(len(part.contents.published) for part in parts)
    assert f"{len(NAMES)} published examples" in page
    assert f"{numbers} of {numbers} published numbers" in page
    rows = [line for line in page.splitlines() if line.startswith("| [")]
    assert len(rows) == len(NAMES)
    measured = next(row for row in rows if "zhang_yan_2024" in row)
    assert measured.endswith("| A | 0.5 | 0.5 |")
    removed = len(withdrawn.FIELD) - 1
    assert sum(row.endswith("| withdrawn |  |  |") for row in rows) == removed
    assert sum(row.endswith("| not measured |  |  |") for row in rows) == len(NAMES) - 1 - removed
    assert f"1 of {len(NAMES)} entries have a table." in page
    assert f"- The tables of {removed} entries are withdrawn, because they were measured" in page
    assert page.count("### ") == 2
    assert "is not measured: the force is held for 0.1 s" in page
    assert "| published law | 1 | 0.1 | 0.2 |" in page
    assert "| C | 0.5 | left | left |" in page
    assert "Not in the table: D: it has" in page
    for name in NAMES:
        assert f"(gallery/{name}.md)" in page


def test_the_page_of_the_corrections_has_all_of_them(parts):
    page = field.corrections_page(parts)
    count = sum(len(part.contents.corrected) for part in parts)
    assert page.startswith("# What the literature printed, and what is correct")
    assert f"{count} corrections" in page
    assert sum(line.startswith("| [") for line in page.splitlines()) == count
    publications, programs = page.split("## Errors in programs")
    for text, place in ((publications, "publication"), (programs, "program")):
        expected = sum(x.found_in == place for part in parts for x in part.contents.corrected)
        assert sum(line.startswith("| [") for line in text.splitlines()) == expected
        assert f"{expected} of {place}s" in page
    assert f"whether somebody was asked: 0 of {count} were." in page
    assert "and with k = 1 by 0.51 rad" in page
    (row,) = (line for line in page.splitlines() if "control\\_1\\_step.m" in line)
    read, contact = "program of others, commit 5aa7ac7 of 2024-07-27", "S. Damodaran, owner"
    assert read in row and contact in row and row.endswith("| not contacted |")
    assert "theory/printed_and_corrected.md" in page


def test_an_answer_is_in_the_table_of_corrections(parts):
    part = next(part for part in parts if part.name == "zhang_yan_2024")
    correction = dataclasses.replace(
        part.contents.corrected[0],
        contacted="confirmed",
        answer="by the author, 2026-12-01",
        edition="second edition",
    )
    table = field.corrections_table([(part, correction)])
    assert "confirmed: by the author, 2026-12-01 |" in table
    assert "| article, second edition |" in table
    contents = dataclasses.replace(part.contents, corrected=(correction,))
    assert "| publication | " in entry_tables.corrections(contents, {})
    assert "Who could be asked: T. Zhang" in entry_tables.corrections(contents, {})


def test_what_was_equal_is_counted():
    found = field.efforts([RESULT])
    assert found == field.Efforts(tables=1, laws=3, equal=2, own=1, failed=1, compared=1)
    assert field.efforts([]).laws == 0


def test_texts_state_what_was_equal_in_the_results():
    """The numbers of a README and of the article are those of the result files."""
    files = sorted(entry.RESULTS.glob("*.json"))
    found = field.efforts([json.loads(path.read_text(encoding="utf-8")) for path in files])
    readme = " ".join((FIELD / "README.md").read_text(encoding="utf-8").split())
    assert found.in_words in readme
    article = " ".join((ROOT / "paper" / "paper.md").read_text(encoding="utf-8").split())
    words = f"of {found.laws} laws {found.equal} have such a factor, and {found.own} have none"
    assert words in article
    assert found.tables == 6 and "Six of them have a table" in article
    assert f"a benchmark of {len(NAMES)} published examples" in article
    entries = [entry.load(entry.ENTRIES / name) for name in NAMES]
    lacking = sum(bool(x.missing) for x in entries)
    corrected = sum(bool(x.corrected) for x in entries)
    assert f"{lacking} of {len(NAMES)} published examples lack at least one" in article
    assert f"{corrected} have a correction" in article


@pytest.mark.slow
def test_most_of_the_effort_belongs_to_the_start():
    """The README states both shares of the squared torque above gravity."""
    scenario = ij.presets.zhang_yan_2024()
    run = ij.simulate(scenario, duration=20.0, dt=1e-3)
    gravity = jax.vmap(scenario.plant.gravity)(jnp.asarray(run.q))
    square = np.sum((np.asarray(run.tau) - np.asarray(gravity)) ** 2, axis=1)
    total, start, late = (
        np.trapezoid(square[part], run.t[part])
        for part in (run.t >= 0.0, run.t <= 0.5, run.t >= 10.0)
    )
    np.testing.assert_allclose(start / total, 0.94, atol=0.01)
    np.testing.assert_allclose(late / total, 0.034, atol=0.005)
    readme = (FIELD / "README.md").read_text(encoding="utf-8")
    assert "94 % of the squared torque" in readme and "3 % to the second half" in readme


def test_laws_that_lose_their_accuracy_with_noise_are_named_below_the_table(parts):
    (measured,) = (part for part in parts if part.result)
    assert field.noisy_laws([measured]) == ""
    published, best, *others = RESULT["rows"]
    published = published | {"error, noise [rad]": 250.0}
    noisy = measured._replace(result=RESULT | {"rows": [published, best, *others]})
    words = f"{measured.short_link} has an error of 250 rad with noise and 0.1 rad without."
    assert words in field.noisy_laws([noisy])
    assert words in field.benchmark_page([noisy])
    published["error, noise [rad]"] = "left"
    assert field.noisy_laws([noisy]) == ""


def test_the_reason_why_rows_agree_is_above_the_table(parts):
    (measured,) = (part for part in parts if part.result)
    pair = entry.EqualRows("A", "B", "The limit is not reached.")
    agreeing = dataclasses.replace(measured.contents, equal_rows=(pair,))
    assert "A and B agree." not in field.section(measured)
    page = field.section(measured._replace(contents=agreeing))
    assert page.index("A and B agree. The limit is not reached.") < page.index("| law |")


def test_the_page_of_an_entry_has_the_numbers_that_decide_its_claims():
    contents = entry.load(TEMPLATE)
    (claim,) = contents.claims
    names = {"scenario": None, "runs": {}, "figure": None, "holds": {claim.statement: True}}
    without = entry_tables.claims(contents, entry.reproduction(names))
    assert without.startswith("| statement | holds | where |\n")
    names["details"] = {claim.statement: "margin |e| 0.1 rad"}
    table = entry_tables.claims(contents, entry.reproduction(names))
    assert table.startswith("| statement | holds | numbers and criterion | where |\n")
    assert f"| yes | margin \\|e\\| 0.1 rad | {claim.where} |" in table


def test_tables_of_a_page_escape_what_markdown_interprets():
    assert entry_tables.escaped("a*b_c <d> [e] `x_1` $y_2$") == (r"a\*b\_c \<d> \[e\] `x_1` $y_2$")
    assert entry_tables.markdown_table(["h"], [["|w|"]]).splitlines()[-1] == r"| \|w\| |"
    assert entry.filled("{a} {a:.1f} {b} {c", {"a": 1.25}) == "1.25 1.2 {b} {c"
