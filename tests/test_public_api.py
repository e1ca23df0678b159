"""What `import iblf_jax` gives: every name documented, nothing heavy loaded, the session's settings untouched."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys

import pytest

import iblf_jax as ij

PROMISED = [
    *("simulate", "recommended_dt", "Scenario", "Initial", "Rollout", "Metrics", "Status", "SimulationError", "SimulationWarning"),
    *("parameters", "with_parameters", "astype", "component", "leaf", "static", "robots", "references", "bounds", "disturbances"),
    *(
        "with_parts",
        "vector_field",
        "VectorField",
        "compare",
        "Comparison",
        "barriers",
        "observers",
        "controllers",
        "metrics",
        "presets",
        "testing",
    ),
    *("identify", "Identification", "excitation", "joint_normal"),
    *("distributed", "certificates", "Study", "TuneResult", "Sensitivity", "Certificate", "Counterexample", "Attack", "Front"),
]

HEAVY = ("matplotlib", "optax", "xarray", "pandas", "scipy", "zarr", "tqdm", "mujoco", "IPython", "hypothesis")


def public(module) -> dict[str, object]:
    """Public names of a module that the package defines, or that its __all__ or __init__ exports."""
    names = getattr(module, "__all__", None) or [x for x in vars(module) if not x.startswith("_")]
    members = {name: getattr(module, name) for name in names}
    if getattr(module, "__all__", None):
        return members
    own = {k: v for k, v in members.items() if inspect.isclass(v) or inspect.isfunction(v)}
    return {k: v for k, v in own.items() if (v.__module__ or "").startswith("iblf_jax")}


MODULES = [ij, *(getattr(ij, name) for name in PROMISED if inspect.ismodule(getattr(ij, name)))]


def undocumented(name: str, thing: object) -> list[str]:
    """What lacks a docstring of its own: the thing, or public methods of a class."""
    if inspect.ismodule(thing) or not (inspect.isclass(thing) or inspect.isfunction(thing)):
        return []
    missing = [] if (thing.__doc__ or "").strip() else [name]
    # The docstring that dataclasses makes up is a signature, and says nothing.
    if re.fullmatch(rf"{getattr(thing, '__name__', '')}\(.*\)", (thing.__doc__ or "").strip(), re.DOTALL):
        missing = [name]
    if inspect.isclass(thing):
        for key, value in vars(thing).items():
            function = inspect.unwrap(value.fget if isinstance(value, property) else value)
            if not key.startswith("_") and inspect.isfunction(function) and not (function.__doc__ or "").strip():
                missing.append(f"{name}.{key}")
    return missing


@pytest.mark.parametrize("name", PROMISED)
def test_promised_names_are_there(name):
    assert hasattr(ij, name)
    assert name in dir(ij)


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.__name__)
def test_every_public_name_is_documented(module):
    assert module.__doc__
    missing = [x for name, thing in public(module).items() for x in undocumented(name, thing)]
    assert not missing, f"{module.__name__}: without a docstring: {missing}"


@pytest.mark.parametrize("module", [m for m in MODULES if hasattr(m, "__all__")], ids=lambda m: m.__name__)
def test_all_lists_what_exists(module):
    """A missing comma joins two names into one that does not exist."""
    assert [name for name in module.__all__ if not hasattr(module, name)] == []
    assert len(set(module.__all__)) == len(module.__all__)


def test_entry_points_document_arguments_returns_and_errors():
    for function in (ij.simulate, ij.with_parameters, ij.with_parts, ij.vector_field, ij.compare):
        for part in ("Args:", "Returns:", "Raises:"):
            assert part in function.__doc__, (function.__name__, part)
        for name in inspect.signature(function).parameters:
            assert re.search(rf"\b{name}\b", function.__doc__), (function.__name__, name)


def test_every_leaf_has_a_unit():
    table = ij.parameters(ij.presets.zhang_yan_2024())
    assert all(p.unit for p in table)
    assert "controller.K2" in repr(table)
    assert "<table>" in table._repr_html_()


def test_what_is_kept_comes_first_and_then_the_path():
    """save_x(x, path), load_x(path)."""
    for name in (name for name in dir(ij) if re.match("save_|load_", name)):
        first, *rest = inspect.signature(getattr(ij, name)).parameters
        if name.startswith("save_"):
            assert rest[0] == "path" and hasattr(ij, name.replace("save_", "load_")), name
        else:
            assert first == "path", name
    with pytest.raises(ValueError, match=r"store: got 'x.zarr', expected it as path"):
        ij.load_sweep(store="x.zarr")


def test_distributed_shows_what_users_call():
    assert dir(ij.distributed) == ["ProcessLostError", "initialize", "rank", "size"]


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = ij.nothing_of_the_kind


def test_version_is_the_packages():
    from importlib.metadata import version

    assert ij.__version__ == version("iblf_jax")


def test_import_is_light_and_leaves_the_session_alone():
    """In a process of its own: nothing heavy beyond what jax loads, no array made, x64 and the cache as they were."""
    code = (
        "import sys, json, jax\n"
        "before = set(sys.modules); x64 = jax.config.jax_enable_x64; cache = jax.config.jax_compilation_cache_dir\n"
        "import iblf_jax\n"
        f"heavy = [m for m in {HEAVY!r} if m in set(sys.modules) - before]\n"
        "from jax._src import xla_bridge\n"
        "same = [x64 == jax.config.jax_enable_x64, cache == jax.config.jax_compilation_cache_dir]\n"
        "print(json.dumps([heavy, *same, bool(xla_bridge._backends)]))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    heavy, same_x64, same_cache, backend_started = json.loads(out)
    assert heavy == []
    assert same_x64
    assert same_cache
    assert not backend_started


def test_these_tests_can_fail():
    class Bare:
        def method(self): ...

    def bare(): ...

    assert undocumented("bare", bare) == ["bare"]
    assert undocumented("Bare", Bare) == ["Bare", "Bare.method"]
    made_up = type("Made", (), {"__doc__": "Made(x: int, y: float)"})
    assert undocumented("Made", made_up) == ["Made"]
