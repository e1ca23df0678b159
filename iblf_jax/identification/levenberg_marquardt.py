"""The Levenberg-Marquardt method inside limits, used by the regression and by multiple shooting.

Near z the objective is approximated by f + g.s + s.A.s/2.  A step s minimises this model with
mu s.D.s/2 added (D: the scales of the parameters) inside the limits.  The damping mu falls after a
good step and rises after a rejected one.  A parameter at a limit stays there while the gradient
points outwards.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

FIRST_DAMPING, DAMPING_FACTOR, LARGEST_DAMPING = 1e-3, 6.0, 1e9
"""The first mu, the factor between steps, and the mu at which the search stops."""
ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE = 1e-2, 1e-9
"""The search stops where the predicted decrease of f is smaller than the sum of the first and the
second times f: that is a seventh of a standard error, and convergence is quadratic there."""
WEAK_PRIOR = 30.0
"""Standard deviation, in scales, of the weak prior about the start; it keeps parameters that are
not identifiable in place."""


class QuadraticModel(NamedTuple):
    """The quadratic model of the objective at a point of the search."""

    cost: float
    """f."""
    gradient: np.ndarray
    """g, (p,)."""
    hessian: np.ndarray
    """A, (p, p)."""
    data: Any = None
    """Further results at the point, for the caller."""


def bounded_step(A: np.ndarray, g: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The s that minimises g.s + s.A.s/2 with low <= s <= high, by an active-set method: entries
    are fixed at their limits one after another.
    """
    s = np.zeros(len(g))
    fixed = np.zeros(len(g), bool)
    for _ in range(len(g) + 1):
        free = ~fixed
        if not free.any():
            break
        right_side = -g[free] - A[np.ix_(free, fixed)] @ s[fixed]
        s[free] = np.linalg.lstsq(A[np.ix_(free, free)], right_side, rcond=1e-15)[0]
        violation = np.where(free, np.maximum(low - s, s - high), -np.inf)
        worst = int(np.argmax(violation))
        if not violation[worst] > 0:
            break
        fixed[worst] = True
        s[worst] = np.clip(s[worst], low[worst], high[worst])
    return np.clip(s, low, high)


def levenberg_marquardt(
    here: QuadraticModel,
    z: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    scale: np.ndarray,
    evaluate: Callable,
    linearize: Callable,
    max_steps: int,
) -> tuple[np.ndarray, QuadraticModel, int]:
    """The minimum inside limits.

    Args:
      here: the quadratic model at z.
      z: start, (p,).
      limits: lower and upper limits of z.
      scale: scale of z, (p,).
      evaluate: function (QuadraticModel, z, step) -> (cost, results) after the step; an infinite
        cost where the objective is undefined.
      linearize: function (z, results) -> QuadraticModel.
      max_steps: largest number of steps.

    Returns:
      z, the quadratic model there, and the number of steps.
    """
    damping, steps = FIRST_DAMPING, 0
    while steps < max_steps and damping < LARGEST_DAMPING and len(z):
        steps += 1
        scaled_hessian = scale[:, None] * here.hessian * scale
        diagonal = np.diag(scaled_hessian)
        largest = diagonal.max(initial=1e-300)
        step = scale * bounded_step(
            scaled_hessian + damping * np.diag(diagonal + 1e-9 * largest),
            scale * here.gradient,
            (limits[0] - z) / scale,
            (limits[1] - z) / scale,
        )
        predicted = -(here.gradient @ step + 0.5 * step @ here.hessian @ step)
        if predicted <= ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * here.cost:
            break
        cost, results = evaluate(here, z, step)
        if not (np.isfinite(cost) and cost < here.cost):
            damping *= DAMPING_FACTOR
            continue
        gain_ratio = (here.cost - cost) / predicted
        z = z + step
        here = linearize(z, results)
        if gain_ratio > 0.5:
            damping /= DAMPING_FACTOR
    return z, here, steps
