"""Converts runs to labelled data: an `xarray.Dataset` in memory, netCDF or npz on disk.

A Dataset has the dimensions `time` and `joint`, preceded by `run` for a batch.  Every variable has
a unit and a description.  Metrics are variables too.  The attributes contain what is needed to
repeat the run: the scenario as TOML (if a file can hold it; in a batch that of the first run), its
parameters as JSON, and the versions.  In a batch, a parameter that differs between runs is a
variable named by its path.

One file holds several named runs, which may differ in length, joints and states.  Every variable
and dimension is therefore stored as `<name>.<variable>`.  netCDF is version 3, written by SciPy.
`load_datasets` returns one Dataset per name, and `load_rollouts` makes the runs of them again.

netCDF 3 has no checksum.  The attribute `digest` of the file holds a digest of each variable
(`files.digest`), which `load_datasets` compares with the data that it reads.  The Datasets that it
returns do not have the attribute, which would become stale in them.  NumPy's format has its own
checksum.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes
from iblf_jax.core.pytree import astype, is_absent
from iblf_jax.core.status import Status, describe
from iblf_jax.files import digest, earlier
from iblf_jax.files.earlier import LEVEL_SIGNALS
from iblf_jax.files.scenario import from_dict, scenario_to_toml
from iblf_jax.files.values import Words, toml_tables
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.paths import full_path, parameters, with_parameters
from iblf_jax.simulation.results import Metrics, Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import FIELDS, SIGNALS, dimension_names
from iblf_jax.simulation.units import signal_meanings, signal_unit, status_words
from iblf_jax.world import plants

if TYPE_CHECKING:
    import xarray

STATES = {
    "controller_state": "state of the law, in its own unit",
    "observer_state": "state of the observer, in its own unit",
    "actuator_state": "state of the actuator, in its own unit",
    "measured": "last measurement of the sensor, positions [rad] and velocities [rad/s]",
}
"""Field of a recorded state -> description."""

METRIC = "metric "
"""Beginning of the description of a metric."""

ENDINGS = (".nc", ".npz")
ONE_RUN = "run"
"""The name of a run that is saved without one."""
_ATTRIBUTES = "attributes"
ARRAY_OF_ATTRIBUTES = f"{_ATTRIBUTES}.npy"
"""File in the archive of ".npz" that only `save_rollouts` writes."""
DIGEST = "digest"
"""Attribute of a netCDF file that holds the digests of its content."""
MAX_NAMED = 4
"""Largest number of damaged variables that an error names."""


def rollout_to_xarray(run: Rollout) -> xarray.Dataset:
    """A Rollout as an `xarray.Dataset`.

    Args:
      run: one run, arrays (T, ...), or a batch, (B, T, ...).

    Returns:
      A Dataset with the dimensions time (T), joint (n), region if the scenario has regions, and run
      (B) first for a batch; for plants in strict-feedback form level (r), higher_level (r - 2, the
      levels from the third on) and model_level (the levels of the model).  Its variables are the
      Rollout's fields and metrics, each with `units` and `description`.  A metric with the name of
      another variable is called `metric_<name>`.

    Raises:
      ValueError: not a Rollout, or a traced one.
    """
    import xarray

    if not isinstance(run, Rollout):
        raise checks.fail("run", run, "a Rollout", "ij.simulate returns one.")
    if not checks.is_concrete(run):
        remedy = "Call this outside of jit, vmap and grad."
        raise checks.fail("run", run, "a Rollout that holds numbers", remedy)
    batch = tuple(f"run_{i}" for i in range(np.ndim(run.status)))
    if len(batch) == 1:
        batch = ("run",)
    variables = _trajectories(run, batch)
    for name, value in run.metrics.items():
        dims = (*batch, *dimension_names(name, np.shape(value)[len(batch) :], run.n))
        label = f"metric_{name}" if name in variables else name
        unit = run.metrics.units.get(name, "1")
        attrs = _attrs(unit, f"{METRIC}{name.replace('_', ' ')}")
        variables[label] = (dims, np.asarray(value), attrs)
    variables |= _status_variables(run, batch)
    varying, attrs = _parameters(run, batch)
    coordinates = _components_and_levels(run, variables)
    if len(batch) == 1:
        coordinates["run"] = _index("run", len(run))
    coordinates["time"], more = _time(run, batch)
    return xarray.Dataset(variables | varying | more, coordinates, attrs)


def save_rollouts(runs: Mapping[str, Rollout] | Rollout, path: str | os.PathLike) -> None:
    """Writes runs to one file.

    Args:
      runs: runs by name (letters, digits, "_", "-" and blanks), or one Rollout, which gets the name
        "run".
      path: the file; its ending selects the format, ".nc" for netCDF or ".npz" for NumPy.

    Raises:
      ValueError: another ending, no runs, an invalid name, or an object that is not a Rollout.
      OSError: the file cannot be written.
    """
    if isinstance(path, Mapping | Rollout):
        remedy = "The order is save_rollouts(runs, path)."
        raise checks.fail("path", Words(type(path).__name__), "a path, after the runs", remedy)
    ending = _ending(checks.file_to_write("path", path, "a file that ends in .nc or .npz"))
    runs = {ONE_RUN: runs} if isinstance(runs, Rollout) else runs
    if not isinstance(runs, Mapping) or not runs:
        raise checks.fail("runs", runs, "a Rollout, or a dict of at least one Rollout by name")
    for name in runs:
        is_text = isinstance(name, str) and name != _ATTRIBUTES
        if not is_text or not re.fullmatch(r"[A-Za-z0-9_][\w -]*", name, re.ASCII):
            expected = 'letters, digits, "_", "-" and blanks'
            raise checks.fail("name of a run", name, expected, "Choose another key.")
    data = {name: rollout_to_xarray(run) for name, run in runs.items()}
    write = {".nc": _write_netcdf, ".npz": _write_npz}[ending]
    write(path, data)


def load_rollouts(path: str | os.PathLike, *, modules: Mapping[str, Any] | None = None) -> Any:
    """The runs of a file that `save_rollouts` wrote.

    Args:
      path: a ".nc" or ".npz" file.
      modules: modules that the file cannot describe, as `load_scenario` takes them.

    Returns:
      The Rollout if one was saved, otherwise a dict of Rollouts by name.  A run whose file has no
      scenario, because no file can hold it or because an earlier version saved many runs, is an
      `xarray.Dataset` in place of the Rollout.

    Raises:
      ValueError, OSError: as `load_datasets`.
    """
    found = load_datasets(path)
    try:
        runs = {name: _rollout_of(data, name, modules) for name, data in found.items()}
    except ValueError as error:
        raise checks.with_location(path, error) from error
    return runs[ONE_RUN] if list(runs) == [ONE_RUN] else runs


def load_datasets(path: str | os.PathLike) -> dict[str, xarray.Dataset]:
    """The runs of a file that `save_rollouts` wrote, as Datasets by name.

    Args:
      path: a ".nc" or ".npz" file.

    Raises:
      ValueError: another ending, a file that `save_rollouts` did not write, or a file that was
        damaged or changed since.
      OSError: the file cannot be read.
    """
    place = checks.file_path("path", path, "a file that ends in .nc or .npz")
    read = {".nc": _read_netcdf, ".npz": _read_npz}[_ending(place)]
    # A file that cannot be opened raises OSError here; the readers would raise other errors.
    with open(checks.file_to_read("path", place), "rb"):
        pass
    try:
        return read(place)
    except DamagedFileError:
        raise
    except Exception as error:
        came, expected = type(error).__name__, "a file written by save_rollouts"
        raise checks.fail(str(place), came, expected, str(error)) from error


class DamagedFileError(ValueError):
    """The content of a file differs from its digest."""


# --- from the Dataset


@jax.enable_x64(True)
def _rollout_of(
    data: xarray.Dataset, name: str, modules: Mapping[str, Any] | None
) -> Rollout | xarray.Dataset:
    """The run of a Dataset; the Dataset itself where it has no scenario."""
    if "scenario" not in data.attrs:
        return data
    batch = tuple(str(dim) for dim in data["status"].dims)
    try:
        scenario = _scenario_of(data, batch, modules)
        start = jax.eval_shape(initial_state, _first(scenario, data["status"].shape))
        states = {
            "controller_state": start.controller,
            "observer_state": start.observer,
            "actuator_state": start.actuator,
            "measured": start.sampled.received if scenario.sampling is not None else (),
        }
        arrays = {str(name): variable.values for name, variable in data.data_vars.items()}
        levels = {name: jnp.asarray(earlier.levels(arrays, name)) for name in LEVEL_SIGNALS}
        signals = {
            signal: jnp.asarray(data[signal].values)
            for signal in FIELDS
            if signal in data and signal not in ("t", *levels)
        }
        times = data["t" if "t" in data.data_vars else "time"].values
        return Rollout(
            **signals,
            **levels,
            t=jnp.asarray(np.broadcast_to(times, (*data["status"].shape, times.shape[-1]))),
            **{state: _state_of(data, state, tree) for state, tree in states.items()},
            scenario=scenario,
            metrics=_metrics_of(data),
            **{key: jnp.asarray(data[key].values) for key in ("status", "fastest_mode", "dt")},
            method=str(data.attrs["method"]),
            steps=int(data.attrs["steps"]) if "steps" in data.attrs else None,
        )
    except Exception as error:  # A missing or wrong entry raises errors of many kinds.
        found = f"{type(error).__name__}: {error}"
        raise checks.fail(name, Words("data that give no run"), "a run", found) from error


def _first(scenario: Scenario, batch: tuple[int, ...]) -> Scenario:
    """The scenario of the first run."""
    if np.ndim(scenario.initial.q) == 1:
        return scenario
    return jax.tree.map(lambda x: x[(0,) * len(batch)], scenario)


def _scenario_of(
    data: xarray.Dataset, batch: tuple[str, ...], modules: Mapping[str, Any] | None
) -> Scenario:
    """The scenario of a run; of many, with the leaves that differ between them."""
    tables = toml_tables(str(data.attrs["scenario"]))
    scenario = astype(from_dict(tables, modules=modules).scenario, data["q"].dtype)
    if not batch:
        return scenario
    known = {p.path for p in parameters(scenario, named=False)}
    given = {
        str(name): jnp.asarray(variable.values)
        for name, variable in data.data_vars.items()
        if full_path(str(name)) in known
    }
    if not given:
        return scenario
    make = partial(with_parameters, scenario)
    for _ in batch:
        make = jax.vmap(make)
    return make(given)


def _state_of(data: xarray.Dataset, state: str, tree: Any) -> Any:
    """A recorded state with the structure of `tree`; `()` where none was recorded."""
    names = [_state_name(state, keys) for keys, _ in jax.tree_util.tree_leaves_with_path(tree)]
    if not names or names[0] not in data:
        return ()
    arrays = [jnp.asarray(data[name].values) for name in names]
    return jax.tree.unflatten(jax.tree.structure(tree), arrays)


def _metrics_of(data: xarray.Dataset) -> Metrics:
    """The variables that are metrics."""
    found, units = {}, {}
    for label, variable in data.data_vars.items():
        text = str(variable.attrs.get("description", ""))
        if text.startswith(METRIC):
            name = str(label).removeprefix("metric_")
            found[name] = jnp.asarray(variable.values)
            units[name] = str(variable.attrs["units"])
    if "metrics" not in data.attrs:  # Earlier versions did not store the order.
        return Metrics(found, tuple(units.items()))
    order = json.loads(str(data.attrs["metrics"]))
    pairs = tuple((name, units.get(name, unit)) for name, unit in order["units"])
    return Metrics({name: found[name] for name in order["names"]}, pairs)


# --- the Dataset


def _attrs(units: str, description: str) -> dict[str, str]:
    return {"units": units, "description": description}


def _index(name: str, size: int) -> tuple[str, np.ndarray, dict[str, str]]:
    """The coordinate of a dimension that is numbered from 0."""
    return name, np.arange(size, dtype=np.int32), _attrs("1", f"{name}, from 0")


def _components_and_levels(run: Rollout, variables: Mapping[str, Any]) -> dict[str, Any]:
    """The coordinates of the components, and of the levels that the plant's notation lists."""
    plant = run.scenario.loop.plant
    found: dict[str, Any] = {"joint": _index("joint", run.n)}
    levels = plant.notation.levels
    if not levels:
        return found
    names = ", ".join(plants.component_names(plant))
    found["joint"][2]["description"] = f"component of a level, from 0: {names}"
    sizes: dict[str, int] = {}
    for dims, values, *_ in variables.values():
        sizes |= dict(zip(dims, np.shape(values), strict=True))
    for dimension, first in (("level", 1), ("model_level", 1), ("higher_level", 3)):
        if dimension in sizes:
            last = first + sizes[dimension]
            numbers = np.arange(first, last, dtype=np.int32)
            text = f"level of the plant, from {first}: {', '.join(levels[first - 1 : last - 1])}"
            found[dimension] = (dimension, numbers, _attrs("1", text))
    return found


