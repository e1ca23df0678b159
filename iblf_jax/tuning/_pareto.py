"""`pareto`: the front of two objectives, for example tracking and effort: first its ends, then
points in its largest gaps.

With A = log risk_b[a_b], B = log risk_b[b_b], an end minimises one of them only,

    minimise A,      and then     minimise B   subject to   A <= A_end + END_TOLERANCE,

so that the end does not have a large B for an A that hardly depends on it; the other end likewise.
Searches for the ends begin at the scenario's gains and at the best of some points that are spread
over the ranges, as a single objective often has several minima.  Of two neighbours on the front
with the largest gap |A_1 - A_2| or |B_1 - B_2|, the objective with the gap gets a level in its
middle, and the other one is minimised,

    minimise B   subject to   A <= (A_1 + A_2) / 2,

by `solvers.sqp`, from the middle of their coordinates z, several gaps in one batch; requirements
hold throughout.  A gap that this does not fill is a gap of the front.  The gains on the front are a
smooth curve in z nearly everywhere: points on the straight lines between neighbours are on the
front up to the fourth power of the distance, so their values are computed, without derivatives.
Every trial that satisfies bounds and requirements is a candidate: the front is the set of
candidates that are not dominated.

Source: Y. Y. Haimes, L. S. Lasdon, D. A. Wismer, IEEE Trans. Syst. Man Cybern. 1 (1971) 296-297
(levels).
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.presentation import Content, Result, present
from iblf_jax.core.progress import announced, bar
from iblf_jax.engine import MAX_FORWARD_NUMBERS, differentiates_forward, takes_runs
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.designs import MAX_RUNS
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.tuning.evaluation import Evaluator, Value, values
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.parameters import Block, Tunable, in_units, names_of, values_at
from iblf_jax.tuning.problem import NO_LEVEL, TuningProblem
from iblf_jax.tuning.robust import Risk
from iblf_jax.tuning.runs import NUMBERS_A_RUN
from iblf_jax.tuning.search import Search
from iblf_jax.tuning.solvers import SQP
from iblf_jax.tuning.starts import screened

if TYPE_CHECKING:
    from tqdm import tqdm

END_TOLERANCE = 1e-3
"""By how much an end may be above the least value of its objective, relative to it."""
GAP_TOLERANCE = 0.05
"""Neighbours whose objectives differ by less, relatively, have no gap between them."""
MAX_BATCH = 8
"""Number of points that are searched for in one batch at most."""
POINTS_BETWEEN = 8
"""Number of values on the lines between neighbours, for each point."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ParetoFront(Result):
    """Gains of which none is dominated by another in both objectives, from low a to low b."""

    labels: tuple[str, str]
    objectives: np.ndarray
    """(a, b) of each point, (P, 2), over the runs as the risk says; relative to the start's unless
    they have scales of their own."""
    x: np.ndarray
    """Gains of each point, (P, p), in their units."""
    names: tuple[str, ...]
    tried: np.ndarray
    """(a, b) of every valid trial, (N, 2)."""
    first: np.ndarray
    """(a, b) at the start, (2,)."""
    start: Scenario
    blocks: tuple[Block, ...]
    z: np.ndarray
    seconds: float
    evaluations: int = 0
    """Number of evaluations with derivatives, each of as many rollouts as there are runs."""
    values: int = 0
    """Number of evaluations without derivatives."""

    def __len__(self) -> int:
        return len(self.x)

    def scenario(self, index: int) -> Scenario:
        """The scenario with the gains of one point.

        Args:
          index: its number, in the order of `objectives`.

        Raises:
          ValueError: no such point (an IndexError too).
        """
        z = self.z[checks.entry("index", index, len(self), "points")]
        return with_parameters(self.start, values_at(self.blocks, jnp.asarray(z)))

    def plot(self, **options):
        """Figure of the front.  Options as `plotting.pareto`."""
        return present("front figure", self, **options)

    def _content(self) -> Content:
        pairs = zip(self.labels, self.objectives.T, strict=True)
        ends = ", ".join(f"{name} {x.min():.4g} to {x.max():.4g}" for name, x in pairs)
        return [f"ParetoFront({len(self)} points of {len(self.tried)} trials; {ends})"]


