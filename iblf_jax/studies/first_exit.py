"""The distribution of the time at which a run first leaves its bounds.

With N runs of one length, no run is censored before its end, and the estimate of Kaplan and Meier
of the survival function is the share of runs that have not left their bounds yet,

    P(first exit <= t) = k(t) / N,   k(t) the number of runs with a first exit up to t.

Source: E. L. Kaplan, P. Meier, J. American Statistical Association 53 (1958) 457-481; the interval
at each time is that of Clopper and Pearson (`studies.statistics`).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.presentation import present
from iblf_jax.core.status import Status, has_flag

if TYPE_CHECKING:
    from iblf_jax.studies.study import Study

INSTANTS = 101
"""Instants at which the distribution is given, if the caller does not say how many."""


@dataclasses.dataclass(frozen=True, eq=False)
class FirstExit:
    """The distribution of the first exit from the bounds, over the runs of a study."""

    times: np.ndarray
    """Time of the first exit of each run that was made, (N,) [s]; infinite without an exit."""
    t: np.ndarray
    """Instants, (K,) [s]."""
    probability: np.ndarray
    """P(first exit <= t), (K,)."""
    low: np.ndarray
    """Lower end of its interval, (K,); NaN where no interval is valid."""
    high: np.ndarray
    """Upper end, (K,)."""
    confidence: float
    """Of the interval at each instant."""
    diverged: int
    """Runs that diverged before an exit was seen; they count as exits at the end of the run."""

    def __repr__(self) -> str:
        return (
            f"FirstExit({len(self.times)} runs; up to {self.t[-1]:g} s:"
            f" {self.probability[-1]:.4g}, {self.confidence:.0%} interval"
            f" {self.low[-1]:.3g} to {self.high[-1]:.3g})"
        )

    def plot(self, **options: Any) -> Any:
        """Figure of the distribution.  Options as `plotting.first_exit`."""
        return present("first exit figure", self, **options)


def first_exit_of(study: Study, joint: int | None, instants: int, confidence: float) -> FirstExit:
    """The distribution of the first exit; arguments as `Study.first_exit`."""
    instants = checks.positive_integer("instants", instants, least=2)
    name = "first_violation_time"
    if joint is not None:
        joint = checks.entry("joint", joint, study.scenario.n, "joints")
        name = "first_exit_time"
    if name not in study.metrics:
        got, remedy = list(study.metrics), "Run the study with metrics=(ij.metrics.Margin(),)."
        if joint is not None:
            remedy = "Run the study with metrics=(ij.metrics.FirstExit(),)."
        raise checks.fail("study.metrics", got, f"the metric {name}", remedy)
    times = np.asarray(study.metrics[name], float)
    if joint is not None:
        times = times[:, joint]
    diverged = has_flag(study.status, Status.NOT_FINITE) & ~np.isfinite(times)
    times = np.where(diverged, study.duration, times)
    t = np.linspace(0.0, study.duration, instants)
    found = [study.probability(times <= instant, confidence) for instant in t]
    ends = [(p.low, p.high) for p in found]
    low, high = np.array(ends, float).T
    return FirstExit(
        times=times[study.made],
        t=t,
        probability=np.array([p.estimate for p in found]),
        low=low,
        high=high,
        confidence=confidence,
        diverged=int(np.sum(diverged & study.made)),
    )
