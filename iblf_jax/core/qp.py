"""Small quadratic programmes inside a time loop: an interior-point method of a fixed number of
iterations.

    minimise  w/2 x^T H x + 1/2 sum_i s_i^2     subject to     G x - s <= h,   s_i = 0 for rows that
    are hard

with a weight w so small that, where there is a solution, a soft row's slack s_i = l_i, its
multiplier, is far below rounding of what the programme is about; it is given as 0.  Where there is
none, x breaks the soft rows least, in the sum of squares of their distances, and the slack says by
how much.  Hard rows must have a common point, such as a box has.

Primal-dual path following by steps of Newton, in plain operations: it lowers to the generated
kernels.  With y the room of a row,

    w H x + G^T l = 0,   G x - l + y = h,   l y = m,   m -> 0,

each iteration aims at a small part of the mean product m.  (With a weight 1/w on s instead, the
multipliers of a programme without a solution have far to go, and many did not get there in 60
iterations.  Mehrotra's corrector needs fewer, and cycled in one of thousands of random programmes;
a penalty on |s| is exact, and needs as many.)  The derivative is that of these equations at the
solution, with the factors of one more step: no iteration is differentiated.

Source: S. J. Wright, Primal-Dual Interior-Point Methods, 1997.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import inner, matvec, solve_spd

ITERATIONS = 36
"""Random programmes of two unknowns are solved after 29 at most, with or without a solution, of
seven after 34."""
REGULARISATION = 1e-12
"""w, relative to the size of H and h: it moves a solution by the share 1e-8 at most (tests)."""
CENTRING_FACTOR = 0.03
"""How far the mean product m is to fall in one iteration."""
MAX_STEP_FRACTION = 0.999
"""Part of the way to the nearest edge that a step goes at most."""
REFINEMENTS = 3
"""Solves for a derivative."""
SLACK_TOLERANCE = 1e-7
"""What counts as slack, relative to the size of h."""


class Solution(NamedTuple):
    """Of a quadratic programme."""

    x: jax.Array
    """(n,)."""
    slack: jax.Array
    """By how much each row is broken, (m,) in its unit: 0 where there is a solution."""


class _Point(NamedTuple):
    x: jax.Array
    y: jax.Array
    l: jax.Array  # noqa: E741 (a multiplier)


def quadratic_program(H: jax.Array, G: jax.Array, h: jax.Array, soft: jax.Array) -> Solution:
    """The minimum of 1/2 x^T H x over G x <= h, soft rows with slack where there is none otherwise.

    Args:
      H: (n, n), symmetric and positive definite.
      G: (m, n); rows of zeros bind nothing.
      h: (m,).
      soft: which rows may be broken, (m,) 1 or 0.

    Returns:
      `Solution`.
    """
    size = jnp.sqrt(jnp.sum(G**2, axis=1))
    size = jnp.where(size > 0, size, 1.0)
    of_H = jnp.sum(H * jnp.eye(len(H), dtype=H.dtype)) / len(H)
    of_h = jax.lax.stop_gradient(1.0 + jnp.max(jnp.abs(h / size)))
    rows, room = G / size[:, None], h / (size * of_h)
    x = _solved(REGULARISATION * H / of_H, rows, room, soft).x
    over, least = matvec(rows, x) - room, max(SLACK_TOLERANCE, float(jnp.finfo(h.dtype).eps) ** 0.5)
    return Solution(of_h * x, jnp.where(over > least, over, 0.0) * size * of_h)


@jax.custom_jvp
def _solved(H: jax.Array, G: jax.Array, h: jax.Array, soft: jax.Array) -> _Point:
    """The solution of a scaled programme."""
    point = _Point(jnp.zeros(G.shape[1], h.dtype), jnp.maximum(h, 1.0), jnp.ones_like(h))
    # A loop: where it is not lowered, XLA compiles one iteration.
    return jax.lax.scan(
        lambda at, _: (_improved(H, G, h, soft, at), None), point, length=ITERATIONS
    )[0]


@jax.jit  # so that the generated code holds it once
def _improved(H: jax.Array, G: jax.Array, h: jax.Array, soft: jax.Array, at: _Point) -> _Point:
    """One iteration."""
    mean, least = inner(at.l, at.y) / h.size, REGULARISATION * float(jnp.finfo(h.dtype).eps) ** 1.05
    target = jnp.maximum(CENTRING_FACTOR * mean, least)
    matrix, weight = _newton(H, G, soft, at)
    residual = matvec(G, at.x) - soft * at.l - h + target / at.l
    dx = solve_spd(matrix, -matvec(H, at.x) - matvec(G.T, at.l + weight * residual))
    dl = weight * (matvec(G, dx) + residual)
    dy = (target - at.y * dl) / at.l - at.y
    part = jnp.minimum(MAX_STEP_FRACTION * jnp.minimum(_room(at.y, dy), _room(at.l, dl)), 1.0)
    # At the solution there is nothing left to gain, and rounding would spoil the factors.
    go_on = (mean > least) & jnp.all(jnp.isfinite(dx))
    return jax.tree.map(
        lambda old, new: jnp.where(go_on, old + part * new, old), at, _Point(dx, dy, dl)
    )


def _newton(H: jax.Array, G: jax.Array, soft: jax.Array, at: _Point) -> tuple[jax.Array, jax.Array]:
    """H + G^T W G, and the weights W of the rows."""
    weight = 1.0 / (at.y / at.l + soft)
    return H + jnp.sum(G[:, :, None] * (weight[:, None] * G)[:, None, :], axis=0), weight


def _room(x: jax.Array, dx: jax.Array) -> jax.Array:
    """How many steps dx until one of the numbers x, all positive, is not."""
    falling = dx < 0
    return jnp.min(jnp.where(falling, x / jnp.where(falling, -dx, 1.0), jnp.inf))


@_solved.defjvp
def _solved_jvp(primals, tangents):
    (H, G, _, soft), (dH, dG, dh, _) = primals, tangents
    at = _solved(*primals)
    matrix, weight = _newton(H, G, soft, at)
    turned, moved = matvec(dH, at.x) + matvec(dG.T, at.l), matvec(dG, at.x) - dh
    dx, dl = jnp.zeros_like(at.x), jnp.zeros_like(at.l)
    # The weights of active rows take from H all but a few digits: what a solve leaves is solved for
    # again.
    for _ in range(REFINEMENTS):
        left, missed = matvec(H, dx) + matvec(G.T, dl) + turned, matvec(G, dx) - dl / weight + moved
        more = solve_spd(matrix, -left - matvec(G.T, weight * missed))
        dx, dl = dx + more, dl + weight * (matvec(G, more) + missed)
    return at, _Point(dx, -at.y / at.l * dl, dl)
