"""The registry of executors: what runs scalar programs, one record each.

A new executor is a module with functions like those of `native`, and one record in `EXECUTORS`.
The scan, which needs no scalar program, is no member: it runs what no executor can.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from iblf_jax.core import devices
from iblf_jax.engine import gpu, native, plan, xla
from iblf_jax.kernels import Program, pack, unpack, written_out


class Limits(NamedTuple):
    """Largest sizes for which "auto" takes an executor; None for no limit."""

    single_run: int | None = None
    """Nodes of a step of a single run."""
    evaluation: int | None = None
    """Operations of one evaluation of the closed loop of a single run, on CPU."""
    derivatives: int | None = None
    """Nodes of a step times one and the number of its tangents."""


def nodes_with_functions(program: Program) -> int:
    """Nodes of a program, the body of a function counted once."""
    return program.size


class Executor(NamedTuple):
    """What runs scalar programs, all steps of all runs."""

    name: str
    """As users request it."""
    platforms: tuple[str, ...]
    """For which it compiles kernels; empty for a portable executor, which runs on any device."""
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
    nodes: Callable[[Program], int] = nodes_with_functions
    """How long a program is for its compiler."""
    start_build: Callable | None = None
    """Arguments of `build`: starts to compile in the background."""
    continues: bool = False
    """Whether `run` takes the number of the first step (`first`) and the choice of a kernel for few
    runs (`narrow`), so that a long single run can be made in several calls."""


EXECUTORS: dict[str, Executor] = {
    executor.name: executor
    for executor in (
        Executor(
            "native",
            ("cpu",),
            native.run,
            native.unavailable,
            native.build,
            Limits(
                single_run=plan.LONGEST_SINGLE_RUN,
                derivatives=plan.JVP_LARGEST_IN_SEGMENTS,
            ),
            native.pack,
            native.unpack,
            start_build=native.ahead,
            continues=True,
        ),
        Executor(
            "gpu",
            ("gpu",),
            gpu.run,
            gpu.unavailable,
            gpu.build,
            Limits(single_run=plan.LONGEST_SINGLE_RUN, derivatives=plan.JVP_LARGEST),
        ),
        Executor(
            "xla",
            (),
            xla.run,
            lambda: None,
            xla.build,
            Limits(
                single_run=plan.LONGEST_SINGLE_RUN_XLA,
                evaluation=plan.LONG_EVALUATION,
                derivatives=plan.JVP_LARGEST,
            ),
            nodes=lambda program: len(written_out(program).nodes),  # XLA has no functions
        ),
    )
}
"""All executors by name; those that compile kernels for a platform in the order of preference."""


def backends() -> tuple[str, ...]:
    """How a user may request that a batch be executed; "vmap" is the scan."""
    return ("auto", "vmap", *EXECUTORS)


def single_run_backends() -> tuple[str, ...]:
    """How a user may request that a single run be executed."""
    return ("auto", *EXECUTORS)


class Machine(NamedTuple):
    """The default device and the executors for it."""

    platform: str
    """As JAX names it."""
    executors: tuple[Executor, ...]
    """Best first; those that compile kernels for the platform come before the portable ones."""
    automatic: str
    """The executor that "auto" takes for a single run and for derivatives."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of all executors for this platform, best first."""
        return tuple(executor.name for executor in self.executors)

    @property
    def portable(self) -> tuple[str, ...]:
        """Names of the executors that run on any device."""
        return tuple(executor.name for executor in self.executors if not executor.platforms)

    def builds_kernels(self, name: str) -> bool:
        """Whether a name is that of an executor that compiles kernels, for any platform."""
        return name in EXECUTORS and bool(EXECUTORS[name].platforms)

    def limits(self, name: str) -> Limits:
        """The limits of an executor."""
        return EXECUTORS[name].limits


def automatic() -> tuple[str, str | None]:
    """The executor that "auto" takes for a single run, and why it does not compile kernels, in one
    line (None if it does).
    """
    platform, reason = devices.platform(), None
    for executor in executors_for(platform):
        if not executor.platforms:
            return executor.name, reason or f"no kernels are compiled for {platform}"
        reason = executor.unavailable()
        if reason is None:
            return executor.name, None
    return "vmap", reason


def executors_for(platform: str) -> tuple[Executor, ...]:
    """The executors for a platform, best first."""
    compiled = [x for x in EXECUTORS.values() if platform in x.platforms]
    return (*compiled, *(x for x in EXECUTORS.values() if not x.platforms))


def machine() -> Machine:
    """The default device of this process, and the executors for it."""
    platform = devices.platform()
    return Machine(platform, executors_for(platform), automatic()[0])
