"""`prove`: is a level set of V_w invariant for all times and all parameters of a box?

V_w = V with the weight w of the estimation error.  Four steps answer:

1. Points of the level set are drawn for every weight of a grid, and V_w' is increased from the
   largest ones by random steps.  If every weight has a point with V_w' > 0, no weight proves the
   statement.
2. At the weight with the least largest V_w', or at a neighbour with which the search advances
   faster, branch and bound with outward rounding decides whether V_w' < 0 everywhere.  For a
   sampled loop, a search before it proves bounds of the rates of a held torque.
3. At this weight, bounds of the torque on the whole set are proved. Limits of the torque are part
   of the statement: weights with a torque beyond them do not count. Where all of them have one, or
   where no proof is found that the torque is within the limits, steps 1 and 2 are repeated for the
   loop whose limits are active.
4. Without a proof, runs start at the points with the largest V_w': one that violates the bounds
   refutes the statement, and of a sampled loop one with V_w > level at a sample.  A loop with a
   delay has no such runs.
"""

from __future__ import annotations

import functools
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.control.sensors import Ideal
from iblf_jax.core import checks, notices
from iblf_jax.core.progress import announced
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import Status
from iblf_jax.engine.simulate import SimulationWarning, simulate
from iblf_jax.kernels import UnsupportedError, enclose
from iblf_jax.proofs.arms import ArmProblem, arm_problem
from iblf_jax.proofs.chains import chain_problem
from iblf_jax.proofs.held_rates import proved_rates
from iblf_jax.proofs.periods import AperiodicError
from iblf_jax.proofs.points import PARENTS, Sampled, sample_weights
from iblf_jax.proofs.problem import LevelSetProblem
from iblf_jax.proofs.proposal import LevelChoice, Proposal, Start, proposed_level, start_of
from iblf_jax.proofs.result import GrowthPoint, Proof, Verdict, Violation, WorstBox
from iblf_jax.proofs.sampled_values import sampled_values
from iblf_jax.proofs.search import SearchedBox, SearchResult, search
from iblf_jax.proofs.support import has_delay, step_within
from iblf_jax.proofs.torque import TorqueRange, found_torque, proved_torque
from iblf_jax.proofs.undecided import left_over
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.distributions import Perturbation

EXAMPLE = '{"plant.mass": ij.factor(ij.interval(0.97, 1.03))}'
WEIGHTS_PER_DECADE = 4
LEAST_RATIO, GREATEST_RATIO = 0.25, 1e3
"""Ends of the grid of weights, in parts of 1/(K2 kf). Below 1/(4 K2 kf), V_w' > 0 for an estimation
error along e2 even without an error of the parameters."""
LEAST_CHAIN_WEIGHT, GREATEST_CHAIN_WEIGHT = 1e-2, 1e2
"""Ends of the grid for a plant in strict-feedback form, whose weight has no unit."""
REFINEMENTS = (0.75, 1.33)
"""Factors of the best weight that are tried as well."""
TRIAL_BOXES = 1_000_000
"""Boxes of the search at each of these weights."""
RUNS = 16
"""Runs that start at points of the level set, if the caller gives no number."""
LEAST_DURATION = 5.0
"""Length of these runs, at least [s]."""
TIME_STEPS = (1e-3, 1e-4, 1e-5)
"""Their time steps [s]: the first one with which a run is accurate."""
EXCESS = 1e-6
"""Part of the level by which V_w must be above it at a sample to refute: the start is on the level
but for rounding, which is smaller by far."""
UNRELIABLE = Status.INACCURATE | Status.STEP_TOO_LARGE
"""Flags of runs that refute nothing."""


