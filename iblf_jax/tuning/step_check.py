"""Repeats the runs of a tuning at half the time step, to show whether objective and requirements
depend on the step.

The comparison covers all runs of the tuning, with its perturbations, its seed and its number of
runs; without perturbations it is the nominal run.  Objective and requirements are combined over the
runs as in the search,

    f = risk_b [ sum_k w_k term_k ],      G_r = mean of g_r over the worst `allowed` share.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Ideal, Motor
from iblf_jax.core.presentation import Content, Result
from iblf_jax.core.units import INPUT, POSITION
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.units import unit_text
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.options import TuningRunOptions
from iblf_jax.tuning.robust import combine, worst_count, worst_share
from iblf_jax.tuning.samples import Sample, SampleRequest, is_random, sample_runs
from iblf_jax.world import plants

T = TypeVar("T")

STEP_TOLERANCE = 1e-3
"""Largest excess of a requirement at half the step, in its scale, that is tolerated.

A requirement that binds at dt has no room left, so that every difference between the two steps may
appear as an excess.  At the step of `recommended_dt`, largest torques, margins and errors of the
presets change by at most 1e-4; only those of `printed_gap`, which moves along its bound, change by
4e-3.  An excess above ten times 1e-4 is therefore an error of the step.  A smaller one does not
matter, as the limits of a machine are not known more exactly."""
LARGEST_DIFFERENCE = 0.01
"""Largest relative difference of the objective at half the step for which the report does not
warn."""


@dataclasses.dataclass(frozen=True)
class RequirementAtSteps:
    """One requirement on the runs of a tuning; each pair is at dt and at dt / 2."""

    name: str
    excess: tuple[float, float]
    """G, in the requirement's scale; negative where the requirement holds."""
    value: tuple[float, float]
    """Mean of the limited quantity over the worst allowed share of the runs."""
    limit: float
    unit: str
    averaged: int = 1
    """Number of runs in this share."""
    event: str = "value"
    """"violated" for a limit on the probability that bounds are violated, whose quantity is the
    margin of the worst runs."""

    @property
    def is_broken(self) -> tuple[bool, bool]:
        """Whether the requirement is violated at dt, and at dt / 2."""
        full, half = (not excess < 0 for excess in self.excess)
        return full, half

    def __str__(self) -> str:
        full, half = (self._with_unit(value) for value in self.value)
        what = "margin " if self.event == "violated" else ""
        if self.averaged > 1:
            what = f"mean {what}of the worst {self.averaged} runs "
        text = f"{self.name}: {what}{full}, at dt / 2 {half}"
        if self.is_broken[0]:
            return f"{text}: BROKEN by {self._amount(0)}"
        if not self.is_broken[1]:
            return f"{text}: kept"
        if self.excess[1] <= STEP_TOLERANCE:
            return f"{text}: kept at dt, and at dt / 2 within the tolerance"
        return f"{text}: kept at dt, BROKEN at dt / 2 by {self._amount(1)}"

    def _amount(self, step: int) -> str:
        """The excess over the limit, with its unit, at dt (0) or dt / 2 (1)."""
        return self._with_unit(abs(self.value[step] - self.limit), 3)

    def _with_unit(self, value: float, digits: int = 5) -> str:
        return f"{value:.{digits}g} {self.unit}".rstrip()


class ReportedQuantities(NamedTuple):
    """Names and units with which a report shows margins and inputs; those of a robot if not
    given.
    """

    margin_unit: str = str(POSITION)
    input: str = "torque"
    input_unit: str = str(INPUT)
    component: str = "joint"

    @classmethod
    def of(cls, scenario: Scenario) -> ReportedQuantities:
        """Those of the plant of a scenario."""
        plant = scenario.plant
        return cls(
            unit_text(scenario, POSITION),
            plants.input_name(plant),
            unit_text(scenario, INPUT),
            plants.component_noun(plant),
        )


class WorstExcess(NamedTuple):
    """The requirement with the largest excess at half the time step."""

    excess: float
    """G in the requirement's scale; minus infinity without requirements."""
    requirement: str
    """Its name; empty without requirements."""
    violated: int
    """Number of runs that leave their bounds or diverge at half the step."""

    @property
    def is_broken(self) -> bool:
        """Whether the excess is beyond `STEP_TOLERANCE`."""
        return self.excess > STEP_TOLERANCE


