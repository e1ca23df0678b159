"""Statistics of runs: probabilities with intervals, one number a run, rank correlations.

Clopper-Pearson: with k events in N independent runs, the interval of the probability p that holds
for every p with at least the requested confidence is [B(a/2; k, N - k + 1), B(1 - a/2; k + 1, N -
k)], B the quantile of the beta distribution.

Source: C. J. Clopper, E. S. Pearson, Biometrika 26 (1934) 404-413.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.presentation import Content, Result

SMALLER_IS_WORSE = (
    "margin",
    "xi_margin",
    "first_violation_time",
    "first_exit_time",
    "velocity_margin",
    "alpha_margin",
    "first_velocity_violation_time",
    "level_margin",
    "level_alpha_margin",
    "first_level_violation_time",
    "region_margin",
    "first_region_violation_time",
)
"""Metrics of which the smallest value, over joints and over runs, is the worst."""


@dataclasses.dataclass(frozen=True, repr=False)
class Probability(Result):
    """The estimated probability of an event, with its confidence interval."""

    estimate: float
    """count / runs."""
    low: float | None
    """Lower end of the interval; None where no interval is valid."""
    high: float | None
    confidence: float
    count: int
    runs: int
    """Runs that were made, which the estimate is over."""
    method: str
    """The method of the interval, or why there is none."""

    def _content(self) -> Content:
        ends = f"no interval ({self.method})"
        if self.low is not None:
            ends = f"{self.confidence:.0%} interval {self.low:.3g} to {self.high:.3g}"
        return [f"{self.estimate:.4g} ({self.count} of {self.runs} runs; {ends})"]


def check_confidence(confidence: object) -> float:
    """A confidence in (0, 1), or a ValueError."""
    number = checks.positive_number("confidence", confidence, "1")
    if number >= 1:
        raise checks.fail(
            "confidence", confidence, "a number between 0 and 1", "0.95, for example."
        )
    return number


def probability(
    events: np.ndarray, valid: np.ndarray, confidence: float, sampler: str, replicates: int
) -> Probability:
    """The probability of an event over the valid runs.

    Args:
      events, valid: (N,) bool.
      confidence: of the interval.
      sampler, replicates: how the runs were drawn; replicates follow each other.
    """
    from scipy import stats  # a second to import

    events = events & valid
    count = int(np.sum(events))
    runs = int(np.sum(valid))
    if not runs:
        return Probability(float("nan"), None, None, confidence, 0, 0, "no run was made")
    if sampler != "independent":
        low, high, method = _replicate_interval(events, valid, confidence, sampler, replicates)
    else:
        test = stats.binomtest(count, runs)
        ends = test.proportion_ci(confidence_level=confidence, method="exact")
        low, high, method = float(ends.low), float(ends.high), "Clopper-Pearson"
    return Probability(count / runs, low, high, confidence, count, runs, method)


def runs_without_event(limit: float, confidence: float) -> int:
    """The smallest number of independent runs that show, if the event occurs in none of them, that
    its probability is below a limit: the upper end of the two-sided Clopper-Pearson interval is at
    most the limit.

    Args:
      limit: in (0, 1).
      confidence: of the interval.
    """
    return int(np.ceil(np.log((1 - confidence) / 2) / np.log1p(-limit)))


def _replicate_interval(
    events: np.ndarray, valid: np.ndarray, confidence: float, sampler: str, replicates: int
) -> tuple[float | None, float | None, str]:
    """The ends of the interval from the means of the replicates, and its method."""
    if replicates < 2:
        return None, None, f"runs of one {sampler} design are not independent; ask for replicates"
    counts = events.reshape(replicates, -1).sum(1)
    sizes = valid.reshape(replicates, -1).sum(1)
    means = counts / np.maximum(sizes, 1)
    standard_error = means.std(ddof=1) / np.sqrt(replicates)
    if standard_error == 0:
        reason = (
            "all replicates agree, so their spread says nothing; ask for more runs or independent"
            " draws"
        )
        return None, None, reason
    from scipy import stats

    half = stats.t.ppf(0.5 + confidence / 2, replicates - 1) * standard_error
    low = float(max(0.0, means.mean() - half))
    high = float(min(1.0, means.mean() + half))
    return low, high, f"Student t over {replicates} replicates"


def worst_joint(metrics: Mapping[str, Any], name: str) -> np.ndarray:
    """A metric as one number a run: the worst joint's, (N,)."""
    checks.one_of("metric", name, metrics)
    values = np.asarray(metrics[name])
    if values.ndim == 1:
        return values
    flat = values.reshape(len(values), -1)
    if name in SMALLER_IS_WORSE:
        return flat.min(1)
    return flat.max(1)


def entry_paths(path: str, shape: tuple[int, ...]) -> list[str]:
    """The paths of the entries of a leaf: "plant.mass[0]", "plant.mass[1]"."""
    return [path + "".join(f"[{i}]" for i in place) for place in np.ndindex(shape)]


def scalar_samples(samples: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The drawn parameters entry by entry, "plant.mass[0]" -> (N,)."""
    out: dict[str, np.ndarray] = {}
    for path, values in samples.items():
        values = np.asarray(values)
        flat = values.reshape(len(values), -1)
        out |= zip(entry_paths(path, values.shape[1:]), flat.T, strict=True)
    return out


def rank_correlation(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Spearman's rank correlation and its two-sided p-value; (nan, nan) where one of the two is
    constant.
    """
    if len(x) < 3 or np.all(x == x[0]) or np.all(y == y[0]):
        return float("nan"), float("nan")
    from scipy import stats

    result = stats.spearmanr(x, y)
    return float(result.statistic), float(result.pvalue)
