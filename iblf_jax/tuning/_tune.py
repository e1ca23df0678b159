"""`tune` builds a tuning problem, chooses a solver, searches, and returns the result with its
report.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import announced, bar
from iblf_jax.core.units import POSITION
from iblf_jax.engine import takes_runs
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.units import unit_text
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.tuning.checkpoints import fingerprint, load_checkpoint, save_checkpoint
from iblf_jax.tuning.confirmation import Confirmation, confirmation_of
from iblf_jax.tuning.conflicts import conflicts_in_words
from iblf_jax.tuning.evaluation import Evaluator, objective_at_quarter_step, values
from iblf_jax.tuning.objectives import Objective, tighter
from iblf_jax.tuning.options import Effort, Report, SearchOptions, chosen_solver, options_of
from iblf_jax.tuning.parameters import Tunable, in_units, names_of, values_at
from iblf_jax.tuning.problem import TuningProblem
from iblf_jax.tuning.result import (
    AT_KINK,
    INFEASIBLE,
    NO_GRADIENT,
    NOT_FOUND_FEASIBLE,
    STUCK,
    UNCONFIRMED,
    TuneResult,
    TuneSetup,
)
from iblf_jax.tuning.robust import Risk
from iblf_jax.tuning.runs import NUMBERS_A_RUN
from iblf_jax.tuning.samples import SampleRequest
from iblf_jax.tuning.search import (
    REPAIR,
    REPAIR_STARTS,
    SECOND_SEARCH,
    STARTS_AROUND,
    STARTS_AT_ENDS,
    Search,
    Strategy,
)
from iblf_jax.tuning.solvers import Solver
from iblf_jax.tuning.solvers.sqp import SQP
from iblf_jax.tuning.starts import (
    FEW_STARTS,
    MAX_SCREENED_RUNS,
    SAME_OBJECTIVE,
    WEIGHTS,
    Screening,
    StepComparison,
    distinct,
    number_of_starts,
    screen,
    starting_points,
    usable_starts,
)
from iblf_jax.tuning.step_check import excess_at_half_step

STARTS_TOGETHER = 8
"""Largest number of starts that are evaluated with derivatives in one batch.  In larger ones more
rows are those of starts that take no step."""
POLISH_STEPS = 15
"""Largest number of steps of the short search at half the time step."""


@notices.each_warning_once
@checks.known_keywords
@announced("compiling the programs of a search for gains")
@takes_runs
def tune(
    scenario: Scenario,
    parameters: Sequence[str | Tunable],
    objective: Objective,
    *,
    duration: float,
    dt: float = 1e-3,
    method: str = "rk4",
    backend: str = "auto",
    perturbations: Mapping[str, Perturbation] | None = None,
    runs: int = 1,
    seed: int = 0,
    risk: str | Risk = "mean",
    solver: Solver | str | None = None,
    effort: str | Effort = "normal",
    report: Report | None = None,
    confirm: float | None = None,
    checkpoint: str | os.PathLike | None = None,
    progress: bool | Callable[[Search], None] | None = None,
) -> TuneResult:
    """Tunes leaves of a scenario, its gains for example, by derivatives through the closed loop.

        minimise    risk_b [ sum_k w_k term_k ]
        subject to  the requirements and the ranges of the parameters

    With the default solver and effort, the tuning evaluates 1,024 points besides the scenario's
    gains without derivatives.  It begins searches at up to 32 of these points, of which those that
    differ continue after five and ten steps, and the better third of these after fifteen and every
    five further ones.  This takes about 400 evaluations with derivatives, and more if the search
    finds no gains that keep the requirements, if it does not converge, or if only one start came
    within 0.5 % of the best objective.  Gains whose objective changes by more than 0.5 % at a
    quarter of the time step do not count.

    The requirements of the result are evaluated again at half the time step.  If one of them is
    then broken by more than `step_check.STEP_TOLERANCE`, a short search at dt / 2 follows, and its
    result, with `setup.dt` equal to dt / 2, is returned.  This needs a solver with the requirements
    as constraints.

    With `confirm` as many fresh runs follow as the claim needs, 368 for 0.01 with 95 % confidence.
    A run fails if it leaves its bounds, diverges or breaks a requirement.  If one fails, the limits
    are tightened, the search continues from its result, and further fresh runs are drawn
    (`iblf_jax.tuning.confirmation`).

    Args:
      scenario: robot, law and motion; its gains are the first point of the search.
      parameters: paths such as "controller.K2" (one number a joint) or `tunable(path, low, high,
        tied=...)`.
      objective: sum of weighted terms and requirements of `iblf_jax.objectives`.
      duration: length of a run [s], a multiple of the step.
      dt: time step [s].
      method: integrator.
      backend: executor of values and of forward mode, as in `monte_carlo`.  Reverse mode always
        uses plain XLA.
      perturbations: path -> `factor`, `offset` or `value` of a distribution; without them there is
        one nominal run.
      runs: number of perturbed runs in the loss.
      seed: seed of these runs and of the points from which starts are chosen.
      risk: "mean", "worst", "cvar" or `cvar(level)`.
      solver: `ij.tuning.SQP()` (sequential quadratic programming; requirements are constraints),
        `ij.tuning.LBFGS()`, `ij.tuning.Adam()` or `ij.tuning.Optax()` (requirements are penalties),
        with their options, or the name of one in `ij.tuning.SOLVERS`.  If not given, SQP for up to
        32 numbers, and L-BFGS with reverse mode for more.
      effort: "quick" (a search from the scenario's gains only), "normal", "thorough" (8,192 points
        without derivatives and 96 starts, about 2,000 evaluations with derivatives, and a second
        search around the best gains), or `ij.tuning.Effort(values=..., starts=...)`.
      report: options of the report on fresh runs, `ij.tuning.Report(runs=..., seed=...,
        confidence=...)`.
      confirm: the probability that a run fails is to be below this number, with the confidence of
        the report; see `TuneResult.confirmation`.  It needs perturbations.
      checkpoint: a file that stores the state after each step; if it exists, the search continues
        from it.
      progress: whether to show a progress bar, or a function that is called with the `Search` after
        each step.  If not given, a progress bar is shown on a terminal and in a notebook.
      runs_as: an `ij.Runs`, in place of its fields.

    Returns:
      A `TuneResult`: scenario, history, report, plot.

    Raises:
      ValueError: an argument that is not valid, or a start that cannot be integrated with this
        step; the message names the remedy.
      TypeError: an unknown keyword argument.

    Source: design of this package; see the modules of `iblf_jax.tuning` for the methods.
    """
    began = time.perf_counter()
    options = options_of(solver, effort, report, progress)
    if checkpoint is not None:
        checkpoint = checks.file_to_write("checkpoint", checkpoint)
    problem = TuningProblem.build(
        scenario,
        parameters,
        objective,
        screens=options.effort.values > 0,
        duration=duration,
        dt=dt,
        method=method,
        backend=backend,
        perturbations=perturbations,
        runs=runs,
        seed=seed,
        risk=risk,
    )
    setup = _setup(problem, options.report)
    confirmation = None
    if confirm is not None:
        confidence = setup.report.confidence
        confirmation = confirmation_of(confirm, confidence, problem.objective, problem.options)
    solver, mode = chosen_solver(options.solver, problem.size)
    search = search_of(problem, solver, mode, options.effort, options.show)
    stopped = _run(search, mode, options.effort.iterations, checkpoint, options)
    if not np.any(np.isfinite(search.state.incumbent_key)):
        raise problem.unstable_error()
    outcomes = [_outcome(search, stopped)]
    outcomes += _polished(outcomes[0], mode)
    if confirmation is not None:
        confirmation, further = _confirmed(outcomes[-1], confirmation, setup, mode, options.effort)
        outcomes += further
    seconds = time.perf_counter() - began
    return _result(outcomes, setup, confirmation, mode=mode, seconds=seconds)


def search_of(
    problem: TuningProblem, solver: Solver, mode: str, effort: Effort, show: bool | None = False
) -> Search:
    """The search with its starting points and, if the solver leaves the number of starts open, a
    `Strategy` for several phases.

    Values are evaluated before the derivatives are compiled, so that an error is raised early.
    With a checkpoint the starting points are determined again; they are the same as before.  A bar
    shows the points, unless `show` is False, and what will follow.
    """
    starts = solver.starts or number_of_starts(effort.starts, problem.runs, solver)
    checks.fits_memory("starts", starts, 8.0 * problem.size * NUMBERS_A_RUN)
    seed = int(problem.options.seed)
    strategy = None
    if solver.starts is None:
        count = min(effort.values, MAX_SCREENED_RUNS // problem.runs)
        with bar(show, count + 1, unit="points") as shown:
            shown.set_description(_cost_in_words(problem, count + 1, starts, effort))
            screening = screen(problem, count, seed, shown.update)
        comparison = None
        if effort.values and solver.handles_requirements and mode == "forward":
            comparison = StepComparison(partial(objective_at_quarter_step, problem))
        z = _chosen_starts(problem, screening, starts, comparison)
        second_starts = min(effort.second_starts, starts)
        second_points = count // 3 if second_starts else 0
        at_ends = 0
        starts_around = 0
        # Other solvers are for many numbers, of which there are too many pairs.
        if isinstance(solver, SQP) and count and len(z) > FEW_STARTS:
            at_ends = STARTS_AT_ENDS
            starts_around = STARTS_AROUND
        strategy = Strategy(
            screening,
            effort.selection,
            len(z),
            second_points,
            second_starts,
            at_ends,
            starts_around,
            comparison,
        )
    else:
        z = starting_points(problem.box, starts, seed)
        z = usable_starts(problem, seed, z, values(problem, problem.box.z[None]))
    problem = problem.for_solver(solver)
    space = problem.search_space(effort.iterations)
    starts_used = len(z)
    rows = starts_used
    if strategy is not None and problem.allowed:
        # a later phase may begin at more points
        rows = max(rows, REPAIR_STARTS, strategy.second_starts + 1)
    z = z[np.minimum(np.arange(rows), starts_used - 1)]  # the last start fills the further rows
    evaluate = Evaluator(problem, problem.candidates(z), mode, space, most=STARTS_TOGETHER)
    search = Search(evaluate, solver, z, strategy)
    search.retire(slice(starts_used, None))
    return search


def _cost_in_words(problem: TuningProblem, points: int, starts: int, effort: Effort) -> str:
    """What a search will evaluate, without and with derivatives."""
    of_runs = f" of {problem.runs} runs" if problem.runs > 1 else ""
    return (
        f"{points:,} points{of_runs} without derivatives, then {starts} starts{of_runs} with them,"
        f" up to {effort.iterations} steps"
    )


def _chosen_starts(
    problem: TuningProblem, screening: Screening, starts: int, comparison: StepComparison | None
) -> np.ndarray:
    """The points that the search begins from, (k, p): the best screened points of each ranking that
    differ from one another and count.

    If all of them are refused, or the scenario's gains are the only point and leave their bounds,
    the start is found by `usable_starts`.
    """
    seed = int(problem.options.seed)
    orders = [screening.order(weight) for weight in WEIGHTS]
    is_refused = problem.sampled_too_slowly
    z = distinct(screening, orders, starts, problem.box, is_refused, comparison)
    if len(z):
        best = jax.tree.map(lambda x: x[orders[0][:1]], screening.found)
        if len(screening.points) > 1 or best.margin[0] > 0:
            return z
    first = jax.tree.map(lambda x: x[:1], screening.found)
    z = usable_starts(problem, seed, problem.box.z[None], first)
    if comparison is not None:
        # Its limit is that of the starts, also in a search that continues from a checkpoint.
        comparison(z, values(problem, z).objective)
    return z


def _run(
    search: Search, mode: str, iterations: int, checkpoint: Path | None, options: SearchOptions
) -> str:
    """Runs a search, from its checkpoint if there is one; returns why it ended."""
    mark = ""
    if checkpoint is not None:
        mark = fingerprint(search.evaluate, search.solver, mode, iterations)
        if checkpoint.exists():
            load_checkpoint(checkpoint, search, mark)
    with bar(options.show, iterations, search.state.iteration, unit="steps") as shown:
        unit = unit_text(search.evaluate.problem.scenario, POSITION)

        def on_step(search: Search) -> None:
            if checkpoint is not None:
                save_checkpoint(search, checkpoint, mark)
            shown.update(1)
            last = {name: x[-1] for name, x in search.history.items()}
            s = int(np.argmin(np.where(last["valid"], last["loss"], np.inf)))  # the best start
            shown.set_postfix_str(
                f"loss {last['loss'][s]:.5g}, |gradient| {last['gradient_norm'][s]:.2g}, margin"
                f" {last['margin'][s]:.3g} {unit}"
            )
            if options.callback is not None:
                options.callback(search)

        return search.run(iterations, on_step)


def _setup(problem: TuningProblem, report: Report) -> TuneSetup:
    """The options of the call that the report needs."""
    seed = int(problem.options.seed)
    if report.seed is None:
        report = dataclasses.replace(report, seed=(seed + 1) % 2**32)
    low, high = (in_units(problem.blocks, z) for z in (problem.box.low, problem.box.high))
    return TuneSetup(
        **vars(problem.options) | {"seed": seed},
        objective=problem.objective,
        report=report,
        limits=tuple(zip(low.tolist(), high.tolist(), strict=True)),
        reasons=problem.box.reasons,
    )


class Outcome(NamedTuple):
    """The best point of a search and its optimality conditions."""

    search: Search
    z: np.ndarray
    """The best point, (p,)."""
    stopped: str
    """As `TuneResult.stopped`."""
    multipliers: np.ndarray
    """As `Conditions.multipliers`, (R,)."""
    residuals: np.ndarray
    """As `Conditions.residuals`, (3,)."""
    tried: tuple[str, ...] = ()
    """As `TuneResult.tried`."""


def _outcome(search: Search, stopped: str) -> Outcome:
    """The best point of a search with its multipliers and residuals, and why the search ended.

    The solver's own criterion is replaced by the conditions at the best point, unless a search that
    ran out of iterations or patience is at feasible gains where they do not hold.
    """
    found = search.conditions()
    if stopped == "converged" or search.is_violated or found.hold:
        if not np.all(np.isfinite(found.residuals)):
            stopped = NO_GRADIENT
        elif search.is_violated:
            # Without phases the search itself minimised the violation.
            is_minimised = search.strategy is None or search.state.repair_ended
            stopped = INFEASIBLE if is_minimised and found.hold else NOT_FOUND_FEASIBLE
        elif found.hold and search.is_unconfirmed:
            stopped = UNCONFIRMED
        elif found.at_kink:
            stopped = AT_KINK
        else:
            stopped = "converged" if found.hold else STUCK
    tried = _tried(search)
    if search.is_violated:
        tried += conflicts_in_words(search.evaluate.problem, search.state.least_excess)
    z = search.state.incumbent_z
    return Outcome(search, z, stopped, found.multipliers, found.residuals, tried)


def _tried(search: Search) -> tuple[str, ...]:
    """What a search in phases did, in words; empty for a search without phases."""
    if search.strategy is None:
        return ()
    valleys, reached, confirming, below = search.state.valleys.tolist()
    starts = search.strategy.starts
    lines = []
    if search.state.unresolved:
        assert search.strategy.comparison is not None
        change = 100 * search.strategy.comparison.largest_change
        lines.append(
            f"{search.state.unresolved} searches came to gains, or would have begun at gains, whose"
            f" objective changes by more than {change:.2g} % at a quarter of the time step: they do"
            " not count"
        )
    if starts > 1:
        noun = "valley"
        if valleys != 1:
            noun = "valleys"
        lines.append(
            f"searches from {starts} of {len(search.strategy.screening.points)} points: they were"
            f" in {valleys} {noun} when they ended or were dropped, {reached} in the best one, and"
            f" {confirming} within {100 * SAME_OBJECTIVE:g} % of the best objective"
        )
    if below:
        lines.append(f"{below} of them had a lower objective then and broke a requirement")
    phase = search.state.phase
    if phase == REPAIR or search.state.repair_ended:
        least = float(search.state.incumbent_key[0])
        how = "to a stationary point" if search.state.repair_ended else "without converging"
        lines.append(
            f"no gains that keep the requirements were found; the largest excess was minimised from"
            f" up to {REPAIR_STARTS} points, {how}: {least:.3g}"
        )
    elif phase >= SECOND_SEARCH:
        places = []
        if search.state.phases_around:
            places.append("the best points near them")
        if search.strategy.starts_at_ends:
            places.append("points with one or two of them at an end of their range")
        text = "a second search followed, around the best gains"
        if places:
            text += f", from {' and '.join(places)}"
        lines.append(text)
    return tuple(lines)


# ---------------------------------------------------------------------- at half the time step


def _polished(outcome: Outcome, mode: str) -> list[Outcome]:
    """The outcome of a short search by `SQP` at half the time step.

    Empty if no requirement is broken there by more than the tolerance, if the requirements are not
    kept at the full step, or if the short search finds no gains that keep them.  Also empty for a
    solver that has no constraints, and in reverse mode.
    """
    search = outcome.search
    problem = search.evaluate.problem
    can_polish = search.solver.handles_requirements and mode == "forward" and problem.allowed
    if search.is_violated or not can_polish:
        return []
    worst = excess_at_half_step(
        problem.scenario,
        _tuned_values(problem, outcome.z),
        problem.objective,
        problem.options,
        batch=problem.runs * problem.points_together(1),
    )
    if not worst.is_broken:
        return []
    found = _continued(outcome, problem.at_half_the_step, mode, POLISH_STEPS)
    if found is None:
        return []
    summary = (
        f"{worst.requirement} was broken at dt / 2 by {worst.excess:.2g} of its scale, so that"
        f" {len(found.search.history['z'])} steps at dt / 2 followed; the result is one of dt / 2"
    )
    return [found._replace(tried=(*outcome.tried, summary))]


def _continued(
    outcome: Outcome, problem: TuningProblem, mode: str, iterations: int
) -> Outcome | None:
    """The outcome of a further search from a result, for a problem that has changed; None if it
    finds no gains that keep the requirements.

    `SQP` takes the place of other solvers with constraints in forward mode.
    """
    solver = outcome.search.solver
    if solver.handles_requirements and mode == "forward":
        solver = SQP(sharpenings=0)
        iterations = POLISH_STEPS
    # A group of as many starts as before needs no further compilation.
    starts = min(len(outcome.search.state.finished), STARTS_TOGETHER)
    z = np.tile(outcome.z, (starts, 1))
    space = problem.search_space(iterations)
    evaluate = Evaluator(problem, problem.candidates(z), mode, space, most=STARTS_TOGETHER)
    search = Search(evaluate, solver, z)
    search.retire(slice(1, None))
    stopped = search.run(iterations)
    if search.is_violated:
        return None
    found = _outcome(search, stopped)
    if outcome.stopped == UNCONFIRMED and found.stopped in ("converged", AT_KINK):
        return found._replace(stopped=UNCONFIRMED)
    return found


def _confirmed(
    outcome: Outcome, confirmation: Confirmation, setup: TuneSetup, mode: str, effort: Effort
) -> tuple[Confirmation, list[Outcome]]:
    """The rounds of fresh runs, and the outcome of the searches with tightened limits: one, or none
    if the limits were not tightened.
    """
    problem = outcome.search.evaluate.problem
    names = tuple(block.path for block in problem.blocks)
    request = SampleRequest(
        scenario=problem.scenario,
        tuned=names,
        objective=setup.objective,
        options=problem.options,
        dt=float(problem.options.dt),
        runs=0,
        seed=int(setup.report.seed or 0),
        batch=problem.runs * problem.points_together(1),
    )
    found: list[Outcome] = []
    tightened = confirmation.tightened
    while True:
        gains = with_parameters(problem.scenario, _tuned_values(problem, outcome.z))
        confirmation = confirmation.after_round(request, gains, tightened)
        further = confirmation.next_tightening
        if further is None or outcome.search.is_violated:
            return confirmation, found
        tightened = further
        limited = problem.with_objective(tighter(problem.objective, tightened))
        new = _continued(outcome, limited, mode, effort.iterations)
        if new is None:
            return confirmation, found
        outcome = new._replace(tried=outcome.tried)
        found = [outcome]


def _result(
    outcomes: list[Outcome],
    setup: TuneSetup,
    confirmation: Confirmation | None,
    *,
    mode: str,
    seconds: float,
) -> TuneResult:
    """The result, which is the last outcome; the others are part of its history."""
    search = outcomes[0].search
    problem = search.evaluate.problem
    history = _history(search)
    for further in outcomes[1:]:
        history = _joined(history, _history(further.search))
    history["x"] = in_units(problem.blocks, history["z"])
    outcome = outcomes[-1]
    tuned = _tuned_values(problem, outcome.z)
    return TuneResult(
        scenario=with_parameters(problem.scenario, tuned),
        start=problem.scenario,
        values=tuned,
        names=tuple(names_of(problem.blocks)),
        history=history,
        best_start=0,
        stopped=outcome.stopped,
        optimiser=search.solver.name,
        mode=mode,
        seconds=seconds,
        setup=dataclasses.replace(setup, dt=float(outcome.search.evaluate.problem.options.dt)),
        multipliers=tuple(map(float, outcome.multipliers)),
        residuals=tuple(map(float, outcome.residuals)),
        probes=search.state.plain_values,
        tried=outcome.tried,
        objective=float(outcome.search.state.incumbent_key[1]),
        confirmation=confirmation,
    )


def _tuned_values(problem: TuningProblem, z: np.ndarray) -> dict[str, np.ndarray]:
    """Path -> tuned value in the unit of its leaf, at the coordinates z, (p,)."""
    point = values_at(problem.blocks, jnp.asarray(z))
    return {path: np.asarray(x) for path, x in point.items()}


def _history(search: Search) -> dict[str, np.ndarray]:
    """The history with the start that found the best result in the first column."""
    starts = len(search.state.finished)
    order = sorted(range(starts), key=lambda s: s != search.best)
    history = {name: np.stack(x) for name, x in search.history.items()}
    return {name: x if name == "evaluations" else x[:, order] for name, x in history.items()}


def _joined(first: dict[str, np.ndarray], last: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Two histories, one after the other.  The last one has one active start: its entries are
    repeated for the other starts and marked there as invalid.
    """
    starts = first["valid"].shape[1]
    joined = {"evaluations": np.concatenate([first["evaluations"], last["evaluations"]])}
    joined["evaluations"][len(first["evaluations"]) :] += first["evaluations"][-1]
    for name, x in last.items():
        if name == "evaluations":
            continue
        repeated = np.repeat(x[:, :1], starts, axis=1)
        if name == "valid":
            repeated[:, 1:] = False
        joined[name] = np.concatenate([first[name], repeated])
    return joined
