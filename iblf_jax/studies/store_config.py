"""What defines the data of a sweep, as JSON: written into its attributes, and compared before a
store is continued.
"""

from __future__ import annotations

import dataclasses
import secrets
from typing import Any

import jax
import numpy as np

from iblf_jax.core import devices, modules
from iblf_jax.core.program_digest import CallsPythonError, program_digest
from iblf_jax.core.pytree import field_values, is_leaf_field
from iblf_jax.engine import block_size, uses_host_compiler
from iblf_jax.kernels import built_for
from iblf_jax.simulation.paths import get, parameters, unit_at
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.blocks import traced
from iblf_jax.studies.study_setup import PreparedStudy
from iblf_jax.studies.sweep_points import Points


def describe_component(part: object) -> Any:
    """A component as JSON: its class and the values of all its fields, recursively."""
    if isinstance(part, str | bool | None):
        return part
    if isinstance(part, tuple | list):
        return [describe_component(x) for x in part]
    if isinstance(part, jax.Array | np.ndarray | np.generic | float | int):
        return np.asarray(part).tolist()
    if modules.is_module(part):
        inner = {str(k): describe_component(x) for k, x in modules.entries(part).items()}
        return {"class": type(part).__qualname__, **inner}
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return modules.name_of(part)
    fields = {name: describe_component(value) for name, value in field_values(part).items()}
    return {"class": type(part).__qualname__, **fields}


def structure(part: object) -> Any:
    """The classes and static fields of a component, without its numbers."""
    if modules.is_module(part) and not isinstance(part, tuple | list):
        inner = {str(k): structure(x) for k, x in modules.entries(part).items()}
        return {"class": type(part).__qualname__, **inner}
    if isinstance(part, tuple | list):
        return [structure(x) for x in part]
    if callable(part) and not modules.is_component(part):
        return modules.name_of(part)
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return None
    found: dict[str, Any] = {"class": type(part).__qualname__}
    values = field_values(part)
    for field in dataclasses.fields(part):
        inner = values[field.name]
        if field.metadata.get("static"):
            found[field.name] = _static(inner)
        elif not is_leaf_field(field) and not isinstance(inner, jax.Array | np.ndarray):
            found[field.name] = structure(inner)
    return found


def _static(value: object) -> Any:
    """A static field; of a function its name, as its code is in the digest of the program."""
    if isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, tuple):
        return [_static(x) for x in value]
    if callable(value):
        return modules.name_of(value)
    return repr(value)


def values_of(scenario: Scenario) -> dict[str, Any]:
    """Path -> value of every parameter."""
    return {p.path: np.asarray(p.value).tolist() for p in parameters(scenario, named=False)}


def _digest(prepared: PreparedStudy) -> str:
    """The digest of the program of a block, which changes with the code of a law, a robot or a
    metric; of a program that cannot be described, a text that no other store has.
    """
    inputs = prepared.inputs_of(np.arange(block_size()))
    try:
        return program_digest(traced(prepared.program, prepared.shared, inputs))
    except CallsPythonError as error:
        return f"calls Python by {error}, {secrets.token_hex(8)}"


def computed_by(backend: str) -> dict[str, Any]:
    """What decides the last digits of a result besides its program: backend, platform, versions,
    and processor and compiler of kernels on the host.
    """
    import jaxlib

    import iblf_jax

    found: dict[str, Any] = {
        "backend": backend,
        "platform": devices.platform(),
        "versions": {
            "iblf_jax": iblf_jax.__version__,
            "jax": jax.__version__,
            "jaxlib": jaxlib.__version__,
        },
    }
    if uses_host_compiler(backend):
        found["kernel"] = built_for()
    return found


def describe(prepared: PreparedStudy, points: Points, design: str) -> dict[str, Any]:
    """Everything that the data of a sweep depend on."""
    scenario = prepared.scenario

    def place(path: str) -> dict[str, Any]:
        return {
            "along": points.along[path],
            "values": points.axis_values[path].tolist(),
            "unit": unit_at(scenario, path),
            "shape": list(np.shape(get(scenario, path))),
        }

    options = prepared.options
    return {
        "design": design,
        "dims": dict(points.dims),
        "points": {path: place(path) for path in points.values},
        "perturbations": {
            path: describe_component(p) for path, p in prepared.perturbations.items()
        },
        "perturbed": {
            t.path: {"unit": unit_at(scenario, t.path), "source": t.source}
            for t in prepared.program.targets
        },
        **dataclasses.asdict(options),
        "duration": round(options.steps * options.dt, 12),
        **computed_by(prepared.backend),
        "metrics": describe_component(prepared.shared.folds),
        "scenario": values_of(scenario),
        "structure": structure(scenario),
        "joints": scenario.n,
        "dtype": str(scenario.initial.q.dtype),
        "block": block_size(),
        "program": _digest(prepared),
    }
