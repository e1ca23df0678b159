"""Where a tuning under limits begins: at the best of some values, without derivatives, around the
start.

Under limits that bind, many gains have many valleys: in each of them other peaks are at their
  limit.  So the values of

    f + RHO |f| sum_r max(0, G_r)

are looked at, at A_GAIN points a gain, drawn within |z_i - z0_i| <= REACH, and the search starts at
the lowest.  Where it has soon arrived, a second one starts at the lowest that is at least APART, in
one coordinate, from where the first began and from where it ended; the better of the two is then
followed to the end (`optimise.Loop.take_turns`).
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.problem import Value

LEAST = 6
"""Gains from which on there may be valleys enough.  Three problems of six: one of them 4 % better,
the others as good without."""
A_GAIN = 14
"""Points a gain."""
FIRST_RADIUS = 0.5
"""Of the first step of `newton`, where there are valleys."""
REACH = 1.5
"""Ten problems of six and nine gains, six starts each, 40 values with derivatives, mean gap to the
best that is known: 6.1 % as without valleys, 3.1 % with this FIRST_RADIUS, with 128 probes too 1.8
  % (within 2: 3.4 %), with the second search 1.4 % (2.8 %)."""
APART = 0.75
RHO = 2.0
"""Price of an excess, relative to the objective; with 10 the gap was 1.6 % instead of 1.4 %, with
10,000 it was 2.0 %."""


class Probes:
    """The values of a problem around its start.

    Args:
      value: function of z (S, p) -> `Value` as arrays.
      box: start and limits.
      seed: of the draws.
      too_slow: function of z (p,) -> whether nothing can start there.
    """

    def __init__(
        self,
        value: Callable[[np.ndarray], Value],
        box: Box,
        seed: int,
        too_slow: Callable[[np.ndarray], bool],
    ):
        size = len(box.z)
        count = A_GAIN * size
        drawn = box.z + np.random.default_rng([seed, 4]).uniform(-REACH, REACH, (count - 1, size))
        points = np.concatenate([box.z[None], np.clip(drawn, box.low, box.high)])
        seen = value(points)
        excess = np.sum(np.maximum(seen.exact_excess, 0.0), axis=1)
        merit = seen.objective + RHO * np.abs(seen.objective) * excess
        fine = seen.valid & np.isfinite(merit) & (seen.margin > 0)
        # Where none is fine, the start's own comes first.
        order = np.argsort(np.where(fine, merit, np.inf), kind="stable")
        self.points, self.count, self.too_slow = points[order], count, too_slow
        self.first = jax.tree.map(lambda x: x[order[:1]], seen)
        """What the first of them gave, (1, ...)."""

    def best(self, away_from: np.ndarray) -> np.ndarray | None:
        """The best of them, (p,), that is APART from all of some points, (k, p); None if none
        is.
        """
        apart = (z for z in self.points if np.all(np.max(np.abs(away_from - z), axis=1) > APART))
        return next((z for z in apart if not self.too_slow(z)), None)
