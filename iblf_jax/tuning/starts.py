"""Finds the points that searches begin from, by values without derivatives.

With requirements that are active at the optimum, a problem has several local minima: at each of
them other peaks are at their limits.  They are far apart (other gains are the large ones) and the
better ones are not always near the scenario's gains.  So `screen` evaluates points of a Sobol
sequence, a third of them within |z_i - z0_i| <= NEAR and two thirds within FAR of it, and ranks
them by

    f / |f0| + EXCESS_WEIGHT (max_r max(0, G_r) + max(0, -margin)),

with which points that keep the requirements come first.  `distinct` takes the best of them that
differ from one another.

Twenty random starts on two problems of nine gains (three links, torque and margin limited), six
searches each: 45 % ended within 0.5 % of the best known objective; with two thirds of the points
near, 30 %.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from iblf_jax.tuning.evaluation import Value, values
from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.problem import TuningProblem

NEAR = 1.0
"""Half-width of the box of the near points, in the coordinates z: a factor e for gains."""
FAR = 3.0
"""Half-width of the box of the far points: a factor 20."""
MIN_DISTANCE = 1.0
"""Between two starts, in at least one coordinate z; less where a range is narrow."""
EXCESS_WEIGHT = 200.0
"""Of the excess.  With 5 instead, six of eight searches of a problem of nine gains began and stayed
where the requirements cannot be kept."""
MAX_SCREENED_RUNS = 50_000
"""Runs that are spent on points without derivatives."""
FEW_POINTS = 32
"""Points that replace a start that leaves its bounds, where no others are evaluated."""


class Screening(NamedTuple):
    """Points that were evaluated without derivatives."""

    points: np.ndarray
    """(N, p); the scenario's gains first."""
    found: Value
    merit: np.ndarray
    """(N,); infinite where a run is invalid."""
    excess: np.ndarray
    """The largest excess of a requirement or bound, (N,)."""


def largest_excess(found: Value) -> np.ndarray:
    """By how much each point violates requirements (in their scales) and bounds [rad], (N,)."""
    excess = np.max(np.maximum(found.exact_excess, 0.0), axis=1, initial=0.0)
    return np.maximum(excess, np.maximum(-found.margin, 0.0))


def screen(problem: TuningProblem, count: int, seed: int) -> Screening:
    """Evaluates the scenario's gains and `count` further points."""
    drawn = problem.box.z[None]
    if count:
        drawn = np.concatenate([drawn, spread_points(problem.box, count, seed)])
    return ranked(drawn, values(problem, drawn))


def ranked(points: np.ndarray, found: Value) -> Screening:
    """Points with their merit, relative to the first of them that is valid."""
    excess = largest_excess(found)
    usable = found.valid & np.isfinite(found.objective) & np.isfinite(excess)
    size = 1.0
    if np.any(usable):
        size = max(abs(float(found.objective[usable][0])), 1e-12)
    with np.errstate(invalid="ignore"):
        merit = np.where(usable, found.objective / size + EXCESS_WEIGHT * excess, np.inf)
    return Screening(points, found, merit, np.where(usable, excess, np.inf))


def spread_points(box: Box, count: int, seed: int) -> np.ndarray:
    """Points of a scrambled Sobol sequence around the start, (count, p): a third near it."""
    from scipy.stats import qmc  # a second to import

    with warnings.catch_warnings():  # a number of points that is no power of 2 loses no quality
        warnings.simplefilter("ignore", UserWarning)
        unit = qmc.Sobol(len(box.z), seed=np.random.default_rng([seed, 4])).random(count)
    near = np.arange(count) % 3 == 0
    reach = np.where(near, NEAR, FAR)[:, None]
    low = np.maximum(box.low, box.z - reach)
    high = np.minimum(box.high, box.z + reach)
    return low + unit * (high - low)


def distinct(
    screening: Screening,
    order: np.ndarray,
    count: int,
    box: Box,
    is_refused: Callable[[np.ndarray], bool],
    others: np.ndarray | None = None,
) -> np.ndarray:
    """The first points of an order that differ from one another, (at most `count`, p).

    Args:
      screening: the points.
      order: their indices, the best first.
      count: how many at most.
      box: the ranges.
      is_refused: function of z (p,) -> whether no search can begin there; it takes long, so no
        more points are tested than are needed.
      others: from which they must differ too, (k, p).
    """
    distance = np.minimum(MIN_DISTANCE, 0.25 * (box.high - box.low))
    chosen: list[np.ndarray] = []
    taken = list(np.zeros((0, len(box.z))) if others is None else others)
    for i in order[np.isfinite(screening.merit[order])].tolist():
        z = screening.points[i]
        is_apart = all(np.any(np.abs(z - other) >= distance) for other in [*taken, *chosen])
        if is_apart and not is_refused(z):
            chosen.append(z)
        if len(chosen) == count:
            break
    return np.array(chosen).reshape(-1, len(box.z))


def starting_points(box: Box, starts: int, seed: int) -> np.ndarray:
    """The scenario's point and `starts - 1` drawn around it, inside the box, (S, p)."""
    rng = np.random.default_rng([seed, 1])
    drawn = box.z + rng.uniform(-NEAR, NEAR, (starts - 1, len(box.z)))
    return np.concatenate([box.z[None], np.clip(drawn, box.low, box.high)])


def usable_starts(problem: TuningProblem, seed: int, z: np.ndarray, first: Value) -> np.ndarray:
    """The starting points z, (S, p), or better ones where the first of them leaves its bounds,
    cannot be integrated or is sampled too slowly.

    Beyond a bound the motion is chaotic, as it is where it grows from sample to sample, and its
    gradient is of no use.  So FEW_POINTS of the box are evaluated, and the starts are those that
    are stable and violate requirements and bounds least.

    Args:
      problem: what is tuned.
      seed: of the draws.
      z: (S, p).
      first: values at the first of them, (1, ...).

    Raises:
      ValueError: as `screened`.
    """
    if first.valid[0] and first.margin[0] > 0 and not problem.sampled_too_slowly(z[0]):
        return z
    screening = screened(problem, seed, z)
    found = screening.found
    order = np.lexsort((found.objective, screening.excess))
    chosen: list[int] = []
    for group in (order[found.valid[order]], order[~found.valid[order]]):
        stable = (i for i in group if not problem.sampled_too_slowly(screening.points[i]))
        # A test takes long, so no more are tested than are needed.
        first_ones = list(itertools.islice(stable, max(len(z) - len(chosen), 0)))
        chosen += [*first_ones, *(i for i in group if i not in first_ones)]
    return screening.points[chosen[: len(z)]]


def screened(problem: TuningProblem, seed: int, z: np.ndarray) -> Screening:
    """The points z, (S, p), and FEW_POINTS of the box with their values.

    Raises:
      ValueError: none of them can be integrated; the message names a step that is small enough.
    """
    box = problem.box
    rng = np.random.default_rng([seed, 2])
    low = np.where(np.isfinite(box.low), box.low, box.z - FAR)
    high = np.where(np.isfinite(box.high), box.high, box.z + FAR)
    points = np.concatenate([z, rng.uniform(low, high, (FEW_POINTS, len(low)))])
    screening = ranked(points, values(problem, points))
    check_any_valid(problem, screening)
    return screening


def check_any_valid(problem: TuningProblem, screening: Screening) -> None:
    """Raises ValueError where no point can be integrated."""
    if not np.any(screening.found.valid):
        raise problem.unstable_error(float(np.max(screening.found.trusted)))
