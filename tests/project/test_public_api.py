"""What `import iblf_jax` gives: every name documented, nothing heavy loaded, the session's settings
untouched."""

import ast
import functools
import importlib.metadata
import inspect
import json
import re
import subprocess
import sys
import typing
from typing import Any

import pytest
from conftest import ROOT
from test_stability import PAGE, names_in

import iblf_jax as ij

HEAVY = (
    *("matplotlib", "optax", "xarray", "pandas", "scipy", "zarr", "tqdm", "mujoco", "IPython"),
    *("tomli_w", "hypothesis"),
    *("iblf_jax.certificates", "iblf_jax.identification", "iblf_jax.proofs", "iblf_jax.tuning"),
    *("iblf_jax.cli", "iblf_jax.deployment", "iblf_jax.plotting", "iblf_jax.studies.study"),
)
"""Modules that `import iblf_jax` leaves for their first use."""


def public(module) -> dict[str, object]:
    """Public names of a module that the package defines, or that its __all__ or __init__
    exports."""
    names = getattr(module, "__all__", None) or [x for x in dir(module) if not x.startswith("_")]
    members = {name: getattr(module, name) for name in names}
    if getattr(module, "__all__", None):
        return members
    own = {k: v for k, v in members.items() if inspect.isclass(v) or inspect.isfunction(v)}
    return {k: v for k, v in own.items() if (v.__module__ or "").startswith("iblf_jax")}


NAMES = sorted(names_in(PAGE, "stable") | names_in(PAGE, "provisional"))
MODULES = [ij, *(x for x in (getattr(ij, name) for name in NAMES) if inspect.ismodule(x))]


def undocumented(name: str, thing: object) -> list[str]:
    """What lacks a docstring of its own: the thing, or public methods of a class."""
    if not (inspect.isclass(thing) or inspect.isfunction(thing)):
        return []
    words = (thing.__doc__ or "").strip()
    # The docstring that dataclasses makes up is a signature, and says nothing.
    made_up = re.fullmatch(rf"{getattr(thing, '__name__', '')}\(.*\)", words, re.DOTALL)
    missing = [] if words and not made_up else [name]
    for key, value in vars(thing).items() if inspect.isclass(thing) else ():
        function = inspect.unwrap(value.fget if isinstance(value, property) else value)
        if inspect.isfunction(function) and key[0] != "_" and not (function.__doc__ or "").strip():
            missing.append(f"{name}.{key}")
    return missing


PUBLIC_MODULE = {
    "iblf_jax.tuning.quantities": "iblf_jax.tuning.objectives",
    "iblf_jax.simulation.metrics": "iblf_jax.simulation.metrics",
    "iblf_jax.studies.distributions": "iblf_jax.studies.distributions",
}
"""Module with a base class -> the public module of its family, where that is not the module or
folder at the top of the package."""
BASES = {
    *("DisturbanceObserver", "TrackingLaw", "Dynamics", "AnySensor", "Part", "Protocol"),
    *("TimeVarying", "Timed", "abc.ABC"),
}
"""What the base classes of families inherit from."""
ELSEWHERE = (
    *("jax.Array", "np.ndarray", "Any", "bool", "dict", "float", "int", "list", "str", "tuple"),
    *("None", "ClassVar", "Self"),
)
"""What annotations of the base classes name that is not of this package."""


@functools.cache
def contracts() -> dict[str, ast.ClassDef]:
    """Every base class of a family, "module:Name" -> its definition."""
    found = {}
    for path in sorted((ROOT / "iblf_jax").rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.ClassDef) or node.name.startswith("_"):
                continue
            is_member = "component" in map(ast.unparse, node.decorator_list)
            users_write_none = ".core." in module or ".proofs." in module or is_member
            if BASES & {*map(ast.unparse, node.bases)} and not users_write_none:
                found[f"{module}:{node.name}"] = node
    return found


def types_named(annotations: list[ast.expr]) -> set[str]:
    """Names of types in some annotations, without those that come from elsewhere."""
    nodes = [node for annotation in annotations for node in ast.walk(annotation)]
    names = {ast.unparse(node) for node in nodes if isinstance(node, ast.Attribute | ast.Name)}
    return names - set(ELSEWHERE) - {"jax", "np"}


def not_public(key: str, definition: ast.ClassDef) -> list[str]:
    """Types that a class of this family returns or is given, and that no public module has under
    their name."""
    name, _, _ = key.partition(":")
    depth = 3 if name.startswith(("iblf_jax.world.", "iblf_jax.control.")) else 2
    place = PUBLIC_MODULE.get(name, ".".join(name.split(".")[:depth]))
    module, family = importlib.import_module(name), importlib.import_module(place)
    anywhere = [getattr(ij, name) for name in dir(ij) if inspect.ismodule(getattr(ij, name))]
    methods = [node for node in definition.body if isinstance(node, ast.FunctionDef)]
    fields = [node.annotation for node in definition.body if isinstance(node, ast.AnnAssign)]
    given = [arg.annotation for node in methods for arg in node.args.args if arg.annotation]
    returned = types_named([node.returns for node in methods if node.returns is not None])

    def lacking(names: set[str], places: list) -> set[str]:
        found = {name: getattr(module, name) for name in names}
        return {
            name
            for name, thing in found.items()
            if not any(getattr(place, name, None) is thing for place in places)
        }

    missing = lacking({definition.name, *returned}, [family])
    return sorted(missing | lacking(types_named([*fields, *given]), [family, *anywhere]))


def test_every_type_that_a_users_class_returns_is_public():
    """The module of a family exports them, for classes of users."""
    missing = {key: not_public(key, definition) for key, definition in contracts().items()}
    assert not any(missing.values()), {key: x for key, x in missing.items() if x}


