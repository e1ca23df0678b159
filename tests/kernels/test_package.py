"""The compiler is a package of its own: it imports nothing else of iblf_jax."""

from __future__ import annotations

import re

import pytest
from conftest import ROOT

FILES = sorted((ROOT / "iblf_jax" / "kernels").glob("*.py"))


def imported_packages(source: str) -> set[str]:
    """The modules of iblf_jax that a source file imports, at any place."""
    found = re.findall(r"^\s*(?:from|import) (iblf_jax[\w.]*)(?: import (\w+))?", source, re.M)
    return {f"{module}.{name}" if module == "iblf_jax" else module for module, name in found}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_it_imports_nothing_else_of_the_package(path):
    others = {
        name for name in imported_packages(path.read_text()) if "iblf_jax.kernels" not in name
    }
    assert not others


def test_these_tests_can_fail():
    assert imported_packages("    from iblf_jax.core import notices") == {"iblf_jax.core"}
    assert imported_packages("from iblf_jax import engine") == {"iblf_jax.engine"}
    assert FILES
