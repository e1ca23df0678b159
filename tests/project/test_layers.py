"""The layers of the package, held by its imports: they go down only.  The table of layers is
CONTRIBUTING.md's."""

import ast
import functools
import graphlib
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import ROOT

PACKAGE = ROOT / "iblf_jax"
LAYER_OF = {
    name.rstrip("/"): int(layer)
    for layer, names in re.findall(
        r"^\| (\d) [\w ]+\| (`.*) \|$", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE
    )
    for name in re.findall(r"`([\w/]+)`", names)
}
"""Module or folder at the root of the package -> its layer."""
ONLY_IN = dict.fromkeys(("optax", "cma", "optuna", "unopy"), ("tuning",)) | {
    "matplotlib": ("plotting",),
    "argparse": ("cli",),
    "mujoco": ("world", "deployment"),
    "rosbags": ("identification",),
    "xarray": ("files", "studies", "identification", "cli", "plotting"),
}
"""Library -> the modules that may use it, inside functions too."""
INTERNAL = ("jax._src", "jax.extend", "jax.interpreters", "jax.experimental")
"""Modules of JAX that may change in any version."""
INTERNALS = {
    "core/disk_cache.py": "the cache of compiled programs",
    "core/kept_programs.py": "how an executable is written and read",
    "core/taylor.py": "rules of Taylor coefficients",
    "kernels/jaxprs.py": "how a jaxpr stores equations, constants and inner functions",
    "kernels/primitives.py": "primitives and their rules",
    "proofs/examination.py": "the operations that proofs admit",
    "proofs/users_barriers.py": "what an operation does to a physical dimension",
}
"""File -> the part of JAX's internals that it alone knows."""
SOURCES = {path: path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}


def module_of(path: Path) -> str:
    """The top-level module or folder of a file, "" for the package's own __init__."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return "" if parts == ("__init__",) else parts[0]


@functools.cache
def places_of_imports(source: str) -> list[tuple[str, bool]]:
    """Full names of what a file imports, each with whether it is at the top; not what only type
    checkers see."""
    found: list[tuple[str, bool]] = []

    def visit(node, at_the_top):
        if isinstance(node, ast.Import):
            found.extend((alias.name, at_the_top) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the package in full"
            found.extend((f"{node.module}.{alias.name}", at_the_top) for alias in node.names)
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            return
        at_the_top = at_the_top and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case):
                visit(child, at_the_top)

    visit(ast.parse(source), True)
    return found


def imports(source: str, *, at_the_top: bool) -> set[str]:
    return {name for name, is_top in places_of_imports(source) if is_top or not at_the_top}


def edges(source: str, *, at_the_top: bool = True) -> set[str]:
    """Modules and folders at the root of the package that a file imports."""
    names = [name.split(".") for name in imports(source, at_the_top=at_the_top)]
    return {parts[1] for parts in names if parts[0] == "iblf_jax" and len(parts) > 1}


def upward(module: str, source: str, *, at_the_top: bool = True) -> set[str]:
    """The modules of a higher layer that a file of `module` imports."""
    found = edges(source, at_the_top=at_the_top)
    return {name for name in found if LAYER_OF.get(name, -1) > LAYER_OF[module]}


def test_every_module_has_a_layer():
    unknown = {module_of(path) for path in SOURCES} - set(LAYER_OF) - {""}
    assert not unknown, f"say in which layer {unknown} belongs: CONTRIBUTING.md"
    places = {name: (PACKAGE / name, PACKAGE / f"{name}.py") for name in LAYER_OF}
    gone = [name for name, either in places.items() if not any(x.exists() for x in either)]
    assert not gone, f"CONTRIBUTING.md has layers for {gone}, which are not there"


def test_imports_go_down_only_and_in_no_cycle():
    """Inside functions, too: results reach figures, reports and files through
    `core/presentation.py`."""
    graph = {name: set() for name in LAYER_OF}
    for path, text in SOURCES.items():
        if module := module_of(path):
            assert not upward(module, text, at_the_top=False), path
            graph[module] |= edges(text) & set(LAYER_OF) - {module}
    # An order exists only if there is no cycle.
    tuple(graphlib.TopologicalSorter(graph).static_order())


def calls(source: str, name: str) -> list[int]:
    """Lines that use an attribute chain such as jax.lax.scan or jax.config.update."""
    last = name.split(".")[-1]
    if last not in source:
        return []
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Attribute) and node.attr == last and ast.unparse(node) == name
    ]


def users(uses: Callable[[str], object]) -> set[str]:
    return {str(path.relative_to(PACKAGE)) for path, text in SOURCES.items() if uses(text)}


@pytest.mark.parametrize("library", ONLY_IN)
def test_libraries_stay_in_their_place(library):
    def uses(text):
        return library in {x.split(".")[0] for x in imports(text, at_the_top=False)}

    assert {Path(name).parts[0] for name in users(uses)} <= {*ONLY_IN[library]}


def test_internals_of_jax_stay_in_their_modules_and_jaxprs_are_read_by_interpreters_only():
    """The others ask `kernels.jaxprs`."""
    found = users(lambda text: any(x.startswith(INTERNAL) for x in imports(text, at_the_top=False)))
    found |= users(lambda text: any(calls(text, name) for name in INTERNAL))
    assert found <= set(INTERNALS)
    interpreters = {"core/taylor.py", "kernels/from_jaxpr.py", "proofs/examination.py"}
    found = users(lambda text: re.search(r"\.(eqns|constvars|call_jaxpr)\b", text))
    assert found <= set(INTERNALS) | interpreters


def test_time_is_scanned_in_one_place():
    """lax.scan is a loop over time, which is the engine's; stages of an integrator, iterations, the
    samples that an exported law is tested with, a law on recorded states, the plant under torques
    of a log, the switches of a Markov chain and checkers' loops are no runs."""
    allowed = {
        *("core/linalg.py", "core/qp.py", "deployment/export.py", "deployment/ros2/law_replay.py"),
        *("identification/replay.py", "simulation/integrators.py"),
        "world/plants/markov_switched.py",
    }
    found = users(lambda text: calls(text, "jax.lax.scan") or calls(text, "lax.scan"))
    assert {name for name in found if not name.startswith(("engine/", "testing/"))} == allowed


