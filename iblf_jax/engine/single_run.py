"""One run, compiled in three parts, of which only the one in the middle depends on the number of
steps and on what is recorded.

    initialize    the carry before the first step, and the loop linearized at the start
    all steps
    finalize      the folds' results and the status

A long run is made in several calls, so that Python sees Ctrl-C between them; the numbers are those
of one call.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core.caches import CACHE
from iblf_jax.engine import registry, thresholds
from iblf_jax.engine.batch import Batch, StepLoop, finalize, initialize, run_all
from iblf_jax.engine.carry import Carry
from iblf_jax.engine.compile import (
    compilers_stopped_on_error,
    first_that_works,
    inputs_of,
    plan_of_single_run,
    scanned,
    shapes_of,
    single_batch,
    structural_part,
)
from iblf_jax.engine.linearization import Linearization
from iblf_jax.engine.loops import kernel_loop, scan
from iblf_jax.engine.outcome import Outcome
from iblf_jax.engine.plan import BatchLayout
from iblf_jax.engine.registry import Executor
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.engine.waiting import wait_until_ready
from iblf_jax.kernels import StoppedError, ToolchainError
from iblf_jax.simulation.scenario import Scenario

FAILED_BUILDS = "failed builds"
"""Topic of the marks of runs whose kernels could not be built, by backend, structure and shapes;
they are not tried again in this process."""


def run_one(
    scenario: Scenario, folds: Any, dt: jax.Array, request: RunRequest, noise: Any = None
) -> Outcome:
    """One run; do not batch or differentiate it from outside.

    On "auto" a run that is long, or that does not lower, goes by the scan without a warning.

    Args:
      scenario, folds, dt: as `run_batch`.
      request: the checked request.
      noise: key of a sensor's noise.
    """
    leaves, structure = jax.tree.flatten(inputs_of(scenario, folds, dt, request, noise))
    shapes = shapes_of(leaves)
    found = plan_of_single_run(structural_part(request), registry.machine(), structure, shapes)
    execution = found.execution
    request = request._replace(backend="auto")  # the same programs, whatever is requested

    def attempt(executor: Executor) -> Outcome:
        parts = Parts(executor.name, structure, execution.layout)
        try:
            with compilers_stopped_on_error():
                return _run_lowered(parts, found.nodes, request, leaves)
        except ToolchainError as error:
            if not isinstance(error, StoppedError):
                CACHE.mark(FAILED_BUILDS, (executor.name, structure, shapes))
            raise

    def by_scan() -> Outcome:
        return _run_by_scan(structure, execution.scan_layout, request, leaves)

    backends = tuple(
        name
        for name in execution.backends
        if not CACHE.is_marked(FAILED_BUILDS, (name, structure, shapes))
    )
    outcome = first_that_works(execution._replace(backends=backends), attempt, by_scan)
    wait_until_ready(outcome)
    return outcome


class Parts(NamedTuple):
    """What the three parts of a run are compiled for; static."""

    backend: str
    inputs: Any
    """The tree of the `Inputs`."""
    layout: BatchLayout

    def batch(self, leaves: list, request: RunRequest) -> Batch:
        """The run as a batch."""
        return single_batch(jax.tree.unflatten(self.inputs, leaves), request, self.layout)

    @property
    def executor(self) -> Executor:
        """What makes the steps."""
        return registry.EXECUTORS[self.backend]

    @property
    def loop(self) -> StepLoop:
        """The loop over the steps."""
        return kernel_loop(self.executor)


def _run_lowered(parts: Parts, nodes: int, request: RunRequest, leaves: list) -> Outcome:
    """One run by an executor; `nodes` of its step's program."""
    independent = request._replace(steps=0, record_every=None)
    carry, at_start = _initialize(parts, independent, leaves)
    length = _steps_per_call(parts.executor, nodes, request)
    if length > request.steps:
        carry, records = _all_steps(parts, request, leaves, carry)
    else:
        carry, records = _steps_in_calls(parts, request, leaves, carry, length)
    return _finalize(parts, independent, leaves, carry, at_start)._replace(records=records)


def _steps_per_call(executor: Executor, nodes: int, request: RunRequest) -> int:
    """Steps of one run that are made before Python sees whether Ctrl-C was pressed."""
    steps = request.steps + 1
    longest = executor.limits.single_run or nodes
    if not executor.continues or steps * longest <= thresholds.OPERATIONS_PER_CALL:
        return steps
    return thresholds.steps_per_call(nodes, steps, request.record_every)


@partial(jax.jit, static_argnums=(0, 1))
def _initialize(parts: Parts, request: RunRequest, leaves: list) -> tuple[Carry, Linearization]:
    return initialize(parts.loop, parts.batch(leaves, request), request.method)


@partial(jax.jit, static_argnums=(0, 1))
def _all_steps(parts: Parts, request: RunRequest, leaves: list, carry: Carry) -> tuple[Carry, Any]:
    return _steps(parts.loop, parts.batch(leaves, request), request, carry, request.steps + 1)


def _steps_in_calls(
    parts: Parts, request: RunRequest, leaves: list, carry: Carry, length: int
) -> tuple[Carry, Any]:
    """All steps, `length` of them in each call."""
    steps = request.steps + 1
    recorded = []
    for first in range(0, steps, length):
        part = request._replace(steps=min(length, steps - first))
        carry, records = _steps_from(parts, part, leaves, carry, np.int32(first))
        jax.block_until_ready(carry)
        recorded.append(records)
    if request.record_every is None:
        return carry, None
    return carry, jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *recorded)


@partial(jax.jit, static_argnums=(0, 1))
def _steps_from(
    parts: Parts, request: RunRequest, leaves: list, carry: Carry, first: jax.Array
) -> tuple[Carry, Any]:
    """`request.steps` steps of one run from step `first` on, by the kernel for many steps."""
    loop = kernel_loop(parts.executor, first=first, short_vector=True)
    return _steps(loop, parts.batch(leaves, request), request, carry, request.steps)


def _steps(
    loop: StepLoop, batch: Batch, request: RunRequest, carry: Carry, steps: int
) -> tuple[Carry, Any]:
    """Steps of the only run of a batch; the records are None where nothing is recorded."""
    carry, records = loop(TimeStep.of(request), batch, carry, steps, request.record_every)
    if request.record_every is None:
        return carry, None
    return carry, jax.tree.map(lambda x: x[0], records)


@partial(jax.jit, static_argnums=(0, 1))
def _finalize(
    parts: Parts, request: RunRequest, leaves: list, carry: Carry, at_start: Linearization
) -> Outcome:
    outcome = finalize(parts.loop, parts.batch(leaves, request), request, carry, at_start)
    return jax.tree.map(lambda x: x[0], outcome)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _run_by_scan(structure: Any, layout: BatchLayout, request: RunRequest, leaves: list) -> Outcome:
    inputs = jax.tree.unflatten(structure, leaves)
    return scanned(layout, inputs, None, lambda batch: run_all(scan, batch, request))