@notices.each_warning_once
@announced("preparing a proof")
def prove(
    scenario: Scenario,
    *,
    level: float | None = None,
    parameters: Mapping[str, Perturbation] | None = None,
    weight: float | None = None,
    duration: float | None = None,
    disturbance_rate: ArrayLike | None = None,
    max_boxes: int = 1_000_000_000,
    threads: int | None = None,
    progress: bool | None = None,
    checkpoint: str | PathLike | None = None,
    runs: int = RUNS,
    seed: int = 0,
) -> Proof:
    """Decides whether {V_w <= level} is invariant for all parameters of a box.

        V_w' < 0 wherever V_w = level;   V_w = sum_i w_i V1_i + e2^T M0 e2 / 2 + w |f_tilde|^2 / 2

    The plant has parameters p of the box, law and observer those of the scenario's model.  The
    statement holds at all times if the scenario has a period, otherwise for the given duration.  A
    proof is rigorous for real-number equations: bounds are rounded outward.

    Args:
      scenario: the loop of a robot with the corrected backstepping law and the momentum observer,
        whose torque may have limits (`Saturated`, `Motor`; those of `Saturated` without an
        auxiliary state may be active), or of a plant in strict-feedback form
        of order 2 or 3 with one number per level and the law `BarrierBackstepping`.  The loop of a
        robot may be sampled, with exact measurements and delays up to a period, or with positions
        rounded to counts of an `Encoder`; the statement then is about all times, also between
        samples, and with a delay about the starts of `Proof.start`.
      level: level c of V_w, in its unit, N m rad for robots. If not given, for a robot half of the
        greatest level at which no point with V_w' > 0 was found, or the least level whose set
        contains the start if that is more; `Proof.level_choice` has both. `largest_level` searches
        the greatest level with a proof.
      parameters: required; path -> `factor`, `offset` or `value` of an `interval`, such as
        {"plant.mass": ij.factor(ij.interval(0.97, 1.03))}; paths joined by commas vary together;
        {} for the plant as given.
      weight: w [rad/(N m)], without unit for a plant in strict-feedback form; searched if not
        given.
      duration: length of the time interval from t = 0 on [s]; a period of the scenario if not
        given.
      disturbance_rate: bound of the rate of a further disturbance, () or (n,) [N m/s]; none if not
        given.
      max_boxes: largest number of boxes.
      threads: number of threads; one for each processor if not given.
      progress: whether a bar shows the progress; None for where a user sees it.
      checkpoint: file from which an interrupted search continues, and to which it is written.
      runs: number of runs that try to refute the statement where no proof is found; 0 for none.
      seed: of the random points.

    Returns:
      A `Proof` with the verdict PROVED, NOT PROVED, REFUTED or UNDECIDED.

    Raises:
      ValueError: a scenario, a parameter, a level or an option that is not supported; the message
        says why.

    Source: design of this package; branch and bound with interval arithmetic as in R. E. Moore,
      R. B. Kearfott, M. J. Cloud, Introduction to Interval Analysis, 2009.
    """
    options = _options(weight, max_boxes, threads, progress, checkpoint, runs, seed)
    parameters = _checked_parameters(parameters)
    if level is not None:
        level = checks.positive_number("level", level, "the unit of V_w")
    problem = problem_of(scenario, parameters, duration, disturbance_rate)
    begin = time.monotonic()
    with jax.enable_x64(True):
        scenario = canonical(scenario)
        weights = weights_of(scenario, weight)
        start = None
        if level is None:
            start, proposal = _chosen_level(problem, weights, options)
            level, weights, largest = proposal
        sampled = sample_weights(problem, level, weights, seed)
        findings = _decided(problem, level, sampled, options)
        if start is not None:
            choice = LevelChoice(start.level(findings["weight"]), largest)
            findings["level_choice"] = choice
        fields = {
            "rates": {each.weight: each.largest for each in sampled},
            "assumptions": problem.assumptions,
        } | findings
        return Proof(
            scenario=scenario,
            parameters=dict(parameters),
            ranges=problem.uncertain.scales(),
            level=level,
            duration=problem.duration,
            is_period=problem.is_period,
            seconds=time.monotonic() - begin,
            disturbance_rate=disturbance_rate,
            **fields,
        )


def _checked_parameters(
    parameters: Mapping[str, Perturbation] | None,
) -> Mapping[str, Perturbation]:
    """The parameters; the error says how to choose what is missing."""
    if parameters is None:
        remedy = (
            "Name what is uncertain, with its interval: ij.parameters(scenario) lists the paths,"
            " and {} stands for the plant as given."
        )
        raise checks.fail("parameters", None, f"a mapping such as {EXAMPLE}", remedy)
    checks.mapping("parameters", parameters, EXAMPLE)
    return parameters