def non_dominated(points: np.ndarray) -> np.ndarray:
    """Indices of the points (N, 2) that no other one dominates, by increasing first coordinate."""
    order = np.lexsort((points[:, 1], points[:, 0]))
    best = np.minimum.accumulate(np.concatenate([[np.inf], points[order, 1][:-1]]))
    return order[points[order, 1] < best]


@notices.each_warning_once
@announced("compiling the programs of a search for a Pareto front")
@takes_runs
def pareto(
    scenario: Scenario,
    parameters: Sequence[str | Tunable],
    objectives: tuple[Objective, Objective],
    *,
    duration: float,
    dt: float = 1e-3,
    points: int = 8,
    iterations: int = 20,
    perturbations: Mapping[str, Perturbation] | None = None,
    runs: int = 1,
    seed: int = 0,
    risk: str | Risk = "mean",
    method: str = "rk4",
    backend: str = "auto",
    tolerance: float = 1e-5,
    progress: bool | None = None,
) -> ParetoFront:
    """The front of two objectives over some leaves of a scenario.

        an end:            minimise a                        or  minimise b
        a point between:   minimise b subject to a <= level  or  minimise a subject to b <= level

    Args:
      scenario, parameters, duration, dt, perturbations, runs, seed, risk, method, backend: as
        `tune`.
      objectives: two of `iblf_jax.objectives`, of one term each that has no limit; requirements of
        either hold for all points.
      points: number of points that are optimised, the two ends among them; every other trial that
        is not dominated is on the front too.
      iterations: steps for each at most; an end may take three times as many.
      tolerance: relative change of the loss below which a point has converged.
      progress: whether to show a progress bar; on a terminal or in a notebook, if not given.
      runs_as: an `ij.Runs`, in place of its fields.

    Returns:
      A `ParetoFront`.

    Raises:
      ValueError: not two objectives of one term, or as `tune`.

    Source: head of this module.
    """
    began = time.perf_counter()
    points = checks.positive_integer("points", points, least=2, most=MAX_RUNS)
    iterations = checks.positive_integer("iterations", iterations, most=checks.MAX_STEPS)
    tolerance = checks.number_between("tolerance", tolerance, 0.0, 1.0, "1")
    problem = TuningProblem.build(
        scenario,
        parameters,
        _pair(objectives),
        duration=duration,
        dt=dt,
        method=method,
        backend=backend,
        perturbations=perturbations,
        runs=runs,
        seed=seed,
        risk=risk,
        on_front=True,
    )
    if not differentiates_forward(problem.size):
        came = f"{problem.size} numbers"
        expected = f"at most {MAX_FORWARD_NUMBERS} for a front"
        raise checks.fail("parameters", came, expected, "Tie or leave out some.")
    checks.fits_memory("points", points, 8.0 * POINTS_BETWEEN * problem.runs * NUMBERS_A_RUN)
    search = FrontSearch(problem, min(points, MAX_BATCH), iterations, tolerance)
    with bar(progress, points, unit="points") as shown:
        search.run(points, seed, shown)
    return search.front(time.perf_counter() - began)


class Gap(NamedTuple):
    """A gap between two neighbours on the front, and the search that may fill it."""

    size: float
    z: np.ndarray
    """Where the search begins, (p,)."""
    objective: int
    """Which objective is minimised, 0 or 1."""
    level: float
    """Of the logarithm of the other."""


