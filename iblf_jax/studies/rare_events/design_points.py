"""Design points: the failures nearest to the origin of standard normal coordinates, which are the
most likely ones, by gradients.

The margin of a run is the least of m pieces, one for each joint and side, each smooth in z.  For
each piece y_j one search from each start solves

    minimise |z|^2 / 2    subject to    y_j(z) = 0

by the iteration of Hasofer, Lind, Rackwitz and Fiessler with halved steps: the full step goes to
the point of the linearised surface that is nearest to the origin,

    z_full = a (a . z - y_j) / |a|^2,      a = dy_j/dz,

and a step that does not decrease |z|^2 / 2 + c |y_j| is halved.  All searches advance together, in
one batch of runs with derivatives.

Source: Y. Zhang, A. Der Kiureghian, Proc. 6th IFIP WG 7.5 (1995) 297-305 (the improved iteration).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

ITERATIONS = 24
"""Steps of each search at most."""
HALVINGS = 6
"""How often a step is halved before its search ends."""
LARGEST_RADIUS = 12.0
"""Distance beyond which no design point is searched: the probability is below 1e-32 there."""
TOLERANCE = 1e-3
"""Size of |y_j| in units of its value at the origin, and relative step, at which a search has
converged."""
SAME_POINT = 0.5
"""Distance below which two design points count as one."""
FARTHEST = 2.0
"""Distance beyond that of the nearest design point up to which further ones are kept; at beta = 4
one that is farther by 2 has a share of 2e-5 of the probability."""


class Pieces(NamedTuple):
    """The pieces of the margin at S points."""

    margins: np.ndarray
    """(S, m)."""
    gradients: np.ndarray
    """(S, m, d)."""


PiecesOf = Callable[[np.ndarray], Pieces]
"""Points z, (S, d) -> the pieces of their margins; NaN for points that cannot be run."""


def design_points(pieces_of: PiecesOf, starts: np.ndarray) -> tuple[np.ndarray, int]:
    """The design points, nearest first, (K, d), and the number of evaluations.

    Args:
      pieces_of: pieces of the margins of points and their gradients.
      starts: (S, d); each is the start of one search for each piece.
    """
    first = pieces_of(starts)
    count = first.margins.shape[1]
    z = np.repeat(starts, count, axis=0)
    piece = np.tile(np.arange(count), len(starts))
    search = _Search(z, piece, first.margins.reshape(-1), _flat(first.gradients))
    evaluations = len(starts)
    for _ in range(ITERATIONS):
        if not np.any(search.active):
            break
        trial = search.trial()
        found = pieces_of(trial)
        search.accept(trial, found)
        evaluations += len(trial)
    return distinct_points(search.z[search.converged]), evaluations


def _flat(gradients: np.ndarray) -> np.ndarray:
    return gradients.reshape(-1, gradients.shape[-1])


class _Search:
    """The state of all searches, one row each."""

    def __init__(
        self, z: np.ndarray, piece: np.ndarray, margins: np.ndarray, gradients: np.ndarray
    ):
        self.z = z
        self.piece = piece
        self.margin = margins
        self.gradient = gradients
        self.fraction = np.ones(len(z))
        """Of the full step, which the next trial takes."""
        sizes = np.abs(margins)
        typical = np.median(sizes[np.isfinite(sizes)]) if np.any(np.isfinite(sizes)) else 1.0
        self.tolerance = TOLERANCE * max(typical, np.finfo(float).tiny)
        self.converged = np.zeros(len(z), bool)
        self.active = self._has_direction()

    def _has_direction(self) -> np.ndarray:
        size = np.linalg.norm(self.gradient, axis=1)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            distance = np.abs(self.margin) / size
        return np.isfinite(self.margin) & np.isfinite(distance) & (size > 0)

    def _full_step(self) -> np.ndarray:
        a = self.gradient
        length = np.sum(a * a, axis=1)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            factor = (np.sum(a * self.z, axis=1) - self.margin) / length
            target = factor[:, None] * a
            radius = np.linalg.norm(target, axis=1)
            target *= np.minimum(1.0, LARGEST_RADIUS / radius)[:, None]
        return np.where(np.isfinite(target), target, self.z) - self.z

    def trial(self) -> np.ndarray:
        """The next points, (S, d); those of searches that have ended are where they ended."""
        step = self.fraction[:, None] * self._full_step()
        return np.where(self.active[:, None], self.z + step, self.z)

    def _merit(self, z: np.ndarray, margin: np.ndarray) -> np.ndarray:
        """|z|^2 / 2 + c |y|, with c twice the least for which the step is one of descent."""
        size = np.linalg.norm(self.gradient, axis=1)
        reach = np.maximum(np.linalg.norm(self.z, axis=1), 1.0)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            return 0.5 * np.sum(z * z, axis=1) + 2 * reach / size * np.abs(margin)

    def accept(self, trial: np.ndarray, found: Pieces) -> None:
        """Accepts trials that decrease the merit, halves the other steps."""
        rows = np.arange(len(trial))
        margin = found.margins[rows, self.piece]
        gradient = found.gradients[rows, self.piece]
        better = self.active & (self._merit(trial, margin) < self._merit(self.z, self.margin))
        step = np.linalg.norm(trial - self.z, axis=1)
        moved_little = step <= TOLERANCE * np.maximum(1.0, np.linalg.norm(trial, axis=1))
        at_surface = np.abs(np.where(better, margin, self.margin)) <= self.tolerance
        self.z = np.where(better[:, None], trial, self.z)
        self.gradient = np.where(better[:, None], gradient, self.gradient)
        self.margin = np.where(better, margin, self.margin)
        self.fraction = np.where(better, 1.0, 0.5 * self.fraction)
        has_ended = (moved_little & better) | (self.fraction < 0.5**HALVINGS) | moved_little
        self.converged |= self.active & has_ended & at_surface
        self.active &= ~has_ended & self._has_direction()


def distinct_points(points: np.ndarray) -> np.ndarray:
    """The points that differ, nearest first, without those that are much farther than the first."""
    radius = np.linalg.norm(points, axis=1)
    kept: list[np.ndarray] = []
    for i in np.argsort(radius, kind="stable"):
        if radius[i] > np.min(radius) + FARTHEST:
            break
        if all(np.linalg.norm(points[i] - other) > SAME_POINT for other in kept):
            kept.append(points[i])
    return np.array(kept).reshape(-1, points.shape[1])