def _chosen_level(
    problem: LevelSetProblem, weights: Sequence[float], options: _Options
) -> tuple[Start, Proposal]:
    """A level whose set contains the start of a robot's scenario."""
    if has_delay(problem.scenario):
        remedy = "A start must be below the level, by what V_w may grow before the first command."
        raise checks.fail("level", None, "a level of V_w with a delay", remedy)
    if not isinstance(problem, ArmProblem):
        expected = "a level of V_w, such as level=0.5 [the unit of V_w]"
        remedy = (
            "V_w of a start that the set must contain is at least V[0] of its run"
            " (ij.simulate(scenario, ...).V); ij.largest_level(scenario, parameters=...,"
            " between=(0.01, 10.0)) searches the greatest level that can be proved."
        )
        raise checks.fail("level", None, expected, remedy)

    def decreases(level: float, some: list[float]) -> bool:
        try:
            problem.constants(some[0], level)
        except ValueError:  # the level reaches the guard of the barrier
            return False
        sampled = sample_weights(problem, level, some, options.seed)
        decreasing = [each for each in sampled if each.largest <= 0.0]
        if any(_excess(problem, level, each, options) <= 0.0 for each in decreasing):
            return True
        limited = problem.with_active_limits
        if limited is None:
            return False
        return any(x.largest <= 0.0 for x in sample_weights(limited, level, some, options.seed))

    start = start_of(problem)
    return start, proposed_level(start, weights, decreases)


class _Options(NamedTuple):
    """The options of the searches at all weights, and of the runs."""

    max_boxes: int
    threads: int | None
    progress: bool | None
    checkpoint: str | PathLike | None
    runs: int
    seed: int


def _options(
    weight: float | None,
    max_boxes: int,
    threads: int | None,
    progress: bool | None,
    checkpoint: str | PathLike | None,
    runs: int,
    seed: int,
) -> _Options:
    """The options, checked."""
    if weight is not None:
        checks.positive_number("weight", weight, "rad/(N m)")
    if threads is not None:
        threads = checks.positive_integer("threads", threads, most=1024)
    if checkpoint is not None:
        checkpoint = checks.file_to_write("checkpoint", checkpoint)
    return _Options(
        max_boxes=checks.positive_integer("max_boxes", max_boxes, most=10**15),
        threads=threads,
        progress=checks.boolean("progress", progress, optional=True),
        checkpoint=checkpoint,
        runs=checks.positive_integer("runs", runs, least=0, most=PARENTS),
        seed=checks.seed(seed),
    )


def problem_of(
    scenario: Scenario,
    parameters: Mapping[str, Perturbation],
    duration: float | None,
    disturbance_rate: ArrayLike | None,
) -> LevelSetProblem:
    """The proof problem of a scenario.

    Raises:
      ValueError: it is not supported; the message says why.
    """
    if not isinstance(scenario, Scenario):
        raise checks.fail("scenario", scenario, "a Scenario", "Make one with ij.presets.")
    if not scenario.loop.plant.uncertain_levels:
        return arm_problem(
            scenario, parameters, duration=duration, disturbance_rate=disturbance_rate
        )
    if disturbance_rate is not None:
        remedy = "Add a disturbance with an uncertain parameter to the scenario."
        raise checks.fail("disturbance_rate", disturbance_rate, "None for such a plant", remedy)
    return chain_problem(scenario, parameters, duration=duration)


def weights_of(scenario: Scenario, weight: float | None) -> list[float]:
    """The weights that are tried."""
    if weight is not None:
        return [float(weight)]
    if scenario.loop.plant.uncertain_levels:
        return _grid(LEAST_CHAIN_WEIGHT, GREATEST_CHAIN_WEIGHT)
    law: Any = unwrapped(scenario.controller)
    observer: Any = scenario.observer
    scale = 1.0 / float(np.min(np.asarray(law.K2)) * np.min(np.asarray(observer.kf)))
    return _grid(LEAST_RATIO * scale, GREATEST_RATIO * scale)


def _grid(low: float, high: float) -> list[float]:
    """Numbers between two ends, equally spaced on a logarithmic scale."""
    count = 1 + math.ceil(math.log10(high / low) * WEIGHTS_PER_DECADE)
    return np.geomspace(low, high, count).tolist()


