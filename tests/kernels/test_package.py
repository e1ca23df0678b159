"""The compiler is a package of its own: it imports nothing else of iblf_jax."""

from __future__ import annotations

import doctest
import re

import pytest
from conftest import ROOT

from iblf_jax import kernels

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


OUTSIDE = sorted(
    path for path in (ROOT / "iblf_jax").rglob("*.py") if path.parent.name != "kernels"
)
COMPILERS = {"iblf_jax.kernels.cpu"}
"""Modules that the engine's executors of the same platform import besides the package."""


def test_the_rest_of_the_package_imports_the_compiler_from_its_package():
    inner = {
        (path.name, name)
        for path in OUTSIDE
        for name in imported_packages(path.read_text())
        if name.startswith("iblf_jax.kernels.") and name not in COMPILERS
    }
    assert not inner


def test_the_example_of_the_package_runs():
    try:
        kernels.compiler()
    except kernels.ToolchainError:
        pytest.skip("no C++ compiler")
    result = doctest.testmod(kernels)
    assert result.attempted > 10
    assert not result.failed


def test_caches_count_their_results_and_forget_them():
    caches = kernels.caches.Caches()

    @caches.function(maxsize=2)
    def double(x):
        return 2 * x

    assert [double(x) for x in (1, 2, 3)] == [2, 4, 6]
    assert caches.size == 2
    caches.clear()
    assert caches.size == 0


def test_these_tests_can_fail():
    assert imported_packages("    from iblf_jax.core import notices") == {"iblf_jax.core"}
    assert imported_packages("from iblf_jax import engine") == {"iblf_jax.engine"}
    assert FILES
