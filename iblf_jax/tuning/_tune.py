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
from typing import Any

import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import bar
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.tuning.checkpoints import fingerprint, load_checkpoint, save_checkpoint
from iblf_jax.tuning.evaluation import Evaluator, values
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.options import Report, SearchOptions, chosen_solver, options_of
from iblf_jax.tuning.parameters import Tunable, in_units, names_of, values_at
from iblf_jax.tuning.problem import TuningProblem
from iblf_jax.tuning.result import STUCK, TuneResult, TuneSetup
from iblf_jax.tuning.robust import Risk
from iblf_jax.tuning.runs import NUMBERS_A_RUN
from iblf_jax.tuning.search import Search
from iblf_jax.tuning.solvers import Optimality, Solver
from iblf_jax.tuning.starts import NearbyStarts, feasible_starts, starting_points

INFEASIBLE = "the requirements cannot be kept together near these gains"
"""Why a search ended that converged to gains with the least possible violation."""
NO_GRADIENT = "the objective has no finite derivative at the start"
"""Why a search ended that could not make a step."""


@notices.each_warning_once
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
    iterations: int = 60,
    report: Report | None = None,
    checkpoint: str | os.PathLike | None = None,
    progress: bool | Callable[[Search], None] | None = None,
    **deprecated: Any,
) -> TuneResult:
    """Tunes leaves of a scenario, its gains for example, by derivatives through the closed loop.

        minimise    risk_b [ sum_k w_k term_k ]
        subject to  the requirements and the ranges of the parameters

    Args:
      scenario: with the gains to start from, of n joints.
      parameters: paths such as "controller.K2" (one number a joint) or `tunable(path, low, high,
        tied=...)`.
      objective: composed from `iblf_jax.objectives` with + and weights; it may contain
        requirements.
      duration: length of a run [s], a multiple of the step.
      dt: time step [s].
      method: integrator.
      backend: on what values and forward mode are executed, as in `monte_carlo`.  Reverse mode
        always uses plain XLA.
      perturbations: path -> `factor`, `offset` or `value` of a distribution; without them there is
        one nominal run.
      runs: number of perturbed runs in the loss.
      seed: of these runs, and of further starts.
      risk: "mean", "worst", "cvar" or `cvar(level)`.
      solver: `ij.tuning.SQP()` (sequential quadratic programming; requirements are constraints),
        `ij.tuning.LBFGS()` or `ij.tuning.Adam()` (requirements are penalties), with their options,
        or one of their names "sqp", "lbfgs", "adam".  If not given, SQP up to 32 numbers, and
        L-BFGS with reverse mode above.
      iterations: steps of the solver at most.
      report: `ij.tuning.Report(runs=..., seed=..., confidence=...)`: options of the report on fresh
        runs.
      checkpoint: a file that stores the state after each step; if it exists, the search continues
        from it.
      progress: whether to show a progress bar (on a terminal or in a notebook, if not given); or a
        function that is called with the `Search` after each step.
      deprecated: keyword arguments of earlier versions, which are options of solver and report now.

    Returns:
      A `TuneResult`: scenario, history, report, plot.

    Raises:
      ValueError: an argument that is not valid, or a start that cannot be integrated with this
        step; the message names the remedy.
      TypeError: an unknown keyword argument.

    Source: design of this package; see the modules of `iblf_jax.tuning` for the methods.
    """
    began = time.perf_counter()
    iterations = checks.positive_integer("iterations", iterations, most=checks.MAX_STEPS)
    options = options_of(solver, report, progress, deprecated)
    if checkpoint is not None:
        checkpoint = checks.file_to_write("checkpoint", checkpoint)
    problem = TuningProblem.build(
        scenario,
        parameters,
        objective,
        duration=duration,
        dt=dt,
        method=method,
        backend=backend,
        perturbations=perturbations,
        runs=runs,
        seed=seed,
        risk=risk,
    )
    solver, mode = chosen_solver(options, problem.size)
    search, probes = _search_of(problem, solver, mode, iterations)
    stopped = _run(search, mode, iterations, checkpoint, options)
    if not np.any(np.isfinite(search.state["best_key"])):
        raise problem.unstable_error()
    seconds = time.perf_counter() - began
    setup = _setup(problem, options.report)
    return _result(search, setup, stopped, mode=mode, seconds=seconds, probes=probes)


