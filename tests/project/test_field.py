"""The benchmark of the field: the format of its entries, what their pages state, the checker, and
the programs that are written without the package."""

import json
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT

import iblf_jax as ij

FIELD = ROOT / "benchmarks" / "field"
sys.path[:0] = [str(FIELD), str(ROOT / "docs")]
sys.path.append(str(ROOT / "benchmarks"))
import check
import entry
import entry_tables
import field
import gallery
import not_readable
import task_laws

NAMES = [folder.name for folder in entry.folders()]
TEMPLATE = FIELD / "template"
FEWEST = 20


def test_there_are_entries_of_each_method():
    assert {entry.load(entry.ENTRIES / name).method for name in NAMES} == set(entry.METHODS)
    assert len(sorted(entry.ENTRIES.glob("*/independent.py"))) >= FEWEST
    assert len(sorted(entry.ENTRIES.glob("*/scenario.toml"))) >= 6


@pytest.mark.parametrize("name", NAMES)
def test_the_format_of_an_entry(name):
    folder = entry.ENTRIES / name
    contents = entry.load(folder)
    found = [*check._faults_of_name(folder), *check._faults_of_text(contents)]
    found += check._faults_of_script(folder / "example.py")
    if (folder / "scenario.toml").exists():
        found += check._faults_of_scenario(folder, contents)
    assert found == []


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
        made = entry.execute(folder)
        assert all(run.status == 0 for run in made.runs.values()) or name in FLAGGED
        FURTHER[name](made.runs, made.evidence)


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


def dimanidis_2018(runs, evidence):
    assert evidence["best"] < 0.003
    assert evidence["gain"] > 0.1
    np.testing.assert_allclose(evidence["torque"], -0.287, atol=1e-3)
    np.testing.assert_allclose(evidence["sigma"], 7.295, atol=1e-3)
    assert abs(evidence["printed_sigma"] - 7.295) > 0.5


def shaw_cortez_2022(runs, evidence):
    run = runs["filtered"]
    # The law requests more than the filter gives.
    assert int(run.status) == int(ij.Status.TORQUE_SATURATED)
    assert np.min(run.metrics.margin) > 0
    # The reference leaves the bounds, and is no fault of a filter's run.
    assert np.any(run.q_d > run.scenario.bounds[0].upper.value)
    assert evidence["without_term"] > 3 * evidence["with_term"]


def goel_2020(runs, evidence):
    for name in ("exact derivatives", "filter of the package"):
        assert 2.4 < np.abs(runs[name].alpha).max() < 2.5
    np.testing.assert_allclose(evidence["corrected"], evidence["limit"], rtol=1e-6)
    assert evidence["branch"] > 5 * evidence["limit"]
    # The branch at z_1 = 0 has no effect on the runs.
    assert evidence["zeros"] == 0 < evidence["states"]


def xernicrose_2024(runs, evidence):
    for name in ("published barrier", "Log"):
        assert runs[name].status == 0
        assert np.abs(runs[name].e1).max() < 0.06
        assert np.diff(runs[name].V).max() < 1e-10
    unbounded = runs["Quadratic, no barrier"]
    assert unbounded.status == int(ij.Status.BOUND_VIOLATED)
    assert unbounded.x[:, 0].max() > 0.56
    assert evidence["wrong_V"] > 10 * evidence["wrong_least"]
    assert abs(evidence["hand"] - evidence["exact"]) > 0.1 * abs(evidence["exact"])


def zhang_yan_2024(runs, evidence):
    assert evidence["printed"] > 1.02 * evidence["start"]
    # Both start at the same state; the compiler rounds the two programs differently.
    assert evidence["corrected"] <= evidence["start"] * (1 + 1e-12)
    assert evidence["with_term"] < 1e-6 < 1e-3 < evidence["without_term"]
    assert evidence["equal_gains"] > evidence["equal_effort"] > 1.0
    assert evidence["weight_two"] < 1e-12
    assert evidence["K2"] > 0.5
    assert evidence["kf"] > 1.0


