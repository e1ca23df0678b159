"""Stage 4 of a batch that runs with several time steps: it is compiled in three parts, as a single
run is (`single_run`).

    _initialize    the carries before the first step, and the linearizations at the start
    _all_steps     the steps
    _finalize      the metrics and the status

Only the second part, which calls a kernel, depends on the number of steps, and that only as an
input where the executor accepts it.  A search for gains, its checks at a half and a quarter of the
step and its report thus share the parts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import jax
import numpy as np

from iblf_jax.core import programs
from iblf_jax.engine import registry, thresholds
from iblf_jax.engine.batch import finalize, initialize
from iblf_jax.engine.carry import Carry, Inputs
from iblf_jax.engine.compile import inputs_of, structural_part
from iblf_jax.engine.execute import CompiledBatch, compile_batch
from iblf_jax.engine.linearization import Linearization
from iblf_jax.engine.loops import kernel_stepper
from iblf_jax.engine.outcome import Outcome
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.simulation.scenario import Scenario

if TYPE_CHECKING:
    from iblf_jax.simulation.metrics import Fold

Arguments = tuple[
    Scenario, Mapping[str, jax.Array], "tuple[Fold, ...]", jax.Array, np.ndarray | jax.Array
]
"""Scenario, leaves of the runs by path, metrics, time step and number of steps."""


def run_batch_in_parts(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
) -> Outcome:
    """Runs a scenario once for every entry of `varied`, as `run_batch` does; call it outside of
    `jit`.

    Args:
      scenario, varied, folds, dt: as `run_batch`.
      request: the request, without records.

    Returns:
      An `Outcome` with a leading batch axis on every array.

    Raises:
      ValueError: an unknown backend.
    """
    compiled = compile_batch(request, scenario, varied, folds, dt)
    arguments = (scenario, dict(varied), folds, dt, np.asarray(request.steps, dt.dtype))

    def run(batch: CompiledBatch) -> Outcome:
        if not batch.execution.backends:
            return _in_one_program(arguments, batch=batch)
        # A part has what it does not depend on at one value, so that all requests share it.
        of_start = batch._replace(request=request._replace(steps=0, assessed=True))
        of_steps = batch._replace(request=request._replace(assessed=True))
        if registry.EXECUTORS[batch.backend].accepts_first_step:
            of_steps = batch._replace(request=structural_part(request))
        of_end = batch._replace(request=request._replace(steps=0))
        carry, at_start = _initialize(arguments, batch=of_start)
        carry = _all_steps(arguments, carry, np.int32(request.instants), batch=of_steps)
        return _finalize(arguments, carry, at_start, batch=of_end)

    return compiled.first_that_works(run)


def _inputs(arguments: Arguments, batch: CompiledBatch) -> tuple[Inputs, Mapping[str, jax.Array]]:
    """The inputs that all runs share, and the leaves of the runs."""
    scenario, varied, folds, dt, steps = arguments
    inputs = inputs_of(scenario, folds, dt, batch.request)
    return inputs._replace(steps=steps), varied  # type: ignore[arg-type]


@programs.jit(static_argnames="batch", options=programs.SHORTEST_TO_COMPILE, kept=True)
def _initialize(arguments: Arguments, *, batch: CompiledBatch) -> tuple[Carry, Linearization]:
    run_steps, runs = batch.stepper(*_inputs(arguments, batch))
    return initialize(run_steps, runs, batch.request.method)


@programs.jit(static_argnames="batch", kept=True)
def _all_steps(
    arguments: Arguments, carry: Carry, instants: jax.Array, *, batch: CompiledBatch
) -> Carry:
    """The carry after all steps, whose number is `instants`, or that of the request for an executor
    that compiles it in.
    """
    request = batch.request
    executor = registry.EXECUTORS[batch.backend]
    run_steps, runs = batch.stepper(*_inputs(arguments, batch))
    number: int | jax.Array = request.instants
    if executor.accepts_first_step:
        bytes_of_runs = (runs.runs or 1) * runs.dtype.itemsize
        short = thresholds.uses_short_vector(bytes_of_runs, request.instants)
        run_steps = kernel_stepper(executor, short_vector=short)
        number = instants
    return run_steps(TimeStep.of(request), runs, carry, number, None)[0]


@programs.jit(static_argnames="batch", options=programs.SHORTEST_TO_COMPILE, kept=True)
def _finalize(
    arguments: Arguments, carry: Carry, at_start: Linearization, *, batch: CompiledBatch
) -> Outcome:
    run_steps, runs = batch.stepper(*_inputs(arguments, batch))
    return finalize(run_steps, runs, batch.request, carry, at_start)


@programs.jit(static_argnames="batch", kept=True)
def _in_one_program(arguments: Arguments, *, batch: CompiledBatch) -> Outcome:
    """All parts as one program, for the scan, which takes longer to run than to compile."""
    scenario, varied, folds, dt, _ = arguments
    return batch(scenario, varied, folds, dt)
