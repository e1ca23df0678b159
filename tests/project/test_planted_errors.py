"""The errors that `tools/planted_errors.py` plants have their places."""

import ast
import sys
from random import Random

import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "tools"))
import planted_errors
from planted_errors import FIRST, FURTHER, planted

FAULTS = (*FIRST, *FURTHER)


def test_there_are_twice_twenty_in_as_many_files():
    assert (len(FIRST), len(FURTHER)) == (20, 20)
    assert len({fault.file for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.file)
def test_an_error_has_one_place_and_is_no_error_of_syntax(fault):
    text = (ROOT / "iblf_jax" / fault.file).read_text(encoding="utf-8")
    changed = planted(text, fault)
    assert changed != text
    if fault.file.endswith(".py"):
        ast.parse(changed)


@pytest.mark.parametrize("text", ["x + y", "x - y, x - y"])
def test_an_error_without_its_place_is_refused(text):
    fault = planted_errors.Fault("a sign", "a.py", "x - y", "x + y")
    with pytest.raises(ValueError, match=r"a\.py has [02] times 'x - y'"):
        planted(text, fault)


FUNCTION = "def f(a, b):\n    if a < b:\n        return g(a, b - 1)\n    raise ValueError(a + 1)\n"


def test_a_drawn_error_changes_an_operator_a_number_or_the_order_of_arguments():
    """Of any statement but a refusal, and never what is nested in it."""
    found = {
        planted_errors.changed(FUNCTION, place, Random(seed)).new.strip()
        for place in range(len(planted_errors.statements(FUNCTION)))
        for seed in range(30)
    }
    assert found == {
        *("if a >= b:", "return g(b - 1, a)", "return g(a, b + 1)", "return g(a, b - 2)"),
    }
