"""The result of `ij.failure_probability`."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.first_use import xarray
from iblf_jax.core.presentation import Content, Result, present
from iblf_jax.core.status import describe
from iblf_jax.core.tables import as_text
from iblf_jax.engine import RunRequest, run_rollout
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.units import status_words
from iblf_jax.studies.distributions import Perturbation, joint_samples, value
from iblf_jax.studies.rare_events.limit_state import Level, stagnate

GROUP = "rare draws"
"""Name of the draw that the leaves of `rare_draws` share."""
NUMBERS_SHOWN = 8
"""Numbers of the most likely failure that the text lists."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class LikelyFailure(Result):
    """The most likely draw that was found to fail: the failure nearest to the origin of standard
    normal coordinates.
    """

    scenario: Scenario
    """With the values in it."""
    values: dict[str, np.ndarray]
    """Path -> value, in the unit of the leaf."""
    z: np.ndarray
    """Standard normal numbers, (d,)."""
    names: tuple[str, ...]
    """What each of them belongs to, d paths."""
    margin: float
    """Of the run, above the limit; not positive, unless the run diverged before it failed."""
    status: int
    """Flags of `Status` of the run."""
    request: RunRequest
    """What is run."""
    dt: jax.Array
    """Time step, () [s]."""
    noise: jax.Array | None
    """Key of the noise of the run; None for a scenario without noise."""

    @property
    def distance(self) -> float:
        """Distance |z| from the origin, beta; Phi(-beta) is the probability of a half space at this
        distance.
        """
        return float(np.linalg.norm(self.z))

    def replay(self, record_every: int = 1) -> Rollout:
        """The run with its whole trajectory, with the same noise.

        Args:
          record_every: steps between two records.
        """
        every = checks.recorded_every(record_every, self.request.steps)
        request = self.request._replace(record_every=every)
        folds = as_folds(None, self.dt.dtype, self.scenario)
        return run_rollout(self.scenario, folds, self.dt, request, self.noise)

    def _content(self) -> Content:
        order = np.argsort(-np.abs(self.z))[:NUMBERS_SHOWN]
        rows = [("", self.names[i], f"{self.z[i]:+.2f} standard deviations") for i in order]
        left_out = len(self.z) - len(order)
        more = [f"  and {left_out} numbers that deviate less"] if left_out else []
        return [f"LikelyFailure({self.run_in_words()})", *as_text(rows, left=(0, 1)), *more]

    def run_in_words(self) -> str:
        """Distance, margin and flags of the run."""
        flags = describe(self.status, status_words(self.scenario))
        return f"distance {self.distance:.3f}, margin {self.margin:.3g}; {flags}"


