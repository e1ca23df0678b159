"""The result of a tuning: `TuneResult`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices, programs
from iblf_jax.core.presentation import Content, Result, present
from iblf_jax.core.progress import announced
from iblf_jax.core.status import UNTRUSTED
from iblf_jax.engine import RunRequest, points_per_batch, run_batch, run_rollout
from iblf_jax.simulation import paths
from iblf_jax.simulation.advice import advice_of
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.tuning.confirmation import Confirmation
from iblf_jax.tuning.objectives import Objective, depends_on_torque
from iblf_jax.tuning.options import Report, TuningRunOptions
from iblf_jax.tuning.quantities import Quantities
from iblf_jax.tuning.report import ReportRequest, TuningReport, make_report
from iblf_jax.tuning.runs import NUMBERS_A_RUN
from iblf_jax.tuning.samples import is_random
from iblf_jax.tuning.step_check import ReportedQuantities, StepCheck, check_step_size

LARGE_CHANGE = 100.0
"""Factor by which a gain may change before a warning is given."""
AT_KINK = "converged at a kink: the slope of a requirement jumps from one peak to another here"
"""`TuneResult.stopped` where the conditions of an optimum hold only if the gradients of peaks at
nearby gains are added."""
UNCONFIRMED = "an optimum that the starts do not confirm: better ones may exist"
"""`TuneResult.stopped` where the conditions of an optimum hold as for "converged", and of many
starts fewer than a third came within 0.5 % of the objective, or one ended below it and broke a
requirement there."""
STUCK = "the solver ended at gains where the conditions of an optimum do not hold"
"""`TuneResult.stopped` where the solver has converged by its own criterion at gains that keep the
requirements, but the conditions of an optimum do not hold."""
INFEASIBLE = "the requirements cannot be kept together near these gains"
"""`TuneResult.stopped` where all gains that are known violate a requirement, and the returned gains
are a stationary point of the largest excess: the problem is infeasible, locally."""
NOT_FOUND_FEASIBLE = "no gains that keep the requirements were found"
"""`TuneResult.stopped` where all gains that are known violate a requirement, and the returned gains
are no stationary point of the largest excess: the problem may be feasible."""
NO_GRADIENT = "the objective has no finite derivative at the start"
"""`TuneResult.stopped` where the derivatives at the returned gains are not finite."""
LIMIT_TOLERANCE = 0.01
"""A number is at a limit if it differs from the limit by at most this share of the limit, or of the
range where the limit is 0."""


class AtLimit(NamedTuple):
    """A tuned number at an end of its range; prints as words."""

    value: float
    side: str
    """"lower" or "upper"."""
    limit: float
    reason: str = ""
    """Why the range ends there; empty where that is not known."""

    def __str__(self) -> str:
        text = f"= {self.value:.5g} is at the {self.side} end of its range, {self.limit:.5g}"
        return f"{text} ({self.reason})" if self.reason else text


@programs.jit(static_argnames="request")
def _slice(
    scenario: Scenario,
    changes: Mapping[str, jax.Array],
    folds: Any,
    dt: jax.Array,
    *,
    request: RunRequest,
) -> Any:
    return run_batch(scenario, changes, folds, dt, request)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class TuneSetup(TuningRunOptions):
    """The options of a tuning that its report needs: those of its runs, and these."""

    objective: Objective
    """With all scales and limits."""
    report: Report
    """With a seed."""
    limits: tuple[tuple[float, float], ...] = ()
    """Lower and upper limit of each tuned number, (p, 2), in its unit; empty in results that were
    saved without."""
    reasons: tuple[tuple[str, str], ...] = ()
    """Why the ranges end there, in words, (p, 2); empty in results that were saved without."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class TuneResult(Result):
    """A tuned scenario, the history of its search, and its report.

    With perturbations the report is on runs that the tuning did not use.
    """

    scenario: Scenario
    """With the tuned gains."""
    start: Scenario
    """With the gains that tuning started from."""
    values: dict[str, np.ndarray]
    """Path -> tuned value, in the leaf's unit."""
    names: tuple[str, ...]
    """Name of each coordinate, (p,)."""
    history: dict[str, np.ndarray]
    """Numbers of each step, (steps, starts, ...), the best start first: loss, objective, terms,
    excess of the requirements, margin [rad], gradient_norm, valid, z and x (the trial, in
    coordinates and in the units of the gains); evaluations is (steps,).

    With requirements there may be more rows than starts, as a later phase may begin at more points.
    A row that takes no step is invalid there.  The second search uses the first rows."""
    best_start: int
    """The column of the history with the start that found the result."""
    stopped: str
    """Why the search ended.

    "converged" means that the gains keep the requirements and satisfy the conditions of an optimum
    (`optimality.Conditions.hold`).  "iterations used up" and "no improvement in N steps" mean that
    the gains keep the requirements, but do not satisfy these conditions.  The other values are
    UNCONFIRMED, AT_KINK, STUCK, INFEASIBLE, NOT_FOUND_FEASIBLE and NO_GRADIENT of this
    module."""
    optimiser: str
    """Name of the solver."""
    mode: str
    """"forward" or "reverse"."""
    seconds: float
    setup: TuneSetup
    objective: float = math.nan
    """The objective at the tuned gains, on the runs that it was tuned on."""
    multipliers: tuple[float, ...] = ()
    """Lagrange multiplier of each requirement at the tuned gains: the decrease of the objective if
    its limit is loosened by one `scale`.  Where a requirement is violated, they are weights with
    sum 1 for which the weighted sum of the gradients of the excesses vanishes."""
    residuals: tuple[float, ...] = ()
    """Residuals of the optimality conditions at the tuned gains: the largest entry of the
    Lagrangian's gradient by the coordinates z that no range blocks, the largest excess G of a
    requirement, and the sum of multipliers times distances from the limits.  All are 0 at an
    optimum.  Where a requirement is violated, the conditions are those of the smallest largest
    excess."""
    probes: int = 0
    """Number of evaluations without derivatives, each of `setup.runs` rollouts, those at a quarter
    of the time step included."""
    tried: tuple[str, ...] = ()
    """What the search did, in words: number of starts, number of valleys (regions around one local
    minimum) and further phases; if no evaluated gains keep the requirements, also which of them are
    never kept (see `conflicts`)."""
    confirmation: Confirmation | None = None
    """Fresh runs that show how seldom the tuned gains fail, if `tune` was called with `confirm`."""

    @property
    def is_violated(self) -> bool:
        """Whether the tuned gains violate a requirement on the runs that they were tuned on."""
        return len(self.residuals) > 1 and bool(self.residuals[1] > 0)

    @property
    def tuned(self) -> np.ndarray:
        """The tuned numbers, (p,), in the order of `names`."""
        flat = []
        for path, value in self.values.items():
            own = sum(name == path or name.startswith(path + "[") for name in self.names)
            flat.append(np.ravel(value)[:own])
        return np.concatenate(flat)

    @property
    def evaluations(self) -> int:
        """Number of evaluations with derivatives, each of `setup.runs` rollouts."""
        return int(self.history["evaluations"][-1])

    @property
    def at_limits(self) -> dict[str, AtLimit]:
        """The tuned numbers at an end of their range, by name.

        A wider range would change such a number, and so would a term of the objective that limits
        what the number increases.
        """
        found = {}
        all_reasons = self.setup.reasons or (("", ""),) * len(self.names)
        rows = zip(self.names, self.tuned, self.setup.limits, all_reasons, strict=False)
        for name, x, ends, reasons in rows:
            width = ends[1] - ends[0]
            if not np.isfinite(width):
                width = 1.0
            for side, end, reason in zip(("lower", "upper"), ends, reasons, strict=True):
                if np.isfinite(end) and abs(x - end) <= LIMIT_TOLERANCE * (abs(end) or width):
                    found[name] = AtLimit(float(x), side, float(end), reason)
        return found

    @property
    def limit_multipliers(self) -> dict[str, float]:
        """Multiplier of each requirement by its name: the decrease of the objective if the limit is
        loosened by one unit.

        The unit is that of the limit; for a violation probability it is one radian of the margin of
        its worst runs.  Empty where a requirement is violated.
        """
        if self.is_violated:
            return {}
        pairs = zip(self.setup.objective.requirements, self.multipliers, strict=False)
        return {r.name: multiplier / float(r.scale) for r, multiplier in pairs}

    @property
    def notes(self) -> tuple[str, ...]:
        """What to consider before these gains are used, in words: why the search ended, gains far
        from their start, an objective without a cost of torque.
        """
        objective = self.setup.objective
        lines = [f"stopped: {self.stopped}"]
        if self.residuals:
            gradient, excess, complementarity = self.residuals
            lines[0] += (
                f" (gradient of the Lagrangian {gradient:.2g}, largest excess {excess:.2g},"
                f" complementarity {complementarity:.2g}; objective {self.objective:.5g})"
            )
        lines += self.tried
        if self.confirmation is not None:
            lines.append(str(self.confirmation))
        if objective.requirements and self.is_violated:
            lines.append(
                "WARNING: these gains break the requirements as little as was found: loosen one,"
                ' add parameters, or take effort="thorough"'
            )
        if self.stopped == "iterations used up":
            steps = len(self.history["evaluations"])
            lines.append(
                f'WARNING: not converged after {steps} steps: take effort="thorough", or'
                " ij.tuning.Effort(iterations=...)"
            )
        if self.stopped == STUCK:
            lines.append(self._no_optimum_in_words())
        lines += self._distant_gains()
        lines += [f"WARNING: {text}" for text in advice_of(self.scenario)]
        if not depends_on_torque(objective):
            lines.append(
                "WARNING: this objective has no price on torque: add effort(), torque_rate() or"
                " peak_torque_below(limit)"
            )
        return tuple(lines)

    def _no_optimum_in_words(self) -> str:
        """Whether the gains can be used; names the time step only if the runs at half of it
        differ.
        """
        text = "WARNING: better gains may exist"
        if self.setup.objective.requirements:
            text = (
                "WARNING: these gains keep the requirements in the runs of the tuning, but better"
                " ones may exist"
            )
        text += ": the slope of the objective or of a requirement jumps here"
        check = self.step_check
        if not check.depends_on_step:
            return f'{text}; take effort="thorough"'
        return f'{text}, or the time step is too long; {check.remedy}, or take effort="thorough"'

    def _distant_gains(self) -> list[str]:
        """A warning for each gain that has changed by more than the factor LARGE_CHANGE."""
        lines = []
        for path, value in self.values.items():
            start = np.asarray(paths.get(self.start, path))
            for index in np.ndindex(np.shape(value)):
                before, after = start[index], value[index]
                if before * after > 0 and not 1 / LARGE_CHANGE < after / before < LARGE_CHANGE:
                    name = path + "".join(f"[{i}]" for i in index)
                    lines.append(
                        f"WARNING: {name} ended at {after / before:.3g} times its start: the"
                        " objective hardly depends on it, or has no cost of it"
                    )
        return lines

    @cached_property
    def nominal(self) -> tuple[Rollout, Rollout]:
        """The nominal run with the gains before and after the tuning, recorded at every step."""
        step = jnp.asarray(self.setup.dt, self.start.initial.q.dtype)
        folds = as_folds(None, step.dtype, self.start)

        def run(scenario: Scenario) -> Rollout:
            scenario = canonical(scenario)
            return run_rollout(scenario, folds, step, self._request(scenario, record_every=1))

        return run(self.start), run(self.scenario)

    def _request(self, scenario: Scenario, **options: Any) -> RunRequest:
        """A request for a run with the duration, time step and integrator of the tuning."""
        steps = checks.whole_steps(self.setup.duration, self.setup.dt)
        return RunRequest.of(scenario, steps=steps, method=self.setup.method, **options)

    @cached_property
    def step_check(self) -> StepCheck:
        """All runs of the tuning, with the tuned gains, at dt and at dt / 2."""
        setup = self.setup
        batch = self._runs_per_batch
        return check_step_size(self.start, self.values, setup.objective, setup, batch=batch)

    @property
    def _runs_per_batch(self) -> int:
        """Number of runs in a batch of the search's values.  The report uses batches of this size
        too, so that the program that was compiled for the search serves again.
        """
        if self.probes or self.setup.runs > 1:
            return self.setup.runs * points_per_batch(self.setup.runs)
        return 1

    @cached_property
    def report(self) -> TuningReport:
        """Before and after, requirement by requirement: on fresh draws where something is
        perturbed, else on the one nominal run.
        """
        return self.check()

    @notices.each_warning_once
    @announced("checking tuned gains in runs that the search did not use")
    def check(self, runs: int | None = None, seed: int | None = None) -> TuningReport:
        """Makes the report with another number of fresh runs, or another seed.

        Args:
          runs: number of fresh runs; as in `report` if not given.
          seed: of their draws; not the tuning's.

        Returns:
          A `TuningReport`, which prints as text; if the tuning drew no runs, it is on the one
          nominal run, for any `runs` and `seed`.

        Raises:
          ValueError: the seed of the tuning itself.

        Source: `iblf_jax.tuning.report`.
        """
        setup = self.setup
        report = setup.report
        seed = report.seed if seed is None else checks.seed(seed)
        if is_random(setup) and seed == setup.seed:
            expected = "another seed than the tuning's"
            raise checks.fail("seed", seed, expected, "Held-out runs must be fresh.")
        if runs is None:
            runs = report.runs
        runs = checks.positive_integer("runs", runs)
        at_limits = None
        if setup.limits:
            at_limits = tuple(f"{name} {end}" for name, end in self.at_limits.items())
        request = ReportRequest(
            before=self.start,
            after=self.scenario,
            tuned=tuple(self.values),
            objective=setup.objective,
            run=setup,
            report=dataclasses.replace(report, runs=runs, seed=seed),
            batch=self._runs_per_batch,
            step_check=self.step_check,
            at_limits=at_limits,
            multipliers=tuple(self.limit_multipliers.values()),
            notes=self.notes,
        )
        return make_report(request)

    def landscape(
        self, first: str, second: str, *, points: int = 13, span: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The objective of the nominal run on a slice through the optimum.

        Args:
          first, second: two of `names`.
          points: on each axis.
          span: each axis reaches from exp(-span) to exp(span) times the tuned number.

        Returns:
          Values of the first (points,), of the second (points,), and the objective (points,
          points), infinite where a run is invalid.

        Raises:
          ValueError: an unknown name.

        Source: design of this package.
        """
        for name in (first, second):
            checks.one_of("landscape: name", name, self.names)
        points = checks.positive_integer("points", points)
        span = checks.positive_number("span", span, "1")
        checks.fits_memory("points", points, 8 * points * NUMBERS_A_RUN)
        factor = np.exp(np.linspace(-span, span, points))
        a, b = (self.tuned[self.names.index(name)] * factor for name in (first, second))
        return a, b, self.on_slice(first, second, a, b)[0]

    def on_slice(
        self, first: str, second: str, a: np.ndarray, b: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Objective and largest excess of a requirement of the nominal run, (A, B) each, at values
        of two of `names` (A,), (B,).

        The objective is infinite where a run is invalid; without requirements the excess is -inf.
        """
        changes = {}
        for name, x in ((first, np.repeat(a, len(b))), (second, np.tile(b, len(a)))):
            # Where a name is a whole leaf, one number replaces all of its entries.
            shape = np.shape(self.values.get(name, 0.0))
            changes[name] = np.broadcast_to(x.reshape(-1, *(1,) * len(shape)), (len(x), *shape))
        setup = self.setup
        scenario = canonical(self.scenario)
        dtype = scenario.initial.q.dtype
        folds = as_folds((Quantities(setup.objective.quantities),), dtype, scenario)
        request = self._request(scenario, backend=setup.backend)
        outcome = _slice(scenario, changes, folds, jnp.asarray(setup.dt, dtype), request=request)
        exact = outcome.metrics["tuning_exact"]
        values = jax.vmap(setup.objective.values)(exact).sum(axis=1)
        excess = np.asarray(jax.vmap(setup.objective.excesses)(exact))
        worst = np.max(excess, axis=1, initial=-np.inf)
        valid = np.asarray(outcome.status) & int(UNTRUSTED) == 0
        shape = len(a), len(b)
        objective = np.where(valid, np.asarray(values), np.inf)
        return objective.reshape(shape), np.where(valid, worst, np.inf).reshape(shape)

    def plot(self, **options):
        """Figure of the tuning: loss, gains, margin, torque and tubes before and after.  Options as
        `plotting.tuning`.
        """
        return present("tuning figure", self, **options)

    def _content(self) -> Content:
        probes = f", {self.probes} probes" if self.probes else ""
        steps = len(self.history["evaluations"])
        lines = [
            f"TuneResult({self.optimiser}, {self.mode} mode, {steps} steps,"
            f" {self.evaluations} evaluations{probes}, {self.seconds:.3g} s; {self.stopped})"
        ]
        lines += [f"  {words}" for words in self._bounds_and_requirements()]
        if self.confirmation is not None:
            lines.append(f"  {self.confirmation}")
        for path, value in self.values.items():
            before = np.array2string(np.asarray(paths.get(self.start, path)), precision=5)
            lines.append(f"  {path}: {before} -> {np.array2string(np.asarray(value), precision=5)}")
        lines += [f"  {name} {end}" for name, end in self.at_limits.items()]
        peaks = [np.max(np.asarray(run.metrics.peak_torque)) for run in self.nominal]
        shown = ReportedQuantities.of(self.scenario)
        peak_change = f"{peaks[0]:.5g} -> {peaks[1]:.5g} {shown.input_unit}"
        return [*lines, f"  peak {shown.input} of the nominal run: {peak_change}"]

    def _bounds_and_requirements(self) -> list[str]:
        """Bounds and requirements on the runs of the tuning, and on fresh runs if a report on them
        was made.
        """
        check = self.step_check
        rows = [check.bounds_in_words()]
        failed_first = sorted(check.requirements, key=lambda r: -max(r.excess))
        rows += [f"requirement {r}" for r in failed_first]
        if not is_random(self.setup):
            return rows
        report = vars(self).get("report")
        if report is None:
            return [*rows, "fresh runs: not made yet; `.report` makes them"]
        return [f"{report.runs} fresh runs: {report.headline}", *rows]