PAGES = (dimanidis_2018, goel_2020, shaw_cortez_2022, xernicrose_2024, zhang_yan_2024)
FURTHER = {function.__name__: function for function in PAGES}
"""Entry -> what its page states beyond the published numbers and claims."""
FLAGGED = {"shaw_cortez_2022", "xernicrose_2024"}
"""Entries with runs that have a flag, as their functions state."""
SCRIPT = """\"\"\"A title: one sentence.\"\"\"

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
    "has the unknown key 'plant_'": {'plant = "servo': 'plant_ = "servo'},
    "lacks the table [run]": {"[run]": "[runs]"},
    "[[printed]] number 1 lacks the key": {'where = "equation (40)"': ""},
    "family = 'car' must be one of robot, flexible joint": {'"drive"': '"car"'},
    "claims must be a list of tables": {"[[claims]]": "[claims]"},
    "entry.toml is not valid TOML: Invalid value (at line": {"year = 2020": "year ="},
    '[source] needs doi = "10...." or url': {'doi = "10.1000/183"': ""},
    "must begin with 10.": {'"10.1000/183"': '"https://doi.org/10.1000/182"'},
    "must be positive": {"tolerance = 0.005": "tolerance = 0"},
    "'largest error [rad]' is not reached: published 0.513, here 0.3": {
        "value = 0.3\n": "value = 0.513\n"
    },
    "reached lacks 'peak [rad]'": {'"largest error [rad]"': '"peak [rad]"'},
    "no evidence of [[corrected]] contains {printed}": {"{printed}": "0.1"},
    "evidence lacks 'other'": {"{printed}": "{printed} {other:.3g}"},
    "must end in the year of entry.toml": {"year = 2020": "year = 2021"},
    "title is that of the template": {
        '"Bounds of a drive"': '"A bound on the output of a servo drive"'
    },
    "[[corrected]] has the example of the template": {'printed = "k1 = 2"': 'printed = "k1 = 1"'},
    "[[corrected]] number 1: the evidence needs a number": {
        "the error after 0.5 s is {printed} rad, and figure 3 shows 0.001 rad.": "it is larger."
    },
    "answer = 'yes' does not agree with contacted = 'not contacted'": {
        'contacted = "not contacted"': 'answer = "yes"'
    },
    "ends at 0.01 s, and entry.toml": {"duration = 0.01": "duration = 3.0"},
}
IN_SCRIPT = {
    "does not hold": {'bounds": True': 'bounds": False'},
    "holds lacks": {"holds = {": "answers = {"},
    "the figure has no curves": {'axes.plot(runs["first"].t, runs["first"].e1)': ""},
    "panel 1 of the figure has no label of its x axis": {'xlabel="time [s]", ': ""},
    "example.py does not run: line 8: Attribute": {"ij.presets.zhang": "ij.preset.zhang"},
    "must begin with a docstring": {"A title: one": "A title, one"},
    "must be one number": {"float(np.abs(": "(lambda x: np.ones(2))(np.abs("},
    "shorten it to 150": {"evidence =": "\n" * check.MOST_LINES + "evidence ="},
    "has the step 0.0001 s": {"dt=1e-3": "dt=1e-4"},
    "must be the Rollout": {'{"first": ij': '{"second": 1, "first": ij'},
    "uncertain has 'plant.m'": {"holds =": "uncertain = ('plant.m',)\nholds ="},
    "must be True or False": {'bounds": True': 'bounds": np.ones(2) > 0'},
}


def test_the_checker_reports_faults_of_the_folder(faults, tmp_path):
    assert faults() == []
    assert any("named after the first author" in line for line in faults(name="author"))
    assert any("must end in the year" in line for line in faults(name="author_1999"))
    assert "does not exist" in check.faults_of(tmp_path / "other_2020")[0]
    folder = tmp_path / "empty_2020"
    folder.mkdir()
    missing = "there is no {}; copy the one of benchmarks/field/template"
    assert check.faults_of(folder) == [missing.format("entry.toml")]
    shutil.copy(TEMPLATE / "entry.toml", folder)
    assert check.faults_of(folder)[-1] == missing.format("example.py")


FURTHER_FILES = {
    "the first line must be a comment that ends in: python -m iblf_jax simulate": {
        "scenario.toml": '# x\npreset = "zhang_yan_2024"\n[run]\nduration = 0.01\ndt = 1e-3\n'
    },
    "[run] must have the duration and dt of entry.toml": {
        "scenario.toml": 'preset = "zhang_yan_2024"\n[run]\nduration = 1.0\ndt = 1e-3\n'
    },
    "scenario.toml: ": {"scenario.toml": 'preset = "none"\n'},
    "compare() gives 0.1, where 0.0001 is allowed": {
        "independent.py": "def compare():\n    return 0.1\n"
    },
    "independent.py does not run: line 2: ZeroDivisionError": {
        "independent.py": "def compare():\n    return 1 / 0\n"
    },
}
TABLES = {"text": IN_TEXT, "script": IN_SCRIPT, "files": FURTHER_FILES}


@pytest.mark.parametrize(
    ("part", "fault"), [(part, fault) for part, table in TABLES.items() for fault in table]
)
def test_the_checker_reports_a_fault(part, fault, faults):
    assert any(fault in line for line in faults(**{part: TABLES[part][fault]}))


def test_an_independent_integration_that_stops_is_an_error():
    run = SimpleNamespace(t=np.linspace(0.0, 2.0, 21), x=np.ones((21, 1, 1)), dt=0.1)
    assert entry.largest_difference(run, lambda t, x: 0.0 * x, end=0.5) == 0.0
    with pytest.raises(ValueError, match="the integration by SciPy failed"):
        entry.largest_difference(run, lambda t, x: x**2)


def test_the_laws_of_a_plant_have_each_barrier_with_and_without_filters():
    found = task_laws.laws_of(task_of(ij.presets.motor_driven_pendulum()), ())
    assert found[task_laws.OF_ROBOTS] == "the plant is no robot"
    for name in task_laws.BARRIERS:
        exact = found[f"BarrierBackstepping({name})"]
        filtered = found[f"BarrierBackstepping({name}), filters"]
        assert isinstance(exact, str) == isinstance(filtered, str)
        if not isinstance(exact, str):
            assert exact.law.filter is None
            assert filtered.law.filter is not None


def task_of(scenario):
    """The task of a scenario at scales of one."""
    ones = np.ones(scenario.plant.n)
    levels = np.ones((task_laws.plants.order_of(scenario.plant), scenario.plant.n))
    return task_laws.Task(scenario, 1.0, 1e-3, 2.0, ones, levels, 0.0 * ones, ones)


def test_uncertain_parameters_are_those_of_the_plant_that_are_not_zero():
    scenario = ij.presets.zhang_yan_2024()
    made = entry.reproduction({"scenario": scenario, "runs": {}, "figure": None})
    assert task_laws.uncertain_of(made) == ("plant.mass", "plant.inertia")
    named = made._replace(uncertain=("plant.g", "plant.payload"))
    assert task_laws.uncertain_of(named) == ("plant.g",)
    changed = task_laws.scaled_parameters(scenario, ("plant.mass",), 0.8)
    np.testing.assert_allclose(changed["plant.mass"], [1.6, 0.68], rtol=1e-6)


@pytest.fixture
def parts(tmp_path):
    """All entries, one of which is compared."""
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
    (results / "zhang_yan_2024.json").write_text("{}")
    return field.parts(results, tmp_path)


def test_the_pages_of_the_benchmark_and_of_all_corrections(parts):
    page = field.benchmark_page(parts)
    numbers = sum(len(part.contents.published) for part in parts)
    assert f"{len(NAMES)} published examples" in page
    assert f"{numbers} of {numbers} published numbers" in page
    rows = [line for line in page.splitlines() if line.startswith("| [")]
    assert len(rows) == len(NAMES)
    assert all(row.endswith("| yes |") == ("zhang_yan_2024" in row) for row in rows)
    assert f"On 1 of the {len(NAMES)} tasks [laws are compared" in page
    assert all(f"(gallery/{name}.md)" in page for name in NAMES)
    assert all(f"- {work.reference}" in page for work in not_readable.NOT_READABLE)
    assert page.count(f"found {len(NAMES)} of {len(NAMES)} entries correct.") == 2
    assert page.count("It did not read") == 0
    page = field.corrections_page(parts)
    count = sum(len(part.contents.corrected) for part in parts)
    assert page.startswith("# Corrections of publications and programs")
    assert f"{count} corrections" in page
    assert sum(line.startswith("| [") for line in page.splitlines()) == count
    publications, programs = page.split("## Corrections of programs")
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


def test_the_article_counts_the_entries():
    article = " ".join((ROOT / "paper" / "paper.md").read_text(encoding="utf-8").split())
    assert f"a benchmark of {len(NAMES)} published examples" in article
    entries = [entry.load(entry.ENTRIES / name) for name in NAMES]
    lacking = sum(bool(x.missing) for x in entries)
    corrected = sum(bool(x.corrected) for x in entries)
    assert f"{lacking} of {len(NAMES)} published examples lack at least one" in article
    assert f"{corrected} have a correction" in article
    of_others = sum(x.source.read == "secondary" for x in entries)
    assert f"{of_others} of these by others than the authors" in article


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
