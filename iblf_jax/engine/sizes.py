"""How many runs, steps or points callers of the engine take at once on this process's devices.

These functions apply the thresholds of `plan` to the default device, so that studies and tuning
need no thresholds of their own.  No result depends on them, except the layout of a stored study.
"""

from __future__ import annotations

from iblf_jax.core import devices
from iblf_jax.engine import plan
from iblf_jax.kernels import LoweringLimits

STUDY_MEMORY = plan.STUDY_MEMORY
"""Bytes that runs in flight may take, unless the caller gives another number."""
FORWARD_MOST = plan.FORWARD_MOST
"""Numbers up to which derivatives are taken in forward mode."""


def block_size() -> int:
    """Runs in a block of a study."""
    return plan.study_block(devices.platform())


def blocks_in_flight(chunk: int | None, memory: float, block_bytes: int, devices_used: int) -> int:
    """Blocks of a study that are computed at the same time.

    Args:
      chunk: runs in flight, if the caller limits them.
      memory: bytes that runs in flight may take.
      block_bytes: bytes of the inputs and results of one block.
      devices_used: number of devices that share the blocks.
    """
    return plan.blocks_in_flight(chunk, memory, block_bytes, block_size(), devices_used)


def sweep_unit(cases: int, steps: int) -> int:
    """Cases in one unit of a sweep's store: whole blocks, or all cases of a small sweep.

    Args:
      cases: of the sweep.
      steps: of each run.
    """
    return whole_blocks(cases, min(plan.SWEEP_UNIT / steps, cases / plan.SWEEP_UNITS))


def whole_blocks(cases: int, runs: float) -> int:
    """About `runs` runs as whole blocks, at least one block and at most all `cases`."""
    size = block_size()
    return min(cases, size * max(1, round(runs / size)))


def differentiates_forward(numbers: int) -> bool:
    """Whether derivatives by so many numbers are taken in forward mode."""
    return plan.differentiates_forward(numbers)


def values_together(runs: int) -> int:
    """Points of a tuning, of so many runs each, that are evaluated in one batch."""
    return plan.values_together(runs)


def starts_together(starts: int, runs: int) -> int:
    """Starts of a tuning, of so many runs each, that are evaluated in one batch."""
    return plan.starts_together(starts, runs)


def fresh_together(steps: int, compiled: int) -> int:
    """Runs of a tuning's report that are evaluated in one batch.

    Args:
      steps: of all runs together.
      compiled: runs for which the search has compiled a program.
    """
    return plan.fresh_together(devices.platform(), steps, compiled)


def lowering_limits() -> LoweringLimits:
    """Up to which sizes a step is expressed as a scalar program."""
    return plan.LIMITS
