"""A batch of runs through a lowered step: start, kernel, finish."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax import rollout
from iblf_jax.lowering.program import Program
from iblf_jax.lowering.step import Leaves, Packed, Shapes, lowered, pack, split, unpack

Executor = Callable[[Program, jax.Array, jax.Array, Packed, int, int | None], tuple[Packed, jax.Array]]
"""Runs a program: `native.run` or `xla.run`."""


@lru_cache(maxsize=64)
def step_function(treedef, is_lane: tuple[bool, ...], carry_treedef, method: str, recorded: bool) -> Callable:
    """One step as a function of lists of leaves, for `lowered`; the same object for the same structure."""

    def step(shared, lane, carry, index):
        scenario, folds, dt = Leaves(treedef, is_lane, [], []).together(shared, lane)
        carry = jax.tree.unflatten(carry_treedef, carry)
        state = carry.state
        carry, sample = rollout.advance(scenario, folds, method, dt, carry, index)
        samples = jax.tree.leaves(rollout._recorded(sample, state)) if recorded else []
        return jax.tree.leaves(carry), samples

    return step


def program_of(leaves: Leaves, dtype, carry: Any, method: str, recorded: bool) -> tuple[Program, Shapes]:
    """The lowered step and the shapes of its carry; `carry` has a leading batch axis."""
    flat, treedef = jax.tree.flatten(carry)
    step = step_function(leaves.treedef, leaves.is_lane, treedef, method, recorded)
    shapes = Shapes.of(flat, 1)
    return lowered(step, np.dtype(dtype), Shapes.of(leaves.shared), Shapes.of(leaves.lane, 1), shapes), shapes


def run(executor: Executor, scenario, varied, folds, dt, *, steps: int, method: str, record_every: int | None):
    """`rollout.run` for every entry of `varied`, by a lowered step.

    Raises:
      Unsupported: the step does not lower.
      ToolchainError: the native backend has no compiler.
    """
    runs = jax.tree.leaves(dict(varied))[0].shape[0]
    leaves = split(scenario, varied, folds, dt)

    def whole(lane):
        return leaves.together(leaves.shared, lane)

    def begin(lane):
        scenario, folds, dt = whole(lane)
        return rollout.start(scenario, folds, dt)

    carry = jax.vmap(begin, axis_size=runs)(leaves.lane)
    program, shapes = program_of(leaves, dt.dtype, carry, method, record_every is not None)
    flat, treedef = jax.tree.flatten(carry)
    shared = jnp.concatenate([jnp.ravel(x) for x in leaves.shared]) if leaves.shared else jnp.zeros((0,), dt.dtype)
    lane = pack(leaves.lane, Shapes.of(leaves.lane, 1), dt.dtype, runs).floats
    packed, samples = executor(program, shared, lane, pack(flat, shapes, dt.dtype, runs), steps, record_every)
    carry = jax.tree.unflatten(treedef, unpack(packed, shapes, runs))

    def end(lane, carry):
        scenario, folds, dt = whole(lane)
        carry, sample, outcome = rollout.finish(scenario, folds, method, dt, steps, carry)
        return outcome, rollout._recorded(sample, carry.state)

    outcome, last = jax.vmap(end)(leaves.lane, carry)
    if record_every is None:
        return outcome
    return outcome._replace(records=_records(samples, last, steps % record_every == 0))


def _records(samples: jax.Array, last: Any, with_last: bool) -> Any:
    """The recorded arrays, run axis first, then time; `last` is the sample at the end, which closes a whole number of periods."""
    flat, treedef = jax.tree.flatten(last)
    rows, _, runs = samples.shape
    used, result = 0, []
    for x in flat:
        size = int(np.prod(x.shape[1:]))
        part = samples[:, used : used + size].transpose(2, 0, 1).reshape(runs, rows, *x.shape[1:]).astype(x.dtype)
        used += size
        result.append(jnp.concatenate([part, x[:, None]], axis=1) if with_last else part)
    return jax.tree.unflatten(treedef, result)