# --- the decision --------------------------------------------------------------------------------


def _decided(
    problem: LevelSetProblem, level: float, sampled: Sequence[Sampled], options: _Options
) -> dict[str, Any]:
    """The fields of a `Proof` with the verdict and what it rests on."""
    decreasing = [each for each in sampled if each.largest <= 0.0]
    excesses = [_excess(problem, level, each, options) for each in decreasing]
    admitted = [each for each, excess in zip(decreasing, excesses, strict=True) if excess <= 0.0]
    limited = problem.with_active_limits
    if admitted:
        found = _searched_at_best(problem, level, admitted, options)
        needs_limits = found["verdict"] == Verdict.UNDECIDED and found.get("done") == 1.0
        if limited is None or not needs_limits:
            return found
    if limited is not None:
        weights = [each.weight for each in sampled]
        again = sample_weights(limited, level, weights, options.seed)
        return {
            "has_active_limits": True,
            "rates": {each.weight: each.largest for each in again},
            "assumptions": limited.assumptions,
        } | _decided(limited, level, again, options)
    best = min(sampled, key=lambda each: each.largest)
    fields: dict[str, Any] = {}
    if decreasing:
        best = decreasing[int(np.argmin(excesses))]
        fields["torque"] = _torque(problem, level, best, options, to_prove=False)
    else:
        fields["growth_points"] = _growth_points(problem, level, sampled)
    violation = _refuted(problem, level, best, options.runs)
    verdict = Verdict.NOT_PROVED if violation is None else Verdict.REFUTED
    return {"verdict": verdict, "weight": best.weight, "violation": violation, **fields}


def _growth_points(
    problem: LevelSetProblem, level: float, sampled: Sequence[Sampled]
) -> tuple[GrowthPoint, ...]:
    """For each weight the point with the largest V_w'."""
    points = []
    for each in sampled:
        state = problem.state_of(each.points[0], problem.constants(each.weight, level))
        points.append(GrowthPoint(each.weight, each.largest, state))
    return tuple(points)


def _searched_at_best(
    problem: LevelSetProblem, level: float, admitted: Sequence[Sampled], options: _Options
) -> dict[str, Any]:
    """The fields of a `Proof` at the best of some weights, from a search."""
    best, found = _search_best_weight(problem, level, admitted, options)
    result = found.result
    fields = _of_search(problem, found, options.seed)
    is_proved = result.proved and not found.is_of_held_rates
    is_within = True
    if problem.torque is not None:
        # What the law commands beyond its limits needs no bound.
        to_prove = is_proved and not problem.limits_may_be_active
        torque = _torque(problem, level, best, options, to_prove=to_prove)
        fields["torque"] = torque
        is_within = problem.torque.limits is None or torque.is_proved
    violation, verdict = None, Verdict.PROVED
    if not is_proved or not is_within:
        violation = _refuted(problem, level, best, options.runs)
        verdict = Verdict.UNDECIDED if violation is None else Verdict.REFUTED
    return {"verdict": verdict, "weight": best.weight, "violation": violation, **fields}


def _torque(
    problem: LevelSetProblem, level: float, at: Sampled, options: _Options, *, to_prove: bool
) -> TorqueRange:
    """The torque at a weight: the extremes that were found, and bounds where they are to be proved
    and no torque beyond a limit was found.
    """
    assert problem.torque is not None
    constants = problem.constants(at.weight, level)
    found = found_torque(problem, constants, options.seed)
    limits = problem.torque.limits
    if not to_prove or (limits is not None and found.excess(limits) > 0.0):
        return found
    searched = functools.partial(_searched, problem, options)
    return proved_torque(problem, constants, found, limits, searched, options.max_boxes)


def _excess(problem: LevelSetProblem, level: float, at: Sampled, options: _Options) -> float:
    """How far the torque that was found at a weight is beyond the limits, in parts of their
    distance; 0 or less inside, and without limits.
    """
    if problem.torque is None or problem.torque.limits is None:
        return 0.0
    found = _torque(problem, level, at, options, to_prove=False)
    return found.excess(problem.torque.limits)