class FrontSearch:
    """The trials of a front so far, and the searches that make more of them.

    Args:
      problem: with two terms, on a front.
      batch: number of searches in a batch; always the same, so that all batches are of one compiled
        shape.
      iterations, tolerance: of a search.
    """

    def __init__(self, problem: TuningProblem, batch: int, iterations: int, tolerance: float):
        self.problem = problem
        self.batch = batch
        self.iterations = iterations
        self.solver = SQP(tolerance, sharpenings=0, patience=iterations, radius=1.0)
        self.z = np.zeros((0, len(problem.box.z)))
        """Of each trial that satisfies its bounds and requirements."""
        self.terms = np.zeros((0, 2))
        self.nodes: list[int] = []
        """The trials that are ends, or best under a level."""
        self.levels: list[tuple[int, float]] = []
        """Which objective has been under which level."""
        self.evaluations = 0
        self.values = 0

    def run(self, points: int, seed: int, shown: tqdm) -> None:
        """The ends, points in the largest gaps, and values on the lines between them."""
        self.ends(seed)
        shown.update(2)
        while len(self.nodes) < points:
            gaps = self.largest_gaps(points - len(self.nodes))
            if not gaps:
                break
            self.minimise(
                np.stack([gap.z for gap in gaps]),
                np.array([gap.objective for gap in gaps]),
                np.array([gap.level for gap in gaps]),
            )
            shown.update(len(gaps))
        self.fill(POINTS_BETWEEN * points)

    def ends(self, seed: int) -> None:
        """Both ends: each objective alone, and then the other one at nearly no cost to it.

        The first searches begin at the scenario's gains, and at the best of some points that are
        spread over their ranges.
        """
        screening = screened(self.problem, seed, self.problem.box.z[None])
        points, found, violation = screening.points, screening.found, screening.excess
        self.first = found.terms[0]
        self._keep_values(points, found)
        best = [_best_of(found, violation, k) for k in (0, 1)]
        self._search(points[[0, 0, *best]], np.array([0, 1, 0, 1]), np.full((4, 2), NO_LEVEL))
        if not len(self.z):
            came = "no trial that keeps bounds and requirements"
            remedy = "Loosen them, or tune to them first."
            raise checks.fail("objectives", came, "at least one", remedy)
        least = np.argmin(self.terms, axis=0)
        levels = np.log(np.min(self.terms, axis=0)) + END_TOLERANCE
        self.minimise(self.z[least], np.array([1, 0]), levels)

    def minimise(self, z: np.ndarray, objectives: np.ndarray, levels: np.ndarray) -> None:
        """Minimises one objective from each z, (S, p), under a level of the other.

        Args:
          z: starting points, (S, p).
          objectives: which one is minimised, 0 or 1, (S,).
          levels: of the logarithm of the other, (S,).
        """
        both = np.full((len(z), 2), NO_LEVEL)
        both[np.arange(len(z)), 1 - objectives] = levels
        self._search(z, objectives, both)
        for objective, level in zip(objectives.tolist(), levels.tolist(), strict=True):
            satisfied = np.log(self.terms[:, 1 - objective]) <= level
            candidates = np.where(satisfied, self.terms[:, objective], np.inf)
            self.nodes.append(int(np.argmin(candidates)))
            self.levels.append((1 - objective, level))

    def _search(self, z: np.ndarray, objectives: np.ndarray, levels: np.ndarray) -> None:
        """Searches from each z; starts that fill up the batch are retired at once."""
        problem = self.problem
        dtype = problem.dt.dtype
        rows = np.arange(max(self.batch, len(z))) % len(z)
        candidates = problem.candidates(z[rows])._replace(
            weights=np.eye(2)[objectives[rows]].astype(dtype), levels=levels[rows].astype(dtype)
        )
        space = problem.search_space(self.iterations)
        search = Search(Evaluator(problem, candidates, "forward", space), self.solver, z[rows])
        search.retire(slice(len(z), None))
        search.run(self.iterations)
        self.evaluations += int(search.history["evaluations"][-1])
        names = ("z", "terms", "valid", "margin", "excess")
        self._keep(*(np.stack(search.history[name]) for name in names))

    def _keep_values(self, z: np.ndarray, found: Value) -> None:
        self.values += len(z)
        self._keep(z, found.terms, found.valid, found.margin, found.exact_excess)

    def _keep(
        self,
        z: np.ndarray,
        terms: np.ndarray,
        valid: np.ndarray,
        margin: np.ndarray,
        excess: np.ndarray,
    ) -> None:
        """Stores the trials that satisfy bounds and requirements."""
        feasible = valid & (margin > 0) & (np.max(excess, axis=-1, initial=-np.inf) <= 0)
        self.z = np.concatenate([self.z, z[feasible]])
        self.terms = np.concatenate([self.terms, terms[feasible]])

    def _curve(self, *further: int) -> np.ndarray:
        """The nodes, and further trials, that are not dominated, by increasing first objective."""
        nodes = np.unique([*self.nodes, *further])
        return nodes[non_dominated(self.terms[nodes])]

    def largest_gaps(self, most: int) -> list[Gap]:
        """The largest gaps, those of at least half of the largest size; none where all are filled
        or have had their level.
        """
        gaps = [self._gap(one, other) for one, other in itertools.pairwise(self._curve())]
        found = [gap for gap in gaps if gap is not None]
        largest = max((gap.size for gap in found), default=0.0)
        found = [gap for gap in found if gap.size >= 0.5 * largest]
        return sorted(found, key=lambda gap: -gap.size)[: min(most, self.batch)]

    def _gap(self, one: int, other: int) -> Gap | None:
        """The larger gap between two neighbours that has not had a level."""
        ends = np.log(self.terms[[one, other]])
        size = np.abs(ends[1] - ends[0])
        for k in np.argsort(-size).tolist():
            low, high = np.sort(ends[:, k])
            had_level = any(j == k and low + 2 * END_TOLERANCE < x < high for j, x in self.levels)
            if size[k] > GAP_TOLERANCE and not had_level:
                middle = 0.5 * (self.z[one] + self.z[other])
                return Gap(float(size[k]), middle, 1 - k, 0.5 * (low + high))
        return None

    def fill(self, count: int) -> None:
        """Values, without derivatives, at `count` points on the lines between neighbours: most
        where the gaps are largest.
        """
        curve = self._curve(*np.argmin(self.terms, axis=0).tolist())
        if len(curve) < 2:
            return
        size = np.max(np.abs(np.diff(np.log(self.terms[curve]), axis=0)), axis=1)
        along = np.concatenate([[0.0], np.cumsum(size)])
        at = (np.arange(count) + 0.5) / count * along[-1]
        z = np.stack([np.interp(at, along, x) for x in self.z[curve].T], axis=1)
        self._keep_values(z, values(self.problem, z))

    def front(self, seconds: float) -> ParetoFront:
        """The trials that are not dominated."""
        problem = self.problem
        front = non_dominated(self.terms)
        z = self.z[front]
        first, second = problem.objective.terms
        return ParetoFront(
            labels=(first.name, second.name),
            objectives=self.terms[front],
            x=in_units(problem.blocks, z),
            names=tuple(names_of(problem.blocks)),
            tried=self.terms,
            first=self.first,
            start=problem.scenario,
            blocks=problem.blocks,
            z=z,
            seconds=seconds,
            evaluations=self.evaluations,
            values=self.values,
        )


def _best_of(found: Value, violation: np.ndarray, term: int) -> int:
    """Index of the best point by one term, the first point excluded."""
    order = np.lexsort((found.terms[1:, term], violation[1:], ~found.valid[1:]))
    return 1 + int(order[0])


def _pair(objectives: Sequence[Objective]) -> Objective:
    """The two objectives as one."""
    is_pair = isinstance(objectives, tuple | list) and len(objectives) == 2
    if is_pair and all(isinstance(x, Objective) and len(x.terms) == 1 for x in objectives):
        one, other = objectives
        if one.terms[0].shape == "plain" and other.terms[0].shape == "plain":
            return one + other
    expected = "two objectives of one term each, without a limit"
    remedy = "Such as (ij.objectives.tracking(), ij.objectives.effort())."
    raise checks.fail("objectives", objectives, expected, remedy)
