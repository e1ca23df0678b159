"""`tune`: gains by gradient through the closed loop, under requirements, over perturbed runs,
checked on fresh ones.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from itertools import islice
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import bar
from iblf_jax.engine.mechanism import known_of
from iblf_jax.engine.plan import BACKENDS, differentiates_forward, values_together
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.sampling import check_step, has_noise
from iblf_jax.simulation.scenario import Scenario, canonical, fit_joints
from iblf_jax.studies.designs import MOST_RUNS
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import Cases, targets_of
from iblf_jax.studies.recommended import recommended_dt
from iblf_jax.studies.statistics import check_confidence
from iblf_jax.tuning import newton
from iblf_jax.tuning import probes as probing
from iblf_jax.tuning.first_order import LBFGS, Adam
from iblf_jax.tuning.newton import Newton, Pieces
from iblf_jax.tuning.objectives import (
    Objective,
    check_signals,
    checked,
    complete,
    for_scenario,
    is_complete,
    is_smoothed,
)
from iblf_jax.tuning.optimise import (
    FIRST_MU,
    CountedProblem,
    Loop,
    fingerprint,
    load_checkpoint,
    save_checkpoint,
)
from iblf_jax.tuning.parameters import Box, Tunable, in_units, layout, names_of, values_at
from iblf_jax.tuning.probes import Probes
from iblf_jax.tuning.problem import (
    NO_LEVEL,
    NUMBERS_A_RUN,
    Formulation,
    Lane,
    ProblemInputs,
    Value,
    piece_counts,
    value,
)
from iblf_jax.tuning.ranges import sampled_too_slowly
from iblf_jax.tuning.result import STUCK, TuneResult, TuneSetup
from iblf_jax.tuning.robust import Risk, as_risk

OPTIMISERS = ("auto", "newton", "lbfgs", "adam")
MODES = ("auto", "forward", "reverse")
LEARNING_RATES = (1e-12, 1e3)
"""Between which a learning rate must lie [1]."""
SPREAD = 1.0
"""Half-width of the box around the start in which further starts are drawn, in the coordinates z: a
factor e for gains."""
MOST_SHARPENINGS = 60
"""Past them the smoothing is no number in float32."""
INFEASIBLE = "the requirements cannot be kept together near these gains"
"""Why a tuning stopped that converged to gains that break a requirement as little as can be."""
NO_SLOPE = "the objective has no finite derivative at the start"
"""Why one stopped that could not make a step."""
SCREENED = 32
"""Points of the whole box that are looked at where the first start leaves its bounds, and for the
ends of a front."""


@notices.each_warning_once
def tune(
    scenario: Scenario,
    parameters: Sequence[str | Tunable],
    objective: Objective,
    *,
    duration: float,
    dt: float = 1e-3,
    perturbations: Mapping[str, Perturbation] | None = None,
    runs: int = 1,
    seed: int = 0,
    risk: str | Risk = "mean",
    resample: bool = False,
    method: str = "rk4",
    backend: str = "auto",
    optimiser: str = "auto",
    mode: str = "auto",
    starts: int = 1,
    sharpenings: int = 2,
    iterations: int = 60,
    tolerance: float = 1e-5,
    patience: int = 15,
    learning_rate: float = 0.1,
    report_runs: int = 1000,
    report_seed: int | None = None,
    confidence: float = 0.95,
    checkpoint: str | os.PathLike | None = None,
    progress: bool | None = None,
    callback: Callable[[Loop], None] | None = None,
) -> TuneResult:
    """Tunes leaves of a scenario, its gains say, by gradient through the closed loop.

        minimise  risk_b [ sum_k w_k term_k ]   subject to the requirements and the limits of the
        parameters

    Args:
      scenario: where to start from, of n joints.
      parameters: paths such as "controller.K2" (one number a joint) or `tunable(path, low, high,
        tied=...)`.
      objective: composed from `iblf_jax.objectives` with + and weights; it may hold requirements.
      duration: length of a run [s], a whole number of steps.
      dt: time step [s].
      perturbations: path -> `factor`, `offset` or `value` of a distribution; one nominal run if
        there are none.
      runs: perturbed runs that a loss is made of.
      seed: fixes these runs, and the further starts.
      risk: "mean", "worst", "cvar" or `cvar(level)`.
      resample: draw the runs anew at every step (adam only); the same ones for all steps otherwise.
      method: integrator.
      backend: what values and forward mode run on, as in `monte_carlo`.  Reverse mode is plain XLA.
      optimiser: "newton" (sequential quadratic programming with Gauss-Newton matrices, in a trust
        region; requirements are constraints of it), "lbfgs" and "adam" (requirements are
        penalties), or "auto": newton where forward mode is used, else lbfgs, and adam where runs
        are resampled.
      mode: "forward", "reverse", or "auto": forward up to 32 numbers.
      starts: number of starting points.  1: the scenario's; with six gains and more under
        requirements, where there are valleys, the best of some values around it, and where the
        search from there has soon arrived, a second one from another of them (`probes`). More: the
        scenario's, the others are drawn around it; they run as one batch, and at each sharpening
        the better half goes on.
      sharpenings: how many times the smoothing of the peaks in the objective's terms is divided by
        4, each time once the starts have converged; 0 where no term is smoothed, and with adam.
        Requirements are exact from the start.
      iterations: steps of the optimiser at most.
      tolerance: relative change of the loss below which a start has converged.
      patience: stop (before the last sharpening: sharpen) after so many steps without a better
        result.
      learning_rate: of adam, in squashed coordinates.
      report_runs, report_seed: fresh runs for the report, and their seed (seed + 1 if not given);
        without perturbations it is on the one nominal run.
      confidence: of the report's intervals.
      checkpoint: a file that holds the state after each step; if it exists, tuning goes on from
        there.
      progress: a progress bar; shown where somebody watches if not given.
      callback: called with the loop after each step.

    Returns:
      A `TuneResult`: scenario, history, report, plot.

    Raises:
      ValueError: bad arguments, or a start that cannot be integrated with this step; the message
        names the remedy.

    Source: design of this package; see the modules of `iblf_jax.tuning` for the methods.
    """
    began = time.perf_counter()
    iterations, starts = (
        checks.positive_integer("iterations", iterations, most=checks.MOST_STEPS),
        checks.positive_integer("starts", starts),
    )
    patience, report_runs = (
        checks.positive_integer("patience", patience, most=checks.MOST_STEPS),
        checks.positive_integer("report_runs", report_runs, most=MOST_RUNS),
    )
    sharpenings = checks.positive_integer(
        "sharpenings", sharpenings, least=0, most=MOST_SHARPENINGS
    )
    tolerance = checks.number_between("tolerance", tolerance, 0.0, 1.0, "1")
    learning_rate = checks.number_between("learning_rate", learning_rate, *LEARNING_RATES, "1")
    confidence, resample, seed = (
        check_confidence(confidence),
        checks.flag("resample", resample),
        checks.seed(seed),
    )
    report_seed = (
        (seed + 1) % 2**32 if report_seed is None else checks.seed(report_seed, "report_seed")
    )
    checkpoint = None if checkpoint is None else checks.file_to_write("checkpoint", checkpoint)
    if callback is not None and not callable(callback):
        raise checks.fail(
            "callback", callback, "a function that is called with the loop after each step"
        )
    checks.one_of("mode", mode, MODES)
    checks.one_of("optimiser", optimiser, OPTIMISERS)
    timing = {"duration": duration, "dt": dt, "method": method, "backend": backend}
    problem = build(scenario, parameters, objective, perturbations, runs, seed, risk, timing)
    mode, optimiser = choose(mode, optimiser, len(problem.box.z), resample)
    checks.fits("starts", starts, 8.0 * len(problem.box.z) * NUMBERS_A_RUN)
    # With a checkpoint too: what is looked at is no part of it, and the same again.
    probes = (
        problem.probes(seed)
        if starts == 1 and optimiser == "newton" and problem.has_valleys
        else None
    )
    z = (
        starting_points(problem.box, starts, seed)
        if probes is None
        else np.stack([probes.points[0]] * 2)
    )
    # Values alone: who is refused has waited for one small kernel.
    z = way_in(problem, seed, z, problem.at_start if probes is None else probes.first)
    radius = probing.FIRST_RADIUS if problem.has_valleys else newton.FIRST_RADIUS
    method_ = make_method(
        optimiser,
        problem.box,
        iterations,
        tolerance,
        learning_rate,
        problem.limits,
        problem.runs,
        radius,
    )
    # The line search of L-BFGS is a loop of JAX's around the problem.
    formulation = problem.formulation._replace(
        nested=optimiser == "lbfgs", penalised=method_.penalised
    )
    evaluator = CountedProblem(formulation, problem.shared, problem.lanes(z), mode)
    stages = sharpenings if method_.converges and is_smoothed(problem.shared.objective) else 0
    loop = Loop(evaluator, method_, z, resample=resample, sharpenings=stages)
    if probes is not None:
        loop.take_turns(probes.best)
    options = (
        optimiser,
        mode,
        starts,
        tolerance,
        learning_rate,
        resample,
        stages,
        iterations if optimiser == "adam" else 0,
    )
    mark = fingerprint(formulation, problem.shared, options)
    if checkpoint is not None and checkpoint.exists():
        load_checkpoint(checkpoint, loop, mark)
    with bar(progress, iterations, int(loop.state["iteration"]), unit="steps") as shown:

        def on_step(loop: Loop) -> None:
            if checkpoint is not None:
                save_checkpoint(loop, checkpoint, mark)
            _show(shown, loop)
            if callback is not None:
                callback(loop)

        stopped = loop.run(iterations, tolerance=tolerance, patience=patience, on_step=on_step)
    if not np.any(np.isfinite(loop.state["best_key"])):
        raise problem.too_stiff()
    setup = TuneSetup(
        problem.shared.objective,
        dict(perturbations or {}),
        problem.formulation.risk,
        problem.runs,
        seed,
        float(duration),
        float(dt),
        method,
        backend,
        report_runs,
        report_seed,
        confidence,
        tuple(
            zip(
                *(
                    in_units(problem.formulation.blocks, z).tolist()
                    for z in (problem.box.low, problem.box.high)
                ),
                strict=True,
            )
        ),
        reasons=problem.box.reasons,
    )
    return _result(
        problem,
        loop,
        setup,
        stopped,
        optimiser,
        mode,
        time.perf_counter() - began,
        0 if probes is None else probes.count,
    )


class Problem:
    """A tuning problem, checked and ready to be evaluated."""

    def __init__(
        self,
        formulation: Formulation,
        shared: ProblemInputs,
        box: Box,
        runs: int,
        step: Callable[[], float],
    ):
        self.formulation, self.shared, self.box, self.runs = formulation, shared, box, runs
        self.step = step
        """Looks for a time step that will do, which takes some runs."""

    def too_stiff(self, trusted: float = 0.0) -> ValueError:
        """The error of a problem in which no gains that were tried have runs that can all be
        integrated; it names a step that will do.

        Args:
          trusted: share of the runs that can, at the best of these gains.
        """
        count = round(trusted * self.runs)
        how_many = f"only {count} of {self.runs} runs" if count else "no run"
        return checks.fail(
            "scenario",
            f"gains with which {how_many} can be integrated to the end, and stably",
            "a start with which all runs can",
            f"Take dt={self.step():g}, not {float(self.shared.dt):g} s (ij.recommended_dt), lower"
            " gains, or narrower perturbations.",
        )

    def too_slow(self, z: np.ndarray) -> bool:
        """Whether the law is sampled too slowly for these gains, (p,)."""
        return sampled_too_slowly(
            with_parameters(
                self.shared.cases.scenario, values_at(self.formulation.blocks, jnp.asarray(z))
            )
        )

    @property
    def has_valleys(self) -> bool:
        """Whether it is to be expected that searches from different starts end at different
        gains.
        """
        return bool(self.formulation.shares) and len(self.box.z) >= probing.LEAST

    def values(self, z: np.ndarray) -> Value:
        """The problem without derivatives at some points, (S, p), as arrays; so many at once that
        few shapes are compiled.
        """
        # Where many points will be looked at, what they take serves one too.
        many = len(z) > 1 or self.runs > 1 or self.has_valleys or self.formulation.levels
        group, parts = values_together(self.runs) if many else 1, []
        for first in range(0, len(z), group):
            lanes = self.lanes(np.resize(z[first : first + group], (group, z.shape[1])))
            parts.append(
                jax.tree.map(np.asarray, value(self.shared, lanes, formulation=self.formulation))
            )
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(z)], *parts)

    @cached_property
    def at_start(self) -> Value:
        """The problem where it starts, (1, ...)."""
        return self.values(self.box.z[None])

    def probes(self, seed: int) -> Probes:
        """Values around the start."""
        return Probes(self.values, self.box, seed, self.too_slow)

    @property
    def limits(self) -> Pieces:
        """The requirements, as `newton` sees them."""
        terms, form = len(self.shared.objective.terms), self.formulation
        levels = terms if form.levels else 0
        return Pieces.of(
            (*form.pieces[terms:-1], *(1,) * levels), (*form.shares, *(0.0,) * levels), self.runs
        )

    def lanes(self, z: np.ndarray) -> Lane:
        """Lanes at z, (S, p): the same runs for all, no multipliers yet."""
        starts, dtype = len(z), self.shared.dt.dtype
        index = np.broadcast_to(np.arange(self.runs, dtype=np.uint32), (starts, self.runs))
        count, terms = len(self.formulation.shares), len(self.shared.objective.terms)
        weights, lam, mu = (
            np.ones((starts, terms), dtype),
            np.zeros((starts, count), dtype),
            np.full(starts, FIRST_MU, dtype),
        )
        level = np.full((starts, terms), NO_LEVEL, dtype)
        return Lane(np.asarray(z, dtype), index, weights, lam, mu, level)


def build(
    scenario,
    parameters,
    objective,
    perturbations,
    runs: int,
    seed: int,
    risk,
    timing,
    *,
    levels: bool = False,
) -> Problem:
    """Checks what `tune` and its relatives were asked for; `timing` is duration, dt, method and, if
    it is not "auto", backend.
    """
    tableau(timing["method"])
    checks.one_of("backend", timing.get("backend", "auto"), BACKENDS)
    steps = checks.whole_steps(timing["duration"], timing["dt"])
    goal, risk = checked(objective), as_risk(risk)
    seed, runs, scenario = (
        checks.seed(seed),
        checks.positive_integer("runs", runs, most=MOST_RUNS),
        canonical(scenario),
    )
    check_step(scenario, float(timing["dt"]))
    dtype = scenario.initial.q.dtype
    targets, by_path = targets_of(scenario, {} if perturbations is None else perturbations)
    if not targets and runs > 1 and not has_noise(scenario):
        raise checks.fail(
            "runs",
            runs,
            "1 without perturbations",
            "All runs would be the same: give perturbations.",
        )
    blocks, box = layout(scenario, parameters, float(timing["dt"]), timing["method"])
    checks.fits("runs", runs, 8.0 * (1 + len(box.z)) * NUMBERS_A_RUN)
    goal = for_scenario(goal, scenario)
    check_signals(goal, scenario)
    fit_joints(goal, scenario.n, "objective")
    ones = complete(goal, np.ones(len(goal.terms)))
    shares = tuple(float(r.allowed) for r in goal.requirements)
    ones, by_path, step = jax.tree.map(
        lambda x: jnp.asarray(x, dtype), (ones, by_path, timing["dt"])
    )
    backend, mechanism = timing.get("backend", "auto"), known_of(scenario)
    pieces = piece_counts(ones, scenario, float(timing["duration"]))
    formulation = Formulation(
        blocks,
        targets,
        steps,
        timing["method"],
        risk,
        shares,
        levels,
        backend,
        mechanism=mechanism,
        pieces=pieces,
    )
    inputs = ProblemInputs(Cases(scenario, by_path, jax.random.PRNGKey(seed)), ones, step)
    again = {
        "duration": timing["duration"],
        "method": timing["method"],
        "perturbations": perturbations,
        "seed": seed,
    }
    problem = Problem(formulation, inputs, box, runs, partial(recommended_dt, scenario, **again))
    if not is_complete(goal):
        goal = complete(goal, problem.at_start.exact[0, : len(goal.terms)])
        problem.shared = problem.shared._replace(
            objective=jax.tree.map(lambda x: jnp.asarray(x, dtype), goal)
        )
    return problem


def choose(mode: str, optimiser: str, size: int, resample: bool) -> tuple[str, str]:
    """Mode and optimiser, where the user left them open."""
    if mode == "auto":
        mode = "forward" if optimiser == "newton" or differentiates_forward(size) else "reverse"
    if optimiser == "auto":
        optimiser = "adam" if resample else "newton" if mode == "forward" else "lbfgs"
    if optimiser == "newton" and mode == "reverse":
        raise checks.fail(
            "mode",
            mode,
            '"forward" with newton',
            'Reverse mode has no Gauss-Newton matrix: take optimiser="lbfgs".',
        )
    if resample and optimiser != "adam":
        raise checks.fail(
            "resample",
            resample,
            f"False with {optimiser}",
            'It compares losses of the same runs: take optimiser="adam".',
        )
    return mode, optimiser


def make_method(
    optimiser: str,
    box: Box,
    iterations: int,
    tolerance: float,
    learning_rate: float,
    limits: Pieces | None = None,
    runs: int = 1,
    radius: float = newton.FIRST_RADIUS,
) -> Any:
    """The optimiser by name."""
    if optimiser == "newton":
        return Newton(box, tolerance, radius, limits, runs)
    return LBFGS(box, tolerance) if optimiser == "lbfgs" else Adam(box, iterations, learning_rate)


def starting_points(box: Box, starts: int, seed: int) -> np.ndarray:
    """The scenario's point and `starts - 1` drawn around it, inside the box, (S, p)."""
    rng = np.random.default_rng([seed, 1])
    drawn = box.z + rng.uniform(-SPREAD, SPREAD, (starts - 1, len(box.z)))
    return np.concatenate([box.z[None], np.clip(drawn, box.low, box.high)])


