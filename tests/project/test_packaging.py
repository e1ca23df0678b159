"""pyproject.toml, constraints.txt and the workflows name the same Pythons, and declare what the
package imports."""

import ast
import importlib.metadata
import json
import re
import sys
import tomllib
from collections.abc import Iterable

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
OF_ROS = ["rclpy", "rcl_interfaces", "sensor_msgs", "std_msgs", "std_srvs", "diagnostic_msgs"]
DISTRIBUTION = {"PIL": "pillow", "mpl_toolkits": "matplotlib", "tomli_w": "tomli-w"} | {
    name: f"ros-{name.replace('_', '-')}" for name in OF_ROS
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


def names_of(requirements: Iterable[Requirement]) -> set[str]:
    return {canonicalize_name(requirement.name) for requirement in requirements}


def test_the_classifiers_are_the_pythons_that_are_required():
    oldest = min(CLASSIFIED)
    assert PROJECT["requires-python"] == f">={oldest[0]}.{oldest[1]}"
    none_left_out = [(3, minor) for minor in range(oldest[1], max(CLASSIFIED)[1] + 1)]
    assert none_left_out == CLASSIFIED
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
    names = {name for source in sources for name in imported(source)}
    distributions = {canonicalize_name(DISTRIBUTION.get(name, name)) for name in names}
    known = names_of([*REQUIRED, *OPTIONAL]) | {*COMES_WITH, *OF_TYPE_CHECKERS}
    assert not distributions - known, "declare them in pyproject.toml"
    for name, parent in COMES_WITH.items():
        brought = map(Requirement, importlib.metadata.requires(parent) or [])
        assert name in names_of(brought), (name, parent)


def test_every_dependency_is_pinned_at_a_version_that_is_allowed():
    assert {"jax", "numpy", "scipy"} <= names_of(REQUIRED), "every part imports these: no extras"
    assert names_of(REQUIRED) <= set(PINS)
    for requirement in (*REQUIRED, *OPTIONAL):
        pin = PINS.get(canonicalize_name(requirement.name))
        assert pin is None or requirement.specifier.contains(pin), (requirement, pin)


def test_jax_is_limited_to_the_versions_that_were_tested():
    """The lower limit is the pinned version, and the upper one a minor version."""
    (jax_,) = [x for x in REQUIRED if x.name == "jax"]
    lower = PINS["jax"]
    specifier = ",".join(sorted(map(str, jax_.specifier), reverse=True))
    match = re.fullmatch(rf">={re.escape(lower)},<0\.(\d+)", specifier)
    assert match is not None, jax_
    newest = f"0.{int(match[1]) - 1}"
    page = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
    assert f"from {lower} to {newest}." in page
    assert jax_.specifier.contains(importlib.metadata.version("jax"))


def test_these_tests_can_fail():
    code = "import os, made_up.part\ndef f():\n    from other import x\n    import iblf_jax"
    assert imported(code) == {"made_up", "other"}
    assert not SpecifierSet(">=3.12").contains("3.11.9")
