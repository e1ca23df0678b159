"""The report on a tuning compares the gains before and after on fresh runs, which the tuning did
not use, or on the one nominal run where nothing is perturbed.

It contains torque, and gains at an end of their range, whatever the objective is: the best tracking
without a cost of torque needs more torque than any actuator has.

The scenario is run with both gains on the same fresh draws, so that the change of every number is a
mean of paired differences D_i with the interval

    mean(D) +- z std(D) / sqrt(N)

(for CVaR, D_i is the difference of the influence functions v + max(L_i - v, 0) / (1 - level), v the
quantile).  A change is called significant if that interval excludes zero.  A requirement is
satisfied with a probability: it passes if the upper Clopper-Pearson limit of its violation is
within what is allowed, fails if the lower limit is beyond, and is undecided otherwise.

Violated bounds come first, then requirements, the objective with its terms, and the rest.
`failures` explains which perturbation the failed runs have in common, and `step_check` repeats the
runs of the tuning at half the step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from iblf_jax.core.presentation import Content, Result
from iblf_jax.core.status import Status, has_flag
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.units import unit_text
from iblf_jax.studies.statistics import (
    Probability,
    probability,
    runs_without_event,
    scalar_samples,
)
from iblf_jax.tuning.failures import (
    FailedRuns,
    FreshRuns,
    drawn_leaves,
    failed_runs,
    is_outside,
)
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.options import Report, TuningRunOptions
from iblf_jax.tuning.quantities import OF_LIMIT
from iblf_jax.tuning.robust import Risk, worst_share
from iblf_jax.tuning.samples import (
    Sample,
    SampleRequest,
    is_random,
    sample_runs,
    uncertain_scenario,
)
from iblf_jax.tuning.step_check import ReportedQuantities, StepCheck

T = TypeVar("T")

LARGEST_PERCENTAGE = 100.0
"""Ratio of two values from which a report shows the factor and no percentage."""


@dataclasses.dataclass(frozen=True)
class Change:
    """One number before and after."""

    name: str
    before: float
    after: float
    low: float | None
    """Ends of the interval of after - before; None for a single run."""
    high: float | None

    @property
    def significant(self) -> bool | None:
        """Whether the interval excludes zero; None for a single run."""
        if self.low is None or self.high is None:
            return None
        return bool(self.low > 0 or self.high < 0)

    def __str__(self) -> str:
        text = f"{self.name}: {self.before:.5g} -> {self.after:.5g}"
        if self.before:
            text += f" ({_change_in_words(self.after / self.before)})"
        if self.low is None:
            return text
        verdict = "NOT significant: the interval contains zero"
        if self.significant:
            verdict = "significant"
        return f"{text}; change {self.low:.3g} to {self.high:.3g}; {verdict}"


def _change_in_words(ratio: float) -> str:
    """A ratio of two values as a percentage, or as a factor where it is large."""
    if abs(ratio) >= LARGEST_PERCENTAGE:
        return f"a factor of {ratio:.3g}"
    return f"{(ratio - 1) * 100:+.1f} %"


@dataclasses.dataclass(frozen=True)
class Verdict:
    """One requirement before and after."""

    name: str
    allowed: float
    before: Probability
    """Of a violation."""
    after: Probability
    verdict: str
    """"pass", "fail" or "undecided"."""
    value: float = float("nan")
    """Of the limited quantity, after: the mean over the worst allowed share of the runs; a margin
    as a margin."""
    limit: float = float("nan")
    unit: str = ""
    multiplier: float | None = None
    """Decrease of the tuning's objective for each unit by which the limit is loosened; None where
    it is not known."""
    event: str = "value"
    """"value", or "violated" for a limit of the probability that bounds are violated."""

    def __str__(self) -> str:
        return self._change_in_words() + self._value_in_words() + self._sensitivity_in_words()

    def _change_in_words(self) -> str:
        if self.after.runs == 1:
            words = ["broken" if x.count else "kept" for x in (self.before, self.after)]
            return f"{self.name}: {' -> '.join(words)}: {self.verdict}"
        text = (
            f"{self.name} (broken by at most {self.allowed:g} of the runs):"
            f" {self.before.estimate:.4g} -> {self.after}: {self.verdict}"
        )
        if self.runs_needed is None:
            return text
        return (
            f"{text}; no run broke it, but {self.runs_needed} such runs are needed to conclude that"
            f" with {self.after.confidence:.0%} confidence"
        )

    @property
    def runs_needed(self) -> int | None:
        """The number of runs, none of which breaks the requirement, that would decide it; None
        where it is decided or a run broke it.
        """
        if self.verdict != "undecided" or self.after.count or not self.allowed > 0:
            return None
        return runs_without_event(self.allowed, self.after.confidence)

    def _value_in_words(self) -> str:
        """The value; where each joint has a limit of its own, that of the worst joint relative to
        its limit.
        """
        if not np.isfinite(self.value):
            return ""
        if self.unit == OF_LIMIT:
            return f"; the worst joint is at {100 * self.value:.4g} % of its limit"
        what = "margin of the worst runs " if self.event == "violated" else ""
        text = f"; {what}{self.value:.5g} {self.unit}"
        if self.verdict != "fail":
            return text
        side = "above" if self.value > self.limit else "below"
        return f"{text}, {abs(self.value - self.limit):.3g} {self.unit} {side} the limit"

    def _sensitivity_in_words(self) -> str:
        multiplier = self.multiplier
        if multiplier is None or self.verdict == "fail" or not multiplier > LEAST_MULTIPLIER:
            return ""
        change = f"{multiplier:.3g} for each {self.unit} that the limit is"
        if self.unit == OF_LIMIT:
            change = f"{multiplier / 100:.3g} for each percent that the limits are"
        return f"; the objective would fall by {change} loosened by"


LEAST_MULTIPLIER = 1e-6
"""Smallest change of the objective by a unit of a limit that the report mentions."""
WORST_FIRST = {"fail": "FAILED", "undecided": "undecided", "pass": "passed"}
"""Verdicts in the order of a report -> the word in its headline."""


@dataclasses.dataclass(frozen=True, repr=False)
class TuningReport(Result):
    """Changes and verdicts, on fresh runs or on the nominal one; prints as text."""

    runs: int
    seed: int | None
    """Of the fresh draws; None for a single nominal run."""
    confidence: float
    changes: tuple[Change, ...]
    """The objective first, then its terms."""
    verdicts: tuple[Verdict, ...]
    violation: tuple[Probability, Probability]
    """Of bounds: probability that a run leaves them or diverges, before and after."""
    margin: tuple[float, float]
    """The smallest margin of all runs, before and after [rad]."""
    peak_torque: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    """The largest torque of all runs, joint by joint, before and after [N m]."""
    at_limits: tuple[str, ...] | None = None
    """The tuned numbers at an end of their range, in words; None where the ranges are not known."""
    step_check: StepCheck | None = None
    """All runs of the tuning, with the tuned gains, at dt and at dt / 2."""
    notes: tuple[str, ...] = ()
    """Why the search ended, and warnings."""
    quantities: ReportedQuantities = ReportedQuantities()
    """Names and units of margins and inputs."""
    failures: tuple[FailedRuns, ...] = ()
    """Fresh runs that failed with the tuned gains: those that left their bounds or diverged, then
    those that broke each requirement, with the most influential perturbation."""
    sampling_radius: tuple[float, float] | None = None
    """The largest `sampling_radius` of all runs, before and after; None for a continuous law."""
    unstable: tuple[int, int] = (0, 0)
    """Number of runs whose sampled loop is unstable, before and after."""

    @property
    def passed(self) -> bool:
        """Whether every requirement passed."""
        return all(v.verdict == "pass" for v in self.verdicts)

    @property
    def improved(self) -> bool:
        """Whether the objective is lower, and significantly so where there are several runs."""
        first = self.changes[0]
        return first.after < first.before and first.significant is not False

    @property
    def bounds_kept(self) -> bool:
        """Whether no run leaves its bounds or diverges with the tuned gains: of the report's runs,
        and of the tuning's runs at dt and at dt / 2.
        """
        check = self.step_check
        return not self.violation[1].count and not (check and any(check.violated))

    @property
    def failed(self) -> bool:
        """Whether bounds are violated more often than a requirement allows, or at all where none
        limits the probability, a requirement failed, or the runs of the tuning break one at dt / 2
        that they keep at dt.
        """
        check = self.step_check
        if any(v.verdict == "fail" for v in self.verdicts):
            return True
        if check is not None and check.newly_broken:
            return True
        allows_violations = any(v.event == "violated" for v in self.verdicts)
        return not (self.bounds_kept or allows_violations)

    @property
    def headline(self) -> str:
        """Bounds and requirements in a few words, what failed first."""
        left = self.violation[1]
        words = ["bounds kept"]
        if left.count:
            words = ["bounds VIOLATED"]
            if self.seed is not None:
                words = [f"bounds VIOLATED in {left.count} of {left.runs} runs"]
        elif not self.bounds_kept:
            words = ["bounds VIOLATED in the runs of the tuning"]
        for kind, text in WORST_FIRST.items():
            count = sum(v.verdict == kind for v in self.verdicts)
            if count:
                words.append(f"{count} of {len(self.verdicts)} requirements {text}")
        return "; ".join([*words, *self._numerical_failures()])

    def _numerical_failures(self) -> list[str]:
        """What fails at dt / 2, and where the sampled loop is unstable, in words."""
        words = []
        if self.step_check is not None and self.step_check.newly_broken:
            words.append("a requirement is BROKEN at dt / 2")
        if self.unstable[1]:
            words.append(f"the sampled loop is UNSTABLE in {self._unstable_in_words()}")
        return words

    @property
    def title(self) -> str:
        """The verdict in a sentence, what failed first: how many fresh runs keep the bounds, and
        how many are needed to claim more.
        """
        words = []
        failed = sum(v.verdict == "fail" for v in self.verdicts)
        if failed:
            words.append(f"{failed} of {len(self.verdicts)} requirements FAILED")
        left = self.violation[1]
        if not self.bounds_kept and not left.count:
            words.append("the runs of the tuning leave their bounds")
        elif self.seed is None:
            verb = "leaves" if left.count else "keeps"
            words.append(f"the nominal run {verb} its bounds")
        else:
            kept = left.runs - left.count
            words.append(f"{kept} of {left.runs} fresh runs keep the bounds")
        words += self._numerical_failures()
        open_ones = [v for v in self.verdicts if v.runs_needed is not None]
        if open_ones:
            strictest = max(open_ones, key=lambda v: v.runs_needed or 0)
            share = 100 * (1 - strictest.allowed)
            words.append(f"{strictest.runs_needed} runs are needed to claim {share:g} %")
        return "; ".join(words)

    def _content(self) -> Content:
        shown = self.quantities
        heading = "Report on one nominal run: no statistics"
        of_all = ""
        if self.seed is not None:
            heading = (
                f"Report on {self.runs} fresh runs (seed {self.seed}),"
                f" {self.confidence:.0%} confidence"
            )
            of_all = " of all runs"
        torques = [", ".join(f"{x:.5g}" for x in row) for row in self.peak_torque]
        rows = self._bounds_in_words()
        # The failed requirements are first, with the explanation of the runs that broke them, and
        # those that the tuning's runs break are last.
        for verdict in sorted(self.verdicts, key=lambda v: list(WORST_FIRST).index(v.verdict)):
            rows.append(f"requirement {verdict}")
            own = [x for x in self.failures if x.requirement == verdict.name]
            rows += [f"  {x.cause_in_words()}" for x in own]
        if self.step_check is not None:
            rows += self.step_check.warnings_of_requirements()
        rows += map(str, self.changes)
        objective = self.changes[0]
        if objective.significant is False:
            doubt = "these runs do not show that tuning helped."
            rows.append(f"The objective's change is not significant: {doubt}")
        elif objective.after > objective.before:
            rows.append("The objective went up.")
        rows.append(
            f"peak {shown.input}{of_all}, {shown.component} by {shown.component}:"
            f" {torques[0]} -> {torques[1]} {shown.input_unit}"
        )
        if self.at_limits is not None:
            rows += self.at_limits or ["gains at an end of their range: none"]
        if self.step_check is not None:
            rows.append(self.step_check.numbers_in_words())
        return [heading, *(f"  {row}" for row in (*rows, *self.notes))]

    def _bounds_in_words(self) -> list[str]:
        """Violated bounds with their explanation, those of the tuning's runs, the smallest margin,
        and the largest spectral radius of a sampled loop.
        """
        violated: list[Any] = list(self.violation)
        if self.seed is None:
            violated = [p.count for p in self.violation]
        bounds = f"bounds violated: {violated[0]} -> {violated[1]}"
        if self.violation[1].count:
            bounds += "; WARNING: with the tuned gains the bounds are not kept"
        check = self.step_check
        rows = [bounds, *(str(x) for x in self.failures if x.requirement is None)]
        if check is not None and (any(check.violated) or any(check.untrusted)):
            rows.append(check.bounds_in_words())
        margins = f"{self.margin[0]:.4g} -> {self.margin[1]:.4g} {self.quantities.margin_unit}"
        rows.append(f"smallest margin: {margins}")
        if self.sampling_radius is None:
            return rows
        before, after = self.sampling_radius
        row = f"largest sampling_radius: {before:.6g} -> {after:.6g}; stable below 1"
        if self.unstable[1]:
            row += (
                "; WARNING: with the tuned gains the sampled loop is unstable in"
                f" {self._unstable_in_words()}: narrow the ranges of its gains"
            )
        return [*rows, row]

    def _unstable_in_words(self) -> str:
        """The number of runs whose sampled loop is unstable with the tuned gains."""
        if self.seed is None:
            return "the nominal run"
        return f"{self.unstable[1]} of {self.runs} runs"

    def to_dict(self) -> dict[str, Any]:
        """Everything as numbers and strings."""
        changes = [{**dataclasses.asdict(c), "significant": c.significant} for c in self.changes]
        further = {"changes": changes, "headline": self.headline}
        return dataclasses.asdict(self) | further


class ReportRequest(NamedTuple):
    """What is reported on: a scenario before and after a tuning."""

    before: Scenario
    after: Scenario
    tuned: tuple[str, ...]
    """Paths of the tuned leaves."""
    objective: Objective
    """With scales and limits."""
    run: TuningRunOptions
    """As in the tuning, except for the number of runs and their seed."""
    report: Report
    """With a seed."""
    batch: int = 1
    """Runs in a batch of the search's values, whose compiled program is used again."""
    step_check: StepCheck | None = None
    """The runs of the tuning at half the step; the report contains none if not given."""
    at_limits: tuple[str, ...] | None = None
    """The tuned numbers at an end of their range, in words."""
    multipliers: tuple[float, ...] = ()
    """Of each requirement, by the unit of its limit; none if not known."""
    notes: tuple[str, ...] = ()
    """Further lines."""


