"""The errors that `tools/planted_errors.py` plants have their places."""

from __future__ import annotations

import ast
import sys

import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "tools"))
import planted_errors
from planted_errors import FAULTS, planted


def test_there_are_twenty_in_as_many_files():
    assert len({fault.file for fault in FAULTS}) == len(FAULTS) == 20


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