def _search_of(
    problem: TuningProblem, solver: Solver, mode: str, iterations: int
) -> tuple[Search, int]:
    """The search from its starting points, and the number of points that were evaluated without
    derivatives to find them.

    Values come first, so that an error does not wait for the derivatives' compilation.  With a
    checkpoint the starting points are determined again, and are the same.
    """
    checks.fits_memory("starts", solver.starts, 8.0 * problem.size * NUMBERS_A_RUN)
    seed = int(problem.options.seed)
    second_start = None
    probes = 0
    if solver.starts == 1 and solver.handles_requirements and problem.multimodal:
        nearby = NearbyStarts(
            partial(values, problem), problem.box, seed, problem.sampled_too_slowly
        )
        z = feasible_starts(problem, seed, np.stack([nearby.points[0]] * 2), nearby.first)
        second_start = nearby.away_from
        probes = nearby.count
    else:
        z = starting_points(problem.box, solver.starts, seed)
        z = feasible_starts(problem, seed, z, values(problem, problem.box.z[None]))
    problem = problem.for_solver(solver)
    space = problem.search_space(iterations)
    evaluate = Evaluator(problem, problem.candidates(z), mode, space)
    return Search(evaluate, solver, z, second_start), probes


def _run(
    search: Search, mode: str, iterations: int, checkpoint: Path | None, options: SearchOptions
) -> str:
    """All steps of a search, from its checkpoint if there is one; returns why it ended."""
    mark = fingerprint(search.evaluate.problem, search.solver, mode, iterations)
    if checkpoint is not None and checkpoint.exists():
        load_checkpoint(checkpoint, search, mark)
    with bar(options.show, iterations, int(search.state["iteration"]), unit="steps") as shown:

        def on_step(search: Search) -> None:
            if checkpoint is not None:
                save_checkpoint(search, checkpoint, mark)
            _show(shown, search)
            if options.callback is not None:
                options.callback(search)

        return search.run(iterations, on_step)


def _show(shown: Any, search: Search) -> None:
    """Writes the last step's numbers beside the progress bar."""
    shown.update(1)
    last = {name: x[-1] for name, x in search.history.items()}
    s = int(np.argmin(np.where(last["valid"], last["loss"], np.inf)))
    shown.set_postfix_str(
        f"loss {last['loss'][s]:.5g}, |gradient| {last['gradient_norm'][s]:.2g}, margin"
        f" {last['margin'][s]:.3g} rad"
    )


def _setup(problem: TuningProblem, report: Report) -> TuneSetup:
    """What the report needs to know of the call."""
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


def _result(
    search: Search, setup: TuneSetup, stopped: str, *, mode: str, seconds: float, probes: int
) -> TuneResult:
    problem = search.evaluate.problem
    state = search.state
    best = search.best
    optimality = search.solver.optimality(state["solver"], best)
    violated = bool(state["best_key"][best][0] > 0)
    if stopped == "converged":
        stopped = _why_converged(optimality, violated)
    multipliers, residuals = _multipliers(search, optimality, stopped, violated)
    point = values_at(problem.blocks, jnp.asarray(state["best_z"][best]))
    tuned = {path: np.asarray(x) for path, x in point.items()}
    history = {name: np.stack(x) for name, x in search.history.items()}
    history["x"] = in_units(problem.blocks, history["z"])
    return TuneResult(
        scenario=with_parameters(problem.scenario, tuned),
        start=problem.scenario,
        values=tuned,
        names=tuple(names_of(problem.blocks)),
        history=history,
        best_start=best,
        stopped=stopped,
        optimiser=search.solver.name,
        mode=mode,
        seconds=seconds,
        setup=setup,
        multipliers=tuple(map(float, multipliers)),
        residuals=tuple(map(float, residuals)),
        probes=probes,
    )


def _why_converged(optimality: Optimality | None, violated: bool) -> str:
    """Why a search ended of which all starts have converged."""
    if optimality is not None and not np.all(np.isfinite(optimality.residuals)):
        return NO_GRADIENT
    if optimality is not None and optimality.stuck:
        return STUCK
    return INFEASIBLE if violated else "converged"


def _multipliers(
    search: Search, optimality: Optimality | None, stopped: str, violated: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers and residuals at the best result.

    Multipliers are known at the point where the solver ended only, and are NaN elsewhere.  Where
    requirements are violated they are those of the penalty function, and are left out.
    """
    none = np.zeros(0)
    best_z = search.state["best_z"][search.best]
    if optimality is None:
        multipliers = search.state["multipliers"][search.best]
        residuals = none
        is_here = stopped == "converged"
    else:
        multipliers = optimality.multipliers
        residuals = optimality.residuals
        is_here = np.array_equal(best_z, optimality.z)
    unknown = np.full(len(multipliers), np.nan)
    if violated:
        return none, none
    if stopped == STUCK:
        return unknown, residuals
    if not is_here or stopped == NO_GRADIENT:
        return unknown, none
    return multipliers, residuals
