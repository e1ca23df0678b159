"""Design points: the failures nearest to the origin of standard normal coordinates, which are the
most likely ones, by gradients.

The margin of a run is the least of m pieces, one for each joint, side and
window of time, each smooth in z.  For
each piece y_j a search from the origin, and from each known failure at which y_j is the
least piece, solves

    minimise |z|^2 / 2    subject to    y_j(z) = 0

by the iteration of Hasofer, Lind, Rackwitz and Fiessler with halved steps: the full step goes to
the point of the linearised surface that is nearest to the origin,

    z_full = a (a . z - y_j) / |a|^2,      a = dy_j/dz,

and a step that does not decrease |z|^2 / 2 + c |y_j| is halved; steps grow again after one that
does.  All searches advance together, in
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
STEP_TOLERANCE = 3e-3
"""Relative step at which a search ends."""
MARGIN_TOLERANCE = 1e-2
"""Size of |y_j| in units of the median at the starts at which a point is on the surface; samples
around a point need no more."""
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


def design_points(pieces_of: PiecesOf, failures: np.ndarray) -> tuple[np.ndarray, int]:
    """The design points, nearest first, (K, d), and the number of evaluations.

    Args:
      pieces_of: pieces of the margins of points and their gradients.
      failures: known failures, (F, d); there may be none.  For each piece a search starts at the
        origin, and one at each failure for the piece that is least there.
    """
    starts = np.concatenate([np.zeros((1, failures.shape[1])), failures])
    first = pieces_of(starts)
    count = first.margins.shape[1]
    known = 1 + np.flatnonzero(np.all(np.isfinite(first.margins[1:]), axis=1))
    start = np.concatenate([np.zeros(count, int), known])
    piece = np.concatenate([np.arange(count), np.argmin(first.margins[known], axis=1)])
    search = _Search(
        starts[start], piece, first.margins[start, piece], first.gradients[start, piece]
    )
    evaluations = len(starts)
    for _ in range(ITERATIONS):
        if not np.any(search.active):
            break
        active = np.flatnonzero(search.active)
        trial = search.trial(active)
        search.accept(active, trial, pieces_of(trial))
        evaluations += len(trial)
    return distinct_points(search.z[search.on_surface]), evaluations


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
        self.tolerance = MARGIN_TOLERANCE * max(typical, np.finfo(float).tiny)
        self.on_surface = np.zeros(len(z), bool)
        """Whether the last point of each search is a failure point but for the tolerance."""
        self.active = self._has_direction()

    def _has_direction(self) -> np.ndarray:
        size = np.linalg.norm(self.gradient, axis=1)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            distance = np.abs(self.margin) / size
        return np.isfinite(self.margin) & np.isfinite(distance) & (size > 0)

    def trial(self, rows: np.ndarray) -> np.ndarray:
        """The next points of these searches, (k, d)."""
        a, z = self.gradient[rows], self.z[rows]
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            factor = (np.sum(a * z, axis=1) - self.margin[rows]) / np.sum(a * a, axis=1)
            target = factor[:, None] * a
            radius = np.linalg.norm(target, axis=1)
            target *= np.minimum(1.0, LARGEST_RADIUS / radius)[:, None]
        step = np.where(np.isfinite(target), target, z) - z
        return z + self.fraction[rows, None] * step

    def accept(self, rows: np.ndarray, trial: np.ndarray, found: Pieces) -> None:
        """Accepts trials of these searches that decrease the merit, halves the other steps.

        The merit is |z|^2 / 2 + c |y|, with c twice the least for which the step is one of descent.
        """
        own = np.arange(len(rows)), self.piece[rows]
        margin, gradient = found.margins[own], found.gradients[own]
        z = self.z[rows]
        slope = np.linalg.norm(self.gradient[rows], axis=1)
        c = 2 * np.maximum(np.linalg.norm(z, axis=1), 1.0) / slope
        before = 0.5 * np.sum(z * z, axis=1) + c * np.abs(self.margin[rows])
        after = 0.5 * np.sum(trial * trial, axis=1) + c * np.abs(margin)
        better = after < before  # False for NaN
        step = np.linalg.norm(trial - z, axis=1)
        has_stopped = step <= STEP_TOLERANCE * np.maximum(1.0, np.linalg.norm(trial, axis=1))
        taken = rows[better]
        self.z[taken] = trial[better]
        self.margin[taken] = margin[better]
        self.gradient[taken] = gradient[better]
        self.fraction[rows] *= np.where(better, 2.0, 0.5)
        self.fraction[rows] = np.minimum(1.0, self.fraction[rows])
        has_ended = has_stopped | (self.fraction[rows] < 0.5**HALVINGS)
        at_surface = np.abs(self.margin[rows]) <= self.tolerance
        self.on_surface[rows] = at_surface
        self.active[rows] = ~has_ended & self._has_direction()[rows]


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
