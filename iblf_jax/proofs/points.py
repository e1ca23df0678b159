"""Points of a level set at which a function is large: random ones, improved by random steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from iblf_jax.proofs.problem import LevelSetProblem

POINTS = 2048
"""Points of the level set at which a function is computed together."""
PARENTS = 32
"""Points from which it is increased."""
ROUNDS = 8
"""Rounds of random steps from the best points."""
SHRINKAGE = 0.6
"""Factor of the size of the random steps after each round."""


class Sampled(NamedTuple):
    """The largest V_w' that was found at a weight."""

    weight: float
    points: np.ndarray
    """The points with the largest V_w', in descending order, (PARENTS, p)."""
    rates: np.ndarray
    """V_w' there, (PARENTS,)."""

    @property
    def largest(self) -> float:
        """The largest V_w'."""
        return float(self.rates[0])


def sample_weights(
    problem: LevelSetProblem, level: float, weights: Sequence[float], seed: int
) -> list[Sampled]:
    """The largest V_w' that was found at each weight.

    The points of one weight are among the first ones of the next, because a point is one of every
    level set.
    """
    points = problem.sample(seed, POINTS)
    of_weights = []
    for weight in weights:
        constants = problem.constants(weight, level)

        def rates_of(some: np.ndarray, constants: list[np.ndarray] = constants) -> np.ndarray:
            return problem.rate(some, constants)

        best, rates = increased(rates_of, problem, points, seed)
        points = np.concatenate([best, points[: POINTS - PARENTS]])
        of_weights.append(Sampled(weight, best, rates))
    return of_weights


def increased(
    values_of: Callable[[np.ndarray], np.ndarray],
    problem: LevelSetProblem,
    points: np.ndarray,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The points with the largest values that were found, in descending order, and the values.

    Each round moves coordinates of the best points a part of the way to those of random points,
    with which times and parameters stay in their intervals.

    Args:
      values_of: points, (count, p) -> values, (count,).
      problem: of the level set.
      points: with which the search begins, (count, p).
      seed: of the random points.
    """
    best, values = _best(points, values_of(points))
    generator = np.random.default_rng(seed)
    part = 1.0
    for number in range(ROUNDS):
        part *= SHRINKAGE
        random = problem.sample(seed + 1 + number, POINTS)
        parents = np.repeat(best, POINTS // PARENTS, axis=0)
        # Some steps change only a few coordinates: the largest values are at corners of the others.
        changed = generator.uniform(size=random.shape) < 0.5
        candidates = parents + part * changed * (random - parents)
        joined = np.concatenate([best, candidates])
        best, values = _best(joined, np.concatenate([values, values_of(candidates)]))
    return best, values


def _best(points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points with the largest values."""
    order = np.argsort(-np.nan_to_num(values, nan=-np.inf), kind="stable")[:PARENTS]
    return points[order], values[order]
