"""The native executor: compiles and runs the kernels of `kernels.cpu`."""

from __future__ import annotations

from typing import cast

import jax

from iblf_jax.core.devices import threads
from iblf_jax.engine import thresholds
from iblf_jax.kernels import Build, Packed, Program, ToolchainError, compiler, cpu
from iblf_jax.kernels.cpu import pack as pack
from iblf_jax.kernels.cpu import unpack as unpack


def unavailable() -> str | None:
    """Why this process cannot use the executor, in one line; None if it can."""
    try:
        compiler()
    except ToolchainError as error:
        return str(error)
    return None


def _kernel_build(
    program: Program, runs: int, steps: int | jax.Array, short_vector: bool | None = None
) -> Build:
    """How the kernel of a program is compiled.

    Args:
      program: the scalar program of a step.
      runs, steps: numbers of runs and steps.
      short_vector: whether the kernel is the one for so few runs, of many steps, that they fit in
        a short vector; `runs` and `steps` decide if None.
    """
    if short_vector is None:
        size = runs * program.dtype.itemsize
        short_vector = thresholds.uses_short_vector(size, cast(int, steps))
    return Build(*thresholds.native_build(program.size, short_vector))


def build(program: Program, shared: int, per_run: int, runs: int, steps: int) -> None:
    """Compiles the kernel with which `run` makes so many steps of so many runs."""
    # With every argument that `cpu.run` passes, so that it finds this kernel in the cache.
    cpu.kernel(program, shared, per_run, _kernel_build(program, runs, steps), 0)


def start_build(
    program: Program, shared: int, per_run: int, runs: int, steps: int, series: int = 0
) -> None:
    """As `build`, in the background, of a program that may read a series."""
    cpu.start_build(program, shared, per_run, _kernel_build(program, runs, steps), series)


def run(
    program: Program,
    shared: jax.Array,
    per_run: jax.Array,
    carry: Packed,
    steps: int | jax.Array,
    every: int | None,
    first: jax.Array | int = 0,
    short_vector: bool | None = None,
    series: jax.Array | None = None,
) -> tuple[Packed, list[jax.Array]]:
    """All steps of all runs.

    Args:
      program, shared, per_run, carry, steps, every, first, series: as `kernels.cpu.run`.
      short_vector: as `_kernel_build`; required where `steps` is an array.

    Returns:
      The rows after the last step, and the recorded arrays, (samples, numbers, runs), of every
      `every`-th step.
    """
    kernel = _kernel_build(program, carry.floats.shape[1], steps, short_vector)
    return cpu.run(
        program,
        shared,
        per_run,
        carry,
        steps,
        every,
        first=first,
        series=series,
        build=kernel,
        threads=threads(),
    )
