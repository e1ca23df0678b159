"""The page on choosing a law says what `benchmarks/laws.py` measured."""

from __future__ import annotations

import importlib
import json
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STORED = json.loads((ROOT / "benchmarks" / "results" / "laws.json").read_text())


@pytest.fixture
def scripts(monkeypatch):
    """The modules `benchmarks/laws.py` and `docs/choosing.py`."""
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
    rows = [
        dict.fromkeys((*choosing.LOWER_IS_BETTER, choosing.LONGEST), 3.0) | {"law": law}
        for law in ("a", "b", "c")
    ]
    rows[1][column], rows[2][column], rows[0][choosing.LONGEST] = 1.0, "left", 0.0
    sentences = choosing.best_of_each_column(rows)
    assert "least with b (1), largest with a (3). Outside the bounds: c." in sentences[0]
    assert "up to 3 ms: b; c. With none of the tested delays: a." in sentences[-1]
    assert choosing.page(STORED).startswith("# Choosing a law")


def test_the_saving_of_the_trigger_is_that_of_the_file(scripts):
    _, choosing = scripts
    rows = [
        {"trigger": words, "messages per s": rate, "error [mrad]": error}
        for words, rate, error in (("none", 1000.0, 0.5), ("T", 12.0, 3.0))
    ]
    found = choosing.saving(rows)
    assert "`T` the first law sends 12 messages a second in place of 1000" in found
    assert "3 mrad in place of 0.5 mrad" in found
    assert choosing.saving(STORED["messages"]) in choosing.page(STORED)


@pytest.mark.release
def test_a_row_regenerates_to_the_digits_of_the_page(scripts):
    laws, _ = scripts
    stored = STORED["rows"][0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = laws.row(stored["law"])
    digits = [[f"{x:.3g}" for x in values] for values in (found[1:], list(stored.values())[1:])]
    assert digits[0] == digits[1]
