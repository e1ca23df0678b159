"""The search for the worst case among bounded perturbations, of `ij.falsify` and of
`ij.certificates.counterexample`.

A solver minimises a loss over the unit cube of the perturbations (`perturbation_cube`) from random
admissible points; of all points that were evaluated the best one is the result.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from iblf_jax.studies.perturbation_cube import Cube


class Losses(NamedTuple):
    """A loss at S points."""

    values: np.ndarray
    """(S,); infinite where nothing can be said."""
    gradients: np.ndarray
    """By u, (S, d)."""
    status: np.ndarray
    """Flags of each point, (S,)."""


class Worst(NamedTuple):
    """The point with the least loss."""

    u: np.ndarray
    """(d,)."""
    loss: float
    status: int


class WorstCaseSearch:
    """The problem that a solver gets: it evaluates points and keeps the best one.

    Args:
      cube: of the perturbations.
      evaluate: function of points u, (S, d).
      starts: number S of starting points.
      seed: of the starting points.
      excluded: why a starting point with an infinite loss is rejected; "" to accept it without an
        evaluation.
    """

    def __init__(
        self,
        cube: Cube,
        evaluate: Callable[[np.ndarray], Losses],
        starts: int,
        seed: tuple[int, ...],
        excluded: str = "",
    ) -> None:
        self.cube = cube
        self.evaluate = evaluate
        self.starts = starts
        self.seed = seed
        self.excluded = excluded
        self.worst: Worst | None = None
        self.history: list[np.ndarray] = []
        """Losses of every evaluation, (S,) each."""

    def __call__(self, u: np.ndarray) -> Losses:
        """The losses at points, (S, d)."""
        found = self.evaluate(u)
        self.history.append(found.values)
        s = int(np.argmin(found.values))
        least = np.inf if self.worst is None else self.worst.loss
        if found.values[s] < least:
            self.worst = Worst(u[s].copy(), float(found.values[s]), int(found.status[s]))
        return found

    def points(self, *further: int) -> np.ndarray:
        """Random admissible points, (S, d), from the seed and further numbers."""
        return self.cube.admissible_points(self.starts, [*self.seed, *further], self.why_unusable)

    def why_unusable(self, u: np.ndarray) -> str:
        """Why a point, (d,), is no starting point; "" for one that is."""
        why = self.cube.why_inadmissible(u)
        if why or not self.excluded or np.isfinite(self(u[None]).values[0]):
            return why
        return self.excluded


def search(
    problem: WorstCaseSearch, solver: Callable[[WorstCaseSearch], None], remedy: str = ""
) -> Worst:
    """The best point that a solver finds.

    Args:
      problem: what is minimised.
      solver: evaluates points of the problem, from `problem.points()` on.
      remedy: of the error if all losses were infinite.

    Raises:
      ValueError: no admissible point was found.
    """
    solver(problem)
    if problem.worst is None:
        raise problem.cube.no_admissible_point(remedy)
    return problem.worst
