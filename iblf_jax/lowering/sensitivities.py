"""Values and forward sensitivities of a batch, in one pass: the lowered jvp of the step, several tangents a run.

Gains are few, so forward mode beats reverse mode and needs no memory along time; the numbers that all tangents share are computed
once, because equal nodes of a scalar program are one node.  The Gauss-Newton products of folds that offer `curvature` (see
`derivatives`) are summed up in the same pass, their upper triangle only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from iblf_jax import time_loop
from iblf_jax.closed_loop import LoopState, Sample, evaluate
from iblf_jax.derivatives import Tangents, outer_of, value_and_tangents
from iblf_jax.lowering import native
from iblf_jax.lowering.batch import Executor, batch_of, critical_modes, step_function, verdicts
from iblf_jax.lowering.step import Leaves
from iblf_jax.paths import get, with_parameters

LARGEST, LARGEST_IN_PIECES = 60_000, 150_000
"""Operations of a step, times one and its tangents, up to which "auto" lowers its derivatives: compilers take minutes over longer ones,
the native backend, which cuts a step into pieces, half a one.  Equal numbers are computed once, so that about a third is left of them."""
FLAGS = ("guard_active", "saturated")
"""Fields of a sample that are no numbers."""


class Directions(NamedTuple):
    """Tangents of leaves by path; hashable, the numbers are part of what is compiled."""

    items: tuple[tuple[str, tuple[int, ...], tuple[float, ...]], ...]

    @staticmethod
    def of(directions: Mapping[str, Any]) -> Directions:
        """From path -> (P, *shape of the leaf)."""
        arrays = {path: np.asarray(x, float) for path, x in directions.items()}
        return Directions(tuple((path, x.shape, tuple(x.ravel().tolist())) for path, x in arrays.items()))

    @property
    def tangents(self) -> int:
        """P."""
        return self.items[0][1][0]

    def moved(self, scenario, eps: jax.Array):
        """The scenario, its leaves moved by eps (P,) along the directions."""
        values = {}
        for path, shape, numbers in self.items:
            change = np.asarray(numbers, eps.dtype).reshape(shape)
            values[path] = get(scenario, path) + jnp.tensordot(eps, change, 1)
        return with_parameters(scenario, values)


class Differentiated(NamedTuple):
    """What goes from step to step: the carry, P tangents of state and accumulators, the products of each `Outer`."""

    carry: time_loop.Carry
    tangents: list[jax.Array]
    products: list[jax.Array]
    """Upper triangles, row by row, (P (P + 1) / 2,) each."""


def _floats(carry: time_loop.Carry) -> tuple[list[jax.Array], Callable]:
    """The numbers of a carry that have tangents, and the function that puts others in their place."""
    leaves, treedef = jax.tree.flatten((carry.state, carry.accumulators))
    places = [i for i, x in enumerate(leaves) if jnp.issubdtype(x.dtype, jnp.floating)]

    def replaced(floats):
        new = list(leaves)
        for i, x in zip(places, floats, strict=True):
            new[i] = x
        state, accumulators = jax.tree.unflatten(treedef, new)
        return carry._replace(state=state, accumulators=accumulators)

    return [leaves[i] for i in places], replaced


def pushed(function: Callable, directions: Directions, scenario, before: Differentiated | None, dtype):
    """function(scenario, carry, eps) and its derivative along every direction.

    Args:
      function: of a scenario, a carry and how far it is moved along the directions; gives a list of floats and anything else.
      directions: P of them.
      scenario: where.
      before: carry and tangents, or None where the function takes no carry.
      dtype: of the tangents.
    """
    floats, replaced = _floats(before.carry) if before else ([], lambda _: None)

    def of(eps, floats):
        return function(directions.moved(scenario, eps), replaced(floats), eps)

    def along(unit, tangents):
        value, tangent, rest = jax.jvp(of, (jnp.zeros_like(unit), floats), (unit, tangents), has_aux=True)
        return value, tangent, rest

    units = np.eye(directions.tangents, dtype=dtype)
    return jax.vmap(along, out_axes=(None, 0, None))(units, before.tangents if before else [])


def _floats_and_rest(carry: time_loop.Carry):
    return _floats(carry)[0], carry


def without_flags(sample: Sample) -> Any:
    """The numbers of a sample; its flags have no derivative."""
    return {name: x for name, x in sample._asdict().items() if name not in FLAGS}


def preaccumulated(scenario, directions: Directions, eps: jax.Array, like: LoopState) -> Callable:
    """`closed_loop.evaluate`, its Jacobian by state and directions worked out once and applied to every tangent.

    One tangent through the law costs as much as the law; applying the Jacobian costs a tenth of it.
    """
    if not all(jnp.issubdtype(x.dtype, jnp.floating) for x in jax.tree.leaves(like)):
        return lambda moved, t, state, dt=0.0: evaluate(moved, t, state, dt)
    unravel = ravel_pytree(like)[1]

    def numbers(flat, eps, t, dt):
        slope, sample = evaluate(directions.moved(scenario, eps), t, unravel(flat), dt)
        flags = {name: getattr(sample, name) for name in FLAGS}
        return ravel_pytree((slope, without_flags(sample)))[0], flags

    @jax.custom_jvp
    def floats(flat, eps, t, dt):
        return numbers(flat, eps, t, dt)[0]

    @floats.defjvp
    def _(primals, tangents):
        flat, eps, t, dt = primals
        units = np.eye(flat.size + eps.size, dtype=flat.dtype)
        value = lambda x: numbers(x[: flat.size], x[flat.size :], t, dt)[0]  # noqa: E731
        here = jnp.concatenate([flat, eps])
        columns = jax.vmap(lambda unit: jax.jvp(value, (here,), (unit,))[1])(units)
        return floats(*primals), jnp.concatenate(tangents[:2]) @ columns

    def loop(moved, t, state, dt=0.0):
        dt = jnp.asarray(dt, t.dtype)
        slope, sample = jax.eval_shape(lambda: evaluate(scenario, t, state, dt))
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), (slope, without_flags(sample)))
        flat = ravel_pytree(state)[0]
        slope, values = ravel_pytree(zeros)[1](floats(flat, eps, t, dt))
        return slope, Sample(**values, **numbers(*jax.lax.stop_gradient((flat, eps, t, dt)))[1])

    return loop


@lru_cache(maxsize=64)
def derivative_function(treedef, is_lane: tuple[bool, ...], carry_treedef, method: str, directions: Directions) -> Callable:
    """One step of value and tangents as a function of lists of leaves, for `lowered`."""
    rows, columns = np.triu_indices(directions.tangents)

    def step(shared, lane, carry, index):
        scenario, folds, dt = Leaves(treedef, is_lane, [], []).together(shared, lane)

        def one(moved, carry, eps):
            loop = preaccumulated(scenario, directions, eps, carry.state)
            after, sample = time_loop.advance(moved, folds, method, dt, carry, index, loop)
            outer = outer_of(folds, carry.accumulators, sample)
            return (_floats(after)[0], [o.vector for o in outer]), (after, [(o.weight, o.decay) for o in outer])

        before = jax.tree.unflatten(carry_treedef, carry)
        _, (tangents, pushed_vectors), (carry, factors) = pushed(one, directions, scenario, before, dt.dtype)
        terms = zip(before.products, pushed_vectors, factors, strict=True)
        products = [decay * N + jnp.sum(weight * y[rows] * y[columns], axis=-1) for N, y, (weight, decay) in terms]
        return jax.tree.leaves(Differentiated(carry, tangents, products)), []

    return step


def _floats_of(metrics: dict[str, jax.Array]) -> dict[str, jax.Array]:
    return {name: x for name, x in metrics.items() if jnp.issubdtype(x.dtype, jnp.floating)}


def is_short(executor: Executor, scenario, varied, directions: Directions, folds, dt, *, method: str) -> bool:
    """Whether the derivatives' program is short enough for an executor to be compiled in about a minute at most.

    Raises:
      UnsupportedError: the step does not lower.
    """
    batch = batch_of(executor, scenario, varied, folds, dt)
    program, _, _ = batch.program(step_function, jax.eval_shape(partial(batch.start, method)), method, False)
    return len(program.nodes) * (1 + directions.tangents) <= (LARGEST_IN_PIECES if executor is native.run else LARGEST)


def lowered_jvp(executor: Executor, scenario, varied, directions: Directions, folds, dt, *, steps: int, method: str) -> Tangents:
    """`run_batch_jvp` by a lowered step; raises as `batch.run`."""
    batch = batch_of(executor, scenario, varied, folds, dt)._replace(sparse=True)
    count = sum(getattr(fold, "curvatures", 0) for fold in folds)
    rows, columns = np.triu_indices(directions.tangents)

    def begin(lane):
        scenario, folds, dt = batch.whole(lane)
        _, tangents, carry = pushed(
            lambda s, *_: _floats_and_rest(time_loop.start(s, folds, method, dt)), directions, scenario, None, dt.dtype
        )
        return Differentiated(carry, tangents, [jnp.zeros((len(rows),), dt.dtype)] * count)

    before = jax.vmap(begin, axis_size=batch.runs)(batch.leaves.lane)
    before, _ = batch.advance(derivative_function, before, steps, None, method, directions)

    def end(lane, before):
        scenario, folds, dt = batch.whole(lane)

        def metrics(scenario, carry, _):
            carry, _ = time_loop.observe_end(scenario, folds, method, dt, steps, carry)
            outcome = time_loop.verdict(folds, method, dt, carry, jnp.zeros((1,), dt.dtype))
            return _floats_of(outcome.metrics), carry

        _, tangents, carry = pushed(metrics, directions, scenario, before, dt.dtype)
        full = jnp.zeros((directions.tangents,) * 2, dt.dtype)
        return carry, tangents, tuple(full.at[rows, columns].set(x).at[columns, rows].set(x) for x in before.products)

    carry, tangents, products = jax.vmap(end)(batch.leaves.lane, before)
    outcome = verdicts(batch, method, carry, critical_modes(batch._replace(sparse=False), steps, carry))
    return Tangents(outcome, tangents, products)


def plain_jvp(scenario, varied, directions: Directions, folds, dt, *, steps: int, method: str) -> Tangents:
    """`run_batch_jvp` on plain vmap: a leaf that moves becomes one that varies."""
    runs = len(next(iter(varied.values())))
    moving = {path: np.asarray(numbers, dt.dtype).reshape(shape) for path, shape, numbers in directions.items}
    values = jax.vmap(lambda run: {path: get(with_parameters(scenario, run), path) for path in moving})(dict(varied))
    along = {path: jnp.broadcast_to(x[:, None], (len(x), runs, *x.shape[1:])) for path, x in moving.items()}
    return value_and_tangents(scenario, dict(varied) | values, along, folds, dt, steps=steps, method=method)