def _trajectories(run: Rollout, batch: tuple[str, ...]) -> dict[str, Any]:
    """Variables of the signals and of the states of law, observer, actuator and sensor."""
    variables = {}

    def add(name: str, value: ArrayLike, unit: str, description: str) -> None:
        dims = (*batch, "time", *dimension_names(name, np.shape(value)[len(batch) + 1 :], run.n))
        variables[name] = (dims, np.asarray(value), _attrs(unit, description))

    meanings = signal_meanings(run.scenario)
    for name, value in attributes(run, SIGNALS).items():
        # The views show all rows of the signals of a robot.
        is_shown = name in LEVEL_SIGNALS and np.shape(value)[-2] <= len(LEVEL_SIGNALS[name])
        if name != "t" and not is_absent(value) and not is_shown:
            missing = SIGNALS[name].missing
            if missing is not None:
                rows = value
                value = np.full_like(run.x, missing)
                value[..., : np.shape(rows)[-2], :] = rows
            add(name, value, signal_unit(run.scenario, name), meanings[name])
    for state, tree in attributes(run, STATES).items():
        for keys, value in jax.tree_util.tree_leaves_with_path(tree):
            add(_state_name(state, keys), value, "1", STATES[state])
    return variables


def _state_name(state: str, keys: tuple[Any, ...]) -> str:
    """The variable of one array of a recorded state."""
    return re.sub(r"\W+", "_", state + jax.tree_util.keystr(keys)).strip("_")


