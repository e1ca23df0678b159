"""Bounds of the rates with which a held torque and a sampled estimate become old, on the whole set.

The bound of V_w' of a sampled loop needs them (`arm_held`): they limit by how much the torque of a
sample may differ from the one that the law would command later.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from iblf_jax.proofs.points import POINTS, increased
from iblf_jax.proofs.problem import LevelSetProblem
from iblf_jax.proofs.search import SearchResult

FACTORS = (2.0, 3.0, 6.0)
"""Bounds that are tried, in parts of the largest rates that were found; the least one with a proof
is used. Larger ones make the enclosure of a path wider, but a proof that they hold shorter."""
LOOSER = 3.0
"""Factor of the bound of the rate of f, the third one: the enclosure of f' is the widest one, and a
path hardly depends on it."""
LEAST = 1e-9
"""The least of these bounds [N m/s] or [N m]: a number that is 0 on the set is below it."""
BOXES = 5_000_000
"""Boxes of the search with one of them."""


def found_rates(problem: LevelSetProblem, constants: Sequence[np.ndarray], seed: int) -> np.ndarray:
    """The largest rates that were found at points of V_w = level, (k, n) [N m/s]."""
    points = problem.sample(seed, POINTS)
    largest = np.abs(problem.held_rates(points, constants)).max(axis=0)
    for place in np.ndindex(largest.shape):

        def size(some: np.ndarray, place: tuple[int, ...] = place) -> np.ndarray:
            return np.abs(problem.held_rates(some, constants)[(slice(None), *place)])

        largest[place] = increased(size, problem, points, seed)[1][0]
    return largest


def proved_rates(
    problem: LevelSetProblem,
    constants: Sequence[np.ndarray],
    searched: Callable[..., SearchResult],
    max_boxes: int,
    seed: int,
) -> tuple[np.ndarray | None, SearchResult]:
    """Bounds of the rates, (k, n) [N m/s], and the search that proved them; None and the last
    search without a proof.

    Args:
      problem: the statement.
      constants: of its weight and level.
      searched: `search` with options of the caller.
      max_boxes: of each search.
      seed: of the points.
    """
    assert problem.held_torque is not None
    largest = found_rates(problem, constants, seed)
    largest[2] *= LOOSER
    lower, upper, scales = problem.whole_set
    for factor in FACTORS:
        limits = np.maximum(factor * largest, LEAST)
        result = searched(
            problem.held_torque.excess,
            lower,
            upper,
            [*constants, limits],
            scales=scales,
            max_boxes=min(BOXES, max_boxes),
        )
        if result.proved:
            return limits, result
    return None, result
