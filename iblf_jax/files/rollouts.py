"""Runs as labelled data: `xarray.Dataset`s in memory, netCDF or npz on disk.

A Dataset has the dimensions `time` and `joint` (and `run`, before them, for a batch), a unit and a
description on every variable, the metrics beside the trajectories, and in its attributes what is
needed to do the run again: the scenario as TOML where a file can hold it, its parameters as JSON,
  the versions.  In a batch, a parameter that differs between runs is a variable named by its path.

On disk, several runs by name share one file.  They may differ in length, joints and states, so
nothing is stacked: every variable and dimension is stored as `<name>.<variable>`, and
  `load_rollouts` gives one Dataset a name back.  netCDF is version 3, written by SciPy.

netCDF 3 has no checksum, so the file's attribute `digest` holds one of each variable
(`files.digest`), and `load_rollouts` compares it with what it reads.  The attribute belongs to the
file: the Datasets that `load_rollouts` returns do not carry it, so it cannot become stale in them.
NumPy's format has a checksum of its own.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.status import Status, describe
from iblf_jax.files import digest
from iblf_jax.files.scenario import scenario_to_toml
from iblf_jax.files.values import Words
from iblf_jax.simulation.paths import parameters
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.signals import SIGNALS, own_dims

if TYPE_CHECKING:
    import xarray

STATES = {
    "controller_state": "state of the law, in its own unit",
    "observer_state": "state of the observer, in its own unit",
    "actuator_state": "state of the actuator, in its own unit",
    "measured": "what the sensor told last, positions [rad] and velocities [rad/s]",
}
"""Recorded state -> description."""

ENDINGS = (".nc", ".npz")
_ATTRIBUTES = "attributes"
DIGEST = "digest"
"""The attribute of a netCDF file that holds the digests of what is in it."""
MOST_NAMED = 4
"""How many damaged variables an error names."""


def rollout_to_xarray(run: Rollout) -> xarray.Dataset:
    """A Rollout as an `xarray.Dataset`.

    Args:
      run: one run, arrays (T, ...), or a batch, (B, T, ...).

    Returns:
      Dimensions time (T), joint (n), region where there are some, and run (B) first for a batch;
      variables as the Rollout's fields and metrics, each with `units` and `description`.  A metric
      whose name is taken is called `metric_<name>`.

    Raises:
      ValueError: not a Rollout, or one that is being traced.
    """
    import xarray

    if not isinstance(run, Rollout):
        raise checks.fail("run", run, "a Rollout", "ij.simulate returns one.")
    if not checks.is_concrete(run):
        raise checks.fail(
            "run", run, "a Rollout that holds numbers", "Call this outside of jit, vmap and grad."
        )
    batch = _batch_dims(run)
    variables = _trajectories(run, batch)
    variables |= _states(run, batch)
    for name, value in run.metrics.items():
        dims = (*batch, *own_dims(name, np.shape(value)[len(batch) :], run.n))
        label = f"metric_{name}" if name in variables else name
        variables[label] = (
            dims,
            np.asarray(value),
            _attrs(run.metrics.units.get(name, "1"), f"metric {name.replace('_', ' ')}"),
        )
    variables |= _verdict(run, batch)
    varying, attributes = _parameters(run, batch)
    coordinates: dict[str, Any] = {
        "joint": ("joint", np.arange(run.n, dtype=np.int32), _attrs("1", "joint, from 0"))
    }
    if len(batch) == 1:
        coordinates["run"] = (
            "run",
            np.arange(len(run), dtype=np.int32),
            _attrs("1", "run, from 0"),
        )
    coordinates["time"], more = _time(run, batch)
    return xarray.Dataset(variables | varying | more, coordinates, attributes)


def save_rollouts(runs: Mapping[str, Rollout] | Rollout, path: str | os.PathLike) -> None:
    """Writes runs to one file.

    Args:
      runs: runs by name (letters, digits, "_", "-" and blanks), or one Rollout, which is then
        called "run".
      path: the file; its ending decides, ".nc" for netCDF or ".npz" for NumPy.

    Raises:
      ValueError: another ending, no runs, a bad name, or something that is not a Rollout.
      OSError: the file cannot be written.
    """
    if isinstance(path, Mapping | Rollout):
        raise checks.fail(
            "path",
            Words(type(path).__name__),
            "a path, after the runs",
            "The order is save_rollouts(runs, path).",
        )
    ending = _ending(checks.file_to_write("path", path, "a file that ends in .nc or .npz"))
    runs = {"run": runs} if isinstance(runs, Rollout) else runs
    if not isinstance(runs, Mapping) or not runs:
        raise checks.fail("runs", runs, "a Rollout, or a dict of at least one Rollout by name")
    for name in runs:
        if (
            not isinstance(name, str)
            or not re.fullmatch(r"[A-Za-z0-9_][\w -]*", name, re.ASCII)
            or name == _ATTRIBUTES
        ):
            raise checks.fail(
                "name of a run", name, 'letters, digits, "_", "-" and blanks', "Choose another key."
            )
    data = {name: rollout_to_xarray(run) for name, run in runs.items()}
    (_write_netcdf if ending == ".nc" else _write_npz)(path, data)


def load_rollouts(path: str | os.PathLike) -> dict[str, xarray.Dataset]:
    """The runs of a file that `save_rollouts` wrote, as Datasets by name.

    Args:
      path: a ".nc" or ".npz" file.

    Raises:
      ValueError: another ending, a file that `save_rollouts` did not write, or one that was damaged
        or changed since.
      OSError: the file cannot be read.
    """
    place = checks.file_path("path", path, "a file that ends in .nc or .npz")
    read = _read_netcdf if _ending(place) == ".nc" else _read_npz
    with open(
        checks.file_to_read("path", place), "rb"
    ):  # a locked file is an OSError, whatever the reader would make of it
        pass
    try:
        return read(place)
    except DamagedFileError:
        raise
    except Exception as error:
        raise checks.fail(
            str(place), type(error).__name__, "a file written by save_rollouts", str(error)
        ) from error


class DamagedFileError(ValueError):
    """The content of a file is not what its digest was made of."""


# --- the Dataset


def _attrs(units: str, description: str) -> dict[str, str]:
    return {"units": units, "description": description}


def _batch_dims(run: Rollout) -> tuple[str, ...]:
    depth = np.ndim(run.status)
    return ("run",) if depth == 1 else tuple(f"run_{i}" for i in range(depth))


def _trajectories(run: Rollout, batch: tuple[str, ...]) -> dict[str, Any]:
    variables = {}
    for name, signal in SIGNALS.items():
        if name == "t":
            continue
        if isinstance(getattr(run, name), tuple):
            continue  # this scenario has no such signal
        value = np.asarray(getattr(run, name))
        dims = (*batch, "time", *own_dims(name, value.shape[len(batch) + 1 :], run.n))
        variables[name] = (dims, value, _attrs(signal.unit, signal.meaning))
    return variables


def _states(run: Rollout, batch: tuple[str, ...]) -> dict[str, Any]:
    variables = {}
    for whole, description in STATES.items():
        for keys, value in jax.tree_util.tree_leaves_with_path(getattr(run, whole)):
            name = re.sub(r"\W+", "_", whole + jax.tree_util.keystr(keys)).strip("_")
            dims = (*batch, "time", *own_dims(name, np.shape(value)[len(batch) + 1 :], run.n))
            variables[name] = (dims, np.asarray(value), _attrs("1", description))
    return variables


def _verdict(run: Rollout, batch: tuple[str, ...]) -> dict[str, Any]:
    flags = [flag for flag in Status if flag]
    status = np.asarray(run.status)
    attributes: dict[str, Any] = _attrs("1", "bit flags; 0 is ok")
    attributes["flag_masks"] = np.array([int(f) for f in flags], np.int32)
    attributes["flag_meanings"] = " ".join(f.name.lower() for f in flags if f.name)
    words = {value: describe(value) for value in np.unique(status).tolist()}
    return {
        "status": (batch, status.astype(np.int32), attributes),
        "status_words": (
            batch,
            np.vectorize(words.get, otypes=[str])(status),
            _attrs("1", "status in words"),
        ),
        "fastest_mode": (
            batch,
            np.asarray(run.fastest_mode),
            _attrs("1/s", "largest measured mode of the closed loop"),
        ),
        "dt": (batch, np.asarray(run.dt), _attrs("s", "time step")),
    }


def _time(run: Rollout, batch: tuple[str, ...]) -> tuple[Any, dict[str, Any]]:
    """The time coordinate; if the runs of a batch differ in it, sample numbers, and a variable `t`
    (run, time).
    """
    t = np.asarray(run.t)
    first = t.reshape(-1, t.shape[-1])[0]
    if np.all(t == first):
        return ("time", first, _attrs("s", "time")), {}
    numbers = np.arange(t.shape[-1], dtype=np.int32)
    return ("time", numbers, _attrs("1", "sample, from 0; the time is t")), {
        "t": ((*batch, "time"), t, _attrs("s", "time"))
    }


def _parameters(run: Rollout, batch: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Variables for what differs between the runs of a batch; attributes for the rest."""
    import iblf_jax

    fixed, varying = {}, {}
    batched = np.ndim(run.scenario.initial.q) > 1
    for p in parameters(run.scenario, named=False):
        value = np.asarray(p.value)
        if batched:
            one = value[(0,) * len(batch)]
            if not np.all(value == one):
                varying[p.path] = (
                    (*batch, *own_dims(p.path, one.shape, run.n)),
                    value,
                    _attrs(p.unit or "1", f"parameter {p.path}"),
                )
                continue
            value = one
        fixed[p.path] = value.tolist()
    attributes = {
        "parameters": json.dumps(fixed),
        "method": run.method,
        "iblf_jax_version": iblf_jax.__version__,
        "jax_version": jax.__version__,
    }
    if not batch:
        attributes["status"] = describe(int(run.status))
        try:
            attributes["scenario"] = scenario_to_toml(run.scenario)
        except ValueError as error:
            attributes["scenario_not_saved"] = str(error)
    return varying, attributes


