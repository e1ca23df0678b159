"""Failed fresh runs are explained by the perturbed number that separates them from the others best.

For a perturbed number x and the runs that failed F and were kept K, the rank statistic is the area
under the ROC curve, the share of the pairs in which the failed run has the larger number (Mann and
Whitney's U, divided by the number of pairs),

    A = P(x_f > x_k) + P(x_f = x_k) / 2,      f in F, k in K;

1/2 for a number without influence.  The reported statistic is the larger of A and 1 - A, with the
side; the distance |x - median| takes the place of x where failures lie at both ends of a range.
The largest statistic of m numbers is compared with chance by the p-value of the U test, corrected
for m tests (Sidak): 1 - (1 - p)^m.

Source: H. B. Mann, D. R. Whitney, Ann. Math. Stat. 18 (1947) 50-60.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.simulation.paths import unit_at
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.draws import Target, UncertainScenario, draw
from iblf_jax.studies.summaries import initial_margins

FEWEST_FAILURES = 3
"""Failed runs from which a perturbation is called influential."""
SIGNIFICANCE = 0.05
"""Largest corrected p-value of an influence."""
CLEAR_STATISTIC = 0.75
"""Rank statistic from which a perturbation separates failed runs clearly: three of four pairs."""
LEAD_OF_DISTANCE = 0.05
"""By how much the statistic of a distance from the median has to exceed that of the number itself,
which is easier to understand."""
FEWEST_ORDERED = 8
"""Runs from which numbers that are in the same order in all runs are taken for one draw."""
LISTED_RUNS = 10
"""Failed runs whose numbers are stored."""
EXACT_PAIRS = 1_000_000
"""Pairs of a failed and a kept run up to which the p-value of a few failures is exact: the time
grows with the number of pairs."""


@dataclasses.dataclass(frozen=True)
class Influence:
    """The perturbed number that separates failed runs from the others best."""

    path: str
    unit: str
    side: str
    """In failed runs: "larger", "smaller", or "both ends" of the range."""
    statistic: float
    """The rank statistic, from 0.5 (no influence) to 1 (all pairs are ordered)."""
    p_value: float
    """Probability of such a statistic by chance, for the best of all perturbed numbers."""
    failed: float
    """Median in the failed runs; of the distance from the median of all runs for "both ends"."""
    kept: float
    """The same in the others."""
    drawn_with: tuple[str, ...] = ()
    """Further numbers with the same draw, which separate the runs equally well."""

    def __str__(self) -> str:
        name = self.path
        if self.drawn_with:
            name += f" (with the same draw: {', '.join(self.drawn_with)})"
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        what = "median"
        if self.side == "both ends":
            what = "at both ends of its range: median distance from the middle"
        return (
            f"{name}, {what} {self.failed:.4g}{unit} in them, {self.kept:.4g}{unit} in the others"
            f" (rank statistic {self.statistic:.3g})"
        )


@dataclasses.dataclass(frozen=True)
class FailedRuns:
    """Fresh runs that failed in one respect; prints as one line."""

    requirement: str | None
    """The requirement that they broke; None for runs that left their bounds or diverged."""
    count: int
    runs: int
    diverged: int
    """How many of them diverged."""
    started_outside: int
    """How many of them were drawn outside their bounds at t = 0, so that no gains keep these."""
    first: tuple[int, ...]
    """Numbers of the first of them, at most LISTED_RUNS: of the runs of `ij.monte_carlo` with the
    same perturbations and the seed of the report."""
    influence: Influence | None
    """None where nothing was perturbed, or no run was kept."""

    @property
    def is_explained(self) -> bool:
        """Whether the influence is larger than what chance gives, with enough failures."""
        found = self.influence
        return found is not None and self.count >= FEWEST_FAILURES and found.p_value <= SIGNIFICANCE

    def __str__(self) -> str:
        return f"{self._count_in_words()}; {self.cause_in_words()}"

    def _count_in_words(self) -> str:
        event = "left their bounds"
        if self.requirement is not None:
            event = f"broke {self.requirement}"
        text = f"{self.count} of {self.runs} runs {event}"
        details = []
        if self.started_outside:
            details.append(f"{self.started_outside} of them started outside")
        if self.diverged:
            details.append(f"{self.diverged} of them diverged")
        return f"{text} ({'; '.join(details)})" if details else text

    def cause_in_words(self) -> str:
        """The most influential perturbation, or why none is named."""
        found = self.influence
        if self.count == self.runs:
            return "no run is left to compare them with"
        if found is None:
            return "no perturbation differs between the runs"
        chance = f"chance gives one as large with probability {found.p_value:.2g}"
        if self.count < FEWEST_FAILURES:
            which = "run" if self.count == 1 else "runs"
            numbers = ", ".join(map(str, self.first))
            return (
                f"too few to name a cause ({which} {numbers}); the most unusual number is {found},"
                f" {chance}"
            )
        if not self.is_explained:
            return f"no single perturbation separates them: the nearest is {found}, {chance}"
        if found.statistic < CLEAR_STATISTIC:
            return f"no single perturbation separates them clearly; most influential: {found}"
        return f"most influential: {found}"


class FreshRuns(NamedTuple):
    """What is known of N fresh runs besides which of them failed."""

    diverged: np.ndarray
    """(N,) bool."""
    admissible: np.ndarray
    """Whether each run was made, (N,)."""
    started_outside: np.ndarray
    """Whether each run was drawn outside its bounds at t = 0, (N,)."""
    numbers: Mapping[str, np.ndarray]
    """Path -> perturbed number, (N,)."""
    scenario: Scenario
    """For units."""


def failed_runs(requirement: str | None, failed: np.ndarray, fresh: FreshRuns) -> FailedRuns | None:
    """The explanation of failed runs; None where no run failed.

    Args:
      requirement: that they broke; None for bounds.
      failed: whether each run did, (N,).
      fresh: these and the other runs.
    """
    made = fresh.admissible
    failed = failed & made
    count = int(np.sum(failed))
    if not count:
        return None
    numbers = {path: x[made] for path, x in fresh.numbers.items()}
    return FailedRuns(
        requirement=requirement,
        count=count,
        runs=int(np.sum(made)),
        diverged=int(np.sum(failed & fresh.diverged)),
        started_outside=int(np.sum(failed & fresh.started_outside)),
        first=tuple(np.flatnonzero(failed)[:LISTED_RUNS].tolist()),
        influence=most_influential(numbers, failed[made], fresh.scenario),
    )


def most_influential(
    numbers: Mapping[str, np.ndarray], failed: np.ndarray, scenario: Scenario
) -> Influence | None:
    """The number that separates failed runs from the others best; None where no number varies, or
    all runs failed.

    Args:
      numbers: path -> number of each run, (N,).
      failed: whether each run failed, (N,).
      scenario: for units.
    """
    varying = {path: x for path, x in numbers.items() if np.ptp(x) > 0}
    if not varying or np.all(failed) or not np.any(failed):
        return None
    names = list(varying)
    x = np.stack(list(varying.values()), axis=1)
    distance = np.abs(x - np.median(x, axis=0))
    above = rank_statistic(x, failed)
    apart = rank_statistic(distance, failed)
    either = np.maximum(above, 1 - above)
    column = int(np.argmax(either))
    side = "larger" if above[column] >= 0.5 else "smaller"
    statistic, compared = either, x
    if np.max(apart) > either[column] + LEAD_OF_DISTANCE:
        column, side = int(np.argmax(apart)), "both ends"
        statistic, compared = apart, distance
    chosen = compared[:, column]
    p = p_value(chosen[failed], chosen[~failed])
    # Each number is tested itself and by its distance from the median.
    tests = 2 * len(_distinct_draws(x))
    path = names[column]
    same = [i for i in _same_draw(x, column) if i != column]
    return Influence(
        path=path,
        unit=unit_at(scenario, path),
        side=side,
        statistic=float(statistic[column]),
        p_value=float(-np.expm1(tests * np.log1p(-p))) if p < 1 else 1.0,
        failed=float(np.median(chosen[failed])),
        kept=float(np.median(chosen[~failed])),
        drawn_with=tuple(names[i] for i in same),
    )


def rank_statistic(x: np.ndarray, failed: np.ndarray) -> np.ndarray:
    """The area A under the ROC curve of each column of x, (N, m), for N runs that failed or not."""
    from scipy import stats  # a second to import

    count = int(np.sum(failed))
    ranks = stats.rankdata(x, axis=0)
    larger = ranks[failed].sum(axis=0) - count * (count + 1) / 2
    return larger / (count * (len(x) - count))


def p_value(failed: np.ndarray, kept: np.ndarray) -> float:
    """The two-sided p-value of Mann and Whitney's test."""
    from scipy import stats

    method = "auto" if len(failed) * len(kept) <= EXACT_PAIRS else "asymptotic"
    return float(stats.mannwhitneyu(failed, kept, method=method).pvalue)


