"""The verdict on a tuning: before and after, on runs that it never saw; on the one nominal run
where nothing is perturbed.

Torque, and gains at the end of their range, are in it whatever the objective asked for: what tracks
best without a price on torque asks for more than any actuator has.

Both gains are run on the same fresh draws, so that the change of every number is a mean of paired
differences D_i with the interval

    mean(D) +- z std(D) / sqrt(N)

(for CVaR, D_i is the difference of the influence functions v + max(L_i - v, 0) / (1 - level), v the
quantile).  A change is called significant if that interval excludes zero, and not otherwise, in
words.  A requirement is kept with probability: it passes if the upper Clopper-Pearson limit of its
  breaking is within what is allowed, fails if the lower one is beyond, and is undecided between.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, devices
from iblf_jax.core.status import Status
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.draws import Cases, targets_of
from iblf_jax.studies.recommended import warn_of_step
from iblf_jax.studies.statistics import Probability, probability
from iblf_jax.studies.study import VIOLATED
from iblf_jax.tuning.evaluation import Rollouts, drawn, rollouts
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.quantities import OF_LIMIT
from iblf_jax.tuning.robust import Risk, worst_share
from iblf_jax.tuning.runs import Run, fresh_together, known_of


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
        return (
            None if self.low is None or self.high is None else bool(self.low > 0 or self.high < 0)
        )

    def __str__(self) -> str:
        part = f" ({(self.after / self.before - 1) * 100:+.1f} %)" if self.before else ""
        text = f"{self.name}: {self.before:.5g} -> {self.after:.5g}{part}"
        if self.low is None:
            return text
        verdict = "significant" if self.significant else "NOT significant: the interval holds zero"
        return f"{text}; change {self.low:.3g} to {self.high:.3g}; {verdict}"


@dataclasses.dataclass(frozen=True)
class Verdict:
    """One requirement before and after."""

    name: str
    allowed: float
    before: Probability
    """How often it was broken."""
    after: Probability
    verdict: str
    """"pass", "fail" or "undecided"."""
    value: float = float("nan")
    """What is limited, after: the mean over the worst allowed share of the runs; a margin as a
    margin."""
    limit: float = float("nan")
    unit: str = ""
    price: float | None = None
    """By how much the objective of the tuning would fall if the limit were loosened by one unit;
    None where that is not known."""

    def __str__(self) -> str:
        text = self._verdict()
        if np.isfinite(self.value):
            text += self._of_limits() if self.unit == OF_LIMIT else self._of_units()
        if self.price is not None and self.verdict != "fail" and self.price > 0:
            text += self._price_in_words(self.price)
        return text

    def _of_units(self) -> str:
        text = f"; {self.value:.5g} {self.unit}"
        if self.verdict != "fail":
            return text
        away = self.value - self.limit
        return f"{text}, {abs(away):.3g} {self.unit} {'above' if away > 0 else 'below'} the limit"

    def _of_limits(self) -> str:
        """Where each joint has a limit of its own, the value is that of the worst joint, in
        limits.
        """
        return f"; the worst joint is at {100 * self.value:.4g} % of its limit"

    def _price_in_words(self, price: float) -> str:
        if self.unit == OF_LIMIT:
            return (
                f"; the objective would fall by {price / 100:.3g} for each percent that the limits"
                " are loosened by"
            )
        return (
            f"; the objective would fall by {price:.3g} for each {self.unit} that the limit is"
            " loosened by"
        )

    def _verdict(self) -> str:
        if self.after.runs == 1:
            return (
                f"{self.name}: {'broken' if self.before.count else 'kept'} ->"
                f" {'broken' if self.after.count else 'kept'}: {self.verdict}"
            )
        text = (
            f"{self.name} (broken by at most {self.allowed:g} of the runs):"
            f" {self.before.estimate:.4g} -> {self.after}: {self.verdict}"
        )
        if self.verdict == "undecided" and self.after.count == 0 and self.allowed > 0:
            need = int(np.ceil(np.log((1 - self.after.confidence) / 2) / np.log1p(-self.allowed)))
            text += (
                f"; not one run broke it, but {need} such runs are needed to say so with"
                f" {self.after.confidence:.0%} confidence"
            )
        return text


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
    """How often a run left its bounds or ran away, before and after."""
    margin: tuple[float, float]
    """The smallest margin of all runs, before and after [rad]."""
    peak_torque: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    """The largest torque of all runs, joint by joint, before and after [N m]."""
    at_limits: tuple[str, ...] | None = None
    """The tuned numbers that sit at an end of their range, in words; None where the ranges are not
    known."""
    halved: str = ""
    """What the nominal run with the tuned gains gives at dt / 2, in words."""
    notes: tuple[str, ...] = ()
    """How the search ended, and warnings."""

    @property
    def passed(self) -> bool:
        """Whether every requirement passed."""
        return all(v.verdict == "pass" for v in self.verdicts)

    @property
    def improved(self) -> bool:
        """Whether the objective is lower, significantly so where there are runs to tell."""
        first = self.changes[0]
        return first.after < first.before and first.significant is not False

    def __str__(self) -> str:
        """What matters first: bounds, then requirements, then the objective, then the rest."""
        sections = (
            self._of_bounds(),
            self._of_requirements(),
            self._of_objective(),
            self._of_gains(),
        )
        rows = [f"  {row}" for section in sections for row in section]
        return "\n".join([self._heading(), *rows])

    def _heading(self) -> str:
        if self.seed is None:
            return "Report on one nominal run: no statistics"
        runs = f"{self.runs} fresh runs (seed {self.seed})"
        return f"Report on {runs}, {self.confidence:.0%} confidence"

    def _of_bounds(self) -> list[str]:
        """How often bounds were violated, and the smallest margin."""
        before, after = (p.count if self.seed is None else p for p in self.violation)
        violated = f"bounds violated: {before} -> {after}"
        if self.violation[1].count:
            violated += "; WARNING: with the tuned gains the bounds are not kept"
        return [violated, f"smallest margin: {self.margin[0]:.4g} -> {self.margin[1]:.4g} rad"]

    def _of_requirements(self) -> list[str]:
        """The requirements, those that failed first."""
        ordered = sorted(self.verdicts, key=lambda verdict: WORST_FIRST.index(verdict.verdict))
        return [f"requirement {verdict}" for verdict in ordered]

    def _of_objective(self) -> list[str]:
        """The objective and its terms, and what their change is worth."""
        whole = self.changes[0]
        rows = [str(change) for change in self.changes]
        if whole.significant is False:
            doubt = "these runs do not show that tuning helped."
            rows.append(f"The objective's change is not significant: {doubt}")
        elif whole.after > whole.before:
            rows.append("The objective went up.")
        return rows

    def _of_gains(self) -> list[str]:
        """Torque, gains at the end of their range, the run at half the step, the search's end."""
        torques = [", ".join(f"{x:.5g}" for x in row) for row in self.peak_torque]
        of_all = "" if self.seed is None else " of all runs"
        rows = [f"peak torque{of_all}, joint by joint: {torques[0]} -> {torques[1]} N m"]
        if self.at_limits is not None:
            rows += self.at_limits or ["gains at an end of their range: none"]
        return [*rows, *(words for words in (self.halved, *self.notes) if words)]

    __repr__ = __str__

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain numbers and strings."""
        out = dataclasses.asdict(self)
        out["changes"] = [
            {**dataclasses.asdict(c), "significant": c.significant} for c in self.changes
        ]
        return out


APART = 0.01
"""By how much the objective may differ at half the step before the report warns."""


class _Sample(NamedTuple):
    """What a report needs of N runs with one set of gains."""

    exact: np.ndarray
    """Of each quantity of the objective, and minus the margin, (N, K + 1)."""
    torque: np.ndarray
    """The largest of each joint, (N, n)."""
    status: np.ndarray
    made: np.ndarray

    @property
    def margin(self) -> np.ndarray:
        """Of each run, (N,) [rad]."""
        return -self.exact[:, -1]


def _run(
    scenarios: Sequence[Scenario],
    tuned: Sequence[str],
    objective: Objective,
    perturbations,
    runs: int,
    seed: int,
    timing: dict[str, Any],
    backend: str,
    together: int,
) -> list[_Sample]:
    """The same runs of scenarios that differ in what was tuned: drawn ones, or the nominal one
    where `runs` is 0, so many together.

    They are made by the program of a search's values, and the nominal one replaces what is drawn
    too: one kernel does for all.
    """
    first = canonical(scenarios[0])
    dtype, (targets, by_path) = first.initial.q.dtype, targets_of(first, perturbations or {})
    by_path, objective, dt = jax.tree.map(
        lambda x: jnp.asarray(x, dtype), (by_path, objective, timing["dt"])
    )
    cases = Cases(first, by_path, jax.random.PRNGKey(seed))
    run = Run(
        checks.whole_steps(timing["duration"], timing["dt"]),
        timing["method"],
        mechanism=known_of(first),
    )
    points = {
        path: np.stack([np.asarray(paths.get(s, path), dtype) for s in scenarios]) for path in tuned
    }
    index, of = (
        np.tile(np.arange(runs or 1, dtype=np.uint32), len(scenarios)),
        np.repeat(np.arange(len(scenarios)), runs or 1),
    )
    parts = []
    for begin in range(0, len(of), together):
        rows = np.resize(np.arange(len(of))[begin : begin + together], together)
        varied, made = drawn(
            cases,
            {path: x[of[rows]] for path, x in points.items()},
            index[rows],
            targets=targets,
            nominal=not runs,
        )
        parts.append(
            jax.tree.map(
                np.asarray, (rollouts(first, varied, objective, dt, run=run, backend=backend), made)
            )
        )
    whole: tuple[Rollouts, np.ndarray] = jax.tree.map(
        lambda *x: np.concatenate(x)[: len(of)], *parts
    )
    found, made = whole
    if len(scenarios) > 1:  # once a report
        warn_of_step(
            found.status, found.fastest_mode, found.relative_error, timing["dt"], timing["method"]
        )
    each = (
        x.reshape(len(scenarios), -1, *x.shape[1:])
        for x in (found.exact, found.peak_torque, found.status, made)
    )
    return [_Sample(*x) for x in zip(*each, strict=True)]


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


def verdict_of(p: Probability, allowed: float) -> str:
    """pass, fail or undecided."""
    if p.runs == 1 or p.low is None or p.high is None:
        return "fail" if p.count else "pass"
    return "pass" if p.high <= allowed else "fail" if p.low > allowed else "undecided"


def _broken(objective: Objective, r: int, sample: _Sample) -> np.ndarray:
    requirement = objective.requirements[r]
    left = sample.status & int(VIOLATED) != 0
    if requirement.event == "violated":
        return left
    return ~(
        np.asarray(requirement.excess(jnp.asarray(sample.exact[:, len(objective.terms) + r]))) < 0
    ) | (sample.status & int(Status.NOT_FINITE) != 0)


def make_report(
    before: Scenario,
    after: Scenario,
    tuned: Sequence[str],
    objective: Objective,
    perturbations: Any,
    *,
    runs: int,
    seed: int,
    risk: Risk,
    confidence: float,
    timing: dict[str, Any],
    backend: str = "auto",
    together: int = 1,
    at_limits: tuple[str, ...] | None = None,
    prices: tuple[float, ...] = (),
    notes: tuple[str, ...] = (),
) -> TuningReport:
    """Runs both scenarios on the same fresh draws and compares them.

    Args:
      before, after: the scenario with its starting gains and with the tuned ones.
      tuned: paths of these.
      objective: complete, with scales and limits.
      perturbations: path -> perturbation; one nominal run if empty.
      runs, seed: of the fresh draws.
      risk: how the objective combines runs.
      confidence: of the intervals.
      timing: duration, dt, method.
      backend: what the runs run on.
      together: how many runs a search made at once for its values: what is compiled serves again.
      at_limits: the tuned numbers at an end of their range, in words.
      prices: of each requirement, by the unit of its limit; none if not known.
      notes: lines for the reader.
    """

    def made(scenarios: tuple[Scenario, ...], runs: int, dt: float) -> list[_Sample]:
        steps = runs * len(scenarios) * checks.whole_steps(timing["duration"], dt)
        at_once = fresh_together(devices.platform(), steps, together)
        return _run(
            scenarios,
            tuned,
            objective,
            perturbations,
            runs,
            seed,
            timing | {"dt": dt},
            backend,
            at_once,
        )

    samples = made((before, after), runs if perturbations else 0, timing["dt"])
    both = samples[0].made & samples[1].made
    terms = [
        np.stack(
            [
                np.asarray(t.value(jnp.asarray(s.exact[both, i])))
                for i, t in enumerate(objective.terms)
            ],
            axis=1,
        )
        for s in samples
    ]
    level = f" {risk.level:g}" if risk.kind == "cvar" else ""
    changes = [
        _objective_change(
            risk,
            f"objective ({risk.kind}{level})" if len(both) > 1 else "objective",
            terms,
            confidence,
        )
    ]
    for i, term in enumerate(objective.terms):
        changes.append(
            _change(
                f"{term.name} (mean)" if len(both) > 1 else term.name,
                terms[0][:, i],
                terms[1][:, i],
                confidence,
            )
        )
        if risk.kind == "cvar" and len(objective.terms) > 1:
            changes.append(
                _objective_change(
                    risk, f"{term.name} (cvar{level})", [x[:, i : i + 1] for x in terms], confidence
                )
            )
    verdicts = []
    for r, requirement in enumerate(objective.requirements):
        found = [
            probability(_broken(objective, r, s), s.made, confidence, "independent", 1)
            for s in samples
        ]
        allowed = float(requirement.allowed)
        # What limits a probability is a margin in the programme: its multiplier is no price of the
        # probability.
        priced = r < len(prices) and requirement.event == "value"
        (sign, unit), price = requirement.measure, prices[r] if priced else None
        worst = float(
            worst_share(
                jnp.asarray(samples[1].exact[samples[1].made, len(objective.terms) + r]), allowed
            )
        )
        shown = sign * worst, sign * float(requirement.limit), unit, price
        verdicts.append(
            Verdict(
                requirement.name, allowed, found[0], found[1], verdict_of(found[1], allowed), *shown
            )
        )
    left = tuple(
        probability(s.status & int(VIOLATED) != 0, s.made, confidence, "independent", 1)
        for s in samples
    )
    margins = tuple(float(s.margin[s.made].min()) for s in samples)
    torques = tuple(tuple(s.torque[s.made].max(axis=0).tolist()) for s in samples)
    full = samples[1] if not perturbations else made((after,), 0, timing["dt"])[0]
    half = made((after,), 0, 0.5 * timing["dt"])[0]
    return TuningReport(
        len(both),
        seed if perturbations else None,
        confidence,
        tuple(changes),
        tuple(verdicts),
        left,  # type: ignore[arg-type]
        margins,  # type: ignore[arg-type]
        torques,  # type: ignore[arg-type]
        at_limits,
        _at_half_the_step(objective, full, half),
        notes,
    )


def _at_half_the_step(objective: Objective, full: _Sample, half: _Sample) -> str:
    """The nominal run at dt and at dt / 2, in words: a result that the step made is no result."""
    values = [
        float(sum(t.value(jnp.asarray(s.exact[0, i])) for i, t in enumerate(objective.terms)))
        for s in (full, half)
    ]
    text = f"the nominal run at dt / 2: objective {values[1]:.5g} instead of {values[0]:.5g}"
    text += f", smallest margin {half.margin[0]:.4g} rad, peak torque {np.max(half.torque):.5g} N m"
    apart = abs(values[1] - values[0]) > APART * abs(values[0])
    lost = any(
        _broken(objective, r, half)[0] and not _broken(objective, r, full)[0]
        for r in range(len(objective.requirements))
    )
    if lost:
        return (
            "WARNING: "
            + text
            + "; a requirement is broken there: leave it some room, or take a smaller dt"
        )
    return (
        "WARNING: " + text + f", more than {APART:.0%} apart: take a smaller dt" if apart else text
    )


def _objective_change(risk: Risk, name: str, terms: list[np.ndarray], confidence: float) -> Change:
    losses = [x.sum(axis=1) for x in terms]
    if risk.kind == "worst" and len(losses[0]) > 1:
        return Change(name, float(losses[0].max()), float(losses[1].max()), None, None)
    return _change(name, influence(risk, losses[0]), influence(risk, losses[1]), confidence)
