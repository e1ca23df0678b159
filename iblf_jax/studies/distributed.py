"""Deprecated: several processes that meet through `jax.distributed`.

Work on other processes and machines goes through the argument `executor` of `monte_carlo`, `sweep`
and `sensitivity`, or through a store that several processes share (`ij.studies.StoreOptions(path,
shared=True)`).  The names of this module keep working for one release.  In a job that `initialize`
has made, the processes share a sweep with a store; every process computes all of a study without
one.
"""

from __future__ import annotations

import jax

from iblf_jax.core import checks, notices
from iblf_jax.studies.workers import WorkerError

ProcessLostError = WorkerError


def rank() -> int:
    """Number of this process, from 0."""
    return jax.process_index()


def size() -> int:
    """Number of processes."""
    return jax.process_count()


def initialize(
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
    *,
    heartbeat: int = 10,
    start: int = 300,
) -> None:
    """Deprecated: makes this process one of a job by `jax.distributed.initialize`.

    Args:
      coordinator: address of process 0, "host:port".
      num_processes: number of processes.
      process_id: number of this one, from 0.
      heartbeat: seconds after which JAX takes a silent process for lost.
      start: seconds to wait for all processes to be there.

    Raises:
      ValueError: some of the first three are given and some are not, or they are not valid.

    Source: jax.distributed.
    """
    given = (coordinator, num_processes, process_id)
    if any(x is None for x in given) and not all(x is None for x in given):
        raise checks.fail(
            "coordinator, num_processes, process_id",
            given,
            "all three, or none where JAX finds them by itself",
        )
    notices.warn(
        "ij.distributed is deprecated: give sweep and monte_carlo an executor, or start the same"
        " sweep several times with store=ij.studies.StoreOptions(path, shared=True).",
        DeprecationWarning,
    )
    jax.distributed.initialize(
        coordinator,
        num_processes,
        process_id,
        initialization_timeout=start,
        heartbeat_timeout_seconds=heartbeat,
    )


__all__ = ["ProcessLostError", "initialize", "rank", "size"]


def __dir__() -> list[str]:
    return __all__