@dataclasses.dataclass(frozen=True, repr=False)
class StepCheck(Result):
    """The runs of a tuning with the tuned gains, at dt and at dt / 2; prints as text.

    Each pair of numbers is in this order.
    """

    runs: int
    seed: int | None
    """Seed of the draws; None for the one nominal run."""
    dt: float
    """The time step of the tuning [s]."""
    objective: tuple[float, float]
    """The objective, combined over the runs by the risk of the tuning."""
    requirements: tuple[RequirementAtSteps, ...]
    margin: tuple[float, float]
    """The smallest margin of all runs [rad]."""
    peak_torque: tuple[tuple[float, ...], tuple[float, ...]]
    """The largest torque of all runs at each joint [N m]."""
    violated: tuple[int, int]
    """Number of runs that leave their bounds or diverge."""
    untrusted: tuple[int, int]
    """Number of runs that diverge or are integrated unstably."""
    quantities: ReportedQuantities = ReportedQuantities()
    """Names and units."""
    torque_jumps: bool = False
    """Whether the objective has the rate of a torque that jumps at each sample."""

    @property
    def remedy(self) -> str:
        """What to do about an objective that depends on the step."""
        if self.torque_jumps:
            return (
                "the squared rate of a held torque grows as 1/dt, so a smaller dt does not help:"
                " take an actuator with a lag, or an objective without torque_rate()"
            )
        return "take a smaller dt"

    @property
    def worst(self) -> WorstExcess:
        """The requirement with the largest excess at dt / 2."""
        return worst_of([(r.excess[1], r.name) for r in self.requirements], self.violated[1])

    @property
    def newly_broken(self) -> tuple[RequirementAtSteps, ...]:
        """The requirements that are kept at dt and broken at dt / 2 by more than STEP_TOLERANCE."""
        return tuple(
            r for r in self.requirements if not r.is_broken[0] and r.excess[1] > STEP_TOLERANCE
        )

    @property
    def depends_on_step(self) -> bool:
        """Whether the objectives at dt and dt / 2 differ by more than `LARGEST_DIFFERENCE`."""
        full, half = self.objective
        return not abs(half - full) <= LARGEST_DIFFERENCE * abs(full)

    @property
    def subject(self) -> str:
        """Words for the runs that are compared."""
        if self.seed is None:
            return "the nominal run"
        return f"the {self.runs} runs of the tuning" if self.runs > 1 else "the run of the tuning"

    def bounds_in_words(self) -> str:
        """Whether the runs keep their bounds at both steps."""
        if not (any(self.violated) or any(self.untrusted)):
            return f"bounds: kept by {self.subject}, at dt and at dt / 2"
        parts = []
        if any(self.violated):
            full, half = self.violated
            parts.append(f"leave their bounds or diverge: {full} at dt, {half} at dt / 2")
        if any(self.untrusted):
            full, half = self.untrusted
            parts.append(f"not trustworthy: {full} at dt, {half} at dt / 2")
        counted = "run" if self.runs == 1 else "runs"
        return f"WARNING: of {self.runs} {counted} of the tuning, {'; '.join(parts)}"

    def warnings_of_requirements(self) -> list[str]:
        """A warning for each requirement that is broken on these runs, the worst first.

        Requirements that are kept at dt count if they are broken at dt / 2 by more than the
        tolerance.  Those that are broken at dt already are omitted for the nominal run, because its
        report lists them elsewhere.
        """
        rows = []
        newly_broken = self.newly_broken
        for r in sorted(self.requirements, key=lambda r: -max(r.excess)):
            if r.is_broken[0] and self.seed is not None:
                rows.append(f"WARNING: {self.subject}: {r}")
            elif r in newly_broken:
                remedy = "leave it some room, or take a smaller dt"
                rows.append(f"WARNING: {self.subject}: {r}; {remedy}")
        return rows

    def numbers_in_words(self) -> str:
        """Objective, smallest margin and largest torque at both steps, and the largest excess at
        dt / 2 if it is within the tolerance.
        """
        full, half = self.objective
        shown = self.quantities
        torques = [max(x, default=float("nan")) for x in self.peak_torque]
        text = (
            f"{self.subject} at dt / 2: objective {half:.5g} instead of {full:.5g}, smallest margin"
            f" {self.margin[1]:.4g} instead of {self.margin[0]:.4g} {shown.margin_unit}, peak"
            f" {shown.input} {torques[1]:.5g} instead of {torques[0]:.5g} {shown.input_unit}"
        )
        worst = self.worst
        if 0 <= worst.excess <= STEP_TOLERANCE:
            text += (
                f"; {worst.requirement} is broken there by {worst.excess:.2g} of its scale, within"
                f" the tolerance of {STEP_TOLERANCE:g}"
            )
        if not self.depends_on_step:
            return text
        return f"WARNING: {text}; more than {LARGEST_DIFFERENCE:.0%} apart: {self.remedy}"

    def _content(self) -> Content:
        requirements = [f"requirement {r}" for r in self.requirements]
        return [self.bounds_in_words(), *requirements, self.numbers_in_words()]