def make_report(request: ReportRequest) -> TuningReport:
    """Runs both scenarios on the same fresh draws and compares them."""
    fresh = is_random(request.run)
    confidence = request.report.confidence
    draws = SampleRequest(
        scenario=request.before,
        tuned=request.tuned,
        objective=request.objective,
        options=request.run,
        dt=request.run.dt,
        runs=request.report.runs if fresh else 1,
        seed=int(request.report.seed or 0),
        batch=request.batch,
        nominal=not fresh,
    )
    before, after = samples = sample_runs(draws, (request.before, request.after))

    def each(function: Callable[[Sample], T]) -> tuple[T, T]:
        return function(before), function(after)

    return TuningReport(
        runs=int(np.sum(before.admissible & after.admissible)),
        seed=request.report.seed if fresh else None,
        confidence=confidence,
        changes=_changes(request, samples),
        verdicts=tuple(
            _verdict(request, r, samples) for r in range(len(request.objective.requirements))
        ),
        violation=each(lambda x: _probability(x.left_bounds(), x, confidence)),
        margin=each(lambda x: float(x.margin[x.admissible].min())),
        peak_torque=each(lambda x: tuple(x.torque[x.admissible].max(axis=0).tolist())),
        sampling_radius=None
        if request.after.sampling is None
        else each(lambda x: float(x.sampling_radius[x.admissible].max())),
        unstable=each(lambda x: int(np.sum(x.is_sampled_too_slowly()))),
        quantities=ReportedQuantities.of(request.before),
        at_limits=request.at_limits,
        step_check=request.step_check,
        notes=request.notes,
        failures=_failures(request, draws, after) if fresh else (),
    )