# --- files


def _ending(path: Path) -> str:
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise checks.fail("path", str(path), "a file that ends in .nc (netCDF) or .npz (NumPy)")
    return ending


def _write_netcdf(path: str | os.PathLike, data: dict[str, xarray.Dataset]) -> None:
    import xarray

    attributes: dict[str, Any] = {"names": json.dumps(list(data))}
    digests = {name: digest.dataset_digests(one) for name, one in data.items()}
    attributes[DIGEST] = digest.encoded(digests)
    renamed = []
    for name, one in data.items():
        attributes |= {f"{name}.{key}": value for key, value in one.attrs.items()}
        labels = {*one.variables, *one.dims}
        renamed.append(
            one.drop_attrs(deep=False).rename({label: f"{name}.{label}" for label in labels})
        )
    merged = xarray.merge(renamed).assign_attrs(attributes)
    merged.to_netcdf(path, engine="scipy")


def _read_netcdf(path: str | os.PathLike) -> dict[str, xarray.Dataset]:
    import xarray

    merged = xarray.load_dataset(path, engine="scipy")
    found = {}
    for name in json.loads(merged.attrs["names"]):
        start = f"{name}."
        mine = merged[[v for v in merged.variables if str(v).startswith(start)]]
        labels = {x for x in (*mine.variables, *mine.dims) if str(x).startswith(start)}
        mine = mine.rename({x: str(x).removeprefix(start) for x in labels})
        mine.attrs = {
            key.removeprefix(start): value
            for key, value in merged.attrs.items()
            if key.startswith(start)
        }
        found[name] = mine
    _verify(path, merged.attrs, found)
    return found


