"""Sweeps: a scenario over many values of its parameters, with perturbed runs at each, into an
`xarray.Dataset`.

Cases are numbered, case = point * runs + run, and run r draws the same at every point (common
random numbers), so that points differ by their parameters and not by chance.  With a store the
cases are computed and written unit by unit (`store`), and a sweep that was killed is resumed.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from typing import Any

import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.first_use import xarray
from iblf_jax.core.progress import announced, bar
from iblf_jax.engine import cases_per_unit, takes_runs, whole_blocks
from iblf_jax.simulation.error_growth import errors_by_step
from iblf_jax.simulation.metrics import Fold, metric_units
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.simulation.signals import dimension_names
from iblf_jax.simulation.stability import RADIUS
from iblf_jax.studies import store_config
from iblf_jax.studies.blocks import case_bytes, named_arrays, result_shapes
from iblf_jax.studies.dataset import DRAWN, to_dataset
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.execution import run_all_cases, run_spans
from iblf_jax.studies.interrupt import Interrupted, StopRequest
from iblf_jax.studies.options import (
    Design,
    LocalExecutor,
    RunOptions,
    StoreOptions,
    design_of,
    executor_of,
    store_of,
)
from iblf_jax.studies.store import Store, StoreError, Variable, load_store, open_store
from iblf_jax.studies.study_setup import PreparedStudy, prepare
from iblf_jax.studies.sweep_points import make_points
from iblf_jax.studies.time_step import warn_of_sampling, warn_of_step


@notices.each_warning_once
@checks.known_keywords
@announced("compiling the program of a sweep")
@takes_runs
def sweep(
    scenario: Scenario,
    grid: Mapping[str, Any],
    *,
    duration: float,
    dt: float = 1e-3,
    perturbations: Mapping[str, Perturbation] | None = None,
    runs: int = 1,
    seed: int = 0,
    design: str | Design = "grid",
    method: str = "rk4",
    metrics: Sequence[Fold] | None = None,
    sampler: str = "independent",
    replicates: int = 1,
    store: str | os.PathLike | StoreOptions | None = None,
    backend: str = "auto",
    executor: LocalExecutor | Executor | None = None,
    progress: bool | None = None,
) -> xarray.Dataset:
    """Runs a scenario over many values of its parameters, with perturbed runs at each.

        case = point * runs + run,   leaf = perturbation(value at the point, F^-1(u)),
        u from seed, run and path only

    Results are bit-identical whatever the executor, the devices and the units, and however often
    the sweep was killed and started again.

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
      design: "grid", or `ij.studies.Design("random", points=100)` or "latin_hypercube".
      method: "rk4", "heun" or "euler".
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      sampler: of the runs: "independent", "latin_hypercube" or "sobol".
      replicates: number of independent designs that a designed sampler is made of.
      store: folder to write to, unit by unit, and to resume from; or an `ij.studies.StoreOptions`
        with the size of a unit, who writes it, and whether several processes share the store.  It
        needs the extra `sweep`.
      backend: "auto", "native", "gpu" or "vmap".
      executor: where the cases are computed: any `concurrent.futures.Executor`, such as a Dask
        client's `get_executor()` or a process pool; or an `ij.studies.LocalExecutor` with devices
        and a limit of memory.  None for this process and all its devices.
      progress: a progress bar; by default it is shown on a terminal.
      runs_as: an `ij.Runs`, in place of its fields.

    Returns:
      An `xarray.Dataset` of the metrics and `status`, with one dimension for each path of a grid
      (or "point"), then `run` if there are perturbations, then `joint`; the configuration, seed and
      versions are in its attributes.  `started_outside` marks runs that violated a bound at
      t = 0, which no law could prevent; it is there if `first_violation_time` is.

    Raises:
      ValueError: bad arguments; the message names the field, the value and the remedy.
      StoreError: a store of another configuration or origin, one that cannot be written, a full
        disk.  What was written stays valid.
      Interrupted: Ctrl-C or SIGTERM with a store, after the present unit; the message says how to
        resume.
      ij.studies.WorkerError: a worker of the executor was lost, or has other versions or settings
        than this process.

    Source: design of this package.
    """
    executor = executor_of(executor)
    store_options = store_of(store)
    design = design_of(design)
    progress = checks.boolean("progress", progress, optional=True)
    if perturbations is None:
        perturbations = {}
    options = RunOptions(
        duration, dt, method, backend, seed, runs=runs, sampler=sampler, replicates=replicates
    )
    example = '{"plant.mass[1]": ij.factor(ij.uniform(0.7, 1.3))}'
    checks.mapping("perturbations", perturbations, example)
    if not perturbations and options.runs > 1:
        remedy = "Without any all runs at a point are the same."
        raise checks.fail("runs", options.runs, "1 without perturbations", remedy)
    if not perturbations and isinstance(grid, Mapping) and not grid:
        remedy = "Give a grid or perturbations, or use ij.simulate."
        raise checks.fail("grid", grid, "something to vary", remedy)
    points = make_points(canonical(scenario), grid, design.kind, design.points, options.seed)
    prepared = prepare(scenario, perturbations, options, metrics, points.values)
    checks.fits_memory("runs at all points", prepared.cases, case_bytes(prepared))
    config = store_config.describe(prepared, points, design.kind)
    if store_options is None:
        with bar(progress, prepared.cases) as shown:
            arrays = named_arrays(run_all_cases(prepared, executor, shown.update))
        variables = _variables(prepared, config)
        data = {name: arrays[name] for name in variables}
        units = {name: variable.si_unit for name, variable in variables.items()}
        result = to_dataset(config, data, units, np.ones(prepared.cases, bool))
    else:
        result = _into_store(prepared, config, executor, progress, store_options)
    status, modes = (np.ravel(result[name]) for name in ("status", "fastest_mode"))
    errors = np.ravel(errors_by_step(result))
    warn_of_step(status, modes, errors, options.dt, method)
    radii = np.ravel(result[RADIUS]) if RADIUS in result else None
    warn_of_sampling(status, radii)
    return result


@checks.known_keywords
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
    return to_dataset(store.config, data, {name: store.si_unit(name) for name in data}, done)


def _variables(prepared: PreparedStudy, config: dict[str, Any]) -> dict[str, Variable]:
    """The arrays of a sweep; metrics first, in their own order."""
    shapes = named_arrays(result_shapes(prepared))
    units = dict(metric_units(prepared.shared.folds, prepared.scenario))
    units |= {"status": "1", "fastest_mode": "1/s"}
    units |= {DRAWN + path: p["unit"] for path, p in config["perturbed"].items()}
    ordered = [name for name in units if name in shapes]
    without_unit = [name for name in shapes if name not in units]
    variables = {}
    for name in ordered + without_unit:
        shape = shapes[name].shape[1:]
        dims = dimension_names(name.removeprefix(DRAWN), shape, config["joints"])
        variables[name] = Variable(shape, str(shapes[name].dtype), dims, units.get(name, ""))
    return variables


def _into_store(
    prepared: PreparedStudy,
    config: dict[str, Any],
    executor: LocalExecutor | Executor,
    progress: bool | None,
    options: StoreOptions,
) -> xarray.Dataset:
    cases = prepared.cases
    if options.unit is None:
        unit = cases_per_unit(cases, prepared.options.steps)
    else:
        unit = whole_blocks(cases, options.unit)
    variables = _variables(prepared, config)
    store = open_store(options.path, config, variables, cases, unit, any_unit=options.unit is None)
    pending, damaged = store.pending()
    if damaged:
        notices.warn(
            f"{options.path}: {len(damaged)} units are damaged (their data do not fit their"
            f" checksums) and are computed again: {damaged[:10]}."
        )
    cases_done = cases - sum(store.size(unit) for unit in pending)
    with StopRequest() as stop, bar(progress, cases, cases_done) as shown:
        spans = _spans(store, pending, set(damaged), options, shown.update)
        with closing(_results(prepared, spans, executor, store, options, shown.update)) as results:
            for span, computed in results:
                if computed is not None:
                    store.write(span.start // store.unit, named_arrays(computed))
                marks = store.marks() if stop.requested else None
                if marks is not None and not marks.all():
                    raise Interrupted(
                        f"Stopped after {marks.sum()} of {store.units} units, which are written to"
                        f" {store.path}. Start the same call or command again to resume."
                    )
    return _dataset(store)


def _results(
    prepared: PreparedStudy,
    spans: Iterator[slice],
    executor: LocalExecutor | Executor,
    store: Store,
    options: StoreOptions,
    advance: Callable[[int], None],
) -> Generator[tuple[slice, Any], None, None]:
    """Units with their results; None for those that a worker has written."""
    if isinstance(executor, LocalExecutor) or options.writer == "client":
        yield from run_spans(prepared, spans, executor, advance)
        return
    from iblf_jax.studies.workers import SharedStore, run_on_workers

    shared = SharedStore(os.path.abspath(store.path), store.config)
    for span, written in run_on_workers(prepared, spans, executor, shared):
        advance(span.stop - span.start)
        yield span, written


def _spans(
    store: Store,
    pending: Sequence[int],
    damaged: set[int],
    options: StoreOptions,
    advance: Callable[[int], None],
) -> Iterator[slice]:
    """The cases of the units that are to be computed.

    Processes that share a store take the units in random orders, so that they rarely meet, and skip
    those that another process has written meanwhile.  Where two of them do compute the same unit,
    they write the same bytes.
    """
    units = list(pending)
    if options.shared:
        random.SystemRandom().shuffle(units)
    for unit in units:
        if options.shared and unit not in damaged and store.marks()[unit]:
            advance(store.size(unit))
        else:
            yield store.span(unit)


__all__ = ["Interrupted", "StoreError", "load_sweep", "sweep"]
