"""Bounds of the rates with which a held torque and a sampled estimate become old, on the whole set.

The bound of V_w' of a sampled loop needs them (`arm_held`): they limit by how much the torque of a
sample may differ from the one that the law would command later.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from iblf_jax.core import checks
from iblf_jax.proofs.points import POINTS, increased
from iblf_jax.proofs.problem import LevelSetProblem
from iblf_jax.proofs.search import SearchResult

FACTORS = (2.0, 3.0, 6.0)
"""Bounds that are tried, in parts of the largest rates that were found; the least one with a proof
is used. Larger ones make the enclosure of a path wider, but a proof that they hold shorter."""
LOOSER = 3.0
"""Factor of the bound of the rate of f, the third one: the enclosure of f' is the widest one, and a
path hardly depends on it."""
OF_TORQUE_CUT = 0.6
"""Factor of the bound of what limits cut from the torque, the fourth one: it is 1.2 of what was
found with the least one of FACTORS."""
GROWTH = 1.2
"""Bound of V_w' before the first command, in parts of the largest one that was found."""
SHARES = (1.0, 0.7, 0.4, 0.2)
"""Roots of the shares of the level at which it is looked for: V_w' may be larger inside the set."""
MOST_GROWTH = 0.99
"""Part of the level by which V_w may grow at most before the first command."""
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
    weight: float,
    level: float,
    searched: Callable[..., SearchResult],
    max_boxes: int,
    seed: int,
) -> tuple[np.ndarray | None, SearchResult]:
    """Bounds of the rates, (k, n) [N m/s], and the search that proved them; None and the last
    search without a proof.

    Args:
      problem: the statement.
      weight, level: of it.
      searched: `search` with options of the caller.
      max_boxes: of each search.
      seed: of the points.
    """
    assert problem.held_torque is not None
    constants = problem.constants(weight, level)
    largest = found_rates(problem, constants, seed)
    largest[2] *= LOOSER
    if problem.limits_may_be_active:
        largest[3] *= OF_TORQUE_CUT
    lower, upper, scales = problem.whole_set
    for factor in FACTORS:
        limits = np.maximum(factor * largest, LEAST)
        if problem.held_torque.growth is not None:
            limits = with_growth(problem, weight, level, limits, seed)
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


def with_growth(
    problem: LevelSetProblem, weight: float, level: float, limits: np.ndarray, seed: int
) -> np.ndarray:
    """Bounds of the rates with one of V_w' before the first command of a loop with a delay.

    Args:
      problem: the statement.
      weight, level: of it.
      limits: bounds of the rates, (3, n).
      seed: of the points.
    """
    points = problem.sample(seed, POINTS)
    largest = LEAST
    for share in SHARES:
        constants = [*problem.constants(weight, share**2 * level), limits]

        def growth(some: np.ndarray, constants: list[np.ndarray] = constants) -> np.ndarray:
            return problem.growth(some, constants)

        points, values = increased(growth, problem, points, seed)
        largest = max(largest, values[0])
    delay = float(checks.given(problem.scenario.sampling).delay)
    bound = min(GROWTH * largest, MOST_GROWTH * level / delay)
    return np.concatenate([limits, np.full((1, limits.shape[1]), bound)])
