"""The data of a sweep as an `xarray.Dataset`: named dimensions, units, coordinates, and the whole
configuration.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from iblf_jax.core.status import Status
from iblf_jax.simulation.signals import own_dims

if TYPE_CHECKING:
    import xarray

RUN = "run"
DRAWN = "drawn_"
"""Begins the name of a drawn parameter in flat data."""
FIRST_TIMES = {
    "first_violation_time": Status.BOUND_VIOLATED,
    "first_velocity_violation_time": Status.VELOCITY_VIOLATED,
    "first_region_violation_time": Status.REGION_VIOLATED,
}
"""Metric that says when a constraint was violated first -> the flag that says that it was."""


def to_dataset(
    config: dict[str, Any],
    flat: Mapping[str, np.ndarray],
    units: Mapping[str, str],
    done: np.ndarray,
) -> xarray.Dataset:
    """The Dataset from flat data.

    Args:
      config: what `config.describe` gave.
      flat: name -> (cases, ...); case = point * runs + run.
      units: name -> unit.
      done: which cases are there, (cases,) bool.

    Returns:
      Dimensions as the design's, then `run` if runs are perturbed, then `joint`.
    """
    import xarray

    outer = dict(config["dims"])
    if config["perturbations"]:
        outer[RUN] = config["runs"]
    coordinates = _coordinates(config)
    variables: dict[str, Any] = {}
    for name, values in flat.items():
        shaped = values.reshape(*outer.values(), *values.shape[1:])
        dims = (*outer, *own_dims(name.removeprefix(DRAWN), values.shape[1:], config["joints"]))
        attributes = {"units": units.get(name, "")}
        if name.startswith(DRAWN):
            path = name.removeprefix(DRAWN)
            same = values.reshape(-1, config["runs"], *values.shape[1:]) if len(values) else values
            if np.all(done) and np.array_equal(
                same, np.broadcast_to(same[:1], same.shape), equal_nan=True
            ):
                coordinates[path] = ((RUN, *dims[len(outer) :]), same[0], attributes)
            else:
                variables[name] = (dims, shaped, attributes)
        else:
            variables[name] = (dims, shaped, attributes)
    dims, status, _ = variables["status"]
    flags = [flag for flag in Status if flag]
    variables["status"] = (
        dims,
        status,
        {
            "units": "1",
            "description": "bit flags; 0 is ok, -1 not computed yet",
            "flag_masks": np.array([int(f) for f in flags], np.int32),
            "flag_meanings": " ".join((f.name or "").lower() for f in flags),
        },
    )
    if "first_violation_time" in flat:
        violated = {
            flag: (flat["status"] >= 0) & (flat["status"] & int(flag) != 0)
            for flag in FIRST_TIMES.values()
        }
        at_start = [
            violated[flag] & (np.asarray(flat[name]) <= 0)
            for name, flag in FIRST_TIMES.items()
            if name in flat
        ]
        outside = np.any(at_start, axis=0)
        words = (
            "whether the run violated a bound, or was outside a region, at t = 0 already: it was"
            " started there, and no law could keep it"
        )
        variables["started_outside"] = (
            dims,
            outside.reshape(status.shape),
            {"units": "1", "description": words},
        )
    return xarray.Dataset(variables, coordinates, _attributes(config, done))


def _coordinates(config: dict[str, Any]) -> dict[str, Any]:
    dtype = config["dtype"]
    found: dict[str, Any] = {
        "joint": ("joint", np.arange(config["joints"]), {"description": "joint, from 0"})
    }
    if config["perturbations"]:
        found[RUN] = (
            RUN,
            np.arange(config["runs"]),
            {"description": "run, from 0; the same draws at every point"},
        )
    for dim, size in config["dims"].items():
        if dim not in config["points"]:
            found[dim] = (dim, np.arange(size), {"description": "point of the design"})
    for path, place in config["points"].items():
        values, attributes = np.asarray(place["values"], dtype), {"units": place["unit"]}
        if values.ndim == 1:
            found[path] = (place["along"], values, attributes)
            continue
        if path == place["along"]:
            found[path] = (
                path,
                np.arange(len(values)),
                {"description": f"number of the value, see '{path}_values'"},
            )
            path = f"{path}_values"
        found[path] = (
            (place["along"], *own_dims(path, values.shape[1:], config["joints"])),
            values,
            attributes,
        )
    return found


def _attributes(config: dict[str, Any], done: np.ndarray) -> dict[str, Any]:
    shown = (
        "design",
        "runs",
        "seed",
        "sampler",
        "duration",
        "dt",
        "method",
        "dtype",
        "backend",
        "platform",
    )
    attributes = {key: config[key] for key in shown}
    attributes |= {f"{name}_version": version for name, version in config["versions"].items()}
    attributes["computed_cases"] = int(done.sum())
    attributes["cases"] = int(done.size)
    attributes["config"] = json.dumps(config)
    return attributes
