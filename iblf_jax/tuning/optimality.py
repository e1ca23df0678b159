"""Multipliers and residuals of the optimality conditions at any gains, from one evaluation there.

At a minimum of f subject to G_r <= 0 there are multipliers y_r >= 0 with

    grad f + sum_r y_r grad G_r = 0     (stationarity),
    y_r G_r = 0                         (complementarity).

The largest value of a signal over time has kinks: where two peaks are equally large its gradient
jumps.  An optimum may be at a kink.  The conditions then hold only with the gradients of both
peaks.  One evaluation gives the gradient of one peak; that of the other one is known from a
rejected trial of the solver nearby, or from random points around (`kinks`).

If no feasible gains are known, the conditions are those of the smallest largest excess:

    sum_r y_r grad G_r = 0     with sum_r y_r = 1.

They hold at a stationary point of the largest excess, at which the requirements cannot be kept
together by small changes of the gains.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iblf_jax.tuning.evaluation import Derivatives, Evaluator
from iblf_jax.tuning.solvers.sqp import (
    STATIONARITY_TOLERANCE,
    Point,
    conditions_at,
    free_slope,
    slope_size,
    with_nearby_pieces,
)


class Conditions(NamedTuple):
    """Multipliers and residuals of the optimality conditions at a point."""

    multipliers: np.ndarray
    """Lagrange multiplier of each requirement, (R,)."""
    residuals: np.ndarray
    """Stationarity, feasibility and complementarity, (3,): the largest entry of the Lagrangian's
    gradient that no range blocks, the largest excess, and the sum of the multipliers times the
    distances from the limits.  NaN where the gradient is not finite."""
    size: float
    """The residuals are relative to this number; it is 1 where the objective does not count."""
    at_kink: bool = False
    """Whether the conditions do not hold with the gradients at the point, but hold if those of
    nearby points are added."""

    @property
    def hold(self) -> bool:
        """Whether the conditions of an optimum hold, at a kink or not.  The largest excess does not
        count: whether the point is feasible is decided by the caller.
        """
        return self.at_kink or self.are_small

    @property
    def are_small(self) -> bool:
        """Whether stationarity and complementarity are at most STATIONARITY_TOLERANCE * size."""
        stationarity, _, complementarity = self.residuals
        return bool(max(stationarity, complementarity) <= STATIONARITY_TOLERANCE * self.size)


def conditions(
    evaluate: Evaluator,
    found: Derivatives,
    row: int,
    z: np.ndarray,
    *,
    violated: bool,
    nearby: list[Point],
) -> Conditions:
    """The conditions for a solver that has the requirements as constraints.

    Args:
      evaluate: the problem.
      found: its derivatives at S points.
      row: the point of the conditions, an index into them.
      z: coordinates of this point, (p,).
      violated: whether the conditions are those of the smallest largest excess.
      nearby: further points, whose pieces may be active together with those of this point.
    """
    space = evaluate.space
    point = Point.of(space, found, row)
    if not point.is_finite:
        unknown = np.full(len(evaluate.problem.allowed), np.nan)
        return Conditions(unknown, np.full(3, np.nan), 1.0)
    size = slope_size(point)
    if violated:
        space = space._replace(constraints=space.constraints._replace(largest_only=True))
        size = 1.0
    result = Conditions(*conditions_at(space, z, point), size)
    if result.are_small or not nearby:
        return result
    space, point = with_nearby_pieces(space, point, nearby)
    with_nearby = Conditions(*conditions_at(space, z, point), size)
    return result._replace(at_kink=with_nearby.are_small)


def conditions_of_penalty(
    evaluate: Evaluator, found: Derivatives, row: int, z: np.ndarray, y: np.ndarray, mu: float
) -> Conditions:
    """The conditions for a solver with the requirements in an augmented Lagrangian.

    The gradient of the augmented Lagrangian is that of the Lagrangian with the multipliers
    max(0, y + mu G).

    Args:
      evaluate, found, row, z: as `conditions`.
      y, mu: multipliers, (R,), and penalty parameter of the start.
    """
    excess = found.value.smooth_excess[row]
    multipliers = np.maximum(y + mu * excess, 0.0)
    worst = float(np.max(found.value.exact_excess[row], initial=0.0))
    complementarity = float(np.sum(np.abs(multipliers * excess)))
    stationarity = free_slope(evaluate.space.box, z, found.gradient[row])
    size = max(1e-3, abs(float(found.value.objective[row])))
    return Conditions(multipliers, np.array([stationarity, worst, complementarity]), size)