def _status_variables(run: Rollout, batch: tuple[str, ...]) -> dict[str, Any]:
    """Variables of the status, the fastest mode and the time step."""
    flags = [flag for flag in Status if flag]
    status = np.asarray(run.status)
    attrs: dict[str, Any] = _attrs("1", "bit flags; 0 is ok")
    attrs["flag_masks"] = np.array([int(f) for f in flags], np.int32)
    attrs["flag_meanings"] = " ".join(f.name.lower() for f in flags if f.name)
    texts = status_words(run.scenario)
    described = {value: describe(value, texts) for value in np.unique(status).tolist()}
    words = np.vectorize(described.get, otypes=[str])(status)
    fastest = _attrs("1/s", "largest measured mode of the closed loop")
    return {
        "status": (batch, status.astype(np.int32), attrs),
        "status_words": (batch, words, _attrs("1", "status in words")),
        "fastest_mode": (batch, np.asarray(run.fastest_mode), fastest),
        "dt": (batch, np.asarray(run.dt), _attrs("s", "time step")),
    }


def _time(run: Rollout, batch: tuple[str, ...]) -> tuple[Any, dict[str, Any]]:
    """The time coordinate; if the times differ between the runs of a batch, sample numbers and a
    variable `t` (run, time).
    """
    t = np.asarray(run.t)
    first = t.reshape(-1, t.shape[-1])[0]
    if np.all(t == first):
        return ("time", first, _attrs("s", "time")), {}
    samples = np.arange(t.shape[-1], dtype=np.int32)
    coordinate = ("time", samples, _attrs("1", "sample, from 0; the time is t"))
    return coordinate, {"t": ((*batch, "time"), t, _attrs("s", "time"))}


