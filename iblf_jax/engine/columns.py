"""Derivatives of a run by the numbers of its leaves, one run a column.

A run with one tangent is a step as any other; a tangent of that one is a second derivative.  Directions are data (`Inputs.direction`), so
one program serves all columns, however many there are: it is what compiles soonest.  Where many runs are differentiated at once, and
compiling pays, `derivatives` computes the law once for all tangents.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.engine.batch import Batch, Executor, Leaves
from iblf_jax.engine.derivatives import floats_of_carry
from iblf_jax.engine.step import Carry, Form, Inputs, Run, TimeStep, start
from iblf_jax.simulation import accuracy
from iblf_jax.simulation.closed_loop import initial_state

Places = tuple[tuple[int, ...], ...]
"""For each derivative, by which leaves of the scenario it is."""


class WithTangent(NamedTuple):
    """A carry and its tangent."""

    carry: Any
    tangent: list[jax.Array]
    """Of its floats."""


def _floats(carry: Carry | WithTangent) -> tuple[list[jax.Array], Callable]:
    """The numbers of a carry that have tangents, and the function that puts others in their place."""
    if not isinstance(carry, WithTangent):
        return floats_of_carry(carry)
    inner, replaced = _floats(carry.carry)
    return inner + carry.tangent, lambda x: WithTangent(replaced(x[: len(inner)]), x[len(inner) :])


def _moved(inputs: Inputs, places: Places, eps: jax.Array) -> Inputs:
    """The inputs, leaves moved by eps along the last direction."""
    leaves, treedef = jax.tree.flatten(inputs.scenario)
    for place, change in zip(places[-1], inputs.direction[len(places) - 1], strict=True):
        leaves[place] = leaves[place] + eps * change
    return inputs._replace(scenario=jax.tree.unflatten(treedef, leaves))


def floats_of(tree: Any) -> list[jax.Array]:
    """The leaves that are floats."""
    return [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]


@dataclasses.dataclass(frozen=True)
class TangentStep:
    """A step and its derivative along the direction of each entry of `places`."""

    step: TimeStep
    places: Places
    is_derivative: ClassVar[bool] = True

    def __call__(self, inputs: Inputs, carry: WithTangent, index: jax.Array, form: Form):
        """The carry after the step, and the derivative of what is recorded."""
        step = TangentStep(self.step, self.places[:-1]) if len(self.places) > 1 else self.step
        floats, replaced = _floats(carry.carry)

        def of(eps, floats):
            after, record = step(_moved(inputs, self.places, eps), replaced(floats), index, form)
            return (_floats(after)[0], floats_of(record)), after

        zero = jnp.zeros_like(inputs.dt)
        _, (tangent, record), after = jax.jvp(of, (zero, floats), (jnp.ones_like(zero), carry.tangent), has_aux=True)
        return WithTangent(after, tangent), record


def _begun(inputs: Inputs, method: str, places: Places) -> Carry | WithTangent:
    """The carry before the first step."""
    if not places:
        size = accuracy.places(initial_state(inputs.scenario)).size
        # The estimate of the accuracy is the run's own: here nobody reads it.
        return start(inputs, method, jnp.zeros((size, size), inputs.dt.dtype))

    def of(eps):
        carry = _begun(_moved(inputs, places, eps), method, places[:-1])
        return _floats(carry)[0], carry

    zero = jnp.zeros_like(inputs.dt)
    _, tangent, carry = jax.jvp(of, (zero,), (jnp.ones_like(zero),), has_aux=True)
    return WithTangent(carry, tangent)


def _metrics(inputs: Inputs, carry: Carry | WithTangent, places: Places) -> dict[str, jax.Array]:
    """The derivative of every metric that is a float."""
    if not isinstance(carry, WithTangent):
        results = [fold.finish(acc) for fold, acc in zip(inputs.folds, carry.accumulators, strict=True)]
        return {name: x for found in results for name, x in found.items() if jnp.issubdtype(x.dtype, jnp.floating)}
    floats, replaced = _floats(carry.carry)
    zero = jnp.zeros_like(inputs.dt)

    def of(eps, floats):
        return _metrics(_moved(inputs, places, eps), replaced(floats), places[:-1])

    return jax.jvp(of, (zero, floats), (jnp.ones_like(zero), carry.tangent))[1]


def _directed(batch: Batch, places: Places) -> tuple[Batch, list[int]]:
    """A run for every column of every run of a batch; and how many columns each derivative has."""
    leaves, runs = batch.leaves, batch.runs or 1
    inputs = leaves.together(leaves.shared, [x[0] for x in leaves.lane])
    scenario = jax.tree.leaves(inputs.scenario)
    shapes = [[scenario[place].shape for place in level] for level in places]
    sizes = [sum(math.prod(shape) for shape in level) for level in shapes]
    lane = [jnp.repeat(x, math.prod(sizes), axis=0) for x in leaves.lane]
    directions = []
    for k, level in enumerate(shapes):
        # One column of this level beside every column of the others, for every run.
        units = np.repeat(np.eye(sizes[k], dtype=batch.dtype), math.prod(sizes[k + 1 :]), axis=0)
        units = np.tile(units, (runs * math.prod(sizes[:k]), 1))
        parts = np.split(units, np.cumsum([math.prod(shape) for shape in level])[:-1], axis=1)
        directions.append([jnp.asarray(x.reshape(-1, *shape)) for x, shape in zip(parts, level, strict=True)])
    treedef = jax.tree.structure(inputs._replace(direction=directions))
    added = jax.tree.leaves(directions)
    wide = Leaves(treedef, (*leaves.is_lane, *[True] * len(added)), leaves.shared, lane + added)
    return batch._replace(leaves=wide, runs=runs * math.prod(sizes)), sizes


def columns(executor: Executor, batch: Batch, places: Places, run: Run) -> tuple[list[jax.Array], dict[str, jax.Array]]:
    """The derivative of records and metrics of every run by the numbers of some leaves, or a second derivative.

    Args:
      executor: what steps.
      batch: of R runs.
      places: of the leaves by whose numbers, P of them, it is; for a second derivative two such tuples, P and Q.
      run: what to run.

    Returns:
      Of each float that is recorded (R, P, T, ...), or (R, P, Q, T, ...), and by name of each metric that is a float (R, P, ...).
    """
    wide, sizes = _directed(batch, places)
    before = wide.each(lambda inputs: _begun(inputs, run.method, places))
    step = TangentStep(TimeStep(run.method, run.record_every is not None), places)
    after, records = executor(step, wide, before, run.steps + 1, run.record_every)
    metrics = wide.each(lambda inputs, carry: _metrics(inputs, carry, places), after)
    return jax.tree.map(lambda x: x.reshape(batch.runs or 1, *sizes, *x.shape[1:]), (list(records), metrics))
