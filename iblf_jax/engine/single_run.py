"""Stage 4 of a single run, which is compiled in three parts:

    _initialize    the carry before the first step, and the linearization at the start
    _all_steps     the steps and the records
    _finalize      the metrics and the status

Only the second part depends on the number of steps and on what is recorded.  XLA does not optimise
the first and the last one, which run for less than a millisecond: that saves about 0.9 of 3.4 s of
processor time at a first call of the paper's loop whose kernels exist.  The steps of a long
run are made in several calls (`_steps_in_calls`), between which Python responds to Ctrl-C; the
results are the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import programs
from iblf_jax.engine import registry, thresholds
from iblf_jax.engine.batch import Batch, Stepper, finalize, initialize, run_all
from iblf_jax.engine.carry import Carry
from iblf_jax.engine.compile import (
    building,
    first_that_works,
    inputs_of,
    plan_of_single_run,
    scan_of,
    shapes_of,
    single_batch,
    structural_part,
)
from iblf_jax.engine.linearization import Linearization
from iblf_jax.engine.loops import kernel_stepper
from iblf_jax.engine.outcome import Outcome
from iblf_jax.engine.registry import Executor
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.engine.waiting import wait_until_ready
from iblf_jax.simulation.scenario import Scenario

if TYPE_CHECKING:
    from jax.tree_util import PyTreeDef

    from iblf_jax.simulation.metrics import Fold


def run_one(
    scenario: Scenario,
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
    noise_key: jax.Array | None = None,
) -> Outcome:
    """Runs a scenario once; the caller must not batch or differentiate it.

    On "auto" the scan makes a run whose step is long or cannot be lowered, without a warning.

    Args:
      scenario, folds, dt: as `run_batch`.
      request: the request.
      noise_key: key of the run's random numbers.
    """
    leaves, structure = jax.tree.flatten(inputs_of(scenario, folds, dt, request, noise_key))
    shapes = shapes_of(leaves)
    execution, nodes = plan_of_single_run(
        structural_part(request), registry.machine(), structure, shapes
    )
    # The parts do not depend on the requested backend, so they are compiled for one value of it.
    request = request._replace(backend="auto")

    def attempt(executor: Executor) -> Outcome:
        compiled = Compiled(executor.name, structure)
        with building():
            return _run_by_executor(compiled, nodes, request, leaves)

    def by_scan() -> Outcome:
        return _run_by_scan(structure, request, leaves)

    key = (run_one, structure, shapes)
    outcome = first_that_works(execution, attempt, by_scan, key)
    wait_until_ready(outcome)
    return outcome


class Compiled(NamedTuple):
    """What the three parts of a run are compiled for; static."""

    backend: str
    """Name of the executor."""
    structure: PyTreeDef
    """Tree structure of the `Inputs`."""

    def batch(self, leaves: list, request: RunRequest) -> Batch:
        """The batch of one run."""
        return single_batch(jax.tree.unflatten(self.structure, leaves), request)

    @property
    def executor(self) -> Executor:
        """The executor."""
        return registry.EXECUTORS[self.backend]


def _run_by_executor(compiled: Compiled, nodes: int, request: RunRequest, leaves: list) -> Outcome:
    """One run by an executor; `nodes` are those of the scalar program of its step."""
    without_steps = request._replace(steps=0, record_every=None)
    carry, at_start = _initialize(compiled, without_steps, leaves)
    executor = compiled.executor
    most_operations = request.instants * (executor.limits.single_run_nodes or nodes)
    length = request.instants
    if executor.accepts_first_step and most_operations > thresholds.OPERATIONS_PER_CALL:
        length = thresholds.steps_per_call(nodes, request.instants, request.record_every)
    if length >= request.instants:
        carry, records = _all_steps(compiled, request, leaves, carry)
    else:
        carry, records = _steps_in_calls(compiled, request, leaves, carry, length)
    outcome = _finalize(compiled, without_steps, leaves, carry, at_start)
    return outcome._replace(records=records)


@programs.jit(static_argnums=(0, 1), options=programs.SHORTEST_TO_COMPILE, kept=True)
def _initialize(
    compiled: Compiled, request: RunRequest, leaves: list
) -> tuple[Carry, Linearization]:
    run_steps = kernel_stepper(compiled.executor)
    return initialize(run_steps, compiled.batch(leaves, request), request.method)


@programs.jit(static_argnums=(0, 1), kept=True)
def _all_steps(
    compiled: Compiled, request: RunRequest, leaves: list, carry: Carry
) -> tuple[Carry, Any]:
    run_steps = kernel_stepper(compiled.executor)
    return _steps(run_steps, compiled.batch(leaves, request), request, carry, request.instants)


def _steps_in_calls(
    compiled: Compiled, request: RunRequest, leaves: list, carry: Carry, length: int
) -> tuple[Carry, Any]:
    """All steps, `length` of them in each call."""
    without_steps = request._replace(steps=0)
    recorded = []
    for first in range(0, request.instants, length):
        count = min(length, request.instants - first)
        carry, records = _steps_from(compiled, without_steps, count, leaves, carry, np.int32(first))
        jax.block_until_ready(carry)
        recorded.append(records)
    if request.record_every is None:
        return carry, None
    return carry, jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *recorded)


@programs.jit(static_argnums=(0, 1, 2), kept=True)
def _steps_from(
    compiled: Compiled,
    request: RunRequest,
    count: int,
    leaves: list,
    carry: Carry,
    first: jax.Array,
) -> tuple[Carry, Any]:
    """`count` steps from step `first` on, by the kernel for many steps."""
    run_steps = kernel_stepper(compiled.executor, first=first, short_vector=True)
    return _steps(run_steps, compiled.batch(leaves, request), request, carry, count)


def _steps(
    run_steps: Stepper, batch: Batch, request: RunRequest, carry: Carry, steps: int
) -> tuple[Carry, Any]:
    """Steps of a batch of one run; the records have no run axis, and are None if not requested."""
    carry, records = run_steps(TimeStep.of(request), batch, carry, steps, request.record_every)
    if request.record_every is None:
        return carry, None
    return carry, jax.tree.map(lambda x: x[0], records)


@programs.jit(static_argnums=(0, 1), options=programs.SHORTEST_TO_COMPILE, kept=True)
def _finalize(
    compiled: Compiled, request: RunRequest, leaves: list, carry: Carry, at_start: Linearization
) -> Outcome:
    run_steps = kernel_stepper(compiled.executor)
    outcome = finalize(run_steps, compiled.batch(leaves, request), request, carry, at_start)
    return jax.tree.map(lambda x: x[0], outcome)


@programs.jit(static_argnums=(0, 1))
def _run_by_scan(structure: PyTreeDef, request: RunRequest, leaves: list) -> Outcome:
    inputs = jax.tree.unflatten(structure, leaves)
    return run_all(scan_of(inputs), Batch.of(inputs, None), request)
