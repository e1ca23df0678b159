"""The compiler is a package of its own: it imports nothing else of iblf_jax."""

import doctest
import re

import pytest
from conftest import ROOT

from iblf_jax import kernels

PACKAGE = ROOT / "iblf_jax"
COMPILERS = {"iblf_jax.kernels.cpu"}
"""Modules that the engine's executors of the same platform import besides the package."""


def imported_packages(source: str) -> set[str]:
    """The modules of iblf_jax that a source file imports, at any place."""
    found = re.findall(r"^\s*(?:from|import) (iblf_jax[\w.]*)(?: import (\w+))?", source, re.M)
    return {f"{module}.{name}" if module == "iblf_jax" else module for module, name in found}


def test_it_imports_nothing_else_of_the_package_which_imports_it_as_a_package():
    inside, outside = set(), set()
    for path in PACKAGE.rglob("*.py"):
        found = inside if path.parent.name == "kernels" else outside
        found |= imported_packages(path.read_text())
    assert inside and {name for name in inside if "iblf_jax.kernels" not in name} == set()
    assert {name for name in outside if name.startswith("iblf_jax.kernels.")} == COMPILERS


def test_the_example_of_the_package_runs():
    try:
        kernels.compiler()
    except kernels.ToolchainError:
        pytest.skip("no C++ compiler")
    result = doctest.testmod(kernels)
    assert result.attempted > 10 and not result.failed


def test_caches_count_their_results_and_forget_them():
    caches = kernels.caches.Caches()

    @caches.function(maxsize=2)
    def double(x):
        return 2 * x

    assert [double(x) for x in (1, 2, 3)] == [2, 4, 6]
    assert caches.size == 2
    caches.clear()
    assert caches.size == 0
