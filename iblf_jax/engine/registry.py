"""The registry of executors: what runs scalar programs, one record each.

A new executor is a module with functions like those of `native`, and one record in `EXECUTORS`.
The scan, which needs no scalar program, is no member: it runs what no executor can, and users
request it as "vmap".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from iblf_jax.core import devices
from iblf_jax.engine import gpu, native, thresholds
from iblf_jax.kernels import pack, unpack


class Limits(NamedTuple):
    """Largest sizes for which "auto" takes an executor; None for no limit."""

    single_run: int | None = None
    """Nodes of a step of a single run."""
    derivatives: int | None = None
    """Nodes of a step times one and the number of its tangents."""


class Executor(NamedTuple):
    """What runs scalar programs, all steps of all runs."""

    name: str
    """The backend, as users request it."""
    platforms: tuple[str, ...]
    """For which it compiles kernels."""
    run: Callable
    """As `native.run`."""
    unavailable: Callable[[], str | None]
    """Why this process cannot use it, in one line; None if it can."""
    build: Callable
    """`build(program, shared, per_run, runs, steps)`: compiles the kernel of a program, for so many
    shared numbers and numbers per run; raises ToolchainError or UnsupportedError."""
    limits: Limits = Limits()
    pack: Callable = pack
    """Leaves to rows of numbers."""
    unpack: Callable = unpack
    """Rows of numbers to leaves."""
    start_build: Callable | None = None
    """Arguments of `build`: starts to compile in the background."""
    continues: bool = False
    """Whether `run` takes the number of the first step (`first`) and the choice of a kernel for few
    runs (`short_vector`), so that a long single run can be made in several calls."""


NATIVE = Executor(
    name="native",
    platforms=("cpu",),
    run=native.run,
    unavailable=native.unavailable,
    build=native.build,
    limits=Limits(thresholds.LONGEST_SINGLE_RUN, thresholds.LONGEST_DERIVATIVE_CUT),
    pack=native.pack,
    unpack=native.unpack,
    start_build=native.start_build,
    continues=True,
)
GPU = Executor(
    name="gpu",
    platforms=("gpu",),
    run=gpu.run,
    unavailable=gpu.unavailable,
    build=gpu.build,
    limits=Limits(thresholds.LONGEST_SINGLE_RUN, thresholds.LONGEST_DERIVATIVE),
)
EXECUTORS: dict[str, Executor] = {executor.name: executor for executor in (NATIVE, GPU)}
"""All executors by name; those for the same platform in the order of preference."""


def backends() -> tuple[str, ...]:
    """How a user may request that runs be executed."""
    return ("auto", "vmap", *EXECUTORS)


class Availability(NamedTuple):
    """Whether an executor can be used."""

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
    return Machine(platform, tuple(Availability(x.name, x.unavailable()) for x in executors))


def executors_for(platform: str) -> list[Executor]:
    """The executors for a platform, best first."""
    return [executor for executor in EXECUTORS.values() if platform in executor.platforms]


def automatic() -> Availability:
    """What "auto" takes; "vmap", with the reason, where no kernels can be compiled."""
    here = machine()
    for executor in here.executors:
        if executor.reason is None:
            return executor
    reasons = [executor.reason for executor in here.executors]
    return Availability("vmap", (*reasons, f"no kernels are compiled for {here.platform}")[0])
