"""Decides whether gains at a kink are optimal, and improves them, by the gradients of points around
them (gradient sampling).

A requirement is a maximum over time, and its gradient jumps where the maximum moves from one peak
to another.  The model of one point does not contain the other peaks, so that a solver may end near
such gains although the conditions of an optimum do not hold, or although they do hold with the
gradients of all peaks.

Gradients are therefore evaluated at p + 1 random points within |s_i| <= reach of the gains.  Their
pieces, linearised there, are further constraints of the subproblem of `SQP` with this trust region.
Its step s is a direction in which all of these peaks fall.  The points z + t s with t of FRACTIONS
are evaluated without derivatives, and the best one takes the place of z.

If that is better by less than IMPROVEMENT, the conditions of an optimum hold at the kink if the
predicted decrease is at most STATIONARITY_TOLERANCE * reach, relative to the objective: no element
of the convex hull of the gradients is larger.  Otherwise the reach shrinks.

Source: J. V. Burke, A. S. Lewis, M. L. Overton, SIAM J. Optim. 15 (2005) 751-779.
"""

from __future__ import annotations

import numpy as np

from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.solvers import SearchSpace
from iblf_jax.tuning.solvers.sqp import (
    MIN_PENALTY,
    PENALTY_FACTOR,
    Point,
    Step,
    Subproblem,
    positive_definite,
    subproblems,
    with_nearby_pieces,
)

FIRST_REACH = 0.2
"""First half-width of the box of the random points, in the coordinates z: 20 % of a gain."""
LEAST_REACH = 0.005
"""The examination ends if the half-width is smaller."""
SHRINK_FACTOR = 0.4
MOST_ROUNDS = 16
"""Largest number of sets of points."""
IMPROVEMENT = 1e-4
"""Decrease of the objective, relative to it, with which the next points have the same reach."""
FRACTIONS = np.geomspace(1.0, 1e-3, 16)
"""Multiples of the step that are evaluated."""


def points_near(box: Box, z: np.ndarray, reach: float, rng: np.random.Generator) -> np.ndarray:
    """Random points within a reach of z, (p,), and within the ranges, (p + 1, p)."""
    moved = z + reach * rng.uniform(-1.0, 1.0, (len(z) + 1, len(z)))
    return np.clip(moved, box.low, box.high)


def step_between_kinks(
    space: SearchSpace,
    z: np.ndarray,
    here: Point,
    nearby: list[tuple[np.ndarray, Point]],
    reach: float,
) -> Step:
    """The step of the subproblem with the pieces of all points.

    Args:
      space: ranges and requirements.
      z: the gains, (p,).
      here: loss and pieces at z.
      nearby: further points with their coordinates, (p,).
      reach: largest step in each coordinate.
    """
    moved = [
        point._replace(pieces=point.pieces + point.linear_change(z - other))
        for other, point in nearby
    ]
    space, here = with_nearby_pieces(space, here, moved)
    requested = Subproblem(
        here.gradient,
        positive_definite(here.matrix, float(np.max(np.abs(here.matrix)))),
        np.maximum(space.box.low - z, -reach),
        np.minimum(space.box.high - z, reach),
        here.pieces,
        here.piece_gradients,
        PENALTY_FACTOR**2 * MIN_PENALTY * max(1e-3, abs(here.loss)),
    )
    (step,) = subproblems(space.constraints, [requested])
    return step
