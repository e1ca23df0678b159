"""A small convex quadratic programme, by a primal-dual interior-point method that is precise enough
for multipliers that are reported.

    minimise  c.x + x.H.x / 2   subject to  A x <= b,      H positive semidefinite

With slacks s and multipliers y the conditions H x + c + A^T y = 0, A x + s = b, y_i s_i = 0 are
followed by Newton's method, first towards y s = 0 (predictor), then towards a common y_i s_i that
depends on how far the predictor came (corrector).

Source: S. Mehrotra, SIAM J. Optim. 2 (1992) 575-601; J. Nocedal, S. J. Wright, Numerical
Optimization, 2nd ed., algorithm 16.4.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

MAX_ITERATIONS = 60
"""Iterations; about fifteen are needed."""
PRECISION = 1e-11
"""Of all conditions, relative to the numbers of the programme."""


def solve(
    H: np.ndarray, c: np.ndarray, A: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The x (n,) of the programme, and the multipliers (m,) of its rows.

    Args:
      H: (n, n), positive semidefinite.
      c: (n,).
      A: (m, n); its rows bound x.
      b: (m,).
    """
    scale = max(float(np.max(np.abs(c))), float(np.max(np.abs(H))), 1e-300)
    H = H / scale + 1e-12 * np.eye(len(c))
    c = c / scale
    x = np.zeros(len(c))
    s = np.maximum(b, 1.0)
    y = np.ones(len(b))
    limit = PRECISION * (1.0 + float(np.max(np.abs(b))))
    for _ in range(MAX_ITERATIONS):
        dual = H @ x + c + A.T @ y
        primal = A @ x + s - b
        gap = max(float(s @ y) / len(b), 1e-300)
        optimal = np.max(np.abs(dual)) < PRECISION * 10 and np.max(np.abs(primal)) < limit
        if gap < PRECISION and optimal:
            break
        try:
            factor = cho_factor(H + (A.T * (y / s)) @ A)
        except (LinAlgError, ValueError):  # the matrix is singular in double precision
            break

        def newton_step(target, dual=dual, primal=primal, factor=factor, s=s, y=y):
            dx = cho_solve(factor, -dual - A.T @ ((y * primal - target) / s))
            ds = -primal - A @ dx
            return dx, ds, -(target + y * ds) / s

        dx, ds, dy = newton_step(s * y)
        length = min(_longest(s, ds), _longest(y, dy))
        predicted = float((s + length * ds) @ (y + length * dy)) / len(b)
        centre = (predicted / gap) ** 3
        dx, ds, dy = newton_step(s * y + ds * dy - centre * gap)
        length = min(1.0, 0.995 * min(_longest(s, ds, 2.0), _longest(y, dy, 2.0)))
        if not np.all(np.isfinite(dx)):
            break
        x = x + length * dx
        s = s + length * ds
        y = y + length * dy
    return x, scale * y


def _longest(x: np.ndarray, change: np.ndarray, most: float = 1.0) -> float:
    """The longest step along a change with which x >= 0 remains, at most `most`."""
    down = change < 0
    return min(most, float(np.min(-x[down] / change[down], initial=most)))
