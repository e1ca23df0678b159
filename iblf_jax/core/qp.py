"""Small quadratic programmes inside a time loop, by an interior-point method with a fixed number of
iterations.

    minimise  w/2 x^T H x + 1/2 sum_i s_i^2   subject to   G x - s <= h,   s_i = 0 for hard rows

The slack of a soft row equals its multiplier, s_i = l_i. The weight w is so small that the slack of
a feasible programme is far below rounding, and it is returned as 0. In an infeasible programme, x
minimises the sum of squares of the violations of the soft rows, and the slack is the violation. The
hard rows must be feasible, as those of a box are.

The method is primal-dual path following by Newton steps. It uses elementwise operations only, so
that `kernels` can compile it. With y the distance of a row to its limit,

    w H x + G^T l = 0,   G x - l + y = h,   l y = m,   m -> 0,

each iteration aims at a small fraction of the mean product m. The derivative is that of these
equations at the solution, with the factors of one more step: no iteration is differentiated.

Alternatives that were tested: with a weight 1/w on s, many infeasible programmes do not converge in
60 iterations, because their multipliers are large. Mehrotra's corrector needs fewer iterations but
cycled in one of thousands of random programmes. A penalty on |s| is exact but needs as many.

Source: S. J. Wright, Primal-Dual Interior-Point Methods, 1997.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import inner, matvec, solve_spd

ITERATIONS = 36
"""Random programmes, feasible or not, converge in at most 29 iterations with two unknowns and in 34
with seven."""
REGULARISATION = 1e-12
"""w, relative to the size of H and h: it changes a solution by 1e-8 of its size at most."""
CENTRING_FACTOR = 0.03
"""Ratio of the mean product m that an iteration aims at to the present one."""
MAX_STEP_FRACTION = 0.999
"""Largest step, relative to the distance to the nearest limit along it."""
REFINEMENTS = 3
"""Number of linear solves for a derivative."""
SLACK_TOLERANCE = 1e-7
"""Smallest slack that is not returned as 0, relative to the size of h."""


class Solution(NamedTuple):
    """Of a quadratic programme."""

    x: jax.Array
    """(n,)."""
    slack: jax.Array
    """Violation of each row, (m,) in its unit; 0 for a feasible programme."""


class _Point(NamedTuple):
    x: jax.Array
    y: jax.Array
    l: jax.Array  # noqa: E741 (a multiplier)


def quadratic_program(H: jax.Array, G: jax.Array, h: jax.Array, soft: jax.Array) -> Solution:
    """Minimises 1/2 x^T H x subject to G x <= h; soft rows have slack if this is infeasible.

    Args:
      H: (n, n), symmetric and positive definite.
      G: (m, n); rows of zeros constrain nothing.
      h: (m,).
      soft: which rows may be violated, (m,) 1 or 0.

    Returns:
      `Solution`.
    """
    size = jnp.sqrt(jnp.sum(G**2, axis=1))
    size = jnp.where(size > 0, size, 1.0)
    H_size = jnp.sum(H * jnp.eye(len(H), dtype=H.dtype)) / len(H)
    h_size = jax.lax.stop_gradient(1.0 + jnp.max(jnp.abs(h / size)))
    rows = G / size[:, None]
    limits = h / (size * h_size)
    x = _solved(REGULARISATION * H / H_size, rows, limits, soft).x
    violation = matvec(rows, x) - limits
    tolerance = max(SLACK_TOLERANCE, float(jnp.finfo(h.dtype).eps) ** 0.5)
    slack = jnp.where(violation > tolerance, violation, 0.0) * size * h_size
    return Solution(h_size * x, slack)


@jax.custom_jvp
def _solved(H: jax.Array, G: jax.Array, h: jax.Array, soft: jax.Array) -> _Point:
    """The solution of a scaled programme."""
    point = _Point(jnp.zeros(G.shape[1], h.dtype), jnp.maximum(h, 1.0), jnp.ones_like(h))
    # XLA compiles one iteration of a loop.
    return jax.lax.scan(
        lambda at, _: (_improved(H, G, h, soft, at), None), point, length=ITERATIONS
    )[0]


@jax.jit  # so that the generated code holds it once
def _improved(H: jax.Array, G: jax.Array, h: jax.Array, soft: jax.Array, at: _Point) -> _Point:
    """One iteration."""
    mean = inner(at.l, at.y) / h.size
    least = REGULARISATION * float(jnp.finfo(h.dtype).eps) ** 1.05
    target = jnp.maximum(CENTRING_FACTOR * mean, least)
    matrix, weight = _newton(H, G, soft, at)
    residual = matvec(G, at.x) - soft * at.l - h + target / at.l
    dx = solve_spd(matrix, -matvec(H, at.x) - matvec(G.T, at.l + weight * residual))
    dl = weight * (matvec(G, dx) + residual)
    dy = (target - at.y * dl) / at.l - at.y
    longest = jnp.minimum(_longest_step(at.y, dy), _longest_step(at.l, dl))
    step = jnp.minimum(MAX_STEP_FRACTION * longest, 1.0)
    # At the solution an iteration gains nothing, and rounding errors would spoil the factors.
    go_on = (mean > least) & jnp.all(jnp.isfinite(dx))
    return jax.tree.map(
        lambda old, new: jnp.where(go_on, old + step * new, old), at, _Point(dx, dy, dl)
    )


def _newton(H: jax.Array, G: jax.Array, soft: jax.Array, at: _Point) -> tuple[jax.Array, jax.Array]:
    """H + G^T W G, and the weights W of the rows."""
    weight = 1.0 / (at.y / at.l + soft)
    return H + jnp.sum(G[:, :, None] * (weight[:, None] * G)[:, None, :], axis=0), weight


def _longest_step(x: jax.Array, dx: jax.Array) -> jax.Array:
    """The factor of dx at which the first of the positive numbers x becomes 0."""
    falling = dx < 0
    return jnp.min(jnp.where(falling, x / jnp.where(falling, -dx, 1.0), jnp.inf))


@_solved.defjvp
def _solved_jvp(primals, tangents):
    (H, G, _, soft), (dH, dG, dh, _) = primals, tangents
    at = _solved(*primals)
    matrix, weight = _newton(H, G, soft, at)
    dual_change = matvec(dH, at.x) + matvec(dG.T, at.l)
    primal_change = matvec(dG, at.x) - dh
    dx, dl = jnp.zeros_like(at.x), jnp.zeros_like(at.l)
    # The large weights of active rows leave few digits of H in the matrix, so the solution is
    # refined by its residuals.
    for _ in range(REFINEMENTS):
        dual = matvec(H, dx) + matvec(G.T, dl) + dual_change
        primal = matvec(G, dx) - dl / weight + primal_change
        correction = solve_spd(matrix, -dual - matvec(G.T, weight * primal))
        dx = dx + correction
        dl = dl + weight * (matvec(G, correction) + primal)
    return at, _Point(dx, -at.y / at.l * dl, dl)
