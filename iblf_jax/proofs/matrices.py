"""Algebra of small symmetric matrices whose entries may be intervals.

`core.linalg` tests pivots and replaces them by NaN; an interval of a pivot may contain zero
although no pivot is zero.  The functions here have no branches.  The factor is the upper one,
M = U U^T: the last diagonal entries of the mass matrix of a serial arm depend on the fewest joints,
so that its first pivots are the narrowest intervals.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import matmul

Factor = dict[tuple[int, int], jax.Array]
"""U of M = U U^T: the entries (i, j) with i <= j."""


def upper_factor(matrix: jax.Array) -> Factor:
    """U, upper triangular, with U U^T = matrix, for a symmetric positive definite (n, n) matrix."""
    n = matrix.shape[-1]
    U: Factor = {}
    for j in reversed(range(n)):
        for i in reversed(range(j + 1)):
            rest = matrix[i, j]
            for k in range(j + 1, n):
                rest = rest - U[i, k] * U[j, k]
            U[i, j] = jnp.sqrt(rest) if i == j else rest / U[j, j]
    return U


def solve_transposed(U: Factor, rhs: jax.Array) -> jax.Array:
    """The solution x of U^T x = rhs, (n,)."""
    x: list[jax.Array] = []
    for i in range(len(rhs)):
        rest = rhs[i]
        for k in range(i):
            rest = rest - U[k, i] * x[k]
        x.append(rest / U[i, i])
    return jnp.stack(x)


def solve_upper(U: Factor, rhs: jax.Array) -> jax.Array:
    """The solution x of U x = rhs, (n,)."""
    n = len(rhs)
    x: list[jax.Array] = [jnp.zeros(())] * n
    for i in reversed(range(n)):
        rest = rhs[i]
        for k in range(i + 1, n):
            rest = rest - U[i, k] * x[k]
        x[i] = rest / U[i, i]
    return jnp.stack(x)


@jax.custom_jvp
def inverse(matrix: jax.Array) -> jax.Array:
    """The inverse of a symmetric positive definite (n, n) matrix; its derivative is that of the
    equation.

    A product with the inverse is narrower over a box than elimination, in which the entries of the
    right-hand side occur several times.
    """
    n = matrix.shape[-1]
    if n == 1:
        return 1.0 / matrix
    if n == 2:
        # The last pivot of a serial arm is constant.
        ratio = matrix[0, 1] / matrix[1, 1]
        first = 1.0 / (matrix[0, 0] - ratio * matrix[0, 1])
        mixed = -ratio * first
        last = 1.0 / matrix[1, 1] - ratio * mixed
        return jnp.stack([jnp.stack([first, mixed]), jnp.stack([mixed, last])])
    U = upper_factor(matrix)
    columns = [solve_transposed(U, solve_upper(U, unit)) for unit in jnp.eye(n)]
    return jnp.stack(columns, axis=-1)


@inverse.defjvp
def _inverse_jvp(primals: tuple, tangents: tuple) -> tuple:
    (matrix,), (matrix_dot,) = primals, tangents
    found = inverse(matrix)
    return found, -matmul(found, matmul(matrix_dot, found))


def solve_general(matrix: jax.Array, rhs: jax.Array) -> jax.Array:
    """The solution x of matrix x = rhs, (n,), by elimination without pivoting, for an (n, n) matrix
    near the identity.
    """
    n = len(rhs)
    rows = [[*[matrix[i, j] for j in range(n)], rhs[i]] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            for j in range(k + 1, n + 1):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
    x: list[jax.Array] = [jnp.zeros(())] * n
    for i in reversed(range(n)):
        rest = rows[i][n]
        for j in range(i + 1, n):
            rest = rest - rows[i][j] * x[j]
        x[i] = rest / rows[i][i]
    return jnp.stack(x)


def least_eigenvalue(matrix: jax.Array) -> jax.Array:
    """A lower bound of the eigenvalues of a symmetric (n, n) matrix: the least one for n <= 2, that
    of Gershgorin's circles above, ().
    """
    n = matrix.shape[-1]
    if n == 1:
        return matrix[0, 0]
    if n == 2:
        middle = 0.5 * (matrix[0, 0] + matrix[1, 1])
        half_gap = 0.5 * (matrix[0, 0] - matrix[1, 1])
        return middle - jnp.sqrt(half_gap**2 + matrix[0, 1] ** 2)
    circles = [
        matrix[i, i] - sum(jnp.abs(matrix[i, j]) for j in range(n) if j != i) for i in range(n)
    ]
    return jnp.min(jnp.stack(circles))


def norm(vector: jax.Array) -> jax.Array:
    """The length of an (n,) vector, ()."""
    if len(vector) == 1:
        return jnp.abs(vector[0])
    return jnp.sqrt(jnp.sum(vector**2))


def sphere(angles: list[jax.Array]) -> list[jax.Array]:
    """The point of the unit sphere with m spherical angles, m + 1 coordinates.

    (cos a_1, sin a_1 cos a_2, ..., sin a_1 ... sin a_m)
    """
    coordinates = []
    rest = None
    for angle in angles:
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        coordinates.append(cosine if rest is None else rest * cosine)
        rest = sine if rest is None else rest * sine
    coordinates.append(jnp.ones(()) if rest is None else rest)
    return coordinates