def test_the_session_is_left_alone():
    """jax.config belongs to the user: the command line, a program of its own, sets it, and the
    cache of compiled programs its fields; `initialize_worker` sets it where a user calls it in a
    worker's process; the options of a thread are read."""
    readers = {"core/devices.py", "core/thread_options.py"}
    found = users(lambda text: calls(text, "jax.config"))
    writers = {"core/disk_cache.py", "studies/workers.py"}
    assert {name for name in found if not name.startswith("cli/")} == writers | readers
    assert not readers & users(lambda text: calls(text, "jax.config.update"))


def test_no_prints_and_no_leftovers():
    for path, text in SOURCES.items():
        if module_of(path) != "cli" and "print(" in text:
            called = [n.func for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call)]
            assert not [f for f in called if isinstance(f, ast.Name) and f.id == "print"], path
        assert not re.search(r"\b(TODO|FIXME|XXX|HACK)\b", text), path
        assert not re.search(r"/(home|Users|work|opt)/\w", text), path


def test_these_tests_can_fail():
    for words in ("from iblf_jax.engine.simulate import simulate", "from iblf_jax import engine"):
        assert upward("world", words) == {"engine"}
    plot = "def plot(self):\n    from iblf_jax import plotting"
    assert upward("simulation", plot) == set()
    assert upward("simulation", plot, at_the_top=False) == {"plotting"}
    for_types = "if TYPE_CHECKING:\n    from iblf_jax import plotting"
    assert upward("simulation", for_types) == set()
    assert upward("engine", "from iblf_jax.world.bounds import Tube") == set()
    code = "import jax\nx = jax.lax.scan(f, 0, None)\njax.config.update('a', 1)"
    assert calls(code, "jax.lax.scan") == [2] and calls(code, "jax.config") == [3]
