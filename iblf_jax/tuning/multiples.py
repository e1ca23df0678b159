"""The search along leaves that are multiples of a step, by values: the sampling period.

A period is a whole number of time steps, so the loss is constant between two periods and has no
derivative by one that a solver could follow.  `best_multiple` compares the loss at the multiples
with all other coordinates as they are; a search by derivatives can continue from the best.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iblf_jax.tuning.evaluation import Value, values
from iblf_jax.tuning.parameters import along
from iblf_jax.tuning.problem import TuningProblem

MOST = 32
"""Largest number of other multiples that are compared, the nearest ones."""


class Compared(NamedTuple):
    """The best of the points that were compared."""

    z: np.ndarray
    """Its coordinates, (p,)."""
    evaluated: int
    """Number of points that were evaluated, the given one included."""


def best_multiple(problem: TuningProblem, z: np.ndarray, most: int = MOST) -> Compared:
    """The best of a point and of those that differ from it in a multiple of a step.

    Valid points come first, then those that violate requirements and bounds least, then those with
    the smallest objective; the given point is kept where none is better.

    Args:
      problem: what is tuned.
      z: the point, (p,).
      most: largest number of other multiples.
    """
    z = np.asarray(z, float)
    others = along(problem.blocks, problem.box, z, most)
    if not len(others):
        return Compared(z, 0)
    points = np.concatenate([z[None], others])
    found = values(problem, points)
    order = np.lexsort((found.objective, violation(found), ~found.valid))
    return Compared(points[order[0]], len(points))


def violation(found: Value) -> np.ndarray:
    """The largest excess of a requirement, plus the distance by which a bound is left, (S,)."""
    excess = np.max(np.maximum(found.exact_excess, 0.0), axis=1, initial=0.0)
    return excess + np.maximum(-found.margin, 0.0)