def _failures(
    request: ReportRequest, draws: SampleRequest, sample: Sample
) -> tuple[FailedRuns, ...]:
    """The explanations of fresh runs that failed with the tuned gains, bounds first."""
    objective = request.objective
    events: list[tuple[str | None, np.ndarray]] = [(None, sample.left_bounds())]
    for r, requirement in enumerate(objective.requirements):
        if requirement.event == "value":
            events.append((requirement.name, sample.is_broken(objective, r)))
    if not any(np.any(failed & sample.admissible) for _, failed in events):
        return ()
    cases, targets = uncertain_scenario(draws)
    point = {path: np.asarray(paths.get(request.after, path)) for path in request.tuned}
    index = np.arange(draws.runs, dtype=np.uint32)
    scenario = paths.with_parameters(cases.scenario, point)
    leaves = drawn_leaves(cases, point, index, targets=targets)
    fresh = FreshRuns(
        diverged=has_flag(sample.status, Status.NOT_FINITE),
        admissible=sample.admissible,
        started_outside=is_outside(scenario, leaves, draws.runs),
        numbers=scalar_samples(leaves),
        scenario=scenario,
    )
    found = [failed_runs(name, failed, fresh) for name, failed in events]
    return tuple(failure for failure in found if failure is not None)


# --------------------------------------------------------------------------------------- changes