def _same_draw(x: np.ndarray, column: int) -> list[int]:
    """The columns of x, (N, m), that order the runs as one column does, or in reverse."""
    if len(x) < FEWEST_ORDERED:
        return [column]
    first = np.argsort(x[:, column], kind="stable")
    ordered = np.diff(x[first], axis=0)
    return [
        i for i in range(x.shape[1]) if np.all(ordered[:, i] >= 0) or np.all(ordered[:, i] <= 0)
    ]


def _distinct_draws(x: np.ndarray) -> list[int]:
    """The columns of x, (N, m), of which no earlier one orders the runs alike."""
    found: list[int] = []
    left = list(range(x.shape[1]))
    while left:
        found.append(left[0])
        same = _same_draw(x, left[0])
        left = [i for i in left if i not in same]
    return found


@partial(jax.jit, static_argnames="targets")
def drawn_leaves(
    cases: UncertainScenario, point: Any, index: jax.Array, *, targets: tuple[Target, ...]
) -> dict[str, jax.Array]:
    """Path -> values of the perturbed leaves in the runs with these numbers, (N, ...).

    Args:
      cases: scenario, perturbations and key.
      point: path -> value that replaces the scenario's before the perturbation.
      index: numbers of the runs, (N,) uint32.
      targets: what is perturbed.
    """
    return jax.vmap(lambda i: draw(cases, targets, i, point, {})[1])(index)


def is_outside(scenario: Scenario, leaves: Mapping[str, Any], runs: int) -> np.ndarray:
    """Whether each of N runs starts outside its bounds, (N,), from their perturbed leaves."""
    outside = np.zeros(runs, bool)
    if not leaves:
        return outside
    for margins in initial_margins(scenario, dict(leaves)).values():
        outside |= ~(np.min(margins, axis=1) > 0)
    return outside
