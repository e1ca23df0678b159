"""Gauss-Newton steps inside limits: what regression and replay share.

Around z the sum of squares is f + g.s + s.A.s/2.  The step minimises that with mu s.D.s/2 added (D:
the scales of the numbers), within the limits; mu falls after a step that was good and rises after
one that was not (Levenberg and Marquardt).  A number at a limit stays there while the slope pushes
it outwards.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

FIRST, GROWTH, MOST = 1e-3, 6.0, 1e9
"""mu, its factor, and where the search gives up."""
SMALL, PART = 1e-2, 1e-9
"""What a step must promise to lower f by, and as a part of f: what ends the search is a seventh of
a standard error, and converges as Newton's method does."""
WEAK = 30.0
"""In scales: how far from its start a number is held back with the force of one standard deviation;
keeps what cannot be told in place."""


class Around(NamedTuple):
    """A point of the search."""

    cost: float
    """f."""
    slope: np.ndarray
    matrix: np.ndarray
    carried: Any = None
    """What else the point holds."""


def inside(A: np.ndarray, g: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The s of min g.s + s.A.s/2 with low <= s <= high, by holding one number after another at its
    limit.
    """
    s, held = np.zeros(len(g)), np.zeros(len(g), bool)
    for _ in range(len(g) + 1):
        free = ~held
        if not free.any():
            break
        s[free] = np.linalg.lstsq(
            A[np.ix_(free, free)], -g[free] - A[np.ix_(free, held)] @ s[held], rcond=1e-15
        )[0]
        beyond = np.where(free, np.maximum(low - s, s - high), -np.inf)
        worst = int(np.argmax(beyond))
        if not beyond[worst] > 0:
            break
        held[worst], s[worst] = True, np.clip(s[worst], low[worst], high[worst])
    return np.clip(s, low, high)


def search(
    here: Around,
    z: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    scale: np.ndarray,
    attempt: Callable,
    full: Callable,
    most: int,
) -> tuple[np.ndarray, Around, int]:
    """The end of the search.

    Args:
      here: at z.
      z: start, (p,).
      limits: low and high of z.
      scale: of z, (p,).
      attempt: function (Around, z, step) -> cost there, and what it holds; infinite where it cannot
        be.
      full: function (z, held) -> Around.
      most: steps.

    Returns:
      z, what is around it, and the number of steps.
    """
    mu, steps = FIRST, 0
    while steps < most and mu < MOST and len(z):
        steps += 1
        S = scale[:, None] * here.matrix * scale
        size = np.diag(S).max(initial=1e-300)
        s = scale * inside(
            S + mu * np.diag(np.diag(S) + 1e-9 * size),
            scale * here.slope,
            (limits[0] - z) / scale,
            (limits[1] - z) / scale,
        )
        foretold = -(here.slope @ s + 0.5 * s @ here.matrix @ s)
        if foretold <= SMALL + PART * here.cost:
            break
        cost, held = attempt(here, z, s)
        if np.isfinite(cost) and cost < here.cost:
            good = (here.cost - cost) / foretold
            z = z + s
            here = full(z, held)
            mu = mu / GROWTH if good > 0.5 else mu
        else:
            mu *= GROWTH
    return z, here, steps
