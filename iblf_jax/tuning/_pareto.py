"""`pareto`: the front of two objectives, tracking against effort say: its ends first, then points
where it has the largest gaps.

With A = log risk_b[a_b], B = log risk_b[b_b], an end minimises one of them alone,

    minimise A,      and then     minimise B   subject to   A <= A_end + GIVEN,

so that it is not bought with a B that A hardly feels; the other end likewise.  They are looked for
from the scenario's gains and from the best of some that are spread over the ranges, as an objective
alone often has several valleys.  Of two neighbours on the front with the largest gap |A_1 - A_2| or
|B_1 - B_2|, the objective that has the gap gets a level in its middle, and the other one is minimised:

    minimise B   subject to   A <= (A_1 + A_2) / 2,

by the method of `newton`, from the middle of their coordinates z, several gaps in one batch;
requirements hold throughout.  A gap that this does not fill is one of the front.  The gains on the
front are a smooth curve in z nearly everywhere: values on the straight lines between neighbours,
  without derivatives, are of the front but for the fourth power of the distance.  Every trial that
  kept its
bounds and requirements is a candidate: the front is what no other one beats in both.

Source: Y. Y. Haimes, L. S. Lasdon, D. A. Wismer, IEEE Trans. Syst. Man Cybern. 1 (1971) 296-297
  (levels).
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.presentation import present
from iblf_jax.core.progress import bar
from iblf_jax.engine.plan import FORWARD_MOST, differentiates_forward
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.designs import MOST_RUNS
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.tuning._tune import Problem, build, look_around, make_method
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.optimise import CountedProblem, Loop
from iblf_jax.tuning.parameters import Block, Tunable, in_units, names_of, values_at
from iblf_jax.tuning.problem import NO_LEVEL, NUMBERS_A_RUN, Value
from iblf_jax.tuning.robust import Risk

GIVEN = 1e-3
"""By how much an end may be above the least value of its objective, relative to it."""
CLOSE = 0.05
"""Neighbours whose objectives differ by less, relatively, have no gap between them."""
TOGETHER = 8
"""Points that are looked for in one batch at most."""
BETWEEN = 8
"""Values on the lines between neighbours, for each point."""


@dataclasses.dataclass(frozen=True, eq=False)
class Front:
    """Gains of which none is beaten by another one in both objectives, from low a to low b."""

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
    """Values with derivatives that were computed, each of as many rollouts as there are runs."""
    values: int = 0
    """Values without derivatives."""

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

    def __repr__(self) -> str:
        ends = ", ".join(
            f"{name} {x.min():.4g} to {x.max():.4g}"
            for name, x in zip(self.labels, self.objectives.T, strict=True)
        )
        return f"Front({len(self)} points of {len(self.tried)} trials; {ends})"


def non_dominated(points: np.ndarray) -> np.ndarray:
    """Indices of the points (N, 2) that no other one beats, by growing first coordinate."""
    order = np.lexsort((points[:, 1], points[:, 0]))
    best = np.minimum.accumulate(np.concatenate([[np.inf], points[order, 1][:-1]]))
    return order[points[order, 1] < best]


@notices.each_warning_once
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
) -> Front:
    """The front of two objectives over some leaves of a scenario.

        the ends:  minimise a,  minimise b          a point between:  minimise b subject to a <=
          level, or a subject to b <= level

    Args:
      scenario, parameters, duration, dt, perturbations, runs, seed, risk, method, backend,
      tolerance: as `tune`. objectives: two of `iblf_jax.objectives`, of one plain term each;
        requirements of either hold for all points.
      points: how many points are optimised, the two ends among them; what lies on the lines between
        them, and every other trial, is on the front too where nothing beats it.
      iterations: steps for each at most; an end may take three times as many.
      progress: a progress bar; shown where somebody watches if not given.

    Returns:
      A `Front`.

    Raises:
      ValueError: not two objectives of one term, or as `tune`.

    Source: head of this module.
    """
    began = time.perf_counter()
    points = checks.positive_integer("points", points, least=2, most=MOST_RUNS)
    seed = checks.seed(seed)
    iterations = checks.positive_integer("iterations", iterations, most=checks.MOST_STEPS)
    tolerance = checks.number_between("tolerance", tolerance, 0.0, 1.0, "1")
    pair = _pair(objectives)
    timing = {"duration": duration, "dt": dt, "method": method, "backend": backend}
    problem = build(
        scenario, parameters, pair, perturbations, runs, seed, risk, timing, levels=True
    )
    if not differentiates_forward(len(problem.box.z)):
        raise checks.fail(
            "parameters",
            f"{len(problem.box.z)} numbers",
            f"at most {FORWARD_MOST} for a front",
            "Tie or leave out some.",
        )
    checks.fits("points", points, 8.0 * BETWEEN * problem.runs * NUMBERS_A_RUN)
    search = Search(problem, min(points, TOGETHER), iterations, tolerance)
    with bar(progress, points, unit="points") as shown:
        search.ends(seed)
        shown.update(2)
        while len(search.nodes) < points and (
            asked := search.largest_gaps(points - len(search.nodes))
        ):
            search.minimise(*asked)
            shown.update(len(asked[0]))
        search.fill(BETWEEN * points)
    return search.front(time.perf_counter() - began)


class Search:
    """The trials of a front so far, and how more of them are made.

    Args:
      problem: with levels.
      lanes: of a batch; always the same number, so that all batches are of one compiled shape.
      iterations, tolerance: of a batch.
    """

    def __init__(self, problem: Problem, lanes: int, iterations: int, tolerance: float):
        self.problem, self.lanes, self.iterations, self.tolerance = (
            problem,
            lanes,
            iterations,
            tolerance,
        )
        self.z, self.terms = np.zeros((0, len(problem.box.z))), np.zeros((0, 2))
        """Of each trial that kept its bounds and requirements."""
        self.nodes: list[int] = []
        """The trials that are ends, or best under a level."""
        self.asked: list[tuple[int, float]] = []
        """Which objective has been under which level."""
        self.evaluations, self.values = 0, 0

    def ends(self, seed: int) -> None:
        """Both ends, each objective alone and then the other one while it gives next to nothing
        away.

        Alone, each is minimised from the scenario's gains and from the best of some that are spread
        over their ranges.
        """
        points, seen, broken = look_around(self.problem, seed, self.problem.box.z[None])
        self.first = seen.terms[0]
        self._values(points, seen)
        best = [1 + np.lexsort((seen.terms[1:, k], broken[1:], ~seen.valid[1:]))[0] for k in (0, 1)]
        self._trials(points[[0, 0, *best]], np.array([0, 1, 0, 1]), np.full((4, 2), NO_LEVEL))
        if not len(self.z):
            raise checks.fail(
                "objectives",
                "no trial that keeps bounds and requirements",
                "at least one",
                "Loosen them, or tune to them first.",
            )
        least = np.argmin(self.terms, axis=0)
        self.minimise(self.z[least], np.array([1, 0]), np.log(np.min(self.terms, axis=0)) + GIVEN)

    def minimise(self, z: np.ndarray, aims: np.ndarray, levels: np.ndarray) -> None:
        """From each z (S, p) one of the objectives, 0 or 1 of `aims` (S,), under a level of the
        logarithm of the other, (S,).
        """
        level = np.full((len(z), 2), NO_LEVEL)
        level[np.arange(len(z)), 1 - aims] = levels
        self._trials(z, aims, level)
        for aim, most in zip(aims.tolist(), levels.tolist(), strict=True):
            kept = np.log(self.terms[:, 1 - aim]) <= most
            self.nodes.append(int(np.argmin(np.where(kept, self.terms[:, aim], np.inf))))
            self.asked.append((1 - aim, most))

    def _trials(self, z: np.ndarray, aims: np.ndarray, level: np.ndarray) -> None:
        problem, wanted = self.problem, len(z)
        rows = np.arange(max(self.lanes, wanted)) % wanted
        lanes = problem.lanes(z[rows])._replace(
            weights=np.eye(2)[aims[rows]].astype(problem.shared.dt.dtype),
            level=level[rows].astype(problem.shared.dt.dtype),
        )
        method = make_method(
            "newton",
            problem.box,
            self.iterations,
            self.tolerance,
            0.1,
            problem.limits,
            problem.runs,
        )
        loop = Loop(
            CountedProblem(problem.formulation, problem.shared, lanes, "forward"), method, z[rows]
        )
        loop.state["finished"][wanted:] = loop.state["retired"][wanted:] = True
        for s in range(wanted, len(rows)):
            method.retire(loop.state["method"], s)
        loop.run(
            self.iterations,
            tolerance=self.tolerance,
            patience=self.iterations,
            on_step=lambda _: None,
        )
        history = {name: np.stack(x) for name, x in loop.history.items()}
        self.evaluations += int(history["evaluations"][-1])
        self._keep(
            history["z"], history["terms"], history["valid"], history["margin"], history["excess"]
        )

    def _values(self, z: np.ndarray, seen: Value) -> None:
        self.values += len(z)
        self._keep(z, seen.terms, seen.valid, seen.margin, seen.exact_excess)

    def _keep(
        self,
        z: np.ndarray,
        terms: np.ndarray,
        valid: np.ndarray,
        margin: np.ndarray,
        excess: np.ndarray,
    ) -> None:
        kept = valid & (margin > 0) & (np.max(excess, axis=-1, initial=-np.inf) <= 0)
        self.z, self.terms = (
            np.concatenate([self.z, z[kept]]),
            np.concatenate([self.terms, terms[kept]]),
        )

    def _curve(self, *further: int) -> np.ndarray:
        """The nodes, and further trials, that no other one beats, by growing first objective."""
        nodes = np.unique([*self.nodes, *further])
        return nodes[non_dominated(self.terms[nodes])]

    def largest_gaps(self, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """What to ask `minimise` in the largest gaps, those of at least half of the largest, or
        None where there is none.
        """
        curve, found = self._curve(), []
        for one, other in itertools.pairwise(curve):
            ends = np.log(self.terms[[one, other]])
            size = np.abs(ends[1] - ends[0])
            for k in np.argsort(-size).tolist():
                low, high = np.sort(ends[:, k])
                if size[k] > CLOSE and not any(
                    j == k and low + 2 * GIVEN < level < high for j, level in self.asked
                ):
                    found.append(
                        (size[k], 0.5 * (self.z[one] + self.z[other]), 1 - k, 0.5 * (low + high))
                    )
                    break
        found = sorted(
            (x for x in found if x[0] >= 0.5 * max(y[0] for y in found)), key=lambda x: -x[0]
        )
        z, aims, levels = ([x[i] for x in found[: min(most, self.lanes)]] for i in (1, 2, 3))
        return (np.stack(z), np.array(aims), np.array(levels)) if z else None

    def fill(self, count: int) -> None:
        """Values, without derivatives, at `count` places on the lines between neighbours: most
        where the gaps are largest.
        """
        curve = self._curve(*np.argmin(self.terms, axis=0).tolist())
        if len(curve) < 2:
            return
        size = np.max(np.abs(np.diff(np.log(self.terms[curve]), axis=0)), axis=1)
        along = np.concatenate([[0.0], np.cumsum(size)])
        at = (np.arange(count) + 0.5) / count * along[-1]
        z = np.stack([np.interp(at, along, x) for x in self.z[curve].T], axis=1)
        self._values(z, self.problem.values(z))

    def front(self, seconds: float) -> Front:
        """What no other trial beats."""
        problem, front = self.problem, non_dominated(self.terms)
        blocks, start = problem.formulation.blocks, problem.shared.cases.scenario
        tried, z = self.terms, self.z[front]
        first, second = problem.shared.objective.terms
        labels, names = (first.name, second.name), tuple(names_of(blocks))
        return Front(
            labels,
            tried[front],
            in_units(blocks, z),
            names,
            tried,
            self.first,
            start,
            blocks,
            z,
            seconds,
            self.evaluations,
            self.values,
        )


def _pair(objectives: Any) -> Objective:
    fine = (
        isinstance(objectives, tuple | list)
        and len(objectives) == 2
        and all(isinstance(o, Objective) for o in objectives)
    )
    if not fine or any(len(o.terms) != 1 or o.terms[0].shape != "plain" for o in objectives):
        raise checks.fail(
            "objectives",
            objectives,
            "two objectives of one plain term each",
            "Such as (ij.objectives.tracking(), ij.objectives.effort()).",
        )
    return objectives[0] + objectives[1]
