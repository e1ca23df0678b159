"""Options of studies as objects: where runs are computed, how a store is written, what a sweep
samples.

They change no number of a result.  `replacements` translates the keyword arguments of earlier
versions into them.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from typing import Any

import jax

from iblf_jax.core import checks, notices
from iblf_jax.engine import STUDY_MEMORY

MAX_MEMORY = 2.0**60
"""Bytes.  No machine has more."""
WRITERS = ("client", "worker")


@dataclasses.dataclass(frozen=True)
class ThisProcess:
    """Computes the runs of a study in this process, on one or several devices."""

    devices: Sequence[jax.Device] | None = None
    """Devices to use; None for all of this process."""
    memory: float = STUDY_MEMORY
    """Bytes that the runs in flight may take."""
    chunk: int | None = None
    """Number of runs in flight; None to derive it from `memory`."""

    def checked(self) -> ThisProcess:
        """The same options with valid values; ValueError names an invalid one."""
        chunk = self.chunk
        if chunk is not None:
            chunk = checks.positive_integer("chunk", chunk, most=checks.MAX_STEPS)
        remedy = "Such as memory=4e9."
        memory = checks.number_between("memory", self.memory, 1.0, MAX_MEMORY, "bytes", remedy)
        return ThisProcess(checks.devices("devices", self.devices), memory, chunk)


@dataclasses.dataclass(frozen=True)
class StoreOptions:
    """A store on disk, and how it is written."""

    path: str | os.PathLike
    """Its folder."""
    unit: int | None = None
    """Cases that are written together; None for an automatic choice."""
    writer: str = "client"
    """Who writes the units that an executor's workers compute: "client", to which they return
    their results, or "worker", where all workers see `path` on a shared disk."""
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
        return StoreOptions(path, unit, self.writer, checks.flag("shared", self.shared))


@dataclasses.dataclass(frozen=True)
class Design:
    """How the points of a sweep are chosen: `Design("random", points=100)`."""

    kind: str = "grid"
    """"grid", "random" or "latin_hypercube"."""
    points: int | None = None
    """Number of points; None for a grid."""


REPLACED = {
    "unit": ("store", "StoreOptions(path, unit=...)"),
    "points": ("design", "Design(kind, points=...)"),
    "chunk": ("executor", "ThisProcess(chunk=...)"),
    "memory": ("executor", "ThisProcess(memory=...)"),
    "devices": ("executor", "ThisProcess(devices=...)"),
}
"""Keyword argument of earlier versions -> the argument and the object that replace it."""


def check_deprecated(call: str, given: Mapping[str, Any], accepted: Sequence[str]) -> None:
    """Warns about keyword arguments of earlier versions; TypeError for an unknown one."""
    for name in given:
        if name not in accepted:
            near = checks.did_you_mean(name, accepted)
            text = f"{call}() got an unexpected keyword argument {name!r}. {near}"
            raise TypeError(text.rstrip())
        argument, replacement = REPLACED[name]
        notices.warn(
            f"The keyword argument {name} of ij.{call} is deprecated: write"
            f" {argument}=ij.studies.{replacement}.",
            DeprecationWarning,
        )


def executor_of(executor: Any, deprecated: Mapping[str, Any]) -> ThisProcess | Executor:
    """The checked `executor` of a study.

    Args:
      executor: as the user gave it; None for this process.
      deprecated: keyword arguments of earlier versions; `chunk`, `memory` and `devices` are used.

    Raises:
      ValueError: it is neither a `ThisProcess` nor a `concurrent.futures.Executor`, or comes with
        one of the deprecated arguments.
    """
    local = {n: deprecated[n] for n in ("chunk", "memory", "devices") if n in deprecated}
    if executor is None:
        return ThisProcess(**local).checked()
    if local:
        raise _given_twice("executor", local)
    if isinstance(executor, ThisProcess):
        return executor.checked()
    if not isinstance(executor, Executor):
        raise checks.fail(
            "executor",
            executor,
            "a concurrent.futures.Executor or an ij.studies.ThisProcess",
            "Of a Dask client give client.get_executor().",
        )
    return executor


def store_of(store: Any, deprecated: Mapping[str, Any]) -> StoreOptions | None:
    """The checked `store` of a sweep, from a path or an object; arguments as `executor_of`."""
    unit = {name: deprecated[name] for name in ("unit",) if name in deprecated}
    if isinstance(store, StoreOptions):
        if unit:
            raise _given_twice("store", unit)
        return store.checked()
    if store is None:
        if unit.get("unit") is not None:
            checks.positive_integer("unit", unit["unit"], most=checks.MAX_STEPS)
        return None
    return StoreOptions(store, **unit).checked()


def design_of(design: Any, deprecated: Mapping[str, Any]) -> Design:
    """The `design` of a sweep, from a word or an object; arguments as `executor_of`."""
    points = {name: deprecated[name] for name in ("points",) if name in deprecated}
    if not isinstance(design, Design):
        return Design(design, **points)
    if points:
        raise _given_twice("design", points)
    return design


def _given_twice(name: str, further: Mapping[str, Any]) -> ValueError:
    names = ", ".join(further)
    return checks.fail(
        name, checks.Words(f"{name}= and {names}"), "one of them", f"Put {names} into {name}."
    )
