"""Bounds the number of memory maps that compiled programs use.

The code of a program that JAX has compiled for a CPU uses some hundred memory maps, and Linux
allows a process 65,530.  JAX keeps every program for the life of the process: after a few hundred
programs (a few dozen arms, each with programs of its own) the compiler cannot allocate memory, and
the process ends.  This module therefore clears JAX's programs when the number of maps comes close
to the limit; programs that are needed again are compiled again, or read from the disk
(`core.disk_cache`).
"""

from __future__ import annotations

import gc
import threading
from pathlib import Path

import jax

MAPS, MAX_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"
"""JAX's event of a program that is compiled, or read from the disk."""
MAX_MAP_FRACTION = 0.6
"""Share of the permitted maps above which programs are released: libraries and other threads need
some, too."""
MAPS_OF_A_PROGRAM = 300
"""Approximate largest number of maps of a program: a step of an arm's closed loop has 250."""


def count_maps() -> int:
    """Number of memory maps of this process; 0 where it is unknown."""
    try:
        return MAPS.read_bytes().count(b"\n")
    except OSError:
        return 0


def most_maps() -> int | None:
    """Largest number of memory maps of a process; None where there is no such limit."""
    try:
        return int(MAX_MAPS.read_text())
    except (OSError, ValueError):
        return None


class ProgramBound:
    """Makes JAX release all programs when the process has more than `bound` memory maps, of the
    `limit` that the system allows.
    """

    def __init__(self, limit: int, bound: int) -> None:
        self.limit = limit
        self.bound = bound
        self.released = 0
        """How many times programs were released."""
        self._until_count = 0
        """Programs to compile before maps are counted again: counting tens of thousands takes as
        long as compiling a small program."""
        self._lock = threading.Lock()

    def __call__(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        """Listens to JAX's events."""
        if event != COMPILE_EVENT:
            return
        self._until_count -= 1
        if self._until_count >= 0 or not self._lock.acquire(blocking=False):
            return
        try:
            self.check()
        finally:
            self._lock.release()

    def check(self) -> None:
        """Counts the maps, and releases programs if there are too many."""
        maps = count_maps()
        if maps > self.bound:
            release_programs()
            self.released += 1
            maps = count_maps()
            # Where other code uses most maps, programs must not be released after every new one.
            self.bound = max(self.bound, maps + (self.limit - maps) // 4)
        self._until_count = max((self.bound - maps) // MAPS_OF_A_PROGRAM, 0)


def release_programs() -> None:
    """Clears the programs that JAX has compiled; running programs stay until their end."""
    jax.clear_caches()
    gc.collect()


def bound_programs() -> ProgramBound | None:
    """Bounds the programs of this process from now on; None where the system has no limit."""
    limit = most_maps()
    if limit is None:
        return None
    bound = ProgramBound(limit, int(MAX_MAP_FRACTION * limit))
    jax.monitoring.register_event_duration_secs_listener(bound)
    return bound
