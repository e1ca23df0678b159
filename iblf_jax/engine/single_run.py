"""One run, compiled in three parts, of which only the one in the middle depends on the number of
steps and on what is recorded.

    initialize    the carry before the first step, and the loop linearized at the start
    advance       all steps
    finalize      the folds' results and the status

A long run is advanced in several calls, so that Python sees Ctrl-C between them; the numbers are
those of one call.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core.caches import CACHE
from iblf_jax.engine import plan, registry
from iblf_jax.engine.batch import Batch, finalize, initialize, run_all
from iblf_jax.engine.compile import (
    SingleRunPlan,
    compilers_stopped_on_error,
    first_that_works,
    inputs_of,
    loop_of,
    plan_of_single_run,
    scanned,
    shapes_of,
    single_batch,
    structural_part,
)
from iblf_jax.engine.executors import lowered_on, scan
from iblf_jax.engine.registry import Executor
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.step import Carry, Linearization, Outcome, TimeStep
from iblf_jax.engine.waiting import wait_until_ready
from iblf_jax.kernels import StoppedError, ToolchainError
from iblf_jax.simulation.scenario import Scenario

FAILED_BUILDS = "failed builds"
"""Topic of the marks of runs whose kernels could not be built, by executor, structure and shapes;
they are not tried again in this process."""


def run_one(
    scenario: Scenario, folds: Any, dt: jax.Array, request: RunRequest, noise: Any = None
) -> Outcome:
    """One run; do not batch or differentiate it from outside.

    A requested executor that compiles kernels falls back with a warning.  On "auto" and "xla" a run
    that is long, or that does not lower, goes by the scan without one.

    Args:
      scenario, folds, dt: as `run_batch`.
      request: the checked request.
      noise: key of a sensor's noise.
    """
    leaves, structure = jax.tree.flatten(inputs_of(scenario, folds, dt, request, noise))
    shapes = shapes_of(leaves)
    found = plan_of_single_run(structural_part(request), registry.machine(), structure, shapes)
    request = request._replace(backend="auto")  # the same programs, whatever is requested

    def attempt(executor: Executor) -> Outcome:
        try:
            with compilers_stopped_on_error():
                return _run_lowered(executor, structure, found, request, leaves)
        except ToolchainError as error:
            if not isinstance(error, StoppedError):
                CACHE.mark(FAILED_BUILDS, (executor.name, structure, shapes))
            raise

    def by_scan() -> Outcome:
        return _run_by_scan(structure, found.execution.scan_layout, request, leaves)

    outcome = first_that_works(_without_failed(found, structure, shapes), attempt, by_scan)
    wait_until_ready(outcome)
    return outcome


def _without_failed(found: SingleRunPlan, structure: Any, shapes: tuple) -> plan.ExecutionPlan:
    """The plan without executors whose kernels could not be built."""
    names = tuple(
        name
        for name in found.execution.executors
        if not CACHE.is_marked(FAILED_BUILDS, (name, structure, shapes))
    )
    return found.execution._replace(executors=names)


class Parts(NamedTuple):
    """What the three parts of a run are compiled for; static."""

    executor: str
    inputs: Any
    """The tree of the `Inputs`."""
    layout: plan.BatchLayout

    def batch(self, leaves: list, request: RunRequest) -> Batch:
        """The run as a batch."""
        return single_batch(jax.tree.unflatten(self.inputs, leaves), request, self.layout)

    @property
    def loop(self) -> Any:
        """The loop over the steps."""
        return loop_of(registry.EXECUTORS[self.executor])


def _run_lowered(
    executor: Executor, structure: Any, found: SingleRunPlan, request: RunRequest, leaves: list
) -> Outcome:
    """One run by an executor."""
    parts = Parts(executor.name, structure, found.execution.layout)
    independent = request._replace(steps=0, record_every=None)
    carry, at_start = _initialize(parts, independent, leaves)
    length = _steps_per_call(executor, found.nodes, request)
    if length > request.steps:
        carry, records = _advance(parts, request, leaves, carry)
    else:
        carry, records = _advance_in_calls(parts, request, leaves, carry, length)
    return _finalize(parts, independent, leaves, carry, at_start)._replace(records=records)


def _steps_per_call(executor: Executor, nodes: int, request: RunRequest) -> int:
    """Steps of one run that are made before Python sees whether Ctrl-C was pressed."""
    steps = request.steps + 1
    longest = executor.limits.single_run or nodes
    if not executor.continues or steps * longest <= plan.NATIVE_UNSEEN:
        return steps
    return plan.native_stretch(nodes, steps, request.record_every)


@partial(jax.jit, static_argnums=(0, 1))
def _initialize(parts: Parts, request: RunRequest, leaves: list) -> tuple[Carry, Linearization]:
    return initialize(parts.loop, parts.batch(leaves, request), request.method)


@partial(jax.jit, static_argnums=(0, 1))
def _advance(parts: Parts, request: RunRequest, leaves: list, carry: Carry) -> tuple[Carry, Any]:
    batch = parts.batch(leaves, request)
    carry, records = parts.loop(
        TimeStep.of(request), batch, carry, request.steps + 1, request.record_every
    )
    return carry, _first_run(records, request)


def _advance_in_calls(
    parts: Parts, request: RunRequest, leaves: list, carry: Carry, length: int
) -> tuple[Carry, Any]:
    """All steps, `length` of them in each call."""
    steps = request.steps + 1
    recorded = []
    for first in range(0, steps, length):
        part = request._replace(steps=min(length, steps - first))
        carry, records = _advance_from(parts, part, leaves, carry, np.int32(first))
        jax.block_until_ready(carry)
        recorded.append(records)
    if request.record_every is None:
        return carry, None
    return carry, jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *recorded)


@partial(jax.jit, static_argnums=(0, 1))
def _advance_from(
    parts: Parts, request: RunRequest, leaves: list, carry: Carry, first: jax.Array
) -> tuple[Carry, Any]:
    """`request.steps` steps of one run from step `first` on, by the kernel for many steps."""
    executor = registry.EXECUTORS[parts.executor]
    run = partial(executor.run, first=first, narrow=True)
    loop = lowered_on(run, executor.pack, executor.unpack)
    batch = parts.batch(leaves, request)
    carry, records = loop(TimeStep.of(request), batch, carry, request.steps, request.record_every)
    return carry, _first_run(records, request)


def _first_run(records: Any, request: RunRequest) -> Any:
    """The records of the only run of a batch; None where nothing is recorded."""
    if request.record_every is None:
        return None
    return jax.tree.map(lambda x: x[0], records)


@partial(jax.jit, static_argnums=(0, 1))
def _finalize(
    parts: Parts, request: RunRequest, leaves: list, carry: Carry, at_start: Linearization
) -> Outcome:
    outcome = finalize(parts.loop, parts.batch(leaves, request), request, carry, at_start)
    return jax.tree.map(lambda x: x[0], outcome)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _run_by_scan(
    structure: Any, layout: plan.BatchLayout, request: RunRequest, leaves: list
) -> Outcome:
    inputs = jax.tree.unflatten(structure, leaves)
    return scanned(layout, inputs, None, lambda batch: run_all(scan, batch, request))
