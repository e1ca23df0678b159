"""Algebra of small symmetric positive definite matrices, unrolled over their static size.

Calls into a matrix library cost microseconds on a 2x2 matrix and stop XLA from fusing a time step.
A mass matrix is n x n with n the number of joints, known when the program is traced, so its
Cholesky factor is written out as scalar operations, and products are sums of elementwise ones.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np


def matvec(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """The product of a matrix and a vector, (m,), for an (m, n) matrix and an (n,) vector."""
    return jnp.sum(matrix * vector, axis=-1)


def matmul(left: jax.Array, right: jax.Array) -> jax.Array:
    """The product of two matrices, (m, p), for an (m, n) and an (n, p) matrix."""
    return jnp.sum(left[:, :, None] * right[None, :, :], axis=1)


def inner(u: jax.Array, v: jax.Array) -> jax.Array:
    """u^T v, (), for two (n,) vectors."""
    return jnp.sum(u * v)


def sums_to(rows: jax.Array, axis: int = 0) -> jax.Array:
    """Entry i: the sum of the entries 0 to i along an axis, such as those of the joints that move
    link i.
    """
    return jax.lax.cumsum(rows, axis)


def sums_from(rows: jax.Array, axis: int = 0) -> jax.Array:
    """Entry i: the sum of the entries from i on along an axis, such as those of the links that
    joint i moves.
    """
    return jax.lax.cumsum(rows, axis, reverse=True)


def symmetric(matrix: jax.Array) -> jax.Array:
    """The matrix with its upper triangle in place of the lower one, (..., k, k).

    A scalar program then computes the upper triangle only.
    """
    above = np.triu(np.ones(matrix.shape[-2:], bool))
    return jnp.where(above, matrix, jnp.swapaxes(matrix, -1, -2))


def _factors(matrix: jax.Array) -> tuple[list[list[jax.Array]], list[jax.Array]]:
    """L (rows below its unit diagonal) and 1/D with L D L^T = matrix; NaN where a pivot is not
    positive.

    The factors take no root and one division per row. On a processor that steps many robots at
    once, roots and divisions cost as much as all other operations together.
    """
    lower: list[list[jax.Array]] = []
    scaled: list[list[jax.Array]] = []
    inverse: list[jax.Array] = []
    for i in range(matrix.shape[-1]):
        lower.append([])
        scaled.append([])
        for j in range(i):
            rest = matrix[i, j]
            for k in range(j):
                rest = rest - scaled[i][k] * lower[j][k]
            scaled[i].append(rest)
            lower[i].append(rest * inverse[j])
        pivot = matrix[i, i]
        for k in range(i):
            pivot = pivot - scaled[i][k] * lower[i][k]
        inverse.append(1.0 / jnp.where(pivot > 0, pivot, jnp.nan))
    return lower, inverse


@jax.custom_jvp
def solve_spd(matrix: jax.Array, rhs: jax.Array) -> jax.Array:
    """The solution x of matrix x = rhs, (n,), for a symmetric positive definite (n, n) matrix.

    A matrix that is not positive definite gives NaN. The derivative is that of the equation,
    dx = matrix^-1 (drhs - dmatrix x), with the same factors.
    """
    lower, inverse = _factors(matrix)
    n = len(inverse)
    y: list[jax.Array] = []
    for i in range(n):
        rest = rhs[i]
        for k in range(i):
            rest = rest - lower[i][k] * y[k]
        y.append(rest)
    x: list[jax.Array] = [jnp.zeros(())] * n
    for i in reversed(range(n)):
        rest = y[i] * inverse[i]
        for k in range(i + 1, n):
            rest = rest - lower[k][i] * x[k]
        x[i] = rest
    return jnp.stack(x)


def _solution_jvp(solver: Callable, primals: tuple, tangents: tuple) -> tuple:
    """The solution x of matrix x = rhs and its derivative, which solves the equation
    matrix dx = drhs - dmatrix x.
    """
    (matrix, rhs), (matrix_dot, rhs_dot) = primals, tangents
    x = solver(matrix, rhs)
    return x, solver(matrix, rhs_dot - matvec(matrix_dot, x))


solve_spd.defjvp(partial(_solution_jvp, solve_spd))


@jax.custom_jvp
def solve_gain(matrix: jax.Array, rhs: jax.Array) -> jax.Array:
    """The solution x of matrix x = rhs, (n,), for any (n, n) matrix, unrolled, with partial
    pivoting.

    A singular matrix gives NaN. The derivative is that of the equation, as that of `solve_spd`.
    """
    n = len(rhs)
    smallest = jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(matrix))
    rows = [[*[matrix[i, j] for j in range(n)], rhs[i]] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            larger = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            upper = [jnp.where(larger, b, a) for a, b in zip(rows[k], rows[i], strict=True)]
            lower = [jnp.where(larger, a, b) for a, b in zip(rows[k], rows[i], strict=True)]
            rows[k], rows[i] = upper, lower
        pivot = rows[k][k]
        inverse = 1.0 / jnp.where(jnp.abs(pivot) > smallest, pivot, jnp.nan)
        rows[k] = [x * inverse for x in rows[k]]
        for i in range(k + 1, n):
            factor = rows[i][k]
            rows[i] = [b - factor * a for a, b in zip(rows[k], rows[i], strict=True)]
    x: list[jax.Array] = [jnp.zeros(())] * n
    for i in reversed(range(n)):
        rest = rows[i][n]
        for j in range(i + 1, n):
            rest = rest - rows[i][j] * x[j]
        x[i] = rest
    return jnp.stack(x)


solve_gain.defjvp(partial(_solution_jvp, solve_gain))


@jax.jit
def solve(matrix: jax.Array, rhs: jax.Array) -> jax.Array:
    """The solution X of matrix X = rhs, (m, k), for any (m, m) matrix, by Gauss-Jordan elimination
    with pivoting.

    It is for operations that occur once per run: a loop over the columns compiles quickly.
    """
    rows = jnp.arange(len(matrix))

    def eliminate(table, k):
        pivot = jnp.argmax(jnp.where(rows >= k, jnp.abs(table[:, k]), -1.0))
        top = table[pivot] / table[pivot, k]
        table = jnp.where((rows == pivot)[:, None], table[k], table)
        return jnp.where((rows == k)[:, None], top, table - table[:, k][:, None] * top), None

    table, _ = jax.lax.scan(eliminate, jnp.concatenate([matrix, rhs], axis=1), rows)
    return table[:, len(matrix) :]
