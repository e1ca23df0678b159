"""Derivatives of a run by the numbers of its leaves: one run with one tangent for each column of
the Jacobian.

A step with a tangent is a step as any other, and a tangent of it is a second derivative.  The
directions are inputs (`Inputs.direction`), so one program serves any number of columns.  The
docstring of `derivatives` compares this with the other ways to differentiate.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.engine.batch import Batch, Leaves, Stepper, run_step
from iblf_jax.engine.carry import Carry, Inputs, Step, StepOptions, carry_without_accuracy
from iblf_jax.engine.derivatives import (
    Directions,
    Tangents,
    count_curvatures,
    floats_of_carry,
    outers_of_step,
)
from iblf_jax.engine.metric_folds import finished
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.step_pieces import MetricSample
from iblf_jax.engine.time_step import StepOutput, TimeStep, samples_of_step
from iblf_jax.simulation import error_estimate
from iblf_jax.simulation.closed_loop import evaluate, initial_state

if TYPE_CHECKING:
    from iblf_jax.simulation.metrics import Fold


ACCURACY = tuple(name for name, _ in error_estimate.ACCURACY_UNITS)
"""Metrics whose derivatives are zero."""
Places = tuple[tuple[int, ...], ...]
"""For each order of a derivative, the indices of the leaves by which it is taken."""


class WithTangent(NamedTuple):
    """A carry and its tangent."""

    carry: Any
    tangent: list[jax.Array]
    """Of its floats."""


def _floats(carry: Carry | WithTangent) -> tuple[list[jax.Array], Callable]:
    """The numbers of a carry that have tangents, and the function that puts others in their
    place.
    """
    if not isinstance(carry, WithTangent):
        return floats_of_carry(carry)
    inner, replaced = _floats(carry.carry)
    return inner + carry.tangent, lambda x: WithTangent(replaced(x[: len(inner)]), x[len(inner) :])


def _with_moved_leaves(inputs: Inputs, places: Places, eps: jax.Array) -> Inputs:
    """The inputs, with leaves moved by eps along the last direction."""
    leaves, treedef = jax.tree.flatten(inputs.scenario)
    for place, change in zip(places[-1], inputs.direction[len(places) - 1], strict=True):
        leaves[place] = leaves[place] + eps * change
    return inputs._replace(scenario=jax.tree.unflatten(treedef, leaves))


def floats_of(tree: object) -> list[jax.Array]:
    """The leaves that are floats."""
    return [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]


def numbers_of(inputs: Inputs, record: Callable) -> int:
    """How many floats a `TimeStep` records of an instant by this function."""

    def one(inputs):
        state = initial_state(inputs.scenario)
        sample = evaluate(inputs.scenario, inputs.dt, state)[1]
        seen = MetricSample(tuple(fold.init(sample) for fold in inputs.folds), sample, True)
        samples = (seen,) * samples_of_step(inputs.scenario)
        found = StepOutput(None, samples, state)  # type: ignore[arg-type]
        return floats_of(record(inputs.folds, found))

    return sum(math.prod(x.shape) for x in jax.eval_shape(one, inputs))


@dataclasses.dataclass(frozen=True)
class TangentStep(Step):
    """A step and its derivative along the direction of each entry of `places`."""

    step: TimeStep
    places: Places
    is_derivative: ClassVar[bool] = True

    def __call__(self, inputs: Inputs, carry: WithTangent, index: jax.Array, options: StepOptions):
        """The carry after the step, and the derivative of what is recorded."""
        step: Callable = self.step
        if len(self.places) > 1:
            step = TangentStep(self.step, self.places[:-1])
        floats, replaced = _floats(carry.carry)

        def of(eps, floats):
            after, record = step(
                _with_moved_leaves(inputs, self.places, eps), replaced(floats), index, options
            )
            return (_floats(after)[0], floats_of(record)), after

        zero = jnp.zeros_like(inputs.dt)
        _, (tangent, record), after = jax.jvp(
            of, (zero, floats), (jnp.ones_like(zero), carry.tangent), has_aux=True
        )
        return WithTangent(after, tangent), record


def _initial_carry(inputs: Inputs, method: str, places: Places) -> Carry | WithTangent:
    """The carry before the first step, with its tangents."""
    if not places:
        # The accuracy is estimated by the run without tangents; this estimate is not read.
        return carry_without_accuracy(inputs, method)

    def of(eps):
        carry = _initial_carry(_with_moved_leaves(inputs, places, eps), method, places[:-1])
        return _floats(carry)[0], carry

    zero = jnp.zeros_like(inputs.dt)
    _, tangent, carry = jax.jvp(of, (zero,), (jnp.ones_like(zero),), has_aux=True)
    return WithTangent(carry, tangent)


def float_metrics(inputs: Inputs, carry: Carry) -> dict[str, jax.Array]:
    """Every metric of a fold that is a float."""
    results = finished(inputs.folds, carry.accumulators).items()
    return {name: x for name, x in results if jnp.issubdtype(x.dtype, jnp.floating)}


def _metrics(inputs: Inputs, carry: Carry | WithTangent, places: Places) -> dict[str, jax.Array]:
    """The derivative of every metric that is a float."""
    if not isinstance(carry, WithTangent):
        return float_metrics(inputs, carry)
    floats, replaced = _floats(carry.carry)
    zero = jnp.zeros_like(inputs.dt)

    def of(eps, floats):
        return _metrics(_with_moved_leaves(inputs, places, eps), replaced(floats), places[:-1])

    return jax.jvp(of, (zero, floats), (jnp.ones_like(zero), carry.tangent))[1]


def _with_directions(batch: Batch, added: list[list[jax.Array]]) -> Batch:
    """A batch with a direction of each derivative for each run, (R, *shape of the leaf)."""
    leaves = batch.leaves
    inputs = leaves.unflatten(leaves.shared, leaves.per_run)._replace(direction=added)
    values = jax.tree.leaves(added)
    is_per_run = (*leaves.is_per_run, *[True] * len(values))
    structure = jax.tree.structure(inputs)
    wide = Leaves(structure, is_per_run, leaves.shared, leaves.per_run + values)
    return batch._replace(leaves=wide)


def _stepped(
    run_steps: Stepper,
    batch: Batch,
    step: TangentStep,
    directions: list[list[Any]],
    request: RunRequest,
) -> tuple[list[jax.Array], Any]:
    """The derivatives of what a step records and of the metrics, (R, P, ...).

    `directions`: for each derivative, of each of its leaves the tangents, (P, *shape of the leaf).
    """
    # A run is made for every column of every run of the batch.
    leaves, runs = batch.leaves, batch.runs or 1
    sizes = [len(of_order[0]) for of_order in directions]
    per_run = [jnp.repeat(x, math.prod(sizes), axis=0) for x in leaves.per_run]

    def beside_others(k: int, column: jax.Array) -> jax.Array:
        """Columns of derivative k, each beside every column of the others, for every run."""
        repeated = jnp.repeat(column, math.prod(sizes[k + 1 :]), axis=0)
        return jnp.tile(repeated, (runs * math.prod(sizes[:k]), *[1] * (column.ndim - 1)))

    added = [[beside_others(k, x) for x in of_order] for k, of_order in enumerate(directions)]
    repeated = batch._replace(leaves=leaves._replace(per_run=per_run))
    wide = _with_directions(repeated, added)._replace(runs=runs * math.prod(sizes))
    return jax.tree.map(
        lambda x: x.reshape(runs, *sizes, *x.shape[1:]), _made(run_steps, wide, step, request)
    )


def _made(
    run_steps: Stepper, wide: Batch, step: TangentStep, request: RunRequest
) -> tuple[list[jax.Array], dict[str, jax.Array]]:
    """The derivatives of what a step records and of the metrics, for each run and direction of a
    batch that has its directions.
    """
    before = wide.map_runs(lambda inputs: _initial_carry(inputs, request.method, step.places))
    after, records = run_steps(step, wide, before, request.instants, request.record_every)
    metrics = wide.map_runs(lambda inputs, carry: _metrics(inputs, carry, step.places), after)
    return list(records), metrics


def columns(
    run_steps: Stepper, batch: Batch, places: Places, request: RunRequest
) -> tuple[list[jax.Array], dict[str, jax.Array]]:
    """The derivative of records and metrics of every run by the numbers of some leaves, or a second
    derivative.

    Args:
      run_steps: makes the steps.
      batch: of R runs.
      places: of the leaves by whose numbers, P of them, it is; for a second derivative two such
        tuples, P and Q.
      request: what is run.

    Returns:
      Of each float that is recorded (R, P, T, ...), or (R, P, Q, T, ...), and by name of each
      metric that is a float (R, P, ...).
    """
    shapes = [jnp.shape(x) for x in jax.tree.leaves(batch.leaves.first.scenario)]
    directions = []
    for of_order in places:  # the tangents of these leaves by each of their numbers in turn
        own_shapes = [shapes[place] for place in of_order]
        sizes = [math.prod(shape) for shape in own_shapes]
        units = np.eye(sum(sizes), dtype=batch.dtype)
        parts = np.split(units, np.cumsum(sizes)[:-1], axis=1)
        directions.append(
            [
                jnp.asarray(part.reshape(len(part), *shape))
                for part, shape in zip(parts, own_shapes, strict=True)
            ]
        )
    return _stepped(
        run_steps, batch, TangentStep(TimeStep.of(request), places), directions, request
    )


def along_direction(
    run_steps: Stepper,
    batch: Batch,
    places: tuple[int, ...],
    tangents: list[jax.Array],
    request: RunRequest,
) -> tuple[list[jax.Array], dict[str, jax.Array]]:
    """The derivative of records and metrics of every run along a direction of its own.

    Args:
      run_steps, batch, request: as `columns`.
      places: of the leaves that move.
      moves: how far each of them moves in every run, (R, *shape of the leaf).

    Returns:
      As `columns`, without the axis of the columns.
    """
    step = TangentStep(TimeStep.of(request), (places,))
    return _made(run_steps, _with_directions(batch, [tangents]), step, request)


def outer_vectors(folds: tuple[Fold, ...], found: StepOutput) -> list[jax.Array]:
    """Of the curvature matrices, what has tangents."""
    return [outer.vector for outer in outers_of_step(folds, found)]


def _weights(folds: tuple[Fold, ...], found: StepOutput) -> list[jax.Array]:
    """And their weights."""
    return [outer.weight for outer in outers_of_step(folds, found)]


def step_of_values(folds: tuple[Fold, ...], method: str) -> TimeStep:
    """The step that makes the values of `run_by_columns`: it records the weights of the curvature
    matrices, if there are any.
    """
    return TimeStep(method, _weights if count_curvatures(folds) else None)


def run_by_columns(
    run_steps: Stepper, batch: Batch, directions: Directions, request: RunRequest
) -> Tangents:
    """The same result as `run_with_tangents`, from one run per tangent."""
    inputs = batch.leaves.first
    zero = jnp.zeros(directions.tangents, batch.dtype)
    before = jax.tree.leaves(inputs.scenario)
    moved = jax.tree.leaves(directions.moved(inputs.scenario, zero))
    places = tuple(i for i, x in enumerate(moved) if x is not before[i])

    def leaves_at(eps):
        moved = jax.tree.leaves(directions.moved(inputs.scenario, eps))
        return [moved[i] for i in places]

    units = np.eye(directions.tangents, dtype=batch.dtype)
    along = jax.vmap(lambda unit: jax.jvp(leaves_at, (zero,), (unit,))[1])(units)
    vector_of, every = None, None
    if count_curvatures(inputs.folds):
        vector_of, every = outer_vectors, 1
    request = request._replace(record_every=every)
    of_values = step_of_values(inputs.folds, request.method)
    outcome, weights = run_step(run_steps, batch, of_values, request)
    step = TangentStep(TimeStep(request.method, vector_of), (places,))
    found, tangents = _stepped(run_steps, batch, step, [along], request)
    constant = {name: x for name, x in outcome.metrics.items() if name in ACCURACY}
    no_tangents = {
        name: jnp.zeros((len(x), directions.tangents, *x.shape[1:]), batch.dtype)
        for name, x in constant.items()
    }
    products = [
        jnp.einsum("rptm,rtm,rqtm->rpq", y, weight, y)
        for y, weight in zip(found, weights, strict=True)
    ]
    return Tangents(outcome, no_tangents | tangents, tuple(products))
