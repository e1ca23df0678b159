"""What defines the data of a sweep, as JSON: written into its attributes, and compared before a
store is continued.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from typing import Any

import jax
import numpy as np

from iblf_jax.core import devices
from iblf_jax.core.pytree import is_leaf_field
from iblf_jax.kernels import built_for
from iblf_jax.simulation.paths import get, parameters, unit_at
from iblf_jax.studies.blocks import _execute, block_size
from iblf_jax.studies.points import Points
from iblf_jax.studies.setup import StudySetup


def describe_component(part: Any) -> Any:
    """A component as JSON: its class, its structural fields and its numbers, all the way down."""
    if isinstance(part, tuple | list):
        return [describe_component(x) for x in part]
    if isinstance(part, jax.Array | np.ndarray | np.generic | float | int) and not isinstance(
        part, bool
    ):
        return np.asarray(part).tolist()
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return part if isinstance(part, str | bool | None) else repr(part)
    fields = {
        field.name: describe_component(getattr(part, field.name))
        for field in dataclasses.fields(part)
    }
    return {"class": type(part).__qualname__, **fields}


def structure(part: Any) -> Any:
    """As `describe_component`, without the numbers: what a parameter table does not tell."""
    if isinstance(part, tuple | list):
        return [structure(x) for x in part]
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return None
    found: dict[str, Any] = {"class": type(part).__qualname__}
    for field in dataclasses.fields(part):
        inner = getattr(part, field.name)
        if field.metadata.get("static"):
            found[field.name] = (
                inner if isinstance(inner, str | bool | int | float) else repr(inner)
            )
        elif not is_leaf_field(field) and not isinstance(inner, jax.Array | np.ndarray):
            found[field.name] = structure(inner)
    return found


def program_digest(setup: StudySetup) -> str:
    """A digest of what a run computes: it tells when the code of a law, a robot or a metric has
    changed.
    """
    traced = _execute.trace(
        setup.shared, setup.lanes(np.arange(block_size())), study_run=setup.study_run
    )
    text = re.sub(r"0x[0-9a-f]+", "", str(traced.jaxpr))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def describe(setup: StudySetup, points: Points, design: str, dt: float) -> dict[str, Any]:
    """Everything that the data of a sweep depend on."""
    import jaxlib

    import iblf_jax

    scenario = setup.shared.cases.scenario

    def place(path: str) -> dict[str, Any]:
        return {
            "along": points.along[path],
            "values": points.ticks[path].tolist(),
            "unit": unit_at(scenario, path),
            "shape": list(np.shape(get(scenario, path))),
        }

    study_run = setup.study_run
    return {
        "design": design,
        "dims": dict(points.dims),
        "points": {path: place(path) for path in points.values},
        "perturbations": {path: describe_component(p) for path, p in setup.perturbations.items()},
        "perturbed": {
            t.path: {"unit": unit_at(scenario, t.path), "source": t.source}
            for t in study_run.targets
        },
        "runs": setup.runs,
        "seed": setup.seed,
        "sampler": setup.sampler,
        "replicates": setup.replicates,
        "duration": round(study_run.steps * dt, 12),
        "dt": dt,
        "method": study_run.method,
        "metrics": describe_component(setup.shared.folds),
        "scenario": {
            p.path: np.asarray(p.value).tolist() for p in parameters(scenario, named=False)
        },
        "structure": structure(scenario),
        "joints": scenario.n,
        "dtype": str(scenario.initial.q.dtype),
        "backend": study_run.backend,
        "platform": devices.platform(),
        **({"kernel": built_for()} if study_run.backend == "native" else {}),
        "block": block_size(),
        "versions": {
            "iblf_jax": iblf_jax.__version__,
            "jax": jax.__version__,
            "jaxlib": jaxlib.__version__,
        },
        "program": program_digest(setup),
    }