def _parameters(run: Rollout, batch: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Variables for the parameters that differ between the runs of a batch, and attributes."""
    fixed: dict[str, Any] = {}
    varying: dict[str, Any] = {}
    is_batched = np.ndim(run.scenario.initial.q) > 1
    for p in parameters(run.scenario, named=False):
        value = np.asarray(p.value)
        first = value[(0,) * len(batch)] if is_batched else value
        if np.all(value == first):
            fixed[p.path] = first.tolist()
        else:
            dims = (*batch, *dimension_names(p.path, first.shape, run.n))
            varying[p.path] = (dims, value, _attrs(p.unit or "1", f"parameter {p.path}"))
    attrs: dict[str, Any] = {
        "parameters": json.dumps(fixed),
        "method": run.method,
        "metrics": json.dumps({"names": list(run.metrics), "units": run.metrics.unit_pairs}),
        "iblf_jax_version": version("iblf_jax"),
        "jax_version": jax.__version__,
    }
    if run.steps is not None:
        attrs["steps"] = run.steps
    if not batch:
        attrs["status"] = describe(int(run.status), status_words(run.scenario))
    try:
        attrs["scenario"] = scenario_to_toml(_first(run.scenario, np.shape(run.status)))
    except ValueError as error:
        attrs["scenario_not_saved"] = str(error)
    return varying, attrs


# --- files


def _ending(path: Path) -> str:
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise checks.fail("path", str(path), "a file that ends in .nc (netCDF) or .npz (NumPy)")
    return ending


def _write_netcdf(path: str | os.PathLike, data: dict[str, xarray.Dataset]) -> None:
    import xarray

    attrs: dict[str, Any] = {"names": json.dumps(list(data))}
    digests = {name: digest.dataset_digests(one) for name, one in data.items()}
    attrs[DIGEST] = digest.encoded(digests)
    renamed = []
    for name, one in data.items():
        attrs |= {f"{name}.{key}": value for key, value in one.attrs.items()}
        labels = {label: f"{name}.{label}" for label in (*one.variables, *one.dims)}
        renamed.append(one.drop_attrs(deep=False).rename(labels))
    merged = xarray.merge(renamed).assign_attrs(attrs)
    merged.to_netcdf(path, engine="scipy")


def _read_netcdf(path: str | os.PathLike) -> dict[str, xarray.Dataset]:
    import xarray

    merged = xarray.load_dataset(path, engine="scipy")
    found = {}
    for name in json.loads(merged.attrs["names"]):
        prefix = f"{name}."
        one = merged[[label for label in merged.variables if str(label).startswith(prefix)]]
        labels = {label: str(label).removeprefix(prefix) for label in (*one.variables, *one.dims)}
        attrs: dict[str, Any] = {
            key.removeprefix(prefix): value
            for key, value in merged.attrs.items()
            if key.startswith(prefix)
        }
        found[name] = one.rename(labels).drop_attrs(deep=False).assign_attrs(attrs)
    _verify(path, merged.attrs, found)
    return found


def _verify(
    path: str | os.PathLike,
    attrs: Mapping[str, Any],
    found: Mapping[str, xarray.Dataset],
) -> None:
    """Raises DamagedFileError for Datasets that differ from the digest of the file.

    Files of older versions have no digest and are accepted.
    """
    stored = digest.stored_in(attrs, DIGEST)
    if stored is None:
        return
    try:
        different = digest.differences(stored, found)
    except ValueError as error:
        different = [str(error)]
    if not different:
        return
    shown = ", ".join(different[:MAX_NAMED])
    if len(different) > MAX_NAMED:
        shown += f" and {len(different) - MAX_NAMED} more"
    came = Words(f"content that differs from its digest: {shown}")
    remedy = (
        "The file is damaged: restore it or run again. If it was edited on purpose, delete its"
        f" attribute {DIGEST!r} before saving."
    )
    text = str(checks.fail(str(path), came, "what save_rollouts wrote", remedy))
    raise DamagedFileError(text)


def _write_npz(path: str | os.PathLike, data: dict[str, xarray.Dataset]) -> None:
    arrays: dict[str, np.ndarray] = {}
    described: dict[str, Any] = {}
    for name, one in data.items():
        variables = {}
        for label, variable in one.variables.items():
            arrays[f"{name}.{label}"] = np.asarray(variable.values)
            attrs: dict[str, Any] = {
                key: np.asarray(x).tolist() for key, x in variable.attrs.items()
            }
            variables[str(label)] = [list(variable.dims), attrs]
        coordinates = [str(label) for label in one.coords]
        described[name] = {"variables": variables, "coords": coordinates, "attrs": dict(one.attrs)}
    arrays[_ATTRIBUTES] = np.array(json.dumps(described))
    with open(path, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _read_npz(path: str | os.PathLike) -> dict[str, xarray.Dataset]:
    import xarray

    found = {}
    with np.load(path, allow_pickle=False) as arrays:
        for name, described in json.loads(str(arrays[_ATTRIBUTES])).items():
            variables = {}
            for label, (dims, attrs) in described["variables"].items():
                variables[label] = (dims, arrays[f"{name}.{label}"], attrs)
            coords = {label: variables.pop(label) for label in described["coords"]}
            found[name] = xarray.Dataset(variables, coords, described["attrs"])
    return found
