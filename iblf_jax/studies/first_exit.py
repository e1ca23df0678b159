"""The distribution of the time at which a run first leaves its bounds.

All N runs have the same length, so no run is censored before its end.  The estimate of Kaplan and
Meier of the survival function is then the share of runs that have not left their bounds yet,

    P(first exit <= t) = k(t) / N,   k(t) the number of runs with a first exit up to t.

Source: E. L. Kaplan, P. Meier, J. American Statistical Association 53 (1958) 457-481; the interval
at each time is that of Clopper and Pearson (`studies.statistics`).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.presentation import Content, Result, present
from iblf_jax.core.status import Status, has_flag
from iblf_jax.world import plants

if TYPE_CHECKING:
    from iblf_jax.studies.study import Study

INSTANTS = 101
"""Default number of instants at which the distribution is given."""
ROUNDING_STEPS = 4.0
"""Largest rounding error of a time of a run, in units of the last place of its duration."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class FirstExit(Result):
    """The distribution of the first exit from the bounds, over the runs of a study."""

    times: np.ndarray
    """Time of the first exit of each run that was made, (N,) [s]; infinite without an exit, and the
    end of the run for one that diverged before an exit was seen."""
    t: np.ndarray
    """Instants, (K,) [s]."""
    probability: np.ndarray
    """P(first exit <= t), (K,)."""
    low: np.ndarray
    """Lower end of its confidence interval, (K,); NaN where no interval is valid."""
    high: np.ndarray
    """Upper end of its confidence interval, (K,); NaN where no interval is valid."""
    confidence: float
    """Confidence of the interval at each instant."""
    diverged: int
    """Runs that diverged before an exit was seen; they count as exits at the end of the run."""

    def _content(self) -> Content:
        return [
            f"FirstExit({len(self.times)} runs; up to {self.t[-1]:g} s:"
            f" {self.probability[-1]:.4g}, {self.confidence:.0%} interval"
            f" {self.low[-1]:.3g} to {self.high[-1]:.3g})"
        ]

    def plot(self, **options: Any) -> Any:
        """Figure of the distribution.  Options as `plotting.first_exit`."""
        return present("first exit figure", self, **options)


def first_exit_of(
    study: Study, joint: int | str | None, instants: int, confidence: float
) -> FirstExit:
    """The distribution of the first exit; arguments as `Study.first_exit`."""
    instants = checks.positive_integer("instants", instants, least=2, most=checks.MAX_POINTS)
    recorded = _recorded_times(study, joint)
    is_diverged = has_flag(study.status, Status.NOT_FINITE) & ~np.isfinite(recorded)
    times = np.where(is_diverged, study.duration, recorded.astype(float))
    # A time of a run has the precision of its numbers: that of the last step may exceed the end.
    rounding = ROUNDING_STEPS * float(np.finfo(recorded.dtype).eps) * study.duration
    t = np.linspace(0.0, study.duration, instants)
    found = [study.probability(times <= instant + rounding, confidence) for instant in t]
    return FirstExit(
        times=times[study.made],
        t=t,
        probability=np.array([p.estimate for p in found]),
        low=np.array([p.low for p in found], float),
        high=np.array([p.high for p in found], float),
        confidence=confidence,
        diverged=int(np.sum(is_diverged & study.made)),
    )


def _recorded_times(study: Study, joint: int | str | None) -> np.ndarray:
    """The first exit of a joint, or of any joint if None, in each run, (N,) [s].

    Raises:
      ValueError: a study without the metric, or no such joint.
    """
    name = "first_violation_time"
    metric = "Margin"
    if joint is not None:
        names = plants.component_names(study.scenario.plant)
        if isinstance(joint, str) and joint in names:
            joint = names.index(joint)
        joint = checks.entry("joint", joint, study.scenario.n, "joints")
        name = "first_exit_time"
        metric = "FirstExit"
    if name not in study.metrics:
        remedy = f"Run the study with metrics=(ij.metrics.{metric}(),)."
        raise checks.fail("study.metrics", list(study.metrics), f"the metric {name}", remedy)
    times = np.asarray(study.metrics[name])
    if joint is None:
        return times
    return times[:, joint]
