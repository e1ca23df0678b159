"""Options of studies as objects: what is run, where runs are computed, how a store is written, and
what a sweep samples.

`RunOptions` are the arguments that all studies share; the others change no number of a result.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from concurrent.futures import Executor

import jax

from iblf_jax.core import checks
from iblf_jax.engine import STUDY_MEMORY, Runs
from iblf_jax.studies.designs import MAX_RUNS, check_sampler

MAX_MEMORY = 2.0**60
"""Largest accepted `memory` [bytes]."""
WRITERS = ("client", "worker")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions(Runs):
    """The arguments that `monte_carlo`, `sweep`, `sensitivity` and `recommended_dt` share, with
    valid values; ValueError names an invalid one.
    """

    runs: int
    """Runs at each point."""
    sampler: str = "independent"
    replicates: int = 1
    """Designs that the runs are made of."""

    def __post_init__(self) -> None:
        runs = checks.positive_integer("runs", self.runs, most=MAX_RUNS)
        super().__post_init__()
        vars(self).update(runs=runs, replicates=check_sampler(self.sampler, runs, self.replicates))


@dataclasses.dataclass(frozen=True)
class LocalExecutor:
    """Computes the runs of a study in this process, on one or several devices."""

    devices: Sequence[jax.Device] | None = None
    """Devices to use; None for all of this process."""
    memory: float = STUDY_MEMORY
    """Bytes that the runs in flight may take."""
    chunk: int | None = None
    """Number of runs in flight; None to derive it from `memory`."""

    @property
    def is_limited(self) -> bool:
        """Whether fewer runs may be in flight than by default."""
        return self.chunk is not None or self.memory < STUDY_MEMORY

    def checked(self) -> LocalExecutor:
        """The same options with valid values; ValueError names an invalid one."""
        chunk = self.chunk
        if chunk is not None:
            chunk = checks.positive_integer("chunk", chunk, most=checks.MAX_STEPS)
        remedy = "Such as memory=4e9."
        memory = checks.number_between("memory", self.memory, 1.0, MAX_MEMORY, "bytes", remedy)
        return LocalExecutor(checks.devices("devices", self.devices), memory, chunk)


@dataclasses.dataclass(frozen=True)
class StoreOptions:
    """A store on disk, and how it is written."""

    path: str | os.PathLike
    """Its folder."""
    unit: int | None = None
    """Cases that are written together; None for an automatic choice."""
    writer: str = "client"
    """Which process writes the units that an executor's workers compute: the "client", to which
    they return their results, or the "worker", if all workers see `path` on a shared disk."""
    shared: bool = False
    """Whether several processes run the same sweep on this store at the same time.  They need not
    know each other: each takes the remaining units in a random order and skips those that another
    one has written."""

    def checked(self) -> StoreOptions:
        """The same options with valid values; ValueError names an invalid one."""
        unit = self.unit
        if unit is not None:
            unit = checks.positive_integer("unit", unit, most=checks.MAX_STEPS)
        checks.one_of("writer", self.writer, WRITERS)
        path = checks.file_path("store", self.path, "a folder")
        return StoreOptions(path, unit, self.writer, checks.boolean("shared", self.shared))


@dataclasses.dataclass(frozen=True)
class Design:
    """How the points of a sweep are chosen: `Design("random", points=100)`."""

    kind: str = "grid"
    """"grid", "random" or "latin_hypercube"."""
    points: int | None = None
    """Number of points; None for a grid."""


def executor_of(executor: object) -> LocalExecutor | Executor:
    """The checked `executor` of a study; None for this process.

    Raises:
      ValueError: it is neither a `LocalExecutor` nor a `concurrent.futures.Executor`.
    """
    if executor is None:
        executor = LocalExecutor()
    if isinstance(executor, LocalExecutor):
        return executor.checked()
    if not isinstance(executor, Executor):
        raise checks.fail(
            "executor",
            executor,
            "a concurrent.futures.Executor or an ij.studies.LocalExecutor",
            "Of a Dask client give client.get_executor().",
        )
    return executor


def store_of(store: StoreOptions | str | os.PathLike | None) -> StoreOptions | None:
    """The checked `store` of a sweep, from a path or an object."""
    if store is None:
        return None
    if not isinstance(store, StoreOptions):
        store = StoreOptions(store)
    return store.checked()


def design_of(design: Design | str) -> Design:
    """The `design` of a sweep, from a word or an object."""
    if isinstance(design, Design):
        return design
    return Design(design)
