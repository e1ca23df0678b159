"""Stage 2 of a run: how a request is executed, decided from sizes and the machine.

`choose_plan` is a pure function from a request, the sizes of its inputs and the machine to an
`ExecutionPlan`, which lists the executors to try and says how XLA compiles a batch.
`within_node_limit` and `scan_only` revise the plan of a single run once its step has been lowered.
The limits are in `thresholds`.
"""

from __future__ import annotations

from typing import NamedTuple

from iblf_jax.engine import registry, thresholds
from iblf_jax.engine.registry import Availability, Machine
from iblf_jax.engine.request import RunRequest, check_backend


class BatchLayout(NamedTuple):
    """How XLA compiles a batch of runs."""

    mapping: str
    """"vmap": all runs advance together; "map": one run after the other."""
    machine_functions: str
    """What is compiled as a machine function: "loop" (the entire time loop), "parts" (closed loop,
    record and metrics, start and end, each on its own) or "none"."""
    rolled: bool
    """Whether the integrator's stages are a loop.  This halves the time of one run as a machine
    function and divides its compilation time by 3.  It multiplies the time of 32 runs by 2.3, and
    that of one run in XLA's own loop by 3."""


PLAIN_LAYOUT = BatchLayout("vmap", "none", False)
"""A batch by `jax.vmap`, compiled by XLA in its usual way."""
STATES_LAYOUT = BatchLayout("vmap", "none", True)
"""For a few steps from each of many states, where compilation takes most of the time."""


class Sizes(NamedTuple):
    """Sizes that are known before a step is lowered."""

    operations: int
    """Operations of one evaluation of the closed loop."""
    runs: int | None
    """Runs of the batch; None for a single run."""


class ExecutionPlan(NamedTuple):
    """How a request is executed."""

    backends: tuple[str, ...]
    """Names of the executors to try, best first.  If none of them can run it, the scan does."""
    layout: BatchLayout
    """Layout of the code before and after the steps that an executor makes."""
    scan_layout: BatchLayout
    """Layout of the scan."""
    reports_unsupported: bool
    """Whether to warn if the step cannot be lowered."""
    warnings: tuple[str, ...] = ()
    """Warnings about the requested backend."""

    @property
    def backend(self) -> str:
        """The first executor to try; "vmap" for the scan."""
        return next(iter(self.backends), "vmap")


def choose_plan(request: RunRequest, sizes: Sizes, machine: Machine) -> ExecutionPlan:
    """The plan for a request.

    Args:
      request: what is to be run.
      sizes: sizes of the closed loop and of the batch.
      machine: the platform and its executors.

    Raises:
      ValueError: an unknown backend.
    """
    backend = check_backend(request.backend)
    names, warnings = requested_executors(backend, machine)
    return ExecutionPlan(
        names,
        lowered_layout(machine.platform, sizes.operations, sizes.runs or 1, request.nested),
        scan_layout(machine.platform, sizes.operations, sizes.runs, request.nested),
        # A single run takes little time on any backend, so that "auto" does not warn.
        reports_unsupported=sizes.runs is not None or backend != "auto",
        warnings=warnings,
    )


def within_node_limit(execution: ExecutionPlan, request: RunRequest, nodes: int) -> ExecutionPlan:
    """The plan of a single run with so many nodes per step; on "auto" the scan makes long steps."""
    limit = registry.EXECUTORS[execution.backend].limits.single_run_nodes
    if request.backend != "auto" or thresholds.is_within(nodes, limit):
        return execution
    return execution._replace(backends=())


def scan_only(execution: ExecutionPlan, reason: object) -> ExecutionPlan:
    """The plan of a run whose step cannot be lowered, for the given reason."""
    warnings = execution.warnings
    if execution.reports_unsupported:
        warnings = (*warnings, scan_warning(reason))
    return execution._replace(backends=(), warnings=warnings)


def plan_of_states(operations: int, backend: Availability) -> ExecutionPlan:
    """The plan of a few steps from each of many states, by the default backend of the machine; a
    kernel is built only if the closed loop has few operations.
    """
    backends: tuple[str, ...] = ()
    if backend.reason is None and operations <= thresholds.LONG_EVALUATION:
        backends = (backend.name,)
    return ExecutionPlan(backends, STATES_LAYOUT, STATES_LAYOUT, reports_unsupported=False)


def plan_of_jacobians(operations: int, backend: Availability) -> ExecutionPlan:
    """The plan of the Jacobians at many states.

    On a CPU their kernel is built for a long loop, too: it takes 3 s of processor time for an arm
    of six joints, XLA's program of the same loop 7 s.
    """
    if backend.reason is None and backend.name == "native":
        return ExecutionPlan((backend.name,), STATES_LAYOUT, STATES_LAYOUT, False)
    return plan_of_states(operations, backend)


def requested_executors(backend: str, machine: Machine) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The available executors for a requested backend, best first, and warnings."""
    if backend == "vmap":
        return (), ()
    requested = [state for state in machine.executors if backend in ("auto", state.name)]
    if not requested and backend != "auto":
        warning = (
            f"The {backend} backend is not for the default device, {machine.platform}: running on"
            " vmap."
        )
        return (), (warning,)
    names = tuple(name for name, reason in requested if reason is None)
    following = next(iter(names), "vmap")
    warnings = tuple(
        unavailable_warning(name, reason, following)
        for name, reason in requested
        if reason is not None
    )
    return names, warnings


def unavailable_warning(backend: str, reason: object, following: str) -> str:
    """The warning that an executor is not available and which backend replaces it."""
    return f"The {backend} backend is not available ({reason}): running on {following}."


def scan_warning(reason: object) -> str:
    """The warning that a scenario cannot be lowered and runs by the scan."""
    return f"This scenario runs on the vmap backend, many times slower: {reason}."


def scan_layout(platform: str, operations: int, runs: int | None, nested: bool) -> BatchLayout:
    """The layout of the scan.

    Args:
      platform: the platform, as JAX names it.
      operations: operations of one evaluation of the closed loop.
      runs: runs of the batch; None for one run.
      nested: whether a caller may batch, differentiate or loop over the result, where XLA refuses
        machine functions or aborts.
    """
    is_long = operations > thresholds.LONG_EVALUATION
    if nested or not thresholds.has_machine_functions(platform):
        return BatchLayout("vmap", "none", is_long)
    if is_long:
        return BatchLayout("map", "parts", True)
    is_small = (runs or 1) <= thresholds.SMALL_BATCH
    return BatchLayout("vmap", "loop" if is_small else "none", runs is None)


def lowered_layout(platform: str, operations: int, runs: int, nested: bool) -> BatchLayout:
    """The layout of the code before and after the steps that an executor makes.

    Machine functions reduce its time to two thirds for one run.  For 48 runs, and for arms of many
    joints, XLA refuses one of their fusions.
    """
    is_short = operations <= thresholds.LONG_EVALUATION
    if runs == 1 and is_short and not nested and thresholds.has_machine_functions(platform):
        return BatchLayout("vmap", "parts", False)
    return PLAIN_LAYOUT
