"""A batch of runs through a lowered step: start, kernel, finish."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax import time_loop
from iblf_jax.closed_loop import LoopState
from iblf_jax.lowering.program import Program, UnsupportedError
from iblf_jax.lowering.step import Leaves, Packed, Shapes, lowered, pack, split, unpack
from iblf_jax.one_function import as_one_function
from iblf_jax.stability import POWER_ITERATIONS, Growth, growth_rate, growth_start, growth_step

Executor = Callable[[Program, jax.Array, jax.Array, Packed, int, int | None], tuple[Packed, list[jax.Array]]]
"""Runs a program: `native.run` or `xla.run`."""


@lru_cache(maxsize=64)
def step_function(treedef, is_lane: tuple[bool, ...], carry_treedef, method: str, recorded: bool) -> Callable:
    """One step of the time loop as a function of lists of leaves, for `lowered`; the same object for the same structure."""

    def step(shared, lane, carry, index):
        scenario, folds, dt = Leaves(treedef, is_lane, [], []).together(shared, lane)
        carry = jax.tree.unflatten(carry_treedef, carry)
        state = carry.state
        carry, sample = time_loop.advance(scenario, folds, method, dt, carry, index)
        return jax.tree.leaves(carry), jax.tree.leaves(time_loop.record_of(sample, state)) if recorded else []

    return step


class Instants(NamedTuple):
    """Carry of the power iteration of some instants at once; times and states stay as they are, so what they decide is done once."""

    growth: Growth
    times: jax.Array
    states: LoopState


@lru_cache(maxsize=64)
def mode_function(treedef, is_lane: tuple[bool, ...], carry_treedef) -> Callable:
    """One step of the power iteration, at all critical instants of a run, as a function of lists of leaves."""

    def step(shared, lane, carry, index):
        scenario, _, _ = Leaves(treedef, is_lane, [], []).together(shared, lane)
        growth, times, states = jax.tree.unflatten(carry_treedef, carry)
        growth = jax.vmap(lambda t, state, growth: growth_step(scenario, t, state, growth, index))(times, states, growth)
        return jax.tree.leaves(Instants(growth, times, states)), []

    return step


class Batch(NamedTuple):
    """The leaves of a batch of runs, and what runs a program."""

    executor: Executor
    leaves: Leaves
    dtype: Any
    runs: int
    sparse: bool = False
    """For steps that hold derivatives."""

    def whole(self, lane):
        """(scenario, folds, dt) of one run, from its leaves."""
        return self.leaves.together(self.leaves.shared, lane)

    def program(self, make: Callable, carry: Any, *options) -> tuple[Program, Shapes, Any]:
        """The lowered step that `make` gives, for a carry with a leading batch axis."""
        flat, treedef = jax.tree.flatten(carry)
        shapes = Shapes.of(flat, 1)
        step = make(self.leaves.treedef, self.leaves.is_lane, treedef, *options)
        program = lowered(step, np.dtype(self.dtype), Shapes.of(self.leaves.shared), Shapes.of(self.leaves.lane, 1), shapes, self.sparse)
        return program, shapes, treedef

    def advance(self, make: Callable, carry: Any, steps: int, every: int | None, *options) -> tuple[Any, list[jax.Array]]:
        """The carry after `steps` steps, and the recorded arrays (see `native.run`)."""
        program, shapes, treedef = self.program(make, carry, *options)
        shared = [jnp.ravel(x).astype(self.dtype) for x in self.leaves.shared]
        lane = pack(self.leaves.lane, Shapes.of(self.leaves.lane, 1), self.dtype, self.runs).floats
        packed = pack(jax.tree.leaves(carry), shapes, self.dtype, self.runs)
        packed, samples = self.executor(program, jnp.concatenate([*shared, jnp.zeros((0,), self.dtype)]), lane, packed, steps, every)
        return jax.tree.unflatten(treedef, unpack(packed, shapes, self.runs)), samples

    def start(self, method: str):
        """The carry before the first step."""

        def one(lane):
            scenario, folds, dt = self.whole(lane)
            return time_loop.start(scenario, folds, method, dt)

        return jax.vmap(one, axis_size=self.runs)(self.leaves.lane)


def batch_of(executor: Executor, scenario, varied, folds, dt) -> Batch:
    """The batch of `varied`."""
    runs = jax.tree.leaves(dict(varied))[0].shape[0]
    return Batch(executor, split(scenario, varied, folds, dt), dt.dtype, runs)


def run(executor: Executor, scenario, varied, folds, dt, *, steps: int, method: str, record_every: int | None):
    """`compact_loop.run` for every entry of `varied`, by a lowered step.

    Raises:
      UnsupportedError: the step does not lower.
      ToolchainError: the native backend has no compiler.
    """
    batch = batch_of(executor, scenario, varied, folds, dt)
    carry, samples = batch.advance(step_function, batch.start(method), steps, record_every, method, record_every is not None)
    outcome, last = finish(batch, method, steps, carry)
    return outcome if record_every is None else outcome._replace(records=_records(samples, last, steps % record_every == 0))


def run_alone(executor: Executor, scenario, folds, dt, *, steps: int, method: str, record_every: int, longest: int | None):
    """`compact_loop.run` for one run, by a lowered step of at most `longest` operations; raises as `run`.

    Start and end are the plain ones, quicker to compile than lowered.
    """
    batch = batch_of(executor, scenario, {"initial.q": scenario.initial.q[None]}, folds, dt)
    carry = jax.tree.map(lambda x: x[None], time_loop.start(scenario, folds, method, dt))
    if longest and len(batch.program(step_function, carry, method, True)[0].nodes) > longest:
        raise UnsupportedError(f"its step has more than {longest} operations")
    carry, samples = batch.advance(step_function, carry, steps, record_every, method, True)

    def end(scenario, folds, dt, carry):
        carry, sample, outcome = time_loop.finish(scenario, folds, method, dt, steps, carry)
        return outcome, time_loop.record_of(sample, carry.state)

    outcome, last = as_one_function(end)(scenario, folds, dt, jax.tree.map(lambda x: x[0], carry))
    records = _records(samples, jax.tree.map(lambda x: x[None], last), steps % record_every == 0)
    return outcome._replace(records=jax.tree.map(lambda x: x[0], records))


def finish(batch: Batch, method: str, steps: int, carry: Any):
    """`time_loop.finish` for a batch: the outcome, and what would be recorded of the last sample."""

    def observe(lane, carry):
        scenario, folds, dt = batch.whole(lane)
        carry, sample = time_loop.observe_end(scenario, folds, method, dt, steps, carry)
        return carry, time_loop.record_of(sample, carry.state)

    carry, last = jax.vmap(observe)(batch.leaves.lane, carry)
    return verdicts(batch, method, carry, critical_modes(batch, steps, carry)), last


def verdicts(batch: Batch, method: str, carry: Any, modes: jax.Array):
    """`time_loop.verdict` for a batch."""

    def judge(lane, carry, modes):
        _, folds, dt = batch.whole(lane)
        return time_loop.verdict(folds, method, dt, carry, modes)

    return jax.vmap(judge)(batch.leaves.lane, carry, modes)


def critical_modes(batch: Batch, steps: int, carry: Any) -> jax.Array:
    """The modes at the critical instants of every run, (runs, instants) [1/s], by a lowered power iteration."""

    def instants(lane, carry):
        scenario, _, dt = batch.whole(lane)
        times, states = time_loop.critical_instants(scenario, dt, steps, carry)
        return Instants(jax.vmap(growth_start)(states), times, states)

    found, _ = batch.advance(mode_function, jax.vmap(instants)(batch.leaves.lane, carry), POWER_ITERATIONS, None)
    return jax.vmap(jax.vmap(growth_rate))(found.growth)


def _records(recorded: list[jax.Array], last: Any, with_last: bool) -> Any:
    """The recorded arrays, run axis first, then time; `last` is the sample at the end, which closes a whole number of periods."""
    flat, treedef = jax.tree.flatten(last)
    result = []
    for array, x in zip(recorded, flat, strict=True):
        samples, _, runs = array.shape
        if with_last:
            array = jax.lax.dynamic_update_slice(array, x.reshape(1, runs, -1).swapaxes(1, 2).astype(array.dtype), (samples - 1, 0, 0))
        result.append(array.transpose(2, 0, 1).reshape(runs, samples, *x.shape[1:]).astype(x.dtype))
    return jax.tree.unflatten(treedef, result)