def has_rate_of_held_torque(scenario: Scenario, objective: Objective) -> bool:
    """Whether an objective contains the rate of a torque that a sampled loop applies without a
    lag.
    """
    has_rate = any(q.signal == "torque_rate" for q in objective.quantities)
    if scenario.sampling is None or not has_rate:
        return False
    actuator = scenario.actuator
    return isinstance(actuator, Ideal) or (
        isinstance(actuator, Motor) and actuator.bandwidth is None
    )


def worst_of(excesses: list[tuple[float, str]], violated: int) -> WorstExcess:
    """The requirement with the largest excess, from pairs of an excess and a name."""
    excess, name = max(excesses, key=lambda pair: pair[0], default=(float("-inf"), ""))
    return WorstExcess(excess, name, violated)


def check_step_size(
    scenario: Scenario,
    values: Mapping[str, Any],
    objective: Objective,
    options: TuningRunOptions,
    *,
    batch: int = 1,
) -> StepCheck:
    """Compares the runs of a tuning at its step and at half of it.

    Args:
      scenario: scenario that the tuning started from.
      values: path -> tuned value.
      objective: objective of the tuning, with all scales and limits.
      options: options of its runs.
      batch: number of runs in a batch.  With that of the search's values, the compiled program of
        the search is used again.
    """
    dt = float(options.dt)
    full = _tuned_runs(scenario, values, objective, options, dt, batch)
    half = _tuned_runs(scenario, values, objective, options, 0.5 * dt, batch)

    def pair(function: Callable[[Sample], T]) -> tuple[T, T]:
        return function(full), function(half)

    return StepCheck(
        runs=len(full.status),
        seed=int(options.seed) if is_random(options) else None,
        dt=dt,
        objective=pair(lambda x: _combined_objective(objective, options, x)),
        requirements=tuple(
            _requirement_at_steps(scenario, objective, r, (full, half))
            for r in range(len(objective.requirements))
        ),
        margin=pair(lambda x: float(x.margin.min())),
        peak_torque=pair(lambda x: tuple(x.torque.max(axis=0).tolist())),
        quantities=ReportedQuantities.of(scenario),
        violated=pair(lambda x: int(np.sum(x.left_bounds()))),
        untrusted=pair(lambda x: int(np.sum(x.is_untrusted()))),
        torque_jumps=has_rate_of_held_torque(scenario, objective),
    )


def excess_at_half_step(
    scenario: Scenario,
    values: Mapping[str, Any],
    objective: Objective,
    options: TuningRunOptions,
    *,
    batch: int = 1,
) -> WorstExcess:
    """The requirement with the largest excess at half the step, on all runs of a tuning.

    Args:
      scenario, values, objective, options, batch: as `check_step_size`.
    """
    half = _tuned_runs(scenario, values, objective, options, 0.5 * float(options.dt), batch)
    excesses = [
        (combined_excess(objective, r, half), requirement.name)
        for r, requirement in enumerate(objective.requirements)
    ]
    return worst_of(excesses, int(np.sum(half.left_bounds())))


def _tuned_runs(
    scenario: Scenario,
    values: Mapping[str, Any],
    objective: Objective,
    options: TuningRunOptions,
    dt: float,
    batch: int,
) -> Sample:
    """The runs of a tuning with the tuned gains at one time step."""
    request = SampleRequest(
        scenario=scenario,
        tuned=tuple(values),
        objective=objective,
        options=options,
        dt=dt,
        runs=options.runs,
        seed=int(options.seed),
        batch=batch,
    )
    return sample_runs(request, [with_parameters(scenario, dict(values))])[0]


def _combined_objective(objective: Objective, options: TuningRunOptions, sample: Sample) -> float:
    """The objective f of some runs."""
    losses = sample.losses(objective).sum(axis=1)
    return float(combine(options.risk, jnp.asarray(losses)))


def combined_excess(objective: Objective, r: int, sample: Sample) -> float:
    """The excess G of requirement r: the mean of g over the worst allowed share of the runs."""
    share = float(objective.requirements[r].allowed)
    return float(worst_share(jnp.asarray(sample.excess(objective, r)), share))


def _requirement_at_steps(
    scenario: Scenario, objective: Objective, r: int, samples: tuple[Sample, Sample]
) -> RequirementAtSteps:
    """Requirement r on the runs at dt and at dt / 2."""
    requirement = objective.requirements[r]
    sign, unit = requirement.measure
    full, half = (combined_excess(objective, r, x) for x in samples)
    limit = float(requirement.limit)
    scale = float(requirement.scale)
    return RequirementAtSteps(
        name=requirement.name,
        excess=(full, half),
        value=(sign * (limit + scale * full), sign * (limit + scale * half)),
        limit=sign * limit,
        unit=unit_text(scenario, unit),
        averaged=worst_count(len(samples[0].status), float(requirement.allowed)),
        event=requirement.event,
    )
