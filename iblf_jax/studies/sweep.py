"""Sweeps: a scenario over many values of its parameters, with perturbed runs at each, into an
`xarray.Dataset`.

Cases are numbered, case = point * runs + run, and run r draws the same at every point (common
random numbers), so that points differ by what was swept and not by luck.  With a store the cases
are computed and written unit by unit (`store`), and a sweep that was killed goes on where it was.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import bar
from iblf_jax.engine import STUDY_MEMORY, sweep_unit, whole_blocks
from iblf_jax.simulation.accuracy import RELATIVE
from iblf_jax.simulation.metrics import Fold, metric_units
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.simulation.signals import own_dims
from iblf_jax.studies import config as configuration
from iblf_jax.studies import distributed
from iblf_jax.studies.blocks import Results, block_size, checked_how, run_blocks
from iblf_jax.studies.dataset import DRAWN, to_dataset
from iblf_jax.studies.designs import MOST_RUNS, check_sampler
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.interrupt import Interrupted, StopRequest
from iblf_jax.studies.points import make_points
from iblf_jax.studies.recommended import tell_of_step
from iblf_jax.studies.setup import StudySetup, prepare
from iblf_jax.studies.store import Store, StoreError, Variable, load_store, open_store

if TYPE_CHECKING:
    import xarray


class _How(NamedTuple):
    """How a sweep is carried out; none of it changes a number."""

    where: dict[str, Any]
    """For `run_blocks`."""
    progress: bool | None


@notices.each_warning_once
def sweep(
    scenario: Scenario,
    grid: Mapping[str, Any],
    *,
    duration: float,
    dt: float = 1e-3,
    perturbations: Mapping[str, Perturbation] | None = None,
    runs: int = 1,
    seed: int = 0,
    design: str = "grid",
    points: int | None = None,
    method: str = "rk4",
    metrics: Sequence[Fold] | None = None,
    sampler: str = "independent",
    replicates: int = 1,
    store: str | os.PathLike | None = None,
    unit: int | None = None,
    backend: str = "auto",
    chunk: int | None = None,
    memory: float = STUDY_MEMORY,
    devices: Sequence[jax.Device] | None = None,
    progress: bool | None = None,
) -> xarray.Dataset:
    """Runs a scenario over many values of its parameters, with perturbed runs at each.

        case = point * runs + run;   leaf = perturbation(value at the point, F^-1(u)),   u from
        seed, run and path only

    Results are bit-identical whatever `chunk`, `unit`, the devices, the processes, and however
    often it was killed and started again.

    Args:
      scenario: what to run, of n joints.
      grid: path -> values for a grid: numbers, or arrays for a vector leaf; a number fills every
        entry.  Path -> distribution (or `factor`, `offset` of one) for the other designs.  Empty
        for one point, the scenario itself, with perturbed runs.
      duration: length of a run [s], a whole number of steps.
      dt: time step [s].
      perturbations: path -> `factor`, `offset` or `value` of a distribution, around the values of
        each point.
      runs: perturbed runs at each point.
      seed: whole number that fixes all draws.
      design: "grid", "random" or "latin_hypercube".
      points: number of points of a random or Latin-hypercube design.
      method: "rk4", "heun" or "euler".
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      sampler: of the runs: "independent", "latin_hypercube" or "sobol".
      replicates: number of independent designs that a designed sampler is made of.
      store: folder to write to, unit by unit, and to go on from; needs the extra `sweep`.
      unit: cases that are written together; chosen if not given.
      backend: "auto", "native", "gpu", "xla" or "vmap".
      chunk: cases in flight on the devices at a time; from `memory` if not given.
      memory: bytes that cases in flight may take.
      devices: devices to use; all of this process if not given.
      progress: a progress bar; shown where somebody watches if not given.

    Returns:
      An `xarray.Dataset` of the metrics and `status`, with one dimension for each path of a grid
      (or "point"), then `run` if there are perturbations, then `joint`; the configuration, seed and
      versions are in its attributes.  `started_outside` tells runs that violated a bound at t = 0
      already, which no law could keep, from violations of the law; it is there if
      `first_violation_time` is.

    Raises:
      ValueError: bad arguments; the message names the field, the value and the remedy.
      StoreError: a store of another configuration, a foreign or unwritable one, a full disk.  What
        was written stays valid.
      Interrupted: Ctrl-C or SIGTERM with a store, after the unit at hand; the message says how to
        go on.

    Source: design of this package.
    """
    how = _How(
        checked_how(chunk, memory, devices), checks.flag("progress", progress, optional=True)
    )
    runs, perturbations = (
        checks.positive_integer("runs", runs, most=MOST_RUNS),
        ({} if perturbations is None else perturbations),
    )
    replicates = check_sampler(sampler, runs, replicates)
    checks.mapping(
        "perturbations", perturbations, '{"plant.mass[1]": ij.factor(ij.uniform(0.7, 1.3))}'
    )
    if not perturbations and runs > 1:
        raise checks.fail(
            "runs", runs, "1 without perturbations", "Without any all runs at a point are the same."
        )
    if not perturbations and isinstance(grid, Mapping) and not grid:
        raise checks.fail(
            "grid", grid, "something to vary", "Give a grid or perturbations, or use ij.simulate."
        )
    unit = None if unit is None else checks.positive_integer("unit", unit, most=checks.MOST_STEPS)
    store = None if store is None else checks.file_path("store", store, "a folder")
    where = make_points(canonical(scenario), grid, design, points, checks.seed(seed))
    options: dict[str, Any] = {
        "metrics": metrics,
        "backend": backend,
        "sampler": sampler,
        "replicates": replicates,
        "points": where.values,
    }
    setup = prepare(
        scenario, perturbations, runs, seed, duration=duration, dt=dt, method=method, **options
    )
    checks.fits("runs at all points", setup.cases, setup.bytes_a_case)
    config = configuration.describe(setup, where, design, float(dt))
    result = (
        _in_memory(setup, config, how)
        if store is None
        else _into_store(setup, config, how, store, unit)
    )
    status, modes, errors = (
        np.ravel(result[name]) for name in ("status", "fastest_mode", RELATIVE)
    )
    tell_of_step(status, modes, errors, float(dt), method)
    return result


@checks.renamed(store="path")
def load_sweep(path: str | os.PathLike) -> xarray.Dataset:
    """The data of a store, complete or not.

    Args:
      path: folder that `sweep` writes to, its `store`.

    Returns:
      The Dataset that `sweep` returns; where nothing has been computed yet, NaN and status -1.  Its
      attributes `computed_cases` and `cases` say how far it is.

    Raises:
      ValueError: something that is not a path.
      StoreError: no store, a foreign or a damaged one.
    """
    opened = load_store(checks.file_path("path", path, "a folder"))
    try:
        return _dataset(opened)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, MemoryError) as error:
        raise StoreError(
            f"{path}: is damaged: its configuration is wrong ({type(error).__name__}). Choose"
            " another store."
        ) from error


def _dataset(store: Store) -> xarray.Dataset:
    data, done = store.read_all()
    return to_dataset(store.config, data, {name: store.units_of(name) for name in data}, done)


def _flat(results: Results) -> dict[str, Any]:
    drawn = {DRAWN + path: x for path, x in results.samples.items()}
    return {
        **results.metrics,
        "status": results.status,
        "fastest_mode": results.fastest_mode,
        **drawn,
    }


def _variables(setup: StudySetup, config: dict[str, Any]) -> dict[str, Variable]:
    """The arrays of a sweep."""
    shapes = _flat(setup.shapes)
    units = dict(metric_units(setup.shared.folds))
    units |= {"status": "1", "fastest_mode": "1/s"} | {
        DRAWN + path: p["unit"] for path, p in config["perturbed"].items()
    }
    shapes = {name: shapes[name] for name in {n: None for n in units if n in shapes} | shapes}
    return {
        name: Variable(
            x.shape[1:],
            str(x.dtype),
            own_dims(name.removeprefix(DRAWN), x.shape[1:], config["joints"]),
            units.get(name, ""),
        )
        for name, x in shapes.items()
    }


def _in_memory(setup: StudySetup, config: dict[str, Any], how: _How) -> xarray.Dataset:
    if distributed.size() > 1:
        raise checks.fail(
            "store",
            None,
            "a store, in a job of several processes",
            "They meet there: store='sweep.zarr' on a shared disk.",
        )
    variables = _variables(setup, config)
    data = {name: np.zeros((setup.cases, *v.shape), v.dtype) for name, v in variables.items()}
    with bar(how.progress, setup.cases) as shown:
        for part, cases in _units(setup, [0], setup.cases, how, shown):
            for name, values in part.items():
                data[name][cases] = values
    return to_dataset(
        config, data, {name: v.unit for name, v in variables.items()}, np.ones(setup.cases, bool)
    )


def _units(
    setup: StudySetup, units: Sequence[int], unit: int, how: _How, shown: Any
) -> Iterator[tuple[dict[str, np.ndarray], slice]]:
    """Computes units and yields their data and cases, in order; in pieces, if a unit is all there
    is.
    """
    size = block_size()
    spans = [slice(u * unit, min((u + 1) * unit, setup.cases)) for u in units]
    blocks = [block for span in spans for block in range(span.start // size, -(-span.stop // size))]
    pieces: list[dict[str, np.ndarray]] = []
    waiting = iter(spans)
    span = next(waiting, None)
    for block, results in run_blocks(
        setup.study_run, setup.shared, setup.lanes, blocks, **how.where
    ):
        assert span is not None
        here = min(size, span.stop - block * size)
        pieces.append({name: x[:here] for name, x in _flat(results).items()})
        shown.update(here)
        if block * size + here == span.stop:
            yield {name: np.concatenate([p[name] for p in pieces]) for name in pieces[0]}, span
            pieces, span = [], next(waiting, None)


def _chosen_unit(setup: StudySetup, unit: int | None) -> int:
    """Cases in a unit: whole blocks, or all there is."""
    if unit is None:
        return sweep_unit(setup.cases, setup.study_run.steps)
    return whole_blocks(setup.cases, unit)


def _into_store(
    setup: StudySetup, config: dict[str, Any], how: _How, path: str | os.PathLike, unit: int | None
) -> xarray.Dataset:
    store = open_store(
        path,
        config,
        _variables(setup, config),
        setup.cases,
        _chosen_unit(setup, unit),
        any_unit=unit is None,
    )
    size = store.unit
    pending, damaged = store.pending()
    if damaged:
        notices.warn(
            f"{path}: {len(damaged)} units are damaged (their data do not fit their checksums) and"
            f" are computed again: {damaged[:10]}."
        )
    mine = distributed.share(pending)
    done, longest, begin = 0, 0.0, time.monotonic()
    with (
        StopRequest() as stop,
        bar(
            how.progress, setup.cases, setup.cases - sum(_length(store, u) for u in pending)
        ) as shown,
    ):
        for data, span in _units(setup, mine, size, how, shown):
            store.write(span.start // size, data)
            done, longest, begin = (
                done + 1,
                max(longest, time.monotonic() - begin),
                time.monotonic(),
            )
            if stop.asked and done < len(mine):
                raise _interrupted(store)

        def progress() -> int:
            found = int(store.marks().sum())
            if stop.asked and found < store.units:
                raise _interrupted(store)
            return found

        if distributed.size() > 1:
            distributed.wait_for(progress, store.units, longest, str(path))
    return _dataset(store)


def _length(store: Store, unit: int) -> int:
    span = store.span(unit)
    return span.stop - span.start


def _interrupted(store: Store) -> Interrupted:
    marks = store.marks()
    return Interrupted(
        f"Stopped after {int(marks.sum())} of {store.units} units, which are written to"
        f" {store.path}. Start the same call or command again to go on from there."
    )


__all__ = ["Interrupted", "StoreError", "load_sweep", "sweep"]