# --- branch and bound ----------------------------------------------------------------------------


class _RateSearch(NamedTuple):
    """A search for V_w' < 0."""

    result: SearchResult
    constants: list[np.ndarray]
    """Of the bound."""
    is_of_held_rates: bool = False
    """Whether the search is the one for bounds of the rates of a held torque, which was not
    complete, so that none for V_w' began."""


def _search_best_weight(
    problem: LevelSetProblem, level: float, sampled: Sequence[Sampled], options: _Options
) -> tuple[Sampled, _RateSearch]:
    """The search at the weight with the least largest V_w', or at a neighbour with which it
    advances faster.
    """
    best = min(sampled, key=lambda each: each.largest)
    candidates = [best]
    if len(sampled) > 1:
        neighbours = [factor * best.weight for factor in REFINEMENTS]
        more = sample_weights(problem, level, neighbours, options.seed)
        candidates += [
            each
            for each in more
            if each.largest < 0.0 and _excess(problem, level, each, options) <= 0.0
        ]
    trials = min(TRIAL_BOXES, options.max_boxes)
    results = []
    for candidate in candidates:
        found = _rate_searched(candidate.weight, problem, level, trials, options)
        if found.result.proved and not found.is_of_held_rates:
            return candidate, found
        results.append((candidate, found))
    candidate, found = max(results, key=_progress)
    if trials == options.max_boxes or found.is_of_held_rates:
        return candidate, found
    most, constants = options.max_boxes, found.constants
    result = _bound_searched(problem, constants, most, options, checkpoint=options.checkpoint)
    return candidate, found._replace(result=result)


def _progress(pair: tuple[Sampled, _RateSearch]) -> tuple[bool, float]:
    """How far a search for V_w' < 0 came."""
    _, found = pair
    return not found.is_of_held_rates, found.result.done


def _rate_searched(
    weight: float, problem: LevelSetProblem, level: float, max_boxes: int, options: _Options
) -> _RateSearch:
    """The search for V_w' < 0 at a weight."""
    constants = problem.constants(weight, level)
    searched = functools.partial(_searched, problem, options)
    if problem.held_torque is not None:
        limits, result = proved_rates(
            problem, weight, level, searched, options.max_boxes, options.seed
        )
        if limits is None:
            return _RateSearch(result, constants, is_of_held_rates=True)
        constants = [*constants, limits]
    return _RateSearch(_bound_searched(problem, constants, max_boxes, options), constants)


def _bound_searched(
    problem: LevelSetProblem,
    constants: list[np.ndarray],
    max_boxes: int,
    options: _Options,
    **more: Any,
) -> SearchResult:
    """The search for V_w' < 0 with the constants of the bound."""
    return _searched(
        problem,
        options,
        problem.bound,
        problem.lower,
        problem.upper,
        constants,
        scales=problem.scales,
        max_boxes=max_boxes,
        **more,
    )


def _searched(
    problem: LevelSetProblem, options: _Options, *arguments: Any, **more: Any
) -> SearchResult:
    """`search` with the patterns of the problem and the options of the caller."""
    try:
        return search(
            *arguments,
            patterns=problem.patterns,
            threads=options.threads,
            progress=options.progress,
            **more,
        )
    except UnsupportedError as error:
        expected = "operations of the list in docs/how_to/prove.md"
        raise checks.fail("prove: scenario", checks.Words(str(error)), expected) from error


def _of_search(problem: LevelSetProblem, found: _RateSearch, seed: int) -> dict[str, Any]:
    """The fields of a `Proof` that describe its search."""
    result, constants = found.result, found.constants
    fields: dict[str, Any] = {"boxes": result.boxes}
    if result.expected is not None:
        fields["expected_boxes"] = tuple(result.expected)
    if found.is_of_held_rates:
        return fields
    fields["done"] = result.done
    if problem.held_torque is not None:
        fields["held_rates"] = constants[-1]
    if result.worst is not None:
        fields["worst_box"] = _worst_box(problem, constants, result.worst)
    if result.proved:
        return fields
    fields["units_left"] = (len(result.left), result.units)
    left = left_over(problem, constants, result.left, seed)
    return fields if left is None else fields | left._asdict()


