"""The registry of executors.  An executor runs the scalar program of a step.

A new executor is a module with functions like those of `native`, and one record in `EXECUTORS`.
The scan is not an executor, because it needs no scalar program.  It runs what no executor can, and
users request it as "vmap".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from iblf_jax.core import devices
from iblf_jax.engine import gpu, native, thresholds
from iblf_jax.kernels import pack, unpack


class Limits(NamedTuple):
    """Largest sizes for which "auto" takes an executor; None for no limit."""

    single_run_nodes: int | None = None
    """Nodes of a step of a single run."""
    derivative_nodes: int | None = None
    """Nodes of a step, times one plus the number of tangents."""


class Executor(NamedTuple):
    """A compiler and a launcher of kernels, which make all steps of all runs of a batch."""

    name: str
    """The backend, as users request it."""
    platforms: tuple[str, ...]
    """Platforms, as JAX names them, for which it compiles kernels."""
    run: Callable
    """`run(program, shared, per_run, carry, steps, every)` returns the carry after the last step
    and the records; `native.run` describes the arguments."""
    unavailable: Callable[[], str | None]
    """Why this process cannot use it, in one line; None if it can."""
    build: Callable
    """`build(program, shared, per_run, runs, steps)` compiles the kernel of a program; `shared` and
    `per_run` are counts of numbers.  It raises ToolchainError or UnsupportedError."""
    limits: Limits = Limits()
    pack: Callable = pack
    """Converts leaves to rows of numbers."""
    unpack: Callable = unpack
    """Converts rows of numbers to leaves."""
    start_build: Callable | None = None
    """Starts to compile in the background; arguments as `build`, and `series`, the count of numbers
    of each step of a run in the series that the program reads."""
    accepts_first_step: bool = False
    """Whether `run` accepts `first`, the index of the first step, `short_vector`, and with it a
    number of steps that is an array.  Then a long single run can be divided into several calls, and
    batches of several numbers of steps have one program."""
    accepts_series: bool = False
    """Whether `run` accepts `series`, a table of which each step reads a row, and `first`.  Then
    the executor differentiates in reverse mode (`adjoint`)."""
    uses_host_compiler: bool = False
    """Whether results depend on the processor and the C++ compiler of the host in their last
    digits."""


NATIVE = Executor(
    name="native",
    platforms=("cpu",),
    run=native.run,
    unavailable=native.unavailable,
    build=native.build,
    limits=Limits(thresholds.MAX_SINGLE_RUN_NODES, thresholds.MAX_SEGMENTED_DERIVATIVE_NODES),
    pack=native.pack,
    unpack=native.unpack,
    start_build=native.start_build,
    accepts_first_step=True,
    accepts_series=True,
    uses_host_compiler=True,
)
GPU = Executor(
    name="gpu",
    platforms=("gpu",),
    run=gpu.run,
    unavailable=gpu.unavailable,
    build=gpu.build,
    limits=Limits(thresholds.MAX_SINGLE_RUN_NODES, thresholds.MAX_DERIVATIVE_NODES),
)
EXECUTORS: dict[str, Executor] = {executor.name: executor for executor in (NATIVE, GPU)}
"""All executors by name; those for the same platform in the order of preference."""


def backends() -> tuple[str, ...]:
    """The values that users may give for `backend`."""
    return ("auto", "vmap", *EXECUTORS)


def uses_host_compiler(backend: str) -> bool:
    """Whether the results of a backend depend on the processor and compiler of the host."""
    return backend in EXECUTORS and EXECUTORS[backend].uses_host_compiler


class Availability(NamedTuple):
    """Whether an executor is available."""

    name: str
    reason: str | None
    """Why this process cannot use it, in one line; None if it can."""


class Machine(NamedTuple):
    """The default device and the executors for it."""

    platform: str
    """As JAX names it."""
    executors: tuple[Availability, ...]
    """Best first."""


def machine() -> Machine:
    """The default device of this process, and the executors for it."""
    platform = devices.platform()
    executors = executors_for(platform)
    available = [Availability(x.name, x.unavailable()) for x in executors]
    return Machine(platform, tuple(available))


def executors_for(platform: str) -> list[Executor]:
    """The executors for a platform, best first."""
    return [executor for executor in EXECUTORS.values() if platform in executor.platforms]


def default_backend() -> Availability:
    """The backend that "auto" selects; "vmap", with the reason, where no executor is available."""
    here = machine()
    for executor in here.executors:
        if executor.reason is None:
            return executor
    if here.executors:
        return here.executors[0]._replace(name="vmap")
    return Availability("vmap", f"no kernels are compiled for {here.platform}")
