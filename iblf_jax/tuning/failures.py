"""Explains failed fresh runs by the perturbed number that separates them best from the other runs.

Let F be the runs that failed, K the other runs, and x a perturbed number.  The rank statistic is
the area under the ROC curve: the share of the pairs in which the failed run has the larger number,
which is Mann and Whitney's U divided by the number of pairs,

    A = P(x_f > x_k) + P(x_f = x_k) / 2,      f in F, k in K;

A is 1/2 for a number without influence.  The reported statistic is the larger of A, for which the
number is larger in failed runs, and 1 - A.  If failures lie at both ends of a range, the distance
|x - median| takes the place of x.

The reported number is the best of several, so that chance alone can make its statistic large.  The
p-value of the U test is therefore corrected for m tests (Sidak): 1 - (1 - p)^m.  Every independent
draw counts twice, for x and for its distance from the median.

Source: H. B. Mann, D. R. Whitney, Ann. Math. Stat. 18 (1947) 50-60.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import programs
from iblf_jax.simulation.paths import unit_at
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.draws import Target, UncertainScenario, draw
from iblf_jax.studies.summaries import initial_margins

FEWEST_FAILURES = 3
"""Smallest number of failed runs for which a perturbation is called influential."""
SIGNIFICANCE = 0.05
"""Largest corrected p-value for which a perturbation is called influential."""
CLEAR_STATISTIC = 0.75
"""Smallest rank statistic of a perturbation that separates failed runs clearly: three of four pairs
are in order."""
LEAD_OF_DISTANCE = 0.05
"""Smallest lead of the statistic of a distance from the median over that of the number itself for
which the distance is reported, as the number itself is easier to understand."""
FEWEST_ORDERED = 8
"""Smallest number of runs in which two numbers in the same order are assumed to be one draw."""
LISTED_RUNS = 10
"""Largest number of failed runs whose indices are stored."""
EXACT_PAIRS = 1_000_000
"""Largest number of pairs of a failed and a kept run for which SciPy may compute the p-value
exactly, as the time grows with the number of pairs."""


@dataclasses.dataclass(frozen=True)
class Influence:
    """The perturbed number that separates failed runs from the others best."""

    path: str
    unit: str
    side: str
    """Where the number is in failed runs: "larger", "smaller", or "both ends" of the range."""
    statistic: float
    """The rank statistic, from 0.5 (no influence) to 1 (all pairs are ordered)."""
    p_value: float
    """Probability of such a statistic by chance, for the best of all perturbed numbers."""
    failed: float
    """Median in the failed runs; for "both ends" that of the distance from the median of all
    runs."""
    kept: float
    """The same in the other runs."""
    drawn_with: tuple[str, ...] = ()
    """Paths of further numbers with the same draw, which separate the runs equally well."""

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
    """Number of failed runs."""
    runs: int
    """Number of fresh runs that were executed."""
    diverged: int
    """Number of failed runs that diverged."""
    started_outside: int
    """Number of failed runs that were drawn outside their bounds at t = 0, so that no gains can
    keep the bounds."""
    first: tuple[int, ...]
    """Indices of the first LISTED_RUNS failed runs.  They are those of the runs of `ij.monte_carlo`
    with the same perturbations and the seed of the report."""
    influence: Influence | None
    """The perturbation that explains them; None where nothing was perturbed, or no run was kept."""

    @property
    def is_explained(self) -> bool:
        """Whether there are enough failures and the influence is significant."""
        found = self.influence
        return found is not None and self.count >= FEWEST_FAILURES and found.p_value <= SIGNIFICANCE

    def __str__(self) -> str:
        event = "left their bounds"
        if self.requirement is not None:
            event = f"broke {self.requirement}"
        text = f"{self.count} of {self.runs} runs {event}"
        details = []
        if self.started_outside:
            details.append(f"{self.started_outside} of them started outside")
        if self.diverged:
            details.append(f"{self.diverged} of them diverged")
        if details:
            text += f" ({'; '.join(details)})"
        return f"{text}; {self.cause_in_words()}"

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
    """N fresh runs: what explains a failure, apart from which of them failed."""

    diverged: np.ndarray
    """Whether each run diverged, (N,) bool."""
    admissible: np.ndarray
    """Whether each run was executed, (N,) bool."""
    started_outside: np.ndarray
    """Whether each run was drawn outside its bounds at t = 0, (N,) bool."""
    numbers: Mapping[str, np.ndarray]
    """Path -> perturbed number of each run, (N,)."""
    scenario: Scenario
    """The scenario, from which units are read."""


def failed_runs(requirement: str | None, failed: np.ndarray, fresh: FreshRuns) -> FailedRuns | None:
    """The explanation of failed runs; None where no run failed.

    Args:
      requirement: name of the requirement that they broke; None for bounds.
      failed: whether each run failed, (N,).
      fresh: all fresh runs.
    """
    executed = fresh.admissible
    failed = failed & executed
    count = int(np.sum(failed))
    if not count:
        return None
    numbers = {path: x[executed] for path, x in fresh.numbers.items()}
    return FailedRuns(
        requirement=requirement,
        count=count,
        runs=int(np.sum(executed)),
        diverged=int(np.sum(failed & fresh.diverged)),
        started_outside=int(np.sum(failed & fresh.started_outside)),
        first=tuple(np.flatnonzero(failed)[:LISTED_RUNS].tolist()),
        influence=most_influential(numbers, failed[executed], fresh.scenario),
    )


def most_influential(
    numbers: Mapping[str, np.ndarray], failed: np.ndarray, scenario: Scenario
) -> Influence | None:
    """The number that separates failed runs best from the others.

    None where no number varies, or where all or no runs failed.

    Args:
      numbers: path -> number of each run, (N,).
      failed: whether each run failed, (N,).
      scenario: scenario from which units are read.
    """
    varying = {path: x for path, x in numbers.items() if np.ptp(x) > 0}
    if not varying or np.all(failed) or not np.any(failed):
        return None
    names = list(varying)
    x = np.stack(list(varying.values()), axis=1)
    distance = np.abs(x - np.median(x, axis=0))
    of_number = rank_statistic(x, failed)
    of_distance = rank_statistic(distance, failed)
    of_either_side = np.maximum(of_number, 1 - of_number)
    column = int(np.argmax(of_either_side))
    if np.max(of_distance) > of_either_side[column] + LEAD_OF_DISTANCE:
        column = int(np.argmax(of_distance))
        side = "both ends"
        statistic = float(of_distance[column])
        chosen = distance[:, column]
    else:
        side = "larger" if of_number[column] >= 0.5 else "smaller"
        statistic = float(of_either_side[column])
        chosen = x[:, column]
    p = p_value(chosen[failed], chosen[~failed])
    # Each number is tested itself and by its distance from the median.
    tests = 2 * len(_distinct_draws(x))
    path = names[column]
    same = [i for i in _same_draw(x, column) if i != column]
    return Influence(
        path=path,
        unit=unit_at(scenario, path),
        side=side,
        statistic=statistic,
        p_value=float(-np.expm1(tests * np.log1p(-p))) if p < 1 else 1.0,
        failed=float(np.median(chosen[failed])),
        kept=float(np.median(chosen[~failed])),
        drawn_with=tuple(names[i] for i in same),
    )


def rank_statistic(x: np.ndarray, failed: np.ndarray) -> np.ndarray:
    """The area A under the ROC curve of each column of x, (N, m), for N runs that failed or not."""
    from scipy import stats  # imported here because the import takes a second

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
    """The columns of x, (N, m), that order the runs as one column does, or in reverse: they are
    functions of the same draw.  With fewer than FEWEST_ORDERED runs the column itself, as equal
    orders are then likely by chance.
    """
    if len(x) < FEWEST_ORDERED:
        return [column]
    order = np.argsort(x[:, column], kind="stable")
    changes = np.diff(x[order], axis=0)
    is_monotonic = np.all(changes >= 0, axis=0) | np.all(changes <= 0, axis=0)
    return np.flatnonzero(is_monotonic).tolist()


def _distinct_draws(x: np.ndarray) -> list[int]:
    """The columns of x, (N, m), without those that are of the same draw as an earlier one."""
    distinct: list[int] = []
    remaining = list(range(x.shape[1]))
    while remaining:
        distinct.append(remaining[0])
        same = _same_draw(x, remaining[0])
        remaining = [i for i in remaining if i not in same]
    return distinct


@programs.jit(static_argnames="targets")
def drawn_leaves(
    cases: UncertainScenario,
    point: Mapping[str, jax.Array],
    index: jax.Array,
    *,
    targets: tuple[Target, ...],
) -> dict[str, jax.Array]:
    """Path -> values of the perturbed leaves in some runs, (N, ...).

    Args:
      cases: scenario, perturbations and key.
      point: path -> value that replaces that of the scenario before the perturbation.
      index: indices of the runs, (N,) uint32.
      targets: the perturbed leaves.
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
