"""How many runs studies and tuning compute in one batch on the devices of this process.

No result depends on these numbers, except the layout of a stored study.
"""

from __future__ import annotations

from iblf_jax.core import checks, devices

RUNS_PER_BLOCK = {"cpu": 256}
"""Runs in a block of a study, by platform."""
DEFAULT_RUNS_PER_BLOCK = 32_768
"""The same on all other platforms: many runs fill a GPU, and few runs, which are padded to a block,
take longer in a larger one.  The measurement of this size is withdrawn (`benchmarks/README.md`)."""
LARGE_BLOCK = 1024
"""Runs in a block of a large study on a CPU. Drawing and starting a block take almost as long for
256 runs: with 1,024, 65,536 runs of 1,000 steps of the paper's loop take 1.9 instead of 2.4 s of
processor time."""
LARGE_STUDY = 16 * LARGE_BLOCK
"""Runs from which a study is large."""
STEPS_OF_LARGE_BLOCK = 2_000
"""Steps of a run up to which a block is large: Ctrl-C waits for the blocks in flight, and a larger
block gains nothing where steps take most of the time."""
STUDY_MEMORY = 256 * 2**20
"""Default limit of the memory that runs in flight take [bytes]."""
MAX_IN_FLIGHT = 4
"""Blocks that are in flight on a device, each in a thread: the draws and results of one block are
processed while the kernel of another one runs."""
STEPS_PER_UNIT = 2e8
"""Steps of all runs in a unit of a sweep's store, which take seconds to a minute."""
MIN_UNITS = 16
"""Smallest number of units of a large sweep."""
MIN_RUNS_PER_BATCH = 64
"""Smallest number of runs in a batch of a tuning without derivatives.  A kernel does not compute
the copies that fill up a batch, but what precedes and follows the steps is computed for all of
them: the assessment of a run of a sampled arm takes 20 ms of processor time."""
MIN_RUNS_WITH_DERIVATIVES = 16
"""The same with derivatives; as many as the vectors of a processor hold."""
MAX_STEPS_IN_SEARCH_SHAPE = 10_000_000
"""Steps up to which the runs of a report are computed in batches of the size that the search has
compiled.  They take half a second for the paper's scenario; another size compiles in 1.5 s."""


def block_size() -> int:
    """Runs in a block of a study; only the layout of a stored study depends on it."""
    return RUNS_PER_BLOCK.get(devices.platform(), DEFAULT_RUNS_PER_BLOCK)


def block_size_in_memory(cases: int, steps: int) -> int:
    """Runs in a block of a study that is not stored: more in a large study of few steps.

    Args:
      cases: number of cases of the study.
      steps: number of steps of each run.
    """
    if cases >= LARGE_STUDY and steps <= STEPS_OF_LARGE_BLOCK:
        return max(block_size(), LARGE_BLOCK)
    return block_size()


def blocks_in_flight(chunk: int | None, memory: float, block_bytes: int, devices_used: int) -> int:
    """Blocks of a study that are in flight.

    Args:
      chunk: limit of the runs in flight; None to apply `memory` instead.
      memory: limit of the memory of the runs in flight [bytes].
      block_bytes: bytes of the inputs and results of one block.
      devices_used: number of devices that share the blocks.
    """
    limit = memory // max(block_bytes, 1)
    if chunk is not None:
        limit = chunk // block_size()
    return int(min(max(limit, 1), MAX_IN_FLIGHT * devices_used))


def cases_per_unit(cases: int, steps: int) -> int:
    """Cases in one unit of a sweep's store: complete blocks, or all cases of a small sweep.

    Args:
      cases: number of cases of the sweep.
      steps: number of steps of each run.
    """
    return whole_blocks(cases, min(STEPS_PER_UNIT / steps, cases / MIN_UNITS))


def whole_blocks(cases: int, runs: float) -> int:
    """`runs` rounded to complete blocks: at least one block, at most all `cases`."""
    size = block_size()
    return min(cases, size * max(1, round(runs / size)))


def points_per_batch(runs: int) -> int:
    """Points of a tuning that are evaluated in one batch, each with so many runs."""
    return checks.ceil_div(MIN_RUNS_PER_BATCH, runs)


def starts_per_batch(starts: int, runs: int) -> int:
    """Starts of a tuning that are evaluated in one batch, each with so many runs."""
    return min(starts, checks.ceil_div(MIN_RUNS_WITH_DERIVATIVES, runs))


def report_runs_per_batch(steps: int, compiled: int) -> int:
    """Runs of a tuning's report that are computed in one batch.

    Args:
      steps: number of steps of all runs together.
      compiled: runs of the batch that the search has compiled.
    """
    return compiled if steps <= MAX_STEPS_IN_SEARCH_SHAPE else block_size()
