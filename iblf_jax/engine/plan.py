"""Stage 2 of a run: how a request is executed, decided from sizes and the machine alone.

`choose_plan` is a pure function from a request, the sizes of its inputs and the machine to an
`ExecutionPlan`: which executors are tried, and how XLA is given a batch.  The numbers that it
compares with are in `thresholds`.
"""

from __future__ import annotations

from typing import NamedTuple

from iblf_jax.engine import registry, thresholds
from iblf_jax.engine.registry import Machine
from iblf_jax.engine.request import RunRequest, check_backend


class BatchLayout(NamedTuple):
    """How XLA is given a batch of runs."""

    mapping: str
    """"vmap": all runs advance together; "map": one run after the other."""
    machine_functions: str
    """"loop": the whole time loop is one machine function; "parts": its parts are one each (closed
    loop, record and metrics, start, end); "none"."""
    rolled: bool
    """Whether the integrator's stages are a loop.  One run as a machine function takes half the
    time so, and a third to compile; 32 runs take 2.3 times as long, and XLA's own loop over one run
    three times."""


PLAIN_LAYOUT = BatchLayout("vmap", "none", False)
"""A batch by `jax.vmap`, compiled by XLA in its usual way."""
STATES_LAYOUT = BatchLayout("vmap", "none", True)
"""How one step is made from each of many states: it is made few times, so what counts is how long
it compiles."""


class Sizes(NamedTuple):
    """What is known of the work before it is compiled."""

    operations: int
    """Operations of one evaluation of the closed loop."""
    runs: int | None
    """Runs of the batch; None for a single run."""
    nodes: int | None = None
    """Nodes of a step's scalar program, where a decision needs them."""
    unsupported: str | None = None
    """Why the step cannot be lowered to a scalar program."""


class ExecutionPlan(NamedTuple):
    """How a request is executed."""

    backends: tuple[str, ...]
    """Names of the executors to try, best first.  The scan follows if none of them can run it."""
    layout: BatchLayout
    """Of what surrounds a scalar program."""
    scan_layout: BatchLayout
    """Of the scan."""
    reports_unsupported: bool
    """Whether a warning says that a step cannot be lowered."""
    notes: tuple[str, ...] = ()
    """Warnings about the request itself."""

    @property
    def backend(self) -> str:
        """The first backend, "vmap" for the scan."""
        return (*self.backends, "vmap")[0]


def choose_plan(request: RunRequest, sizes: Sizes, machine: Machine) -> ExecutionPlan:
    """The plan for a request.

    Args:
      request: what is to be run.
      sizes: of the work.
      machine: platform and the executors for it.

    Raises:
      ValueError: an unknown backend.
    """
    backend = check_backend(request.backend)
    names, notes = requested_executors(backend, machine)
    is_batch = sizes.runs is not None
    # One run takes little time either way: on "auto" it is not worth a warning.
    reports = is_batch or backend != "auto"
    if sizes.unsupported is not None:
        names = ()
        if reports:
            notes = (*notes, slower_by_scan(sizes.unsupported))
    elif names and backend == "auto" and not is_batch and sizes.nodes is not None:
        limit = registry.EXECUTORS[names[0]].limits.single_run
        if not thresholds.is_within(sizes.nodes, limit):
            names = ()
    operations, platform = sizes.operations, machine.platform
    return ExecutionPlan(
        names,
        lowered_layout(platform, operations, sizes.runs or 1, request.nested),
        scan_layout(platform, operations, sizes.runs, request.nested),
        reports,
        notes,
    )


def requested_executors(backend: str, machine: Machine) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The executors for a requested backend on a machine, best first, and warnings about it."""
    if backend == "vmap":
        return (), ()
    requested = [state for state in machine.executors if backend in ("auto", state.name)]
    if not requested and backend != "auto":
        note = (
            f"The {backend} backend is not for the default device, {machine.platform}: running on"
            " vmap."
        )
        return (), (note,)
    names = tuple(name for name, reason in requested if reason is None)
    following = (*names, "vmap")[0]
    notes = tuple(
        not_available(name, reason, following) for name, reason in requested if reason is not None
    )
    return names, notes


def not_available(backend: str, reason: object, following: str) -> str:
    """The warning that another backend takes the place of one."""
    return f"The {backend} backend is not available ({reason}): running on {following}."


def slower_by_scan(reason: object) -> str:
    """The warning that a scenario runs by the scan."""
    return f"This scenario runs on the vmap backend, many times slower: {reason}."


def scan_layout(platform: str, operations: int, runs: int | None, nested: bool) -> BatchLayout:
    """How the scan runs a batch.

    Args:
      platform: as JAX names it.
      operations: of one evaluation of the closed loop.
      runs: in the batch; None for one run.
      nested: whether a caller may batch, differentiate or loop over the result: XLA refuses machine
        functions there, or aborts.
    """
    is_long = operations > thresholds.LONG_EVALUATION
    if nested or not thresholds.has_machine_functions(platform):
        return BatchLayout("vmap", "none", is_long)
    if is_long:
        return BatchLayout("map", "parts", True)
    is_small = (runs or 1) <= thresholds.SMALL_BATCH
    return BatchLayout("vmap", "loop" if is_small else "none", runs is None)


def lowered_layout(platform: str, operations: int, runs: int, nested: bool) -> BatchLayout:
    """How XLA compiles what surrounds a scalar program: as machine functions for one run, which
    takes two thirds of the time.  For 48 runs, and for arms of many joints, XLA refuses a fusion.
    """
    is_short = operations <= thresholds.LONG_EVALUATION
    if runs == 1 and is_short and not nested and thresholds.has_machine_functions(platform):
        return BatchLayout("vmap", "parts", False)
    return PLAIN_LAYOUT