@dataclasses.dataclass(frozen=True, eq=False)
class FailureSamples:
    """Draws with their margins and weights; k of them."""

    z: np.ndarray
    """Standard normal numbers, (k, d)."""
    values: dict[str, np.ndarray]
    """Path -> values, (k, ...), in the unit of the leaf."""
    margins: np.ndarray
    """Above the limit, (k,)."""
    weights: np.ndarray
    """What each counts, (k,); equal for subset simulation and Monte-Carlo."""

    def __len__(self) -> int:
        return len(self.margins)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class FailureProbability(Result):
    """The probability that a run fails, with its interval; printed as sentences."""

    estimate: float
    """The probability; an upper bound at the confidence of the interval if no sample failed
    (`is_upper_bound`)."""
    interval: tuple[float, float]
    """Log-normal, from the coefficient of variation; that of Clopper and Pearson for independent
    draws."""
    confidence: float
    """Of the interval."""
    coefficient_of_variation: float
    """Estimated standard deviation of the estimate, divided by it; infinite if no sample failed."""
    is_upper_bound: bool
    """Whether no sample failed."""
    runs: int
    """Number of runs, those of the search for the most likely failure included."""
    levels: tuple[Level, ...]
    """Of subset simulation: threshold, conditional probability and margins of each level; one for
    the other methods."""
    most_likely_failure: LikelyFailure | None
    """The search may find one also if no sample failed; None if none was found."""
    failures: FailureSamples
    """The draws that failed."""
    nearby: FailureSamples
    """Draws near failure, to be used again: the samples of the last level, or the failures."""
    nearby_probability: float
    """Estimated probability of the set that they are samples of."""
    names: tuple[str, ...]
    """What each of the d standard normal numbers belongs to, a path."""
    nominal_margin: float
    """Margin of the run at z = 0, the medians of all draws, above the limit."""
    effective_samples: float
    """Number of equally weighted independent failures with the same information."""
    excluded: int
    """Number of draws that could not be run (`Status.INADMISSIBLE_DRAW`); the probability is one
    given that a draw can be run."""
    diverged: int
    """Number of runs that diverged, which count as failures."""
    started_outside: int
    """Number of failures that were drawn outside their bounds at t = 0, where no law can act."""
    notes: tuple[str, ...]
    """What limits the estimate, in sentences."""
    check: str
    """What a second method saw of the failures, in a sentence: importance sampling around the
    design points for subset simulation, and the reverse."""
    design_points: np.ndarray
    """The nearest failures that searches by gradients found, nearest first, (K, d); the samples of
    importance sampling are around them."""
    estimator: str
    """What gave the estimate: "subset", "importance", or "monte_carlo", which is also
    that of a probability so large that subset simulation needs no second level."""
    unit: str
    """Of the margins."""
    arguments: dict[str, Any]
    """Keyword arguments of the call: `ij.failure_probability(scenario, perturbations,
    **arguments)` makes the same estimate for another scenario."""

    @property
    def margins_stagnate(self) -> bool:
        """Whether the levels of subset simulation ended at a margin above the limit without a
        failure. `estimate` then only counts levels, and the probability may be 0.
        """
        return self.is_upper_bound and self.estimator == "subset" and stagnate(self.levels)

    @property
    def rare_draws(self) -> dict[str, Perturbation]:
        """The draws near failure as perturbations, for `tune` or `monte_carlo`: path -> `value` of
        `joint_samples`.

        Raises:
          ValueError: there are none, because no sample failed.
        """
        if not len(self.nearby):
            remedy = "Take more runs, or estimator='subset'."
            raise checks.fail(
                "rare_draws", "an estimate without them", "draws near failure", remedy
            )
        weights = self.nearby.weights
        return {
            path: value(joint_samples(x, GROUP, weights)) for path, x in self.nearby.values.items()
        }

    def plot(self, **options: Any) -> Any:
        """Figure: the probability of each margin through the levels, and the most likely failure.
        Options as `plotting.failure_probability`.
        """
        return present("failure figure", self, **options)

    def to_xarray(self) -> xarray.Dataset:
        """Levels along `level`, failures along `failure`: z, margins, weights, and the drawn
        values.
        """
        levels = {
            "threshold": [x.threshold for x in self.levels],
            "conditional_probability": [x.probability for x in self.levels],
            "level_variation": [x.coefficient_of_variation for x in self.levels],
            "acceptance": [x.acceptance for x in self.levels],
        }
        variables: dict[str, Any] = {name: ("level", x) for name, x in levels.items()}
        variables["threshold"] = ("level", levels["threshold"], {"units": self.unit})
        coordinates = {"number": list(self.names)}
        failures = self.failures
        variables["z"] = (("failure", "number"), failures.z)
        variables["failure_margin"] = ("failure", failures.margins, {"units": self.unit})
        variables["weight"] = ("failure", failures.weights)
        for path, x in failures.values.items():
            entries = [f"{path}_{k}" for k in range(x.ndim - 1)]
            variables[path] = (("failure", *entries), x)
        attributes = {
            "estimator": self.estimator,
            "estimate": self.estimate,
            "interval": list(self.interval),
            "confidence": self.confidence,
            "coefficient_of_variation": self.coefficient_of_variation,
            "is_upper_bound": int(self.is_upper_bound),
            "margins_stagnate": int(self.margins_stagnate),
            "runs": self.runs,
            "excluded": self.excluded,
            "diverged": self.diverged,
            "started_outside": self.started_outside,
            "notes": "\n".join(self.notes),
            "check": self.check,
        }
        return xarray.Dataset(variables, coordinates, attributes)

    def _content(self) -> Content:
        low, high = self.interval
        confidence = f"{100 * self.confidence:g}%"
        if self.margins_stagnate:
            first = (
                f"FailureProbability(no failure reachable was found in {self.runs} runs; the"
                f" margins stagnate at {self.levels[-1].threshold:.4g} {self.unit})"
            )
        elif self.is_upper_bound:
            first = (
                f"FailureProbability(no sample failed in {self.runs} runs; at most"
                f" {self.estimate:.2g} with {confidence} confidence)"
            )
        else:
            first = (
                f"FailureProbability({self.estimate:.3g}, {confidence} interval {low:.2g} to"
                f" {high:.2g}, coefficient of variation {self.coefficient_of_variation:.2f};"
                f" {self.runs} runs)"
            )
        lines = [first, f"  {self._method_in_words()}", f"  {self.check}"]
        notes = [f"  {note}" for note in self.notes]
        if self.is_upper_bound:  # the notes say what the bound is about
            lines[1:1] = notes
            notes = []
        if self.most_likely_failure is not None:
            found = self.most_likely_failure
            lines.append(f"  The most likely failure found: {found.run_in_words()}")
            lines += [f"  {line}" for line in repr(found).splitlines()[1:]]
        counts = {
            "draws could not be run and are excluded": self.excluded,
            "runs diverged and count as failures": self.diverged,
            "of the sampled failures started outside their bounds": self.started_outside,
        }
        lines += [f"  {count} {words}." for words, count in counts.items() if count]
        return [*lines, *notes]

    def _method_in_words(self) -> str:
        if self.estimator == "importance":
            return f"Importance sampling with {self.effective_samples:.0f} effective failures."
        if self.estimator == "subset":
            thresholds = ", ".join(f"{level.threshold:.3g}" for level in self.levels)
            return (
                f"Subset simulation with {len(self.levels)} levels, at margins {thresholds}"
                f" {self.unit}."
            )
        return f"{len(self.failures)} failures among independent draws."
