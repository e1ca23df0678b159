"""The gpu executor: compiles and runs the kernels of `kernels.cuda`."""

from __future__ import annotations

import re

import jax

from iblf_jax.core import devices
from iblf_jax.engine import thresholds
from iblf_jax.kernels import Packed, Program, ToolchainError, compiler, cuda, nvrtc


def architecture() -> str:
    """The architecture of the GPUs of this process, as NVRTC names it: "sm_90", for example.

    Raises:
      ToolchainError: the default devices are not GPUs that NVRTC supports, or they differ.
    """
    default_devices = devices.default()
    try:
        found = {device.compute_capability for device in default_devices}
    except AttributeError:  # no GPUs
        found = {""}
    if len(found) > 1:
        raise ToolchainError(f"the GPUs differ: compute capabilities {', '.join(sorted(found))}")
    match = re.fullmatch(r"(\d+)\.(\d)", found.pop())
    if not match:
        raise ToolchainError(f"it needs an NVIDIA GPU, not {default_devices[0].device_kind}")
    return f"sm_{match[1]}{match[2]}"


def unavailable() -> str | None:
    """Why this process cannot use the executor, in one line; None if it can."""
    try:
        architecture()
        nvrtc.library()
        compiler()
    except ToolchainError as error:
        return str(error)
    return None


def call(
    name: str,
    program: Program,
    shared: jax.Array,
    per_run: jax.Array,
    carry: Packed,
    steps: int,
    every: int | None,
    threads: int,
) -> tuple[Packed, list[jax.Array]]:
    """As `kernels.cuda.call`, with the table of signals that this executor uses."""
    return cuda.call(
        name,
        program,
        shared,
        per_run,
        carry,
        steps,
        every,
        threads=threads,
        table=thresholds.MAX_STEPS_PER_LAUNCH,
    )


def run(
    program: Program,
    shared: jax.Array,
    per_run: jax.Array,
    carry: Packed,
    steps: int,
    every: int | None,
) -> tuple[Packed, list[jax.Array]]:
    """All steps of all runs; arguments and results as `native.run`."""
    name = cuda.kernel(program, shared.size, per_run.shape[0], architecture())
    # The CPU devices of the tests have no attribute core_count.
    processors = getattr(devices.default()[0], "core_count", thresholds.DEFAULT_MULTIPROCESSORS)
    threads = thresholds.gpu_threads(carry.floats.shape[1], processors)
    return call(name, program, shared, per_run, carry, steps, every, threads)


def build(program: Program, shared: int, per_run: int, runs: int, steps: int) -> None:
    """Compiles the kernel of `run`, which serves any number of runs and steps."""
    cuda.kernel(program, shared, per_run, architecture())
