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
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.status import Status, has_flag
from iblf_jax.engine import RunRequest, report_runs_per_batch
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.draws import UncertainScenario, targets_of
from iblf_jax.studies.statistics import Probability, probability
from iblf_jax.studies.study import VIOLATED
from iblf_jax.studies.time_step import warn_of_step
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.options import Report, TuningRunOptions
from iblf_jax.tuning.quantities import OF_LIMIT
from iblf_jax.tuning.robust import Risk, worst_share
from iblf_jax.tuning.rollouts import Rollouts, draw_runs, rollouts
from iblf_jax.tuning.runs import in_groups


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
            text += f" ({(self.after / self.before - 1) * 100:+.1f} %)"
        if self.low is None:
            return text
        verdict = "NOT significant: the interval contains zero"
        if self.significant:
            verdict = "significant"
        return f"{text}; change {self.low:.3g} to {self.high:.3g}; {verdict}"


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
        if self.verdict != "undecided" or self.after.count or not self.allowed > 0:
            return text
        confidence = self.after.confidence
        needed = int(np.ceil(np.log((1 - confidence) / 2) / np.log1p(-self.allowed)))
        return (
            f"{text}; no run broke it, but {needed} such runs are needed to conclude that with"
            f" {confidence:.0%} confidence"
        )

    def _value_in_words(self) -> str:
        """The value; where each joint has a limit of its own, that of the worst joint relative to
        its limit.
        """
        if not np.isfinite(self.value):
            return ""
        if self.unit == OF_LIMIT:
            return f"; the worst joint is at {100 * self.value:.4g} % of its limit"
        text = f"; {self.value:.5g} {self.unit}"
        if self.verdict != "fail":
            return text
        side = "above" if self.value > self.limit else "below"
        return f"{text}, {abs(self.value - self.limit):.3g} {self.unit} {side} the limit"

    def _sensitivity_in_words(self) -> str:
        multiplier = self.multiplier
        if multiplier is None or self.verdict == "fail" or not multiplier > 0:
            return ""
        change = f"{multiplier:.3g} for each {self.unit} that the limit is"
        if self.unit == OF_LIMIT:
            change = f"{multiplier / 100:.3g} for each percent that the limits are"
        return f"; the objective would fall by {change} loosened by"


WORST_FIRST = ("fail", "undecided", "pass")
"""Verdicts in the order of a report."""


@dataclasses.dataclass(frozen=True)
class TuningReport:
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
    halved: str = ""
    """The nominal run with the tuned gains at dt / 2, in words."""
    notes: tuple[str, ...] = ()
    """Why the search ended, and warnings."""

    @property
    def passed(self) -> bool:
        """Whether every requirement passed."""
        return all(v.verdict == "pass" for v in self.verdicts)

    @property
    def improved(self) -> bool:
        """Whether the objective is lower, and significantly so where there are several runs."""
        first = self.changes[0]
        return first.after < first.before and first.significant is not False

    def __str__(self) -> str:
        """Bounds first, then requirements, the objective, and the rest."""
        heading = "Report on one nominal run: no statistics"
        violated: list[Any] = [p.count for p in self.violation]
        of_all = ""
        if self.seed is not None:
            heading = (
                f"Report on {self.runs} fresh runs (seed {self.seed}),"
                f" {self.confidence:.0%} confidence"
            )
            violated = list(self.violation)
            of_all = " of all runs"
        bounds = f"bounds violated: {violated[0]} -> {violated[1]}"
        if self.violation[1].count:
            bounds += "; WARNING: with the tuned gains the bounds are not kept"
        verdicts = sorted(self.verdicts, key=lambda verdict: WORST_FIRST.index(verdict.verdict))
        torques = [", ".join(f"{x:.5g}" for x in row) for row in self.peak_torque]
        rows = [
            bounds,
            f"smallest margin: {self.margin[0]:.4g} -> {self.margin[1]:.4g} rad",
            *(f"requirement {verdict}" for verdict in verdicts),
            *map(str, self.changes),
            *self._doubts(),
            f"peak torque{of_all}, joint by joint: {torques[0]} -> {torques[1]} N m",
        ]
        if self.at_limits is not None:
            rows += self.at_limits or ["gains at an end of their range: none"]
        rows += [words for words in (self.halved, *self.notes) if words]
        return "\n  ".join([heading, *rows])

    def _doubts(self) -> list[str]:
        """What to say about the objective where it did not become lower."""
        objective = self.changes[0]
        if objective.significant is False:
            doubt = "these runs do not show that tuning helped."
            return [f"The objective's change is not significant: {doubt}"]
        if objective.after > objective.before:
            return ["The objective went up."]
        return []

    __repr__ = __str__

    def to_dict(self) -> dict[str, Any]:
        """Everything as numbers and strings."""
        changes = [{**dataclasses.asdict(c), "significant": c.significant} for c in self.changes]
        return dataclasses.asdict(self) | {"changes": changes}