def _worst_box(problem: LevelSetProblem, constants: list[np.ndarray], box: SearchedBox) -> WorstBox:
    """The worst box with the names of its coordinates, and its bounds with narrower intervals."""
    intervals = {
        name: (float(low), float(high))
        for name, low, high in zip(problem.names, box.lower, box.upper, strict=True)
    }
    wide = [problem.names.index(name) for name in problem.uncertain.names]
    lower, upper = (np.tile(corner, (len(wide), 1)) for corner in (box.lower, box.upper))
    for row, k in enumerate(wide):
        lower[row, k] = upper[row, k] = 0.5 * (box.lower[k] + box.upper[k])
    narrowed = {}
    if wide:
        _, bounds = enclose(problem.bound, lower, upper, constants)
        least = bounds[0].min(axis=1)
        narrowed = {problem.names[k]: float(x) for k, x in zip(wide, least, strict=True)}
    return WorstBox(intervals, float(box.bound), float(box.value), narrowed)


# --- runs ----------------------------------------------------------------------------------------


def _refuted(
    problem: LevelSetProblem, level: float, sampled: Sampled, runs: int
) -> Violation | None:
    """A run that starts in the set and violates the bounds, or of a sampled loop leaves the set;
    None if none was found.

    Runs start at the points with the largest V_w' that were found, or, if a part of the scenario
    cannot be moved in time, at t = 0 with the other coordinates of these points.  The time step is
    reduced until the run is accurate; a run that is not accurate with the smallest one refutes
    nothing.  The statement of a loop with a delay is not about starts on the level.
    """
    if has_delay(problem.scenario):
        return None
    constants = problem.constants(sampled.weight, level)
    for point in sampled.points[:runs]:
        try:
            scenario = problem.scenario_at(point, constants)
        except AperiodicError as error:
            notices.warn(f"The runs that try to refute the bounds start at t = 0: {error}.")
            # Its other coordinates are a point of the level set at each time.
            point = np.concatenate([[0.0], point[1:]])
            scenario = problem.scenario_at(point, constants)
        duration = max(problem.duration, LEAST_DURATION)
        if not problem.is_period:
            duration = max(problem.duration - point[0], TIME_STEPS[0])
        for longest in TIME_STEPS:
            dt = step_within(scenario, longest)
            run = _run(scenario, duration, dt)
            if not int(run.status) & Status.INACCURATE:
                break
        if int(run.status) & UNRELIABLE:
            continue
        value = None
        if not int(run.status) & Status.BOUND_VIOLATED:
            value = _value_above(scenario, run, level, sampled.weight, dt)
            if value is None:
                continue
        margin = float(np.min(np.asarray(run.metrics["margin"])))
        state = problem.state_of(point, constants)
        return Violation(scenario, state, int(run.steps or 0) * dt, dt, margin, value)
    return None


def _value_above(
    scenario: Scenario, run: Rollout, level: float, weight: float, dt: float
) -> float | None:
    """The largest V_w at a sample, if the loop is sampled with exact measurements and V_w is above
    the level there by more than the difference that half of the time step makes; None otherwise.
    """
    # The estimate of a run is that of the law, from what is measured.
    if scenario.sampling is None or type(scenario.sensor) is not Ideal:
        return None
    values = sampled_values(scenario, run, weight)
    # A comparison with NaN is False.
    if not np.max(values) > (1.0 + EXCESS) * level:
        return None
    again = _run(scenario, int(run.steps or 0) * dt, 0.5 * dt)
    finer = sampled_values(scenario, again, weight)
    k = int(np.argmax(np.minimum(values, finer)))
    value = min(values[k], finer[k])
    if value - level > max(EXCESS * level, abs(values[k] - finer[k])):
        return float(value)
    return None


def _run(scenario: Scenario, duration: float, dt: float) -> Rollout:
    """A run, whose violations are no surprise, recorded at the samples of a sampled loop."""
    steps = math.floor(duration / dt * (1.0 + 1e-9))
    every = steps
    if scenario.sampling is not None:
        every = round(float(scenario.sampling.period) / dt)
        steps = max(1, steps // every) * every
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SimulationWarning)
        return simulate(scenario, duration=steps * dt, dt=dt, record_every=every)