@pytest.mark.parametrize("name", ["controllers.Command", "sensors.Measurement", "objectives.Outer"])
def test_what_users_return_is_documented_on_the_reference_pages(name, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import public_types
    import reference

    family, _, short = name.partition(".")
    listed = {known for _, names in reference.PAGES.values() for known in names.split()}
    if family in reference.FAMILIES:
        listed |= {f"{family}.{known}" for known in public_types.types_of(getattr(ij, family))}
    assert name in listed
    thing = reference.named(name)
    fields = public_types.fields_of(thing)
    assert set(getattr(thing, "_fields", ())) <= set(fields)
    assert all(f"**{field}**" in reference.page_of(thing, short) for field in fields)


def test_every_objective_is_on_its_reference_page(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import reference

    signatures = {
        f"objectives.{name}": inspect.signature(function)
        for name, function in vars(ij.objectives).items()
        if inspect.isfunction(function) and not name.startswith("_")
    }
    made = {
        name
        for name, signature in signatures.items()
        if signature.return_annotation in ("Objective", "Requirement")
        and "objective" not in signature.parameters
    }
    assert {"objectives.tracking", "objectives.margin_above"} <= made
    assert made <= set(reference.PAGES["objectives"][1].split())


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.__name__)
def test_every_public_name_is_documented(module):
    assert module.__doc__
    assert [x for name, thing in public(module).items() for x in undocumented(name, thing)] == []


def functions_of(thing: object) -> dict[str, Any]:
    """A function, or a class and its public methods, by name."""
    if not inspect.isclass(thing):
        return {getattr(thing, "__name__", ""): thing}
    members = {name: value for base in thing.__mro__ for name, value in vars(base).items()}
    functions = {
        f"{thing.__name__}.{name}": getattr(x, "fget", None) or getattr(x, "__func__", x)
        for name, x in members.items()
        if not name.startswith("_")
    }
    return {thing.__name__: thing} | {
        name: x
        for name, x in functions.items()
        if inspect.isfunction(x) and x.__module__.startswith("iblf_jax")
    }


@pytest.mark.slow
def test_every_annotation_can_be_evaluated():
    """By `typing.get_type_hints`, which tools for documentation and for checks of types call."""
    things = [getattr(ij, name) for name in NAMES]
    things += [x for module in filter(inspect.ismodule, things) for x in public(module).values()]
    functions = {}
    for thing in things:
        if (getattr(thing, "__module__", None) or "").startswith("iblf_jax"):
            functions |= functions_of(thing)
    assert len(functions) > 500
    # Only checkers of types need typing_extensions, which has its `TypeIs`.
    del functions["is_absent"]
    wrong = {}
    for name, function in functions.items():
        try:
            typing.get_type_hints(function)
        except (NameError, ModuleNotFoundError) as error:
            wrong[name] = str(error)
    assert wrong == {}


def test_entry_points_document_arguments_returns_and_errors():
    for function in (ij.simulate, ij.with_parameters, ij.with_parts, ij.vector_field, ij.compare):
        words = ["Args:", "Returns:", "Raises:", *inspect.signature(function).parameters]
        assert [x for x in words if x not in function.__doc__] == [], function.__name__


def test_every_leaf_has_a_unit():
    table = ij.parameters(ij.presets.zhang_yan_2024())
    assert all(p.unit for p in table)
    assert "controller.K2" in repr(table)
    assert "<table>" in table._repr_html_()


@pytest.mark.parametrize(
    ("call", "name", "known"),
    [
        (ij.tune, "optimiser", "scenario, parameters, objective, "),
        (ij.sensitivity, "point", "scenario, perturbations, "),
        (ij.certificates.counterexample, "ranges", "scenario, perturbations, starts, seed."),
        (ij.load_sweep, "store", "path."),
    ],
)
def test_an_unknown_keyword_is_refused_with_the_known_ones(call, name, known):
    first = re.escape(f"{call.__name__}() got an unexpected keyword argument {name!r}. ")
    nearest = r"Did you mean points\? " if name == "point" else r"(Did you mean .*\? )?"
    with pytest.raises(TypeError, match=rf"{first}{nearest}Its arguments are {known}"):
        call(**{name: 1})


def test_the_version_is_the_packages_and_an_unknown_name_is_an_attribute_error():
    assert ij.__version__ == importlib.metadata.version("iblf_jax")
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = ij.nothing_of_the_kind


@pytest.mark.slow
def test_import_is_light_and_leaves_the_session_alone():
    """In a process of its own: nothing heavy beyond what jax loads, no array made, x64 and the
    cache as they were.  No device is started, else neither `jax.distributed.initialize` nor the
    number of CPU devices could come after the import of the studies."""
    code = f"""
import sys, json, jax
before, settings = set(sys.modules), ("jax_enable_x64", "jax_compilation_cache_dir")
values = [getattr(jax.config, x) for x in settings]
import iblf_jax
heavy = [m for m in {HEAVY!r} if m in set(sys.modules) - before]
iblf_jax.monte_carlo, iblf_jax.sweep
from jax._src import xla_bridge
same = values == [getattr(jax.config, x) for x in settings]
print(json.dumps([heavy, same, bool(xla_bridge._backends)]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [[], True, False]


def test_these_tests_can_fail():
    code = "class Robot(Protocol):\n    def load(self, x: planar_skeleton) -> keep_programs: ..."
    missing = not_public("iblf_jax.robots._base:Robot", ast.parse(code).body[0])
    assert missing == ["keep_programs", "planar_skeleton"]

    class Bare:
        def method(self): ...

    assert undocumented("Bare", Bare) == ["Bare", "Bare.method"]
    made_up = type("Made", (), {"__doc__": "Made(x: int, y: float)"})
    assert undocumented("Made", made_up) == ["Made"]
