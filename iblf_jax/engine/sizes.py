"""How many runs, steps or points callers of the engine take at once on this process's devices.

Studies and tuning need no thresholds of their own.  No result depends on these numbers, except the
layout of a stored study.
"""

from __future__ import annotations

from iblf_jax.core import devices

RUNS_PER_BLOCK, RUNS_PER_BLOCK_ELSEWHERE = {"cpu": 256}, 32_768
"""Runs in a block of a study, by platform.  On an H100 100,000 runs of 20 s of the paper's loop
take 0.48 s in float64, in blocks of 16,384 0.70 s and of 65,536 0.52 s; 1,000 runs, which a block
is filled up from, 0.16 s, 0.13 s and 0.28 s."""
STUDY_MEMORY = 256 * 2**20
"""Bytes that runs in flight may take, unless the caller gives another number."""
MAX_IN_FLIGHT = 4
"""Blocks that are computed on a device at the same time, each by a thread: draws and results of one
block are handled while the kernel of another one runs."""
STEPS_PER_UNIT, MIN_UNITS = 2e8, 16
"""Steps of all runs in a unit of a sweep's store, which is work for seconds to a minute; and the
least number of units of a large sweep."""
MIN_RUNS_TOGETHER = 16
"""Runs that are evaluated at once at least, when only a few starts of a tuning are left: as many as
the vectors of a processor hold."""
MAX_STEPS_IN_SEARCH_SHAPE = 10_000_000
"""Steps up to which the runs of a report are evaluated in batches of the shape that the search has
compiled: half a second of work for the paper's scenario, where another shape compiles in 1.5 s."""


def block_size() -> int:
    """Runs in a block of a study: results do not depend on it, but a stored study is laid out by
    it.
    """
    return RUNS_PER_BLOCK.get(devices.platform(), RUNS_PER_BLOCK_ELSEWHERE)


def blocks_in_flight(chunk: int | None, memory: float, block_bytes: int, devices_used: int) -> int:
    """Blocks of a study that are computed at the same time.

    Args:
      chunk: runs in flight, if the caller limits them; otherwise `memory` does.
      memory: bytes that runs in flight may take.
      block_bytes: bytes of the inputs and results of one block.
      devices_used: number of devices that share the blocks.
    """
    allowed = memory // max(block_bytes, 1)
    if chunk is not None:
        allowed = chunk // block_size()
    return int(min(max(allowed, 1), MAX_IN_FLIGHT * devices_used))


def sweep_unit(cases: int, steps: int) -> int:
    """Cases in one unit of a sweep's store: whole blocks, or all cases of a small sweep.

    Args:
      cases: of the sweep.
      steps: of each run.
    """
    return whole_blocks(cases, min(STEPS_PER_UNIT / steps, cases / MIN_UNITS))


def whole_blocks(cases: int, runs: float) -> int:
    """About `runs` runs as whole blocks, at least one block and at most all `cases`."""
    size = block_size()
    return min(cases, size * max(1, round(runs / size)))


def values_together(runs: int) -> int:
    """Points of a tuning, of so many runs each, that are evaluated in one batch."""
    return -(-MIN_RUNS_TOGETHER // runs)


def starts_together(starts: int, runs: int) -> int:
    """Starts of a tuning, of so many runs each, that are evaluated in one batch."""
    return min(starts, values_together(runs))


def fresh_together(steps: int, compiled: int) -> int:
    """Runs of a tuning's report that are evaluated in one batch.

    Args:
      steps: of all runs together.
      compiled: runs for which the search has compiled a program.
    """
    return compiled if steps <= MAX_STEPS_IN_SEARCH_SHAPE else block_size()