LARGEST_DIFFERENCE = 0.01
"""Of the objective at half the step, relative, before the report warns."""


class _Sample(NamedTuple):
    """The numbers of N runs with one set of gains that a report needs."""

    exact: np.ndarray
    """Each quantity of the objective, and minus the margin, (N, K + 1)."""
    torque: np.ndarray
    """The largest of each joint, (N, n)."""
    status: np.ndarray
    admissible: np.ndarray
    """Whether the draws of the run were admissible; the others do not count, (N,)."""

    @property
    def margin(self) -> np.ndarray:
        """Of each run, (N,) [rad]."""
        return -self.exact[:, -1]

    def left_bounds(self) -> np.ndarray:
        """Whether each run left its bounds or diverged, (N,)."""
        return has_flag(self.status, VIOLATED)


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
    at_limits: tuple[str, ...] | None = None
    """The tuned numbers at an end of their range, in words."""
    multipliers: tuple[float, ...] = ()
    """Of each requirement, by the unit of its limit; none if not known."""
    notes: tuple[str, ...] = ()
    """Further lines."""


def make_report(request: ReportRequest) -> TuningReport:
    """Runs both scenarios on the same fresh draws and compares them."""
    is_perturbed = bool(request.run.perturbations)
    confidence = request.report.confidence
    dt = request.run.dt
    before, after = samples = _fresh_runs(
        request, (request.before, request.after), request.report.runs if is_perturbed else 0, dt
    )
    full = after
    if is_perturbed:
        (full,) = _fresh_runs(request, (request.after,), 0, dt)
    (half,) = _fresh_runs(request, (request.after,), 0, 0.5 * dt)

    def each(function: Any) -> tuple[Any, Any]:
        return function(before), function(after)

    return TuningReport(
        runs=int(np.sum(before.admissible & after.admissible)),
        seed=request.report.seed if is_perturbed else None,
        confidence=confidence,
        changes=_changes(request, samples),
        verdicts=tuple(
            _verdict(request, r, samples) for r in range(len(request.objective.requirements))
        ),
        violation=each(lambda x: _probability(x.left_bounds(), x, confidence)),
        margin=each(lambda x: float(x.margin[x.admissible].min())),
        peak_torque=each(lambda x: tuple(x.torque[x.admissible].max(axis=0).tolist())),
        at_limits=request.at_limits,
        halved=_at_half_the_step(request.objective, full, half),
        notes=request.notes,
    )


