"""The page on choosing a law says what `benchmarks/laws.py` measured."""

import importlib
import json
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STORED = json.loads((ROOT / "benchmarks" / "results" / "laws.json").read_text())
TUNED = json.loads((ROOT / "benchmarks" / "field" / "results" / "zhang_yan_2024.json").read_text())


@pytest.fixture
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module("laws"), importlib.import_module("choosing")


def test_every_law_has_a_row_and_advice(scripts):
    laws, choosing = scripts
    names = [row["law"] for row in STORED["rows"]]
    assert names == list(laws.CHOICES) == list(choosing.ADVICE)
    assert all(list(row) == laws.COLUMNS for row in STORED["rows"])


def test_the_sentences_follow_the_numbers(scripts):
    _, choosing = scripts
    column = "error [mrad]"
    numbers = dict.fromkeys((*choosing.LOWER_IS_BETTER, choosing.LONGEST), 3.0)
    rows = [{"law": law, "factor": 1.0, **numbers} for law in ("a", "b", "c", "d")]
    # A law with gains of its own has another effort, so that its error is not compared.
    rows[3][column], rows[3]["factor"] = 0.5, choosing.OWN
    rows[1][column], rows[2][column], rows[0][choosing.LONGEST] = 1.0, "left", 0.0
    sentences = choosing.best_of_each_column(rows)
    assert "least with b (1), largest with a (3). Outside the bounds: c." in sentences[0]
    assert "up to 3 ms: b; c; d. With none of the tested delays: a." in sentences[-1]
    assert choosing.page(STORED, TUNED).startswith("# Choosing a law")


def test_laws_with_the_same_budget_of_tuning_have_the_numbers_of_the_result(scripts):
    _, choosing = scripts
    assert choosing.with_tuning() == TUNED
    text = "\n".join(choosing.same_budget(TUNED))
    budget = TUNED["budget"]
    assert f"{budget['points']} points without derivatives and {budget['starts']} searches" in text
    assert TUNED["machine"]["commit"][:8] in text
    assert "With the same budget of tuning 17 of 19 laws stay inside the bounds at 10 ms" in text
    law = TUNED["laws"]["PDGravity"]
    row = next(x for x in law["front"] if x["level"] == 1.0)
    found = choosing.tuned_laws(TUNED)["PDGravity"]
    assert found[:2] == (("Kp", "Kd"), f"{row['points']} + {row['derivatives']}")
    masses = law["robustness"]["masses"]
    numbers = [row["error"], row["late_error"], law["robustness"]["periods"]["0.01"]]
    numbers.append(max(masses["0.7"], masses["1.3"]))
    assert [f"{x:.6g}" for x in found[2:]] == [f"{1e3 * x:.6g}" for x in numbers]


@pytest.mark.release
def test_a_row_regenerates_to_the_digits_of_the_page(scripts):
    laws, _ = scripts
    stored = STORED["rows"][0]
    with warnings.catch_warnings(action="ignore"):
        found = laws.row(stored["law"])
    digits = [[f"{x:.3g}" for x in values[1:]] for values in (found, list(stored.values()))]
    assert digits[0] == digits[1]
