"""The loops over all steps of a batch: of XLA over the step as it is (`scan`, `checkpointed`), and
of an executor over the step's scalar program (`kernel_loop`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core.caches import CACHE
from iblf_jax.engine import thresholds
from iblf_jax.engine.batch import Batch, Leaves, StepLoop
from iblf_jax.engine.carry import StepOptions, keep_if, step_member
from iblf_jax.engine.linearization import LinearizationStep
from iblf_jax.engine.machine_function import machine_function
from iblf_jax.engine.registry import Executor
from iblf_jax.kernels import (
    CompiledStep,
    Shapes,
    compile_step,
    unpacked_records,
)


def scan(step: Any, batch: Batch, carry: Any, steps: int, every: int | None) -> tuple[Any, Any]:
    """All steps of all runs in `jax.lax.scan`: any scenario, any device, and differentiable in
    either mode.
    """
    options = StepOptions(batch.layout.rolled)
    if batch.layout.machine_functions == "parts":
        options = options._replace(piece=machine_function)

    def one(inputs, carry):
        def of_run(carry, index):
            return step(inputs, carry, index, options)

        return _scan_run(of_run, carry, steps, every)

    return batch.each(one, carry)


def _scan_run(step: Callable, carry: Any, steps: int, every: int | None) -> tuple[Any, Any]:
    """All steps of one run.  The step is compiled once, so records that are not kept are computed,
    too, and overwritten.
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

    def one(carried, index):
        before, record = carried
        after, new = step(before, index)
        return (
            keep_if(index < steps, after, before),
            keep_if(index % every == 0, new, record),
        ), None

    def block(carried, first):
        carried, _ = jax.lax.scan(one, carried, first + jnp.arange(every))
        return carried, carried[1]

    (carry, _), records = jax.lax.scan(
        block, (carry, blank), every * jnp.arange(-(-steps // every))
    )
    return carry, records


def checkpointed(
    step: Any, batch: Batch, carry: Any, steps: int, every: int | None
) -> tuple[Any, Any]:
    """As `scan` without records, for reverse mode: about 3 T^(1/3) states are in memory at a time.

    Only every T^(2/3)-th state is kept; the others are computed again, in three nested loops.
    """
    if every is not None or isinstance(step, LinearizationStep):
        return scan(step, batch, carry, steps, every)
    inner, blocks = thresholds.checkpoint_edge(steps)
    options = StepOptions(batch.layout.rolled)

    def one(inputs, carry):
        @jax.checkpoint
        def single(carry, index):
            return (
                keep_if(index < steps, step(inputs, carry, index, options)[0], carry),
                None,
            )

        @jax.checkpoint
        def few(carry, first):
            return jax.lax.scan(single, carry, first + jnp.arange(inner))

        @jax.checkpoint
        def many(carry, first):
            return jax.lax.scan(few, carry, first + inner * jnp.arange(inner))

        return jax.lax.scan(many, carry, inner * inner * jnp.arange(blocks))

    return batch.each(one, carry)


@CACHE.memoised(64)
def _on_leaves(step: Any, treedef, is_per_run: tuple[bool, ...], carry_treedef) -> Callable:
    """A step as a function of lists of leaves, for `compile_step`; the same object for the same
    structure.
    """

    def on_leaves(shared, per_run, carry, index):
        inputs = Leaves(treedef, is_per_run, [], []).together(shared, per_run)
        after, records = step(
            inputs, jax.tree.unflatten(carry_treedef, carry), index, StepOptions(scalar=True)
        )
        return jax.tree.leaves(after), records

    return on_leaves


def program_of(step: Any, batch: Batch, carry: Any) -> CompiledStep:
    """The scalar program of a step, for a carry with a leading batch axis (arrays or their shapes).

    Raises:
      UnsupportedError: it does not lower.
    """
    flat, treedef = jax.tree.flatten(carry)
    leaves = batch.leaves
    function = _on_leaves(step, leaves.treedef, leaves.is_per_run, treedef)
    # A derivative's literal zero says "does not depend".
    sparse = step_member(step, "is_derivative")
    shapes = Shapes.of(leaves.shared), Shapes.of(leaves.per_run, 1), Shapes.of(flat, 1)
    return compile_step(
        function,
        np.dtype(batch.dtype),
        *shapes,
        thresholds.LOWERING_LIMITS,
        sparse,
        batch.known,
    )


def kernel_loop(executor: Executor, **options: Any) -> StepLoop:
    """The loop of an executor over a step's scalar program.

    Args:
      executor: what runs the program.
      options: further arguments of `executor.run`.
    """

    def loop(step: Any, batch: Batch, carry: Any, steps: int, every: int | None) -> tuple[Any, Any]:
        found, runs = program_of(step, batch, carry), batch.runs or 1
        flat, treedef = jax.tree.flatten(carry)
        shapes = Shapes.of(flat, 1)
        pack = partial(executor.pack, dtype=batch.dtype)
        shared, per_run = batch.leaves.shared, batch.leaves.per_run
        shared_numbers = pack([x[None] for x in shared], Shapes.of(shared), runs=1).floats[:, 0]
        numbers_per_run = pack(per_run, Shapes.of(per_run, 1), runs=runs).floats
        before = pack(flat, shapes, runs=runs)
        after, arrays = executor.run(
            found.program, shared_numbers, numbers_per_run, before, steps, every, **options
        )
        records = ()
        if every:
            records = unpacked_records(found.records, arrays)
        return jax.tree.unflatten(treedef, executor.unpack(after, shapes, runs)), records

    return loop
