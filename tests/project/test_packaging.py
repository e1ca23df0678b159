"""pyproject.toml, constraints.txt and the workflows name the same Pythons, and declare what the
package imports."""

from __future__ import annotations

import ast
import importlib.metadata
import json
import re
import sys
import tomllib

import pytest
from conftest import ROOT
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
REQUIRED = [Requirement(text) for text in PROJECT["dependencies"]]
OPTIONAL = [
    Requirement(text) for extra in PROJECT["optional-dependencies"].values() for text in extra
]
PINS = {
    canonicalize_name(name): version
    for name, version in re.findall(
        r"^([\w.-]+)==([\w.]+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE
    )
}
CLASSIFIED = [
    tuple(map(int, match[1].split(".")))
    for text in PROJECT["classifiers"]
    if (match := re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", text))
]
"""The Pythons of the classifiers, as (3, minor)."""
DISTRIBUTION = {"PIL": "pillow", "mpl_toolkits": "matplotlib", "tomli_w": "tomli-w"} | {
    name: f"ros-{name.replace('_', '-')}"
    for name in (
        "rclpy",
        "rcl_interfaces",
        "sensor_msgs",
        "std_msgs",
        "std_srvs",
        "diagnostic_msgs",
    )
}
"""Name of an import -> its distribution, where they differ."""
COMES_WITH = {"jaxlib": "jax", "pandas": "xarray", "pillow": "matplotlib"}
"""What the package imports without a declaration of its own -> the dependency that always brings
it."""
OF_TYPE_CHECKERS = {"typing-extensions"}
"""What every type checker brings, and what is imported for it only."""


def imported(source: str) -> set[str]:
    """Top-level names of what a file imports from outside the standard library, inside functions
    too."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            names.add(str(node.module))
    return {name.split(".")[0] for name in names} - set(sys.stdlib_module_names) - {"iblf_jax"}


def names_of(requirements: list[Requirement]) -> set[str]:
    return {canonicalize_name(requirement.name) for requirement in requirements}


def test_the_classifiers_are_the_pythons_that_are_required():
    oldest = min(CLASSIFIED)
    assert PROJECT["requires-python"] == f">={oldest[0]}.{oldest[1]}"
    assert [(3, minor) for minor in range(oldest[1], max(CLASSIFIED)[1] + 1)] == CLASSIFIED, (
        "none is left out"
    )
    assert sys.version_info[:2] >= oldest


def test_the_tests_run_on_every_python_with_and_without_extras():
    workflow = (ROOT / ".github" / "workflows" / "tests.yml").read_text()
    environments = re.findall(r'- \{python: "(3\.\d+)", pins: "(.*)"\}', workflow)
    assert [tuple(map(int, python.split("."))) for python, _ in environments] == CLASSIFIED
    # The oldest versions on the oldest Python, and what pip takes on the newer ones.
    pins = [pin for _, pin in environments]
    assert pins == ["-c constraints.txt"] + [""] * (len(CLASSIFIED) - 1)
    extras = json.loads(re.findall(r"^ +extras: (\[.*\])$", workflow, re.MULTILINE)[0])
    all_extras = {"test", "sweep", "robots", "tuning", "export", "docs", "bench"}
    assert [set(words.split(",")) for words in extras] == [{"test"}, all_extras]
    assert all_extras <= set(PROJECT["optional-dependencies"])


@pytest.mark.slow
def test_every_import_is_declared():
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "iblf_jax").rglob("*.py")]
    distributions = {
        DISTRIBUTION.get(name, name) for source in sources for name in imported(source)
    }
    declared = names_of(REQUIRED) | names_of(OPTIONAL)
    undeclared = {canonicalize_name(name) for name in distributions} - declared
    undeclared -= {*COMES_WITH, *OF_TYPE_CHECKERS}
    assert not undeclared, f"declare {undeclared} in pyproject.toml"
    for name, parent in COMES_WITH.items():
        assert name in names_of(
            list(map(Requirement, importlib.metadata.requires(parent) or []))
        ), (name, parent)


def test_every_dependency_is_pinned_at_a_version_that_is_allowed():
    assert {"jax", "numpy", "scipy"} <= names_of(REQUIRED), "every part imports these: no extras"
    for requirement in REQUIRED:
        pin = PINS.get(canonicalize_name(requirement.name))
        assert pin is not None, f"constraints.txt has no {requirement.name}"
        assert requirement.specifier.contains(pin), (requirement, pin)
    for requirement in OPTIONAL:
        pin = PINS.get(canonicalize_name(requirement.name))
        assert pin is None or requirement.specifier.contains(pin), (requirement, pin)


def test_jax_is_limited_to_the_versions_that_were_tested():
    """The lower limit is the pinned version, and the upper one a minor version."""
    (jax_,) = [x for x in REQUIRED if x.name == "jax"]
    lower = PINS["jax"]
    match = re.fullmatch(rf">={re.escape(lower)},<0\.(\d+)", sorted_specifier(jax_))
    assert match is not None, jax_
    newest = f"0.{int(match[1]) - 1}"
    page = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
    assert f"from {lower} to {newest}." in page
    assert jax_.specifier.contains(importlib.metadata.version("jax"))


def sorted_specifier(requirement):
    return ",".join(sorted(map(str, requirement.specifier), reverse=True))


def test_these_tests_can_fail():
    assert imported(
        "import os, made_up.part\ndef f():\n    from other import x\n    import iblf_jax"
    ) == {"made_up", "other"}
    assert not SpecifierSet(">=3.12").contains("3.11.9")
