"""The native executor: the kernels of `kernels.cpu`, compiled and run as the plan decides."""

from __future__ import annotations

import jax

from iblf_jax.core.devices import threads
from iblf_jax.engine import plan
from iblf_jax.kernels import Build, Packed, Program, ToolchainError, compiler, cpu
from iblf_jax.kernels.cpu import pack as pack
from iblf_jax.kernels.cpu import unpack as unpack


def unavailable() -> str | None:
    """Why this process cannot run it, in one line, or None if it can."""
    try:
        compiler()
    except ToolchainError as error:
        return str(error)
    return None


def _build(program: Program, runs: int, steps: int, narrow: bool | None = None) -> Build:
    """How the kernel of a program is compiled.

    Args:
      program: what a step computes.
      runs, steps: numbers of runs and steps.
      narrow: whether it is the kernel for one or two runs of many steps; decided by `runs` and
        `steps` if None.
    """
    if narrow is None:
        is_small = runs * program.dtype.itemsize <= plan.NATIVE_NARROW
        narrow = is_small and steps > plan.NATIVE_FEW
    return Build(*plan.native_build(program.size, narrow))


def ahead(program: Program, shared: int, per_run: int, runs: int, steps: int) -> None:
    """Starts to compile the kernel with which `run` makes so many steps of so many runs."""
    cpu.start_build(program, shared, per_run, _build(program, runs, steps))


def run(
    program: Program,
    shared: jax.Array,
    per_run: jax.Array,
    carry: Packed,
    steps: int,
    every: int | None,
    first: jax.Array | int = 0,
    narrow: bool | None = None,
) -> tuple[Packed, list[jax.Array]]:
    """All steps of all runs.

    Args:
      program, shared, per_run, carry, steps, every, first: as `kernels.cpu.run`.
      narrow: as `_build`.

    Returns:
      The rows after the last step, and the recorded arrays, (samples, numbers, runs), of every
      `every`-th step.
    """
    build = _build(program, carry.floats.shape[1], steps, narrow)
    return cpu.run(
        program, shared, per_run, carry, steps, every, first=first, build=build, threads=threads()
    )


def build(program: Program, shared: int, per_run: int, runs: int, steps: int) -> None:
    """Compiles the kernel with which `run` makes so many steps of so many runs."""
    cpu.kernel(program, shared, per_run, _build(program, runs, steps))