def way_in(problem: Problem, seed: int, z: np.ndarray, first: Value) -> np.ndarray:
    """The starting points, (S, p), or better ones where the first one leaves its bounds, cannot be
    integrated or is sampled too slowly.

    Past the wall the motion is chaotic, and so it is where it grows from sample to sample: its
    gradient points nowhere.  So SCREENED points of the box are looked at, values only, and the
    starts are those that are stable and break the requirements and the bounds least.

    Raises:
      ValueError: as `look_around`.
    """
    if first.valid[0] and first.margin[0] > 0 and not problem.too_slow(z[0]):
        return z
    points, seen, broken = look_around(problem, seed, z)
    order, ranked = np.lexsort((seen.objective, broken)), list[int]()
    for group in (order[seen.valid[order]], order[~seen.valid[order]]):
        # The map of a point takes long to look at: no more of them than it takes.
        fast = list(
            islice(
                (i for i in group if not problem.too_slow(points[i])), max(len(z) - len(ranked), 0)
            )
        )
        ranked += [*fast, *(i for i in group if i not in fast)]
    return points[ranked[: len(z)]]


def look_around(problem: Problem, seed: int, z: np.ndarray) -> tuple[np.ndarray, Value, np.ndarray]:
    """Some points (S, p) and SCREENED of the whole box, what they give, and by how much they break
    requirements and bounds.

    Raises:
      ValueError: none of them can be integrated; the message names a step that will do.
    """
    rng, box = np.random.default_rng([seed, 2]), problem.box
    low = np.where(np.isfinite(box.low), box.low, box.z - 3 * SPREAD)
    high = np.where(np.isfinite(box.high), box.high, box.z + 3 * SPREAD)
    points = np.concatenate([z, rng.uniform(low, high, (SCREENED, len(low)))])
    seen = problem.values(points)
    if not np.any(seen.valid):
        raise problem.too_stiff(float(np.max(seen.trusted)))
    return (
        points,
        seen,
        np.max(np.maximum(seen.exact_excess, 0.0), axis=1, initial=0.0)
        + np.maximum(-seen.margin, 0.0),
    )


