"""Stage 2 of a run: how a request is executed, decided from sizes and the machine.

`choose_plan` is a pure function from a request, the sizes of its inputs and the machine to an
`ExecutionPlan`, which lists the executors to try.
`within_node_limit` and `scan_only` revise the plan of a single run once its step has been lowered.
The limits are in `thresholds`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from iblf_jax.engine import registry, thresholds
from iblf_jax.engine.registry import Availability, Machine
from iblf_jax.engine.request import RunRequest, check_backend


class ExecutionPlan(NamedTuple):
    """How a request is executed."""

    backends: tuple[str, ...]
    """Names of the executors to try, best first.  If none of them can run it, the scan does."""
    reports_unsupported: bool
    """Whether to warn if the step cannot be lowered."""
    warnings: tuple[str, ...] = ()
    """Warnings about the requested backend."""

    @property
    def backend(self) -> str:
        """The first executor to try; "vmap" for the scan."""
        return next(iter(self.backends), "vmap")


def choose_plan(request: RunRequest, runs: int | None, machine: Machine) -> ExecutionPlan:
    """The plan for a request.

    Args:
      request: what is to be run.
      runs: runs of the batch; None for a single run.
      machine: the platform and its executors.

    Raises:
      ValueError: an unknown backend.
    """
    backend = check_backend(request.backend)
    names, warnings = requested_executors(backend, machine)
    return ExecutionPlan(
        names,
        # A single run takes little time on any backend, so that "auto" does not warn.
        reports_unsupported=runs is not None or backend != "auto",
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
    """Plan for few steps from many states, by the default backend of the machine.  Compilation
    dominates, so the stages are rolled, and a kernel is built only for a short closed loop.
    """
    backends: tuple[str, ...] = ()
    if backend.reason is None and operations <= thresholds.LONG_EVALUATION:
        backends = (backend.name,)
    return ExecutionPlan(backends, reports_unsupported=False)


def plan_of_jacobians(count_operations: Callable[[], int], backend: Availability) -> ExecutionPlan:
    """The plan of the Jacobians at many states; their operations are counted where they decide.

    On a CPU their kernel is built for a long loop, too: it takes 3 s of processor time for an arm
    of six joints, XLA's program of the same loop 7 s.
    """
    if backend.reason is None and backend.name == "native":
        return ExecutionPlan((backend.name,), reports_unsupported=False)
    return plan_of_states(count_operations(), backend)


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
