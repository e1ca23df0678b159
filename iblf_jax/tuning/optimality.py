"""Multipliers and residuals of the optimality conditions at any gains, from one evaluation there.

For a minimum of f subject to G_r <= 0 there are multipliers y_r >= 0 with

    grad f + sum_r y_r grad G_r = 0,     y_r G_r = 0.

Largest values over time have kinks: at gains where two peaks are equally large the gradient jumps,
and an optimum may be there.  The conditions then hold with gradients of both peaks only, one of
which is known from nearby gains.

Where no gains are known that keep the requirements, the conditions are those of the least largest
excess: sum_r y_r grad G_r = 0 with sum_r y_r = 1.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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
    """Multipliers and residuals at a point."""

    multipliers: np.ndarray
    """Of each requirement, (R,)."""
    residuals: np.ndarray
    """Largest entry of the Lagrangian's gradient that no range blocks, largest excess, and sum of
    the multipliers times the distances from the limits, (3,); NaN without a finite gradient."""
    size: float
    """What the residuals are compared with; 1 where the objective does not count."""
    at_kink: bool = False
    """Whether the conditions hold together with gradients from nearby points."""

    @property
    def hold(self) -> bool:
        """Whether gradient and complementarity are small, or the point is an optimum at a kink."""
        return self.at_kink or self.are_small

    @property
    def are_small(self) -> bool:
        """Whether gradient and complementarity are small."""
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
      found: its derivatives, of which one row counts.
      row: which one.
      z: where it was evaluated, (p,).
      violated: whether the conditions are those of the least largest excess.
      nearby: points whose pieces may be at their limits too.
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
    with_others = Conditions(*conditions_at(space, z, point), size)
    return result._replace(at_kink=with_others.are_small)


def conditions_of_penalty(
    evaluate: Evaluator, found: Derivatives, row: int, z: np.ndarray, state: dict[str, Any]
) -> Conditions:
    """The same where the requirements are penalties: the gradient of the augmented Lagrangian is
    that of the Lagrangian with max(0, y + mu G) as multipliers.

    Args:
      evaluate, found, row, z: as `conditions`.
      state: of the search, with y and mu.
    """
    excess = found.value.smooth_excess[row]
    multipliers = np.maximum(state["multipliers"][row] + state["penalty"][row] * excess, 0.0)
    worst = float(np.max(found.value.exact_excess[row], initial=0.0))
    complementarity = float(np.sum(np.abs(multipliers * excess)))
    stationarity = free_slope(evaluate.space.box, z, found.gradient[row])
    size = max(1e-3, abs(float(found.value.objective[row])))
    return Conditions(multipliers, np.array([stationarity, worst, complementarity]), size)
