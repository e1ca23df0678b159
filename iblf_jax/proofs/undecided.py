"""What is left where a search ends without a proof: where, and whether more boxes would help.

Random points of the units that are left are centres of boxes of several widths. The share of these
boxes with a negative bound shows whether the search advances where it is left: if every box of a
width that a search reaches is negative, more boxes prove the statement; if a bound is not negative
at a point, no number of boxes does.  The same boxes at a smaller level show whether that helps: a
point of coordinates is one of every level set.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from iblf_jax.kernels import enclose
from iblf_jax.proofs.problem import LevelSetProblem

POINTS = 2048
"""Centres of the boxes of each width."""
WIDTHS = tuple(2.0**-k for k in range(2, 10))
"""Widths of the boxes, in parts of the width of each coordinate."""
REACHED = 2.0**-6
"""Width of boxes that a search of two links reaches with some million boxes."""
SMALLER_LEVEL = 0.25
"""Level that is tried on boxes of this width, in parts of the level."""
FEW = 50
"""Boxes without a negative bound that suffice to say where they are."""
CENTRAL = (0.05, 0.95)
"""Quantiles between which they are said to be."""


class Left(NamedTuple):
    """Boxes at random points of the units that are left."""

    negative_shares: dict[float, float]
    """Width of boxes, in parts of each coordinate -> share of those with a negative bound."""
    left_width: float
    """The least width with at least FEW boxes without a negative bound, else the largest one."""
    left_intervals: dict[str, tuple[float, float]]
    """Coordinate -> interval of the middle 90 % of these boxes of this width; the time is that
    since t = 0."""
    left_value: float
    """The largest bound at the points, in the unit of V_w per second."""
    smaller_level_share: float
    """Share of the boxes of width REACHED with a negative bound at SMALLER_LEVEL times the
    level."""


def left_over(
    problem: LevelSetProblem, constants: Sequence[np.ndarray], units: np.ndarray, seed: int
) -> Left | None:
    """Examines boxes at random points of units.

    Args:
      problem: the statement.
      constants: of its weight and level.
      units: lower and upper corners, (k, 2, d).
      seed: of the points.

    Returns:
      What was found; None without units.
    """
    if len(units) == 0:
        return None
    generator = np.random.default_rng(seed)
    low, high = np.moveaxis(units, 1, 0)
    free = len(problem.lower)
    sizes = np.prod((high - low)[:, :free], axis=1, where=(high > low)[:, :free])
    chosen = generator.choice(len(units), POINTS, p=sizes / sizes.sum())
    share = generator.uniform(size=(POINTS, low.shape[1]))
    points = low[chosen] + share * (high - low)[chosen]
    _, (values, *_) = enclose(problem.bound, points, points, constants)
    shares, remaining = {}, {}
    smaller_level_share = 0.0
    for width in WIDTHS:
        lower, upper = points.copy(), points.copy()
        half = 0.5 * width * (problem.upper - problem.lower)
        lower[:, :free] = np.maximum(points[:, :free] - half, problem.lower)
        upper[:, :free] = np.minimum(points[:, :free] + half, problem.upper)
        is_negative = _are_negative(problem, lower, upper, constants)
        shares[width] = float(is_negative.mean())
        remaining[width] = points[~is_negative]
        if width == REACHED:
            smaller = _at_smaller_level(problem, constants)
            smaller_level_share = float(_are_negative(problem, lower, upper, smaller).mean())
    width = min((w for w in WIDTHS if len(remaining[w]) >= FEW), default=WIDTHS[0])
    return Left(
        shares,
        width,
        _intervals(problem, remaining[width]),
        float(values.min(axis=1).max()),
        smaller_level_share,
    )


def _are_negative(
    problem: LevelSetProblem, lower: np.ndarray, upper: np.ndarray, constants: Sequence[np.ndarray]
) -> np.ndarray:
    """Whether the bound is negative on boxes, (k,)."""
    _, (bounds, *_) = enclose(problem.bound, lower, upper, constants)
    return np.asarray(bounds.min(axis=1) < 0.0)


def _at_smaller_level(
    problem: LevelSetProblem, constants: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """The constants of a smaller level; bounds of the rates of a held torque hold in it, too."""
    structure = problem.bound.structure  # type: ignore[attr-defined]
    count = structure.num_leaves
    numbers = jax.tree.unflatten(structure, constants[:count])
    level = np.asarray(SMALLER_LEVEL * numbers.level)
    return [*jax.tree.leaves(numbers._replace(level=level)), *constants[count:]]


def _intervals(problem: LevelSetProblem, points: np.ndarray) -> dict[str, tuple[float, float]]:
    """Coordinate -> interval of the middle 90 % of points."""
    if len(points) == 0:
        return {}
    # The first coordinate is the time since the start of a part, and the last one is that start.
    of_names = np.column_stack([points[:, 0] + points[:, -1], points[:, 1:-1]])
    ends = np.quantile(of_names, CENTRAL, axis=0).T
    names = ("t", *problem.names[1:-1])
    return {name: (float(a), float(b)) for name, (a, b) in zip(names, ends, strict=True)}
