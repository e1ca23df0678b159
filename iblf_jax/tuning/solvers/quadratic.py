"""Small convex quadratic programmes, by a primal-dual interior-point method that is precise enough
for multipliers that are reported.

    minimise  c.x + x.H.x / 2   subject to  A x <= b,      H positive semidefinite

With slacks s and multipliers y the conditions H x + c + A^T y = 0, A x + s = b, y_i s_i = 0 are
followed by Newton's method, first towards y s = 0 (predictor), then towards a common y_i s_i that
depends on how far the predictor came (corrector).

Several programmes are solved together, as arrays with the programmes first, because the calls of
NumPy for an iteration of a small programme take much longer than its arithmetic: 32 random
programmes of 11 unknowns and about 50 rows take four times as long as one of them.

Source: S. Mehrotra, SIAM J. Optim. 2 (1992) 575-601; J. Nocedal, S. J. Wright, Numerical
Optimization, 2nd ed., algorithm 16.4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

MAX_ITERATIONS = 60
"""Iterations; about fifteen are needed."""
PRECISION = 1e-11
"""Of all conditions, relative to the numbers of the programme."""
DUAL_FACTOR = 10.0
"""The residual of H x + c + A^T y = 0 may be larger than the others by this factor."""


class Programmes(NamedTuple):
    """The arrays of N programmes.

    Programmes with fewer rows or unknowns than others are filled up with rows 0 <= 1 and with
    unknowns whose entries are 0, and which are 0 in the solution.
    """

    H: np.ndarray
    """(N, n, n), positive semidefinite."""
    c: np.ndarray
    """(N, n)."""
    A: np.ndarray
    """(N, m, n); its rows bound x."""
    b: np.ndarray
    """(N, m)."""


class Solutions(NamedTuple):
    """The solutions of N programmes."""

    x: np.ndarray
    """(N, n)."""
    y: np.ndarray
    """Multipliers of the rows, (N, m)."""


def solve(programmes: Programmes) -> Solutions:
    """The solution of each programme.

    Rounding may prevent the factorisation of a matrix before all conditions hold to PRECISION, and
    the last iterates may be worse than earlier ones.  The result is therefore the iterate with the
    smallest residual of the conditions.
    """
    H, c, A, b = programmes
    size = np.maximum(np.abs(c).max(axis=1), np.abs(H).max(axis=(1, 2)))
    scale = np.maximum(size, 1e-300)
    # The identity makes matrices definite that are semidefinite, or of unknowns without entries.
    H = H / scale[:, None, None] + 1e-12 * np.eye(c.shape[1])
    c = c / scale[:, None]
    found_x = np.zeros_like(c)
    found_y = np.zeros_like(b)
    least = np.full(len(c), np.inf)
    unsolved = np.arange(len(c))
    x = found_x.copy()
    s = np.maximum(b, 1.0)
    y = np.ones_like(b)
    extent = 1.0 + np.maximum.reduce(np.abs(b), axis=1)
    # `np.sum`, `np.max` and `np.all` take twice as long for small arrays as the reductions that
    # they call.
    for _ in range(MAX_ITERATIONS):
        At = np.swapaxes(A, 1, 2)
        dual = _times(H, x) + c + _times(At, y)
        primal = _times(A, x) + s - b
        gap = np.maximum(np.add.reduce(s * y, axis=1) / b.shape[1], 1e-300)
        residual = np.maximum(gap, np.maximum.reduce(np.abs(dual), axis=1) / DUAL_FACTOR)
        residual = np.maximum(residual, np.maximum.reduce(np.abs(primal), axis=1) / extent)
        better = residual < least[unsolved]
        improved = unsolved[better]
        found_x[improved] = x[better]
        found_y[improved] = y[better]
        least[improved] = residual[better]
        factor = _cholesky(H + (At * (y / s)[:, None, :]) @ A)
        ended = (residual < PRECISION) | ~np.logical_and.reduce(np.isfinite(factor), axis=(1, 2))
        if ended.all():
            break
        if ended.any():
            everything = (unsolved, H, c, A, b, extent, x, s, y, At, dual, primal, gap, factor)
            unsolved, H, c, A, b, extent, x, s, y, At, dual, primal, gap, factor = (
                array[~ended] for array in everything
            )
        # The inverse of a triangular matrix is as precise as a solution with it.
        inverse = np.linalg.inv(factor)
        arrays = (A, At, s, y, dual, primal, inverse)
        dx, ds, dy = _newton_step(*arrays, s * y)
        length = np.minimum(_longest(s, ds, 1.0), _longest(y, dy, 1.0))[:, None]
        products = (s + length * ds) * (y + length * dy)
        predicted = np.add.reduce(products, axis=1) / b.shape[1]
        centre = (predicted / gap) ** 3 * gap
        dx, ds, dy = _newton_step(*arrays, s * y + ds * dy - centre[:, None])
        length = np.minimum(_longest(s, ds, 2.0), _longest(y, dy, 2.0))
        length = np.minimum(1.0, 0.995 * length)[:, None]
        if not np.isfinite(dx).all():
            # A programme whose step is not finite stays where it is.
            is_finite = np.all(np.isfinite(dx), axis=1)[:, None]
            dx, ds, dy = (np.where(is_finite, d, 0.0) for d in (dx, ds, dy))
        x = x + length * dx
        s = s + length * ds
        y = y + length * dy
    return Solutions(found_x, scale[:, None] * found_y)


def _newton_step(
    A: np.ndarray,
    At: np.ndarray,
    s: np.ndarray,
    y: np.ndarray,
    dual: np.ndarray,
    primal: np.ndarray,
    inverse: np.ndarray,
    target: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Changes of x, s and y with which the linearised conditions hold and y s falls by `target`.

    Args:
      A, At: the rows and their transposes.
      s, y: slacks and multipliers.
      dual, primal: residuals of the conditions.
      inverse: of the Cholesky factor of H + A^T diag(y / s) A.
      target: (N, m).
    """
    right = -dual - _times(At, (y * primal - target) / s)
    dx = _times(np.swapaxes(inverse, 1, 2), _times(inverse, right))
    ds = -primal - _times(A, dx)
    return dx, ds, -(target + y * ds) / s


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Products of matrices, (N, m, n), and vectors, (N, n)."""
    return (matrix @ vector[..., None])[..., 0]


def _cholesky(matrix: np.ndarray) -> np.ndarray:
    """The Cholesky factor of each matrix, (N, n, n); NaN where a matrix is not positive definite in
    double precision.
    """
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        if len(matrix) == 1:
            return np.full_like(matrix, np.nan)
        return np.concatenate([_cholesky(one[None]) for one in matrix])


def _longest(x: np.ndarray, change: np.ndarray, most: float) -> np.ndarray:
    """The longest steps along changes, (N, m), with which x >= 0 remains, at most `most`, (N,).
    Changes that are not numbers do not count.
    """
    fastest = -np.fmin.reduce(change / x, axis=1)
    return 1.0 / np.fmax(fastest, 1.0 / most)