def _show(shown: Any, loop: Loop) -> None:
    shown.update(1)
    last = {name: x[-1] for name, x in loop.history.items()}
    s = int(np.argmin(np.where(last["valid"], last["loss"], np.inf)))
    shown.set_postfix_str(
        f"loss {last['loss'][s]:.5g}, |gradient| {last['gradient_norm'][s]:.2g}, margin"
        f" {last['margin'][s]:.3g} rad"
    )


def _result(
    problem: Problem,
    loop: Loop,
    setup: TuneSetup,
    stopped: str,
    optimiser: str,
    mode: str,
    seconds: float,
    probes: int,
) -> TuneResult:
    state, blocks = loop.state, problem.formulation.blocks
    best = loop.best
    broken = state["best_key"][best][0] > 0
    prices, residuals = (
        (state["lam"][best], ())
        if loop.penalised
        else (state["method"][name][best] for name in ("prices", "residuals"))
    )
    if stopped == "converged" and not np.all(np.isfinite(residuals)):
        stopped = NO_SLOPE
    elif stopped == "converged" and not loop.penalised and state["method"]["stuck"][best]:
        stopped = STUCK
    elif stopped == "converged" and broken:
        stopped = INFEASIBLE
    # They are of where the method stands; where the requirements cannot be kept, the multipliers
    # are those of breaking them.
    here = (
        stopped == "converged"
        if loop.penalised
        else np.array_equal(state["best_z"][best], state["method"]["z"][best])
    )
    if stopped == STUCK and not broken:
        prices = np.full(len(prices), np.nan)
    elif broken or not here or stopped == NO_SLOPE:
        prices, residuals = () if broken else np.full(len(prices), np.nan), ()
    values = {
        path: np.asarray(x)
        for path, x in values_at(blocks, jnp.asarray(state["best_z"][best])).items()
    }
    history = {name: np.stack(x) for name, x in loop.history.items()}
    history["x"] = in_units(blocks, history["z"])
    start = problem.shared.cases.scenario
    return TuneResult(
        scenario=with_parameters(start, values),
        start=start,
        values=values,
        names=tuple(names_of(blocks)),
        history=history,
        best_start=best,
        stopped=stopped,
        optimiser=optimiser,
        mode=mode,
        seconds=seconds,
        setup=setup,
        multipliers=tuple(map(float, prices)),
        residuals=tuple(map(float, residuals)),
        probes=probes,
    )