def _verify(
    path: str | os.PathLike,
    attributes: Mapping[str, Any],
    found: Mapping[str, xarray.Dataset],
) -> None:
    """Raises DamagedFileError where Datasets are not those of the file's digest.

    Files of older versions have no digest and are accepted.
    """
    stored = digest.stored_in(attributes, DIGEST)
    if stored is None:
        return
    try:
        different = digest.differences(stored, found)
    except ValueError as error:
        different = [str(error)]
    if different:
        raise DamagedFileError(str(_damaged(path, different)))


def _damaged(path: str | os.PathLike, different: list[str]) -> ValueError:
    shown = ", ".join(different[:MOST_NAMED])
    if len(different) > MOST_NAMED:
        shown += f" and {len(different) - MOST_NAMED} more"
    came = Words(f"content that differs from its digest: {shown}")
    remedy = (
        "The file is damaged: restore it or run again. If it was edited on purpose, delete its"
        f" attribute {DIGEST!r} before saving."
    )
    return checks.fail(str(path), came, "what save_rollouts wrote", remedy)


def _write_npz(path: str | os.PathLike, data: dict[str, xarray.Dataset]) -> None:
    arrays: dict[str, np.ndarray] = {}
    described: dict[str, Any] = {}
    for name, one in data.items():
        arrays |= {
            f"{name}.{label}": np.asarray(variable.values)
            for label, variable in one.variables.items()
        }
        variables = {}
        for label, variable in one.variables.items():
            variables[str(label)] = [
                list(variable.dims),
                {key: np.asarray(x).tolist() for key, x in variable.attrs.items()},
            ]
        described[name] = {
            "variables": variables,
            "coords": [str(c) for c in one.coords],
            "attrs": dict(one.attrs),
        }
    with open(path, "wb") as file:
        np.savez_compressed(
            file, allow_pickle=False, **{_ATTRIBUTES: np.array(json.dumps(described))}, **arrays
        )


def _read_npz(path: str | os.PathLike) -> dict[str, xarray.Dataset]:
    import xarray

    found = {}
    with np.load(path, allow_pickle=False) as arrays:
        for name, described in json.loads(str(arrays[_ATTRIBUTES])).items():
            variables = {
                label: (dims, arrays[f"{name}.{label}"], attrs)
                for label, (dims, attrs) in described["variables"].items()
            }
            coords = {label: variables.pop(label) for label in described["coords"]}
            found[name] = xarray.Dataset(variables, coords, described["attrs"])
    return found