def _changes(request: ReportRequest, samples: Sequence[Sample]) -> tuple[Change, ...]:
    """The objective first, then its terms."""
    risk: Any = request.run.risk
    confidence = request.report.confidence
    terms = request.objective.terms
    both = samples[0].admissible & samples[1].admissible
    before, after = (x.losses(request.objective)[both] for x in samples)
    is_cvar = risk.kind == "cvar"
    of_risk, of_mean = (f" (cvar {risk.level:g})" if is_cvar else f" ({risk.kind})"), " (mean)"
    if len(before) == 1:
        of_risk = of_mean = ""
    found = [_objective_change(risk, f"objective{of_risk}", before, after, confidence)]
    for i, term in enumerate(terms):
        found.append(_change(term.name + of_mean, before[:, i], after[:, i], confidence))
        if is_cvar and len(terms) > 1:
            tail = f"{term.name} (cvar {risk.level:g})"
            one = slice(i, i + 1)
            found.append(_objective_change(risk, tail, before[:, one], after[:, one], confidence))
    return tuple(found)


def _objective_change(
    risk: Risk, name: str, before: np.ndarray, after: np.ndarray, confidence: float
) -> Change:
    """The change of the risk of the sum of some terms, (N, k)."""
    first = before.sum(axis=1)
    last = after.sum(axis=1)
    if risk.kind == "worst" and len(first) > 1:
        return Change(name, float(first.max()), float(last.max()), None, None)
    return _change(name, influence(risk, first), influence(risk, last), confidence)


