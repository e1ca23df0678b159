"""The functions that make all steps of a batch, each a `Stepper`.

`scan` and `checkpointed` are loops of JAX over the step.  `kernel_stepper` returns that of an
executor, which runs the scalar program of the step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import thresholds
from iblf_jax.engine.batch import Batch, Leaves, Stepper
from iblf_jax.engine.carry import Step, StepOptions, tree_where
from iblf_jax.engine.linearization import LinearizationStep
from iblf_jax.engine.registry import Executor
from iblf_jax.kernels import (
    EMPTY,
    CompiledStep,
    Shapes,
    compile_step,
    unpacked_records,
)


def scan(
    step: Step, batch: Batch, carry: Any, steps: int, every: int | None, *, rolled: bool = False
) -> tuple[Any, Any]:
    """All steps of all runs by `jax.lax.scan`, for any scenario and device; differentiable in
    forward and reverse mode.  `rolled`: whether the stages of the integrator are a loop.
    """
    options = StepOptions(rolled)

    def one(inputs, carry):
        def of_run(carry, index):
            return step(inputs, carry, index, options)

        return _scan_run(of_run, carry, steps, every)

    return batch.map_runs(one, carry)


def _scan_run(step: Callable, carry: Any, steps: int, every: int | None) -> tuple[Any, Any]:
    """All steps of one run.  Every step computes its record, because the step is compiled once;
    records that are not requested are discarded.
    """
    if every is None:
        return jax.lax.scan(
            lambda carry, index: (step(carry, index)[0], None), carry, jnp.arange(steps)
        )
    if every == 1:
        return jax.lax.scan(step, carry, jnp.arange(steps))
    every = min(every, steps)
    blank = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(step, carry, jnp.int32(0))[1]
    )

    def one_step(carry_and_record, index):
        before, record = carry_and_record
        after, new_record = step(before, index)
        after = tree_where(index < steps, after, before)
        return (after, tree_where(index % every == 0, new_record, record)), None

    def one_interval(carry_and_record, first):
        indices = first + jnp.arange(every)
        carry_and_record, _ = jax.lax.scan(one_step, carry_and_record, indices)
        return carry_and_record, carry_and_record[1]

    intervals = checks.ceil_div(steps, every)
    (carry, _), records = jax.lax.scan(one_interval, (carry, blank), every * jnp.arange(intervals))
    return carry, records


def checkpointed(
    step: Step, batch: Batch, carry: Any, steps: int, every: int | None, *, rolled: bool = False
) -> tuple[Any, Any]:
    """As `scan` without records, for reverse mode: about 3 T^(1/3) states are in memory at a time.

    Three nested loops keep only every T^(2/3)-th state and compute the others again.
    """
    if every is not None or isinstance(step, LinearizationStep):
        return scan(step, batch, carry, steps, every, rolled=rolled)
    inner, blocks = thresholds.checkpoint_edge(steps)
    options = StepOptions(rolled)

    def one(inputs, carry):
        @jax.checkpoint
        def one_step(carry, index):
            after, _ = step(inputs, carry, index, options)
            return tree_where(index < steps, after, carry), None

        @jax.checkpoint
        def inner_loop(carry, first):
            return jax.lax.scan(one_step, carry, first + jnp.arange(inner))

        @jax.checkpoint
        def middle_loop(carry, first):
            return jax.lax.scan(inner_loop, carry, first + inner * jnp.arange(inner))

        return jax.lax.scan(middle_loop, carry, inner * inner * jnp.arange(blocks))

    return batch.map_runs(one, carry)


@CACHE.memoised(64)
def _on_leaves(step: Step, treedef, is_per_run: tuple[bool, ...], carry_treedef) -> Callable:
    """The step as a function of lists of leaves.  `compile_step` caches by the function object, so
    the same structure gives the same object.  A step that reads a series has one more argument.
    """

    def on_leaves(shared, per_run, *series_carry_and_index):
        *series, carry, index = series_carry_and_index
        inputs = Leaves(treedef, is_per_run, [], []).unflatten(shared, per_run)
        before = jax.tree.unflatten(carry_treedef, carry)
        after, records = step(inputs, before, index, StepOptions(scalar=True), *series)
        return jax.tree.leaves(after), records

    return on_leaves


def program_of(step: Step, batch: Batch, carry: Any, series: Shapes = EMPTY) -> CompiledStep:
    """The scalar program of a step, for a carry with a leading batch axis (arrays or their shapes);
    `series` has the shapes of what each step of a run reads from a series.

    Raises:
      UnsupportedError: the step cannot be lowered.
    """
    flat, treedef = jax.tree.flatten(carry)
    leaves = batch.leaves
    function = _on_leaves(step, leaves.treedef, leaves.is_per_run, treedef)
    return compile_step(
        function,
        np.dtype(batch.dtype),
        Shapes.of(leaves.shared),
        Shapes.of(leaves.per_run, 1),
        Shapes.of(flat, 1),
        limits=thresholds.LOWERING_LIMITS,
        is_derivative=step.is_derivative,
        known=batch.shared_constants,
        series=series,
    )


def rows_of_leaves(executor: Executor, batch: Batch) -> tuple[jax.Array, jax.Array]:
    """The leaves of a batch as a kernel reads them: shared (S,), and per run (P, runs)."""
    pack = partial(executor.pack, dtype=batch.dtype)
    shared, per_run = batch.leaves.shared, batch.leaves.per_run
    # Shared leaves are packed as those of a single run.
    shared_rows = pack([x[None] for x in shared], Shapes.of(shared), runs=1).floats
    per_run_rows = pack(per_run, Shapes.of(per_run, 1), runs=batch.runs or 1).floats
    return shared_rows[:, 0], per_run_rows


def kernel_stepper(executor: Executor, **options: Any) -> Stepper:
    """The `Stepper` of an executor, by the scalar program of a step.

    Args:
      executor: the executor.
      options: further arguments of `executor.run`.
    """

    def run_steps(
        step: Step, batch: Batch, carry: Any, steps: int | jax.Array, every: int | None
    ) -> tuple[Any, Any]:
        compiled = program_of(step, batch, carry)
        runs = batch.runs or 1
        flat, treedef = jax.tree.flatten(carry)
        shapes = Shapes.of(flat, 1)
        before = executor.pack(flat, shapes, batch.dtype, runs)
        after, arrays = executor.run(
            compiled.program, *rows_of_leaves(executor, batch), before, steps, every, **options
        )
        records = ()
        if every:
            records = unpacked_records(compiled.records, arrays)
        return jax.tree.unflatten(treedef, executor.unpack(after, shapes, runs)), records

    return run_steps
