"""Finds the points that a search begins from, by values without derivatives.

A problem whose requirements are active at the optimum has several local minima: at each of them
other peaks are at their limits.  These minima are far apart, as other gains are large at each of
them, and the better ones are not always near the scenario's gains z0.  `screen` therefore evaluates
points of a Sobol sequence: a third each within |z_i - z0_i| <= NEAR, within |z_i - z0_i| <= FAR,
and in the whole ranges with half of the coordinates at an end of theirs.  They are ranked by

    f / |f0| + w max(0, max_r G_r, -margin)

with each w of WEIGHTS, where f0 is the objective at the first valid point.  With the largest weight
feasible points come before all that are not almost feasible.  With the smallest one points of a low
objective come first that break a requirement: on some problems only they lead to the best minimum.
`distinct` takes the best points that differ from one another, from each ranking in turn, and
excludes those whose gains are too high for the sampling period and those that are good at one time
step only (`StepComparison`).

`usable_starts` serves searches without screening, whose starts are near the scenario's gains, and
searches for which `distinct` finds no point.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from iblf_jax.tuning.evaluation import Value, values
from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.problem import TuningProblem
from iblf_jax.tuning.solvers import SQP, Solver
from iblf_jax.tuning.solvers._base import EXCESS_WEIGHT, violations

NEAR = 1.0
"""Half-width of the box of the near points, in the coordinates z: a factor e for gains."""
FAR = 3.0
"""Half-width of the box of the far points: a factor 20."""
UNLIMITED = 4.6
"""Distance from the scenario's gains that takes the place of an infinite end of a range: a factor
100, as of most ranges that are not given."""
WEIGHTS = (EXCESS_WEIGHT, 20.0, 5.0, 1.0)
"""Weights of the excess in the rankings from which the starts are taken."""
MIN_DISTANCE = 1.0
"""Smallest distance of two starts in the coordinate z in which they differ most; smaller where a
range is narrow."""
MAX_SCREENED_RUNS = 50_000
"""Largest number of runs in a screening; with many runs for each point there are fewer points."""
MAX_RUNS_OF_STARTS = 128
"""Largest number of runs of all starts together, unless there are few starts."""
FEW_STARTS = 6
"""Number of starts that are never too many."""
SAME_OBJECTIVE = 0.005
"""Largest difference of two objectives, relative to one of them, that counts as none."""
STEP_FACTOR = 4.0
"""Change of the objective at a quarter of the time step, relative to the median of the first points
that are compared, above which a point does not count."""
MOST_ROUNDS = 4
"""Largest number of comparisons at a quarter of the time step in a choice of starts."""
FEW_POINTS = 32
"""Number of points that are evaluated where a search without screening needs another start."""


class Screening(NamedTuple):
    """Points that were evaluated without derivatives."""

    points: np.ndarray
    """Coordinates z, (N, p)."""
    found: Value
    """Their values."""
    objective: np.ndarray
    """f / |f0|, (N,); infinite where a run is invalid."""
    excess: np.ndarray
    """The largest excess of a requirement or bound, (N,); infinite where a run is invalid."""

    def order(self, weight: float = EXCESS_WEIGHT) -> np.ndarray:
        """Indices of the points, (N,), the best first, with a weight of the excess."""
        return np.argsort(self.objective + weight * self.excess, kind="stable")


def screen(
    problem: TuningProblem, count: int, seed: int, advance: Callable[[int], object]
) -> Screening:
    """Evaluates the scenario's gains, the first point, and `count` further points; `advance` is
    called with the number of points of each group.
    """
    points = problem.box.z[None]
    if count:
        points = np.concatenate([points, spread_points(problem.box, count, seed)])
    return ranked(points, values(problem, points, advance))


def ranked(points: np.ndarray, found: Value) -> Screening:
    """Points with their objective relative to that of the first valid point, and their excess."""
    excess = violations(found)
    usable = found.valid & np.isfinite(found.objective) & np.isfinite(excess)
    size = 1.0
    if np.any(usable):
        size = max(abs(float(found.objective[usable][0])), 1e-12)
    objective = np.where(usable, found.objective / size, np.inf)
    return Screening(points, found, objective, np.where(usable, excess, np.inf))


def spread_points(box: Box, count: int, seed: int) -> np.ndarray:
    """Points of a scrambled Sobol sequence, (count, p): a third each within NEAR of the start,
    within FAR of it, and in the whole ranges with half of their coordinates at an end.

    At the best optimum some gains are often at an end: on a problem of six gains with four of them
    at their lower ends, none of 64 starts from points inside led there.
    """
    from scipy.stats import qmc  # imported here because the import takes a second

    with warnings.catch_warnings():
        # SciPy warns of counts that are no power of 2.  They lose the balance of the sequence,
        # which the search does not need.
        warnings.simplefilter("ignore", UserWarning)
        unit = qmc.Sobol(len(box.z), seed=np.random.default_rng([seed, 4])).random(count)
    unit[2::3] = np.clip(2.0 * unit[2::3] - 0.5, 0.0, 1.0)
    reach = np.resize([NEAR, FAR, np.inf], count)[:, None]
    lowest = np.where(np.isfinite(box.low), box.low, box.z - UNLIMITED)
    highest = np.where(np.isfinite(box.high), box.high, box.z + UNLIMITED)
    low = np.maximum(lowest, box.z - reach)
    high = np.minimum(highest, box.z + reach)
    return low + unit * (high - low)


def points_at_ends(box: Box, z: np.ndarray, most: int, seed: int) -> np.ndarray:
    """Points that differ from z, (p,), in one coordinate or two, which are at an end of their
    range, (N, p); so many of them at most, which are drawn where there are more.

    The range of a coordinate ends UNLIMITED from z where it is infinite.
    """
    ends = np.stack(
        [
            np.where(np.isfinite(box.low), box.low, z - UNLIMITED),
            np.where(np.isfinite(box.high), box.high, z + UNLIMITED),
        ]
    )
    size = len(z)
    moves = list(itertools.product(range(size), range(2)))  # a coordinate and its end
    pairs = [x for x in itertools.combinations(moves, 2) if x[0][0] != x[1][0]]
    changes = [(move,) for move in moves] + pairs
    if len(changes) > most:
        drawn = np.random.default_rng([seed, 6]).choice(len(changes), most, replace=False)
        changes = [changes[i] for i in np.sort(drawn)]
    points = np.tile(z, (len(changes), 1))
    for point, change in zip(points, changes, strict=True):
        for i, end in change:
            point[i] = ends[end, i]
    return points


class StepComparison:
    """Compares the objective with that at a quarter of the time step.

    Gains may be good at the time step of the runs only: it stabilises a motion that runs away at a
    shorter one, or it passes a bound between two instants.  (At half of it many such gains are
    still good.)  The objective of a point may change by SAME_OBJECTIVE, or by STEP_FACTOR times the
    median change of the first points that are compared where that is larger: an objective with
    noise or with the rate of a held torque depends on the step itself.

    Args:
      at_quarter_step: function of points z, (N, p), that returns their objective at a quarter of
        the time step, (N,), as `objective_at_quarter_step`.
    """

    def __init__(self, at_quarter_step: Callable[[np.ndarray], np.ndarray]):
        self.at_quarter_step = at_quarter_step
        self.largest_change = np.nan
        """Largest relative change of the objective of a point that counts; NaN before the first
        comparison."""
        self.points = 0
        """Number of points that were compared."""
        self.unresolved = 0
        """Number of them that do not count."""

    def __call__(self, z: np.ndarray, objective: np.ndarray) -> np.ndarray:
        """Whether points, (N, p), with these objectives, (N,), count, (N,)."""
        if not len(z):
            return np.ones(0, bool)
        fine = self.at_quarter_step(z)
        with np.errstate(invalid="ignore"):  # runs may be invalid at both steps
            change = np.abs(fine - objective) / np.maximum(1e-3, np.abs(objective))
        change[~np.isfinite(change)] = np.inf
        if np.isnan(self.largest_change):
            typical = STEP_FACTOR * float(np.median(change))
            self.largest_change = max(SAME_OBJECTIVE, typical)
        resolved = change <= self.largest_change
        self.points += len(z)
        self.unresolved += int(np.sum(~resolved))
        return resolved


def distinct(
    screening: Screening,
    orders: Sequence[np.ndarray],
    count: int,
    box: Box,
    is_refused: Callable[[np.ndarray], bool],
    are_resolved: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    others: np.ndarray | None = None,
) -> np.ndarray:
    """The first points of some orders that differ from one another and are not refused, (m, p)
    with m at most `count`: one of each order in turn.

    Args:
      screening: the points.
      orders: their indices, the best first.
      count: largest number of points.
      box: the ranges.
      is_refused: function of z, (p,), that returns whether no search can begin there.  It takes
        long, so that no more points are tested than are needed.
      are_resolved: function of points, (k, p), and their objectives, (k,), that returns which of
        them count, (k,).  Those that do not are replaced by the next best ones, in MOST_ROUNDS
        rounds, as many points take as long as one.
      others: further points that the result must differ from, (k, p).
    """
    points = screening.points
    remaining = np.isfinite(screening.excess)
    for other in [] if others is None else others:
        remaining &= ~is_near(points, other, box)
    chosen: list[int] = []
    turns = itertools.cycle(orders)
    for _ in range(MOST_ROUNDS):
        new: list[int] = []
        while len(chosen) + len(new) < count and np.any(remaining):
            order = next(turns)
            i = order[np.argmax(remaining[order])]  # the first one that remains
            remaining[i] = False
            if not is_refused(points[i]):
                new.append(i)
                remaining &= ~is_near(points, points[i], box)
        resolved = np.ones(len(new), bool)
        if are_resolved is not None:
            resolved = are_resolved(points[new], screening.found.objective[new])
        chosen += list(itertools.compress(new, resolved))
    return points[chosen]


def is_near(points: np.ndarray, z: np.ndarray, box: Box) -> np.ndarray:
    """Whether points, (N, p), are too near to z, (p,), for two starts of one search, (N,)."""
    distance = np.minimum(MIN_DISTANCE, 0.25 * (box.high - box.low))
    return np.all(np.abs(points - z) < distance, axis=1)


def number_of_starts(starts: int, runs: int, solver: Solver) -> int:
    """The number of starts of a search, at most that of its effort.

    With many runs for each start, and with other solvers than `SQP`, which need more evaluations,
    there are fewer: a fifth, but at least FEW_STARTS.

    Args:
      starts: number of starts of the effort.
      runs: number of runs of each start.
      solver: the solver.
    """
    few = max(FEW_STARTS, starts // 5)
    if isinstance(solver, SQP):
        few = max(few, MAX_RUNS_OF_STARTS // runs)
    return min(starts, few)


def starting_points(box: Box, starts: int, seed: int) -> np.ndarray:
    """The scenario's point and `starts - 1` drawn around it, inside the box, (S, p)."""
    rng = np.random.default_rng([seed, 1])
    drawn = box.z + rng.uniform(-NEAR, NEAR, (starts - 1, len(box.z)))
    return np.concatenate([box.z[None], np.clip(drawn, box.low, box.high)])


def usable_starts(problem: TuningProblem, seed: int, z: np.ndarray, first: Value) -> np.ndarray:
    """Starting points at which gradients are of use, (S, p).

    Where the first of the points z leaves its bounds or is sampled too slowly, the motion is
    chaotic and its gradient is of no use.  In these cases, and where that point cannot be
    integrated, FEW_POINTS points of the box are evaluated.  The starts are then the valid and
    stable points that violate requirements and bounds least; unstable and invalid points are used
    only if there are not enough of them.  Otherwise the starts are the points z.

    Args:
      problem: what is tuned.
      seed: of the random points.
      z: the starting points, (S, p).
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
        # The generator tests only as many points as are needed, because a test takes long.
        stable = (i for i in group if not problem.sampled_too_slowly(screening.points[i]))
        needed = max(len(z) - len(chosen), 0)
        preferred = list(itertools.islice(stable, needed))
        chosen += preferred
        chosen += [i for i in group if i not in preferred]
    return screening.points[chosen[: len(z)]]


def screened(problem: TuningProblem, seed: int, z: np.ndarray) -> Screening:
    """The points z, (S, p), and FEW_POINTS random points of the box, with their values.

    Raises:
      ValueError: no point can be integrated; the message names a step that is small enough.
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