def influence(risk: Risk, losses: np.ndarray) -> np.ndarray:
    """Numbers whose mean is the risk of some losses, and whose spread gives its standard error."""
    if risk.kind != "cvar":
        return losses
    v = np.quantile(losses, risk.level)
    return v + np.maximum(losses - v, 0.0) / (1 - risk.level)


def _change(name: str, before: np.ndarray, after: np.ndarray, confidence: float) -> Change:
    if len(before) == 1:
        return Change(name, float(before[0]), float(after[0]), None, None)
    from scipy import stats  # a second to import

    difference = after - before
    half = stats.norm.ppf(0.5 + confidence / 2) * difference.std(ddof=1) / np.sqrt(len(difference))
    return Change(
        name,
        float(before.mean()),
        float(after.mean()),
        float(difference.mean() - half),
        float(difference.mean() + half),
    )


# -------------------------------------------------------------------------------------- verdicts


def _verdict(request: ReportRequest, r: int, samples: Sequence[Sample]) -> Verdict:
    """The verdict on requirement r."""
    requirement = request.objective.requirements[r]
    before, after = (
        _probability(x.is_broken(request.objective, r), x, request.report.confidence)
        for x in samples
    )
    allowed = float(requirement.allowed)
    # For a limited probability the constraint is on a margin: its multiplier is not the
    # sensitivity to the probability.
    multiplier = None
    if r < len(request.multipliers) and requirement.event == "value":
        multiplier = request.multipliers[r]
    sign, unit = requirement.measure
    last = samples[1]
    values = last.exact[last.admissible, len(request.objective.terms) + r]
    return Verdict(
        name=requirement.name,
        allowed=allowed,
        before=before,
        after=after,
        verdict=verdict_of(after, allowed),
        value=sign * float(worst_share(jnp.asarray(values), allowed)),
        limit=sign * float(requirement.limit),
        unit=unit_text(request.before, unit),
        multiplier=multiplier,
        event=requirement.event,
    )


def _probability(event: np.ndarray, sample: Sample, confidence: float) -> Probability:
    return probability(event, sample.admissible, confidence, "independent", 1)


def verdict_of(p: Probability, allowed: float) -> str:
    """pass, fail or undecided."""
    if p.runs == 1 or p.low is None or p.high is None:
        return "fail" if p.count else "pass"
    if p.high <= allowed:
        return "pass"
    if p.low > allowed:
        return "fail"
    return "undecided"