def _fresh_runs(
    request: ReportRequest, scenarios: Sequence[Scenario], runs: int, dt: float
) -> list[_Sample]:
    """The runs of each scenario on the same draws: so many drawn ones, or the nominal one where
    `runs` is 0.

    They are made by the program of a search's values.  The nominal run replaces the perturbed
    leaves too, so that one kernel serves all.
    """
    scenario = canonical(request.before)
    dtype = scenario.initial.q.dtype
    targets, by_path = targets_of(scenario, request.run.perturbations or {})
    arrays = by_path, request.objective, dt
    by_path, objective, step = jax.tree.map(lambda x: jnp.asarray(x, dtype), arrays)
    cases = UncertainScenario(scenario, by_path, jax.random.PRNGKey(int(request.report.seed or 0)))
    method = request.run.method
    steps = checks.whole_steps(request.run.duration, dt)
    of_run = RunRequest.of(scenario, steps=steps, method=method, backend=request.run.backend)
    points = {
        path: np.stack([np.asarray(paths.get(s, path), dtype) for s in scenarios])
        for path in request.tuned
    }
    index = np.tile(np.arange(runs or 1, dtype=np.uint32), len(scenarios))
    owner = np.repeat(np.arange(len(scenarios)), runs or 1)

    def run(rows: np.ndarray) -> tuple[Rollouts, jax.Array]:
        own = {path: x[owner[rows]] for path, x in points.items()}
        varied, admissible = draw_runs(cases, own, index[rows], targets=targets, nominal=not runs)
        return rollouts(scenario, varied, objective, step, request=of_run), admissible

    batch = report_runs_per_batch(runs * len(scenarios) * steps, request.batch)
    found, admissible = in_groups(run, len(owner), batch)
    if len(scenarios) > 1:  # once in a report
        warn_of_step(found.status, found.fastest_mode, found.relative_error, dt, method)
    samples = _Sample(found.exact, found.peak_torque, found.status, admissible)
    return [_Sample(*(x[owner == s] for x in samples)) for s in range(len(scenarios))]


# --------------------------------------------------------------------------------------- changes


def _changes(request: ReportRequest, samples: Sequence[_Sample]) -> tuple[Change, ...]:
    """The objective first, then its terms."""
    risk: Any = request.run.risk
    confidence = request.report.confidence
    terms = request.objective.terms
    both = samples[0].admissible & samples[1].admissible
    before, after = (_terms(request.objective, x.exact[both]) for x in samples)
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


def _terms(objective: Objective, exact: np.ndarray) -> np.ndarray:
    """The value of each term in each run, (N, n_terms)."""
    columns = [t.value(jnp.asarray(exact[:, i])) for i, t in enumerate(objective.terms)]
    return np.stack([np.asarray(x) for x in columns], axis=1)


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


def _verdict(request: ReportRequest, r: int, samples: Sequence[_Sample]) -> Verdict:
    """The verdict on requirement r."""
    requirement = request.objective.requirements[r]
    before, after = (
        _probability(_broken(request.objective, r, x), x, request.report.confidence)
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
        unit=unit,
        multiplier=multiplier,
    )


def _probability(event: np.ndarray, sample: _Sample, confidence: float) -> Probability:
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


def _broken(objective: Objective, r: int, sample: _Sample) -> np.ndarray:
    """Whether each run violates a requirement, (N,)."""
    requirement = objective.requirements[r]
    if requirement.event == "violated":
        return sample.left_bounds()
    values = jnp.asarray(sample.exact[:, len(objective.terms) + r])
    satisfied = np.asarray(requirement.excess(values)) < 0
    return ~satisfied | has_flag(sample.status, Status.NOT_FINITE)


def _at_half_the_step(objective: Objective, full: _Sample, half: _Sample) -> str:
    """The nominal run at dt and at dt / 2, in words: a result that depends on the step is not
    valid.
    """
    value_full, value_half = (float(_terms(objective, x.exact[:1]).sum()) for x in (full, half))
    text = (
        f"the nominal run at dt / 2: objective {value_half:.5g} instead of {value_full:.5g},"
        f" smallest margin {half.margin[0]:.4g} rad, peak torque {np.max(half.torque):.5g} N m"
    )
    requirements = range(len(objective.requirements))
    broken_full, broken_half = (
        [_broken(objective, r, x)[0] for r in requirements] for x in (full, half)
    )
    if any(b and not a for a, b in zip(broken_full, broken_half, strict=True)):
        remedy = "a requirement is broken there: leave it some room, or take a smaller dt"
        return f"WARNING: {text}; {remedy}"
    if abs(value_half - value_full) > LARGEST_DIFFERENCE * abs(value_full):
        return f"WARNING: {text}, more than {LARGEST_DIFFERENCE:.0%} apart: take a smaller dt"
    return text
