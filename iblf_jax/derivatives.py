"""The time loop with its derivatives: forward for few directions, checkpointed reverse for many.

**Forward.**  Every direction u of the parameters has a tangent x_u of the state, which is integrated beside the state; memory does
not grow with time.  A fold may offer `curvature(acc, sample)`, a tuple of `curvatures` many `Outer`: vectors y with weights w, whose
Gauss-Newton matrices

    N_uv = sum_k w(t_k) y_u(t_k) . y_v(t_k),      y_u = tangent of y,

are then summed up along the way, at next to no cost.  With w = 2 dt that is the second-order information of every integral of squares.

**Reverse.**  One pass back through time gives the gradient by any number of parameters.  Only every T^(2/3)-th state is kept; the
others are computed again, in three nested scans, so that about 3 T^(1/3) states are in memory at a time.

Both go through `time_loop.start`, `advance` and `finish`: it is the same loop, step by step.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.one_function import SMALL, as_one_function
from iblf_jax.paths import with_parameters
from iblf_jax.scenario import Scenario
from iblf_jax.time_loop import Carry, Outcome, advance, finish, start


class Outer(NamedTuple):
    """What one sample adds to a curvature matrix: N <- decay N + sum_i weight_i y_iu y_iv, y_u the tangent of `vector`."""

    vector: jax.Array
    """y, (m,)."""
    weight: jax.Array
    """(m,) or ()."""
    decay: jax.Array | float = 1.0
    """()."""


class Tangents(NamedTuple):
    """Values and tangents of a batch; B runs, D directions."""

    outcome: Outcome
    """Metrics and status, (B, ...)."""
    tangents: dict[str, jax.Array]
    """Of the real-valued metrics, (B, D, ...)."""
    products: tuple[jax.Array, ...]
    """Curvature matrix of each `Outer` of each fold, (B, D, D)."""


def _is_real(x: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def _split(tree: Any) -> tuple[list, list, Any]:
    """Real leaves, other leaves, and how to put them together."""
    leaves, structure = jax.tree.flatten(tree)
    real = [_is_real(x) for x in leaves]
    return [x for x, r in zip(leaves, real, strict=True) if r], [x for x, r in zip(leaves, real, strict=True) if not r], (structure, real)


def _joined(reals: list, others: list, how: Any) -> Any:
    structure, real = how
    from_reals, from_others = iter(reals), iter(others)
    return jax.tree.unflatten(structure, [next(from_reals) if r else next(from_others) for r in real])


def outer_of(folds, accumulators, sample) -> tuple[Outer, ...]:
    """What a sample adds to the curvature matrices of the folds that have them."""
    found: tuple[Outer, ...] = ()
    for fold, acc in zip(folds, accumulators, strict=True):
        if hasattr(fold, "curvatures"):
            found += tuple(fold.curvature(acc, sample))
    return found


def _pushed(f, directions, primals: tuple, tangents: tuple):
    """Value of f and its tangent along each direction, for functions of (varied, real leaves)."""

    def along(direction, tangent):
        return jax.jvp(f, primals, (direction, *tangent), has_aux=True)

    value, tangent, aux = jax.vmap(along, out_axes=(None, 0, None))(directions, tangents)
    return value, tangent, aux


def forward(scenario: Scenario, varied, directions, folds, dt, *, steps: int, method: str):
    """One run and its tangents: the outcome, the tangents of its real metrics (D, ...) and the Gauss-Newton matrices (D, D).

    Args:
      scenario: canonical.
      varied: path -> value.
      directions: path -> tangents of that value, (D, ...).
      folds, dt, steps, method: as `compact_loop.run`.
    """
    count = len(next(iter(directions.values())))
    first = jax.eval_shape(lambda v: start(with_parameters(scenario, v), folds, method, dt), varied)
    how = _split((first.state, first.accumulators))[2]

    def begin(varied):
        carry = start(with_parameters(scenario, varied), folds, method, dt)
        reals, others, _ = _split((carry.state, carry.accumulators))
        return reals, (others, carry.status, carry.nearest, carry.accuracy)

    def assemble(reals, rest):
        state, accumulators = _joined(reals, rest[0], how)
        return Carry(state, accumulators, *rest[1:])

    def one(rest, index, varied, reals):
        here = with_parameters(scenario, varied)
        before = assemble(reals, rest)
        after, sample = advance(here, folds, method, dt, before, index)
        new, others, _ = _split((after.state, after.accumulators))
        outer = outer_of(folds, before.accumulators, sample)
        factors = jax.lax.stop_gradient(tuple((jnp.broadcast_to(o.weight, o.vector.shape), o.decay) for o in outer))
        return (new, tuple(o.vector for o in outer)), ((others, after.status, after.nearest, after.accuracy), factors)

    def body(loop, index):
        reals, tangents, rest, products = loop
        (reals, _), (tangents, pushed), (rest, factors) = _pushed(partial(one, rest, index), directions, (varied, reals), (tangents,))
        terms = zip(products, pushed, factors, strict=True)
        products = tuple(decay * N + jnp.sum(weight * y[:, None] * y[None, :], axis=-1) for N, y, (weight, decay) in terms)
        return (reals, tangents, rest, products), None

    def end(rest, varied, reals):
        outcome = finish(with_parameters(scenario, varied), folds, method, dt, steps, assemble(reals, rest))[2]
        real = {name: x for name, x in outcome.metrics.items() if _is_real(x)}
        return real, outcome

    reals, tangents, rest = _pushed(begin, directions, (varied,), ())
    products = tuple(jnp.zeros((count, count), dt.dtype) for fold in folds for _ in range(getattr(fold, "curvatures", 0)))
    (reals, tangents, rest, products), _ = jax.lax.scan(body, (reals, tangents, rest, products), jnp.arange(steps))
    _, pushed, outcome = _pushed(partial(end, rest), directions, (varied, reals), (tangents,))
    return Tangents(outcome, pushed, products)


def value_and_tangents(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    directions: Mapping[str, jax.Array],
    folds,
    dt: jax.Array,
    *,
    steps: int,
    method: str,
) -> Tangents:
    """Runs a scenario once for every entry of `varied`, with its tangents along every direction; call it inside `jit`.

    Args:
      scenario: what all runs share, canonical.
      varied: path -> values, (B, ...).
      directions: path -> tangents of these values, (D, B, ...), for some or all of the paths.
      folds: the metrics.
      dt: time step, () [s].
      steps, method: static, as `compact_loop.run`.

    Returns:
      `Tangents` with the run axis first.
    """
    count = len(next(iter(directions.values())))
    full = {path: directions.get(path, jnp.zeros((count, *jnp.shape(x)), jnp.result_type(x))) for path, x in varied.items()}

    def one(varied, directions):
        return forward(scenario, varied, directions, folds, dt, steps=steps, method=method)

    batched = jax.vmap(one, in_axes=(0, 1))
    batch = len(next(iter(varied.values())))
    return (as_one_function(batched) if batch * count <= SMALL else batched)(dict(varied), full)


def run_checkpointed(scenario: Scenario, folds, dt, *, steps: int, method: str) -> Outcome:
    """`compact_loop.run` without records, for reverse mode: about 3 T^(1/3) states are in memory at a time.

    Args:
      scenario, folds, dt, steps, method: as `compact_loop.run`.
    """
    inner = max(1, round(steps ** (1 / 3)))
    blocks, rest = divmod(steps, inner * inner)

    @jax.checkpoint
    def one(carry, index):
        return advance(scenario, folds, method, dt, carry, index)[0], None

    @jax.checkpoint
    def few(carry, first):
        return jax.lax.scan(one, carry, first + jnp.arange(inner))

    @jax.checkpoint
    def many(carry, first):
        return jax.lax.scan(few, carry, first + inner * jnp.arange(inner))

    carry, _ = jax.lax.scan(many, start(scenario, folds, method, dt), inner * inner * jnp.arange(blocks))
    begin = blocks * inner * inner
    carry, _ = jax.lax.scan(few, carry, begin + inner * jnp.arange(rest // inner))
    carry, _ = jax.lax.scan(one, carry, begin + rest // inner * inner + jnp.arange(rest % inner))
    return finish(scenario, folds, method, dt, steps, carry)[2]
