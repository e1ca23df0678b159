"""The data of a sweep as an `xarray.Dataset`: named dimensions, units, coordinates, and the whole
configuration.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from iblf_jax.core.status import Status, has_flag
from iblf_jax.simulation.metrics import VIOLATION_TIMES
from iblf_jax.simulation.signals import dimension_names

if TYPE_CHECKING:
    import xarray

RUN = "run"
DRAWN = "drawn_"
"""Prefix of the names of drawn parameters in flat data."""


def to_dataset(
    config: dict[str, Any],
    flat: Mapping[str, np.ndarray],
    units: Mapping[str, str],
    done: np.ndarray,
) -> xarray.Dataset:
    """The Dataset from flat data.

    Args:
      config: the result of `store_config.describe`.
      flat: name -> (cases, ...); case = point * runs + run.
      units: name -> unit.
      done: which cases are computed, (cases,) bool.

    Returns:
      A Dataset with the dimensions of the design, `run` if runs are perturbed, and `joint`.
    """
    import xarray

    outer = dict(config["dims"])
    if config["perturbations"]:
        outer[RUN] = config["runs"]
    coordinates = _coordinates(config)
    variables: dict[str, Any] = {}
    for name, values in flat.items():
        shaped = values.reshape(*outer.values(), *values.shape[1:])
        dims = (
            *outer,
            *dimension_names(name.removeprefix(DRAWN), values.shape[1:], config["joints"]),
        )
        attributes = {"units": units.get(name, "")}
        by_point = values.reshape(-1, config["runs"], *values.shape[1:])
        of_first = np.broadcast_to(by_point[:1], by_point.shape)
        is_drawn = name.startswith(DRAWN) and np.all(done)
        if is_drawn and np.array_equal(by_point, of_first, equal_nan=True):
            path = name.removeprefix(DRAWN)
            coordinates[path] = ((RUN, *dims[len(outer) :]), by_point[0], attributes)
        else:
            variables[name] = (dims, shaped, attributes)
    dims, status, _ = variables["status"]
    variables["status"] = (dims, status, status_attributes("0 is ok, -1 not computed yet"))
    if "first_violation_time" in flat:
        outside = _started_outside(flat).reshape(status.shape)
        text = (
            "whether the run violated a bound, or was outside a region, at t = 0 already: it was"
            " started there, and no law could keep it"
        )
        variables["started_outside"] = (dims, outside, {"units": "1", "description": text})
    return xarray.Dataset(variables, coordinates, _attributes(config, done))


def status_attributes(values: str) -> dict[str, Any]:
    """Attributes of flags, by the CF conventions; `values` says what special values mean."""
    flags = [flag for flag in Status if flag]
    return {
        "units": "1",
        "description": f"bit flags; {values}",
        "flag_masks": np.array([int(flag) for flag in flags], np.int32),
        "flag_meanings": " ".join((flag.name or "").lower() for flag in flags),
    }


def _started_outside(flat: Mapping[str, np.ndarray]) -> np.ndarray:
    """Whether each case violated a constraint at t = 0, (cases,)."""
    status = flat["status"]
    at_start = [
        (status >= 0) & has_flag(status, flag) & (np.asarray(flat[name]) <= 0)
        for flag, name in VIOLATION_TIMES.items()
        if name in flat
    ]
    return np.any(at_start, axis=0)


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
            (place["along"], *dimension_names(path, values.shape[1:], config["joints"])),
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
