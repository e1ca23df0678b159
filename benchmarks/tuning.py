"""Gain tuning against black-box search, on the same compiled rollout.

    python benchmarks/tuning.py [--quick] [--problem NAME] [--starts 8] [--seeds 3] [--json FILE]
    [--picture FILE] [--solvers all]

The loss, without smoothing, is

    J = ISE / ISE_0 + 0.5 E / E_0 + 10 softplus(20 (p / p_0 - 1)) / 20

(E the integral of |tau|^2, p the largest |tau| over joints and time; 0: at the starting gains).
Rectangle sums at 1 ms: tau as it is applied at the start of a step, e1 as it is reached at its end.
  With e1 at the start of a step too, the error of the start, which no
gain changes, would be a part of the ISE and J 0.003 larger.  Columns: the best J of each search;
rollout-equivalents and seconds until it was within 0.5 % of the best J of all searches (compile
time apart), and until it ended.  One rollout-equivalent is one value of J; a value with its
derivatives counts by its cost, measured in the same run, for as many starts as `tune` evaluates at
once.

Peers: CMA-ES (`cma`) and Optuna's TPE, in logarithms of the gains, from the same start, within the
  same limits.  On the chain of four the
loss has several valleys: `tune` has eight starts there, and several seeds as CMA-ES has.  The last
  table says how many searches of
each method came within 0.5 %, and the expected rollouts to get there by searching with one seed
after another until one does,

    rollouts of all searches, each up to the goal or to its end / number of searches that reached it

(if none did: more than the rollouts of all of them).

Problems under limits that bind (`LIMITED`) are the tracking error + 0.3 effort + 0.02 torque rate,
each relative to the start, with a limit on the peak torque below the start's, and on the margin.
Their table has the best objective that keeps the limits; a search counts what it needs to come
within 0.5 % of the best of all.  Peers: CMA-ES and differential evolution with an exact penalty,
SciPy's SLSQP from ten starts with central differences, and SLSQP from the one start with the exact
values and slopes that `tune` has, of the largest peak of each requirement.

With `--solvers` the limited problems are solved by `tune(..., solver=name)` for each of the names
(or "all"), and nothing else is done.  Each solver has its default options; methods without
derivatives have up to 300 generations.  Seconds are those of a second call, without compilation.

`ATTACKED` are scenarios of which a few in 10,000 random runs leave their bounds: `falsify` (values
with derivatives, which cost several values each) beside random search and CMA-ES of one and several
times as many values.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from _timing import interleaved, report
from scipy import optimize

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, disturbances, observers, references, robots
from iblf_jax.engine import RunRequest
from iblf_jax.engine.execute import run_batch
from iblf_jax.engine.structural_constants import robot_constants
from iblf_jax.simulation.scenario import canonical
from iblf_jax.studies.perturbation_cube import unit_cube
from iblf_jax.tuning import TuningProblem, _falsify, evaluation
from iblf_jax.tuning.quantities import Peak, Quantities

WITHIN = 1.005
SMOOTHING = 0.012
"""Of the peak, in the loss that `tune` starts with."""
BUDGET = {"two_link": (1500, 1500), "chain_4": (4000, 1500), "chain_7": (6000, 1500)}
"""Values of one search by CMA-ES and by TPE, whose own work grows with the square of their
number."""
STARTS = {"two_link": 1, "chain_4": 8, "chain_7": 1}
BACKEND = {"two_link": "auto", "chain_4": "auto", "chain_7": "native"}
"""With "auto" no C compiler works on derivatives of 200,000 operations, which takes it some
minutes."""


def chain(n: int) -> ij.Scenario:
    """A planar chain of n equal links, 1.2 m and 3 kg in all, that follows sinusoids inside a
    funnel, disturbed as in the paper.
    """
    length, mass = 1.2 / n, 3.0 / n
    arm = robots.PlanarChain(
        mass=[mass] * n, length=length, centre=length / 2, inertia=mass * length**2 / 4
    )
    phase = [0.7 * i for i in range(n)]
    offset = [0.6] + [0.25] * (n - 1)
    start = [o + 0.14 * float(np.sin(p)) + 0.12 for o, p in zip(offset, phase, strict=True)]
    softest = float(np.linalg.eigvalsh(np.asarray(arm.mass_matrix(jnp.asarray(start))))[0])
    return ij.Scenario(
        plant=arm,
        reference=references.Sinusoid(offset=offset, amplitude=0.14, frequency=1.0, phase=phase),
        bounds=bounds.Bounds(
            lower=bounds.Funnel(-0.4, -0.25, 1.0), upper=bounds.Funnel(0.4, 0.25, 1.0)
        ),
        disturbance=disturbances.ModelShaped(
            acceleration_amplitude=0.3,
            acceleration_frequency=1.0,
            acceleration_phase=phase,
            velocity_amplitude=0.3,
            velocity_frequency=0.5,
            velocity_phase=0.0,
        ),
        controller=controllers.Backstepping(k1=2.0, K2=0.6 * softest / 1e-3, o=0.1),
        observer=observers.AsPublished(kf=20.0),
        initial=ij.Initial(q=start),
    )


def problem_of(name: str, quick: bool) -> tuple[ij.Scenario, list[Any], float]:
    """Scenario, parameters with limits, duration."""
    if name == "two_link":
        limits = [
            ij.tunable("controller.k1", 0.1, 300.0),
            ij.tunable("controller.K2", 0.5, 200.0),
            ij.tunable("observer.kf", 1.0, 1e3),
        ]
        return ij.presets.zhang_yan_2024(), limits, 0.5 if quick else 5.0
    scenario = chain(int(name.split("_")[1]))
    K2 = float(scenario.controller.K2[0])
    limits = [
        ij.tunable("controller.k1", 0.1, 300.0),
        ij.tunable("controller.K2", 0.02 * K2, 8 * K2),
        ij.tunable("observer.kf", 1.0, 1e3),
    ]
    return scenario, limits, 0.2 if quick else 1.0


class Loss:
    """J of a scenario.  The package's ISE sums e1 at the start of each step; J's, at its end,
    leaves out the first error |e1(0)|^2 dt.

    The errors at 0 and T are part of one sum and not of the other; the one at T, below 1e-8 of the
    ISE, is left alone.
    """

    def __init__(self, scenario: ij.Scenario, duration: float):
        e1 = np.asarray(ij.simulate(scenario, duration=duration, dt=1e-3).e1)
        from_start, first = np.sum(e1[:-1] ** 2), np.sum(e1[0] ** 2)
        self.weight = float(from_start / (from_start - first))
        self.offset = self.weight - 1.0

    def objective(self, smoothing: float) -> ij.objectives.Objective:
        """J + offset, its peak smoothed so much."""
        effort, peak = ij.objectives.effort(), ij.objectives.peak_torque(smoothing=smoothing)
        return self.weight * ij.objectives.tracking() + 0.5 * effort + 10 * peak


class Search(NamedTuple):
    """What a search saw, value by value or step by step."""

    method: str
    seed: int
    seen: np.ndarray
    """J."""
    spent: np.ndarray
    """Rollout-equivalents so far."""
    times: np.ndarray
    """Seconds so far."""
    points: Any = ()
    """z of each value, under limits."""

    def reached(self, goal: float) -> int | None:
        """When it came to the goal."""
        hit = np.flatnonzero(self.seen <= goal)
        return int(hit[0]) if len(hit) else None


class Judge:
    """J at many points; every value counted and timed."""

    def __init__(self, built: TuningProblem, offset: float):
        self.built, self.offset = built, offset
        self.seen: list[float] = []
        self.began = time.perf_counter()
        self.times: list[float] = []

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """J at points (S, p) or (p,)."""
        found = evaluation.value(self.built, self.built.candidates(np.atleast_2d(points)))
        losses = np.where(np.asarray(found.valid), np.asarray(found.objective) - self.offset, 1e6)
        losses = np.where(np.isfinite(losses), losses, 1e6)
        self.seen += losses.tolist()
        self.times += [time.perf_counter() - self.began] * len(losses)
        return losses

    def search(self, method: str, seed: int) -> Search:
        """What was seen."""
        return Search(
            method,
            seed,
            np.asarray(self.seen),
            1.0 + np.arange(len(self.seen)),
            np.asarray(self.times),
        )


def run_cma(built: TuningProblem, offset: float, evaluations: int, seed: int) -> Search:
    """CMA-ES, first step size 0.5 in logarithms, otherwise as it comes."""
    import cma

    options = {
        "bounds": [built.box.low.tolist(), built.box.high.tolist()],
        "seed": seed,
        "verbose": -9,
        "maxfevals": evaluations,
    }
    search = cma.CMAEvolutionStrategy(built.box.z, 0.5, options)
    size = search.popsize
    evaluation.value(built, built.candidates(np.stack([built.box.z] * size)))  # compile
    judge = Judge(built, offset)
    while not search.stop() and len(judge.seen) < evaluations:
        points = search.ask()
        search.tell(points, judge(np.stack(points)).tolist())
    return judge.search("CMA-ES", seed)


def run_tpe(built: TuningProblem, offset: float, evaluations: int, seed: int) -> Search:
    """Optuna's TPE from the same start."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    names = [f"z{i}" for i in range(len(built.box.z))]
    study.enqueue_trial(dict(zip(names, built.box.z.tolist(), strict=True)))
    judge = Judge(built, offset)
    judge(built.box.z)
    judge = Judge(built, offset)

    def target(trial):
        z = [
            trial.suggest_float(n, float(a), float(b))
            for n, a, b in zip(names, built.box.low, built.box.high, strict=True)
        ]
        return float(judge(np.asarray(z))[0])

    study.optimize(target, n_trials=evaluations)
    return judge.search("Optuna TPE", seed)


def run_ours(
    problem_: tuple,
    starts: int,
    backend: str,
    loss: Loss,
    cost: float,
    iterations: int,
    seeds: range,
) -> list[Search]:
    """`tune` with each seed: the best J of every step, after a first call that compiles."""
    scenario, parameters, duration = problem_

    def once(seed: int, iterations: int, callback=None):
        options = {
            "solver": ij.tuning.SQP(starts=starts, patience=100),
            "backend": backend,
            "seed": seed,
            "progress": callback or False,
        }
        timing = {"duration": duration, "effort": ij.tuning.Effort(iterations=iterations)}
        return ij.tune(scenario, parameters, loss.objective(SMOOTHING), **timing, **options)

    def timed(seed: int) -> Search:
        times: list[float] = []
        began = time.perf_counter()
        history = once(
            seed, iterations, lambda loop: times.append(time.perf_counter() - began)
        ).history
        seen = np.where(history["valid"], history["objective"] - loss.offset, 1e6).min(axis=1)
        return Search("iblf_jax tune", seed, seen, cost * history["evaluations"], np.asarray(times))

    once(seeds[0], 1)
    return [timed(seed) for seed in seeds]


def compare(
    name: str, quick: bool, starts: int, seeds: int
) -> tuple[list[list[Any]], list[list[Any]]]:
    """The rows of one problem: of every search, and of every method."""
    scenario, parameters, duration = problem_of(name, quick)
    timing = {"duration": duration, "dt": 1e-3, "method": "rk4", "backend": BACKEND[name]}
    loss = Loss(scenario, duration)
    built = TuningProblem.build(scenario, parameters, loss.objective(SMOOTHING), **timing)
    candidates, size = built.candidates(np.stack([built.box.z] * starts)), len(built.box.z)
    calls = {
        "value": lambda: evaluation.value(built, candidates),
        "slope": lambda: evaluation.forward_derivatives(built, candidates),
    }
    seconds = interleaved(calls, 2 if quick else 20)
    cost = seconds["slope"] / seconds["value"]
    values, trials = (40, 20) if quick else BUDGET[name]
    own = range(seeds if starts > 1 else 1)
    searches = run_ours(
        (scenario, parameters, duration), starts, BACKEND[name], loss, cost, 4 if quick else 80, own
    )
    searches += [run_cma(built, loss.offset, values, seed) for seed in range(1, seeds + 1)]
    searches.append(run_tpe(built, loss.offset, trials, 1))
    goal = WITHIN * min(float(s.seen.min()) for s in searches)
    methods = list(dict.fromkeys(s.method for s in searches))
    of_methods = [
        _method_row(name, method, [s for s in searches if s.method == method], goal)
        for method in methods
    ]
    return [_row(name, size, search, goal, cost) for search in searches], of_methods


def _row(name: str, size: int, search: Search, goal: float, cost: float) -> list[Any]:
    at = search.reached(goal)
    within: list[Any] = (
        ["never", "never"] if at is None else [float(search.spent[at]), float(search.times[at])]
    )
    ends = [
        float(search.spent[-1]),
        float(search.times[-1]),
        cost if search.method.startswith("iblf") else 1.0,
    ]
    return [
        name,
        size,
        f"{search.method}, seed {search.seed}",
        float(search.seen[0]),
        float(search.seen.min()),
        *within,
        *ends,
    ]


def _method_row(name: str, method: str, searches: list[Search], goal: float) -> list[Any]:
    """How many searches reached the goal, and the expected rollouts to get there."""
    at = [s.reached(goal) for s in searches]
    reached = sum(a is not None for a in at)
    spent = sum(float(s.spent[-1 if a is None else a]) for s, a in zip(searches, at, strict=True))
    median = float(np.median([s.seen.min() for s in searches]))
    return [
        name,
        method,
        f"{reached} of {len(searches)}",
        median,
        spent / reached if reached else f"> {spent:.0f}",
    ]


LIMITED = {
    "two gains, tan": ("tan", 0.3, ("controller.k1", "controller.K2"), True, 0.93, 0.9),
    "four gains, mapping": ("mapping", 0.0, ("controller.k1", "controller.K2"), False, 0.95, 0.75),
    "six gains, integral": (
        "integral",
        0.0,
        ("controller.k1", "controller.K2", "observer.kf"),
        False,
        0.85,
        0.9,
    ),
    "six gains, funnel": (
        "funnel",
        0.0,
        ("controller.k1", "controller.K2", "observer.bandwidth"),
        False,
        0.9,
        None,
    ),
    "four gains, 64 runs": ("perturbed", 0.0, ("controller.k1", "controller.K2"), False, 1.3, None),
    "nine gains, chain of three": (
        "chain",
        0.0,
        ("controller.k1", "controller.K2", "observer.kf"),
        False,
        0.9,
        0.9,
    ),
    "fourteen gains, ur5, log": ("ur5", 2.0, ("controller.k1", "controller.K2"), False, 0.97, 0.9),
}
"""Law or arm, payload [kg], gains, whether they are one number for all joints, limits relative to
the start: peak torque, margin (or none).

The funnel has an extended-state observer.  Of 64 perturbed runs one in a hundred may leave its
bounds, and a value is of all of them.
"""
ATTACKED = ("attack, tangent barrier", "attack, chain of three")
PENALTY = 10.0
"""On the sum of the excesses, for searches that know no limits."""


def limited_problem(
    name: str, quick: bool
) -> tuple[ij.Scenario, list[Any], Any, dict[str, Any], dict[str, Any]]:
    """Scenario, parameters, objective, timing, and how the runs are drawn, of one of `LIMITED`."""
    law, payload, paths, tied, torque, margin = LIMITED[name]
    o, backend, study = ij.objectives, "auto", dict[str, Any]()
    goal = o.tracking() + 0.3 * o.effort() + 0.02 * o.torque_rate()
    tunables = [ij.tunable(path, tied=tied) for path in paths]
    if law == "ur5":
        scenario, duration, backend = ij.presets.ur5(law="log", payload=payload), 1.0, "native"
        tunables += [ij.tunable("observer.kf", tied=True), ij.tunable("controller.o", tied=True)]
    elif law == "chain":
        scenario, duration = chain(3), 0.2 if quick else 1.0
    elif law == "funnel":
        scenario, duration = ij.presets.zhang_yan_2024_funnel(), 0.3 if quick else 2.0
        scenario = ij.with_parts(scenario, observer=observers.ExtendedState(bandwidth=[20.0, 20.0]))
    elif law == "perturbed":
        scenario, duration = ij.presets.zhang_yan_2024(variant="corrected"), 0.3 if quick else 1.0
        perturbed = {
            "plant.mass": ij.factor(ij.uniform(0.8, 1.2)),
            "initial.q": ij.offset(ij.uniform(-0.05, 0.05)),
        }
        study = {
            "perturbations": perturbed | {"initial.dq": ij.value(ij.uniform(-1.0, 1.0))},
            "runs": 64,
        }
        goal += o.violation_probability_below(0.01)
    else:
        scenario, duration = (
            ij.presets.zhang_yan_2024(law=law, variant="corrected"),
            (0.3 if quick else 2.0),
        )
        plant = dataclasses.replace(scenario.plant, payload=payload)
        scenario = dataclasses.replace(scenario, plant=plant, model=scenario.plant)
    start = ij.simulate(scenario, duration=duration, dt=1e-3).metrics
    goal += o.peak_torque_below(torque * float(np.max(start.peak_torque)))
    if margin is not None:
        goal += o.margin_above(margin * float(np.min(start.margin)))
    return scenario, tunables, goal, {"duration": duration, "dt": 1e-3, "backend": backend}, study


class LimitedJudge:
    """Objective and excess at many points; remembers every value."""

    def __init__(self, built: TuningProblem):
        self.built = built
        self.seen: list[float] = []
        self.points: list[np.ndarray] = []
        self.began = time.process_time()
        reach = np.full(len(built.box.z), 4.0)
        self.low, self.high = (
            np.maximum(built.box.low, built.box.z - reach),
            np.minimum(built.box.high, built.box.z + reach),
        )

    def both(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Objective (S,), and excess (S, R), by the batches of `tune`."""
        points = np.atleast_2d(points)
        self.points += list(points)
        found = evaluation.values(self.built, points)
        f = np.where(found.valid, found.objective, 1e3)
        excess = np.where(found.valid[:, None], found.exact_excess, 1e3)
        self.seen += np.where(np.all(excess <= 0, axis=1), f, np.inf).tolist()
        return f, excess

    def penalised(self, points: np.ndarray) -> np.ndarray:
        """What searches without limits are given."""
        f, excess = self.both(points)
        return f + PENALTY * np.maximum(excess, 0).sum(axis=1)

    def search(self, method: str, cost: float = 1.0) -> Search:
        """What was seen."""
        spent = cost * (1.0 + np.arange(len(self.seen)))
        return Search(
            method,
            0,
            np.asarray(self.seen),
            spent,
            np.full(len(self.seen), time.process_time() - self.began),
            self.points,
        )


def slsqp(
    everything: Callable[[np.ndarray], Any],
    start: np.ndarray,
    ranges: tuple[np.ndarray, np.ndarray],
    steps: int,
    tolerance: float,
) -> None:
    """SciPy's SLSQP with a function that gives objective, excess and their slopes at once.

    Args:
      everything: of a point, (p,), such a function; `start` is one.
      start: where the search begins.
      ranges: least and largest coordinates, (p,) each.
      steps: at most.
      tolerance: of the objective.
    """
    kept: dict[bytes, Any] = {}

    def at(z: np.ndarray) -> Any:
        if z.tobytes() not in kept:
            kept[z.tobytes()] = everything(z)
        return kept[z.tobytes()]

    limit = {"type": "ineq", "fun": lambda z: -at(z)[1] - 1e-6, "jac": lambda z: -at(z)[3]}
    options = {"maxiter": steps, "ftol": tolerance}
    optimize.minimize(
        lambda z: at(z)[0],
        start,
        jac=lambda z: at(z)[2],
        method="SLSQP",
        bounds=list(zip(*ranges, strict=True)),
        constraints=limit,
        options=options,
    )


def limited_searches(name: str, quick: bool) -> tuple[list[Search], float, ij.TuneResult]:
    """Every search of one limited problem, `tune` first, what a value with its derivatives costs,
    and what `tune` found.
    """
    import cma

    scenario, tunables, goal, timing, study = limited_problem(name, quick)
    runs = study.get("runs", 1)
    built = TuningProblem.build(scenario, tunables, goal, **study, **timing)
    z, size = built.box.z, len(built.box.z)
    one, steps, values = built.candidates(z[None]), 2 if quick else 40, 60 if quick else 250 * size
    calls = {
        "value": lambda: evaluation.value(built, one),
        "slope": lambda: evaluation.forward_derivatives(built, one),
    }
    seconds = interleaved(calls, 2 if quick else 10)
    cost = seconds["slope"] / seconds["value"]

    def tuned(iterations: int) -> ij.TuneResult:
        effort = ij.tuning.Effort(iterations=iterations)
        return ij.tune(scenario, tunables, goal, effort=effort, progress=False, **timing, **study)

    tuned(1)  # compiles
    began = time.process_time()
    best = tuned(4 if quick else 60)
    spent_seconds = time.process_time() - began
    history = best.history
    feasible = history["valid"] & np.all(history["excess"] <= 0, axis=-1)
    seen, spent = (
        np.where(feasible, history["objective"], np.inf).min(axis=1),
        best.probes + cost * history["evaluations"],
    )
    searches = [Search("iblf_jax tune", 0, seen, spent, np.full(len(seen), spent_seconds))]

    judge = LimitedJudge(built)

    def exact(z: np.ndarray) -> Any:
        found = jax.tree.map(
            lambda x: np.asarray(x)[0],
            evaluation.forward_derivatives(built, built.candidates(z[None])),
        )
        judge.points.append(z.copy())
        judge.seen.append(
            float(found.value.objective) if np.all(found.value.exact_excess <= 0) else np.inf
        )
        owner = built.search_space(1).constraints.owner
        limits = range(len(found.value.exact_excess))
        worst = [np.flatnonzero(owner == r)[np.argmax(found.pieces[0, owner == r])] for r in limits]
        return (
            float(found.value.objective),
            found.value.exact_excess,
            found.gradient,
            found.piece_gradients[0][:, worst].T,
        )

    if runs == 1:  # the slope of a probability is that of a smoothed one
        slsqp(exact, z, (judge.low, judge.high), steps, tolerance=1e-8)
        searches.append(judge.search("SLSQP, exact slopes", cost))
    judge = LimitedJudge(built)

    def by_differences(z: np.ndarray) -> Any:
        f, excess = judge.both(
            np.concatenate([z[None], z + 1e-5 * np.eye(size), z - 1e-5 * np.eye(size)])
        )
        halves = slice(1, size + 1), slice(size + 1, None)
        return (
            f[0],
            excess[0],
            (f[halves[0]] - f[halves[1]]) / 2e-5,
            (excess[halves[0]] - excess[halves[1]]).T / 2e-5,
        )

    rng = np.random.default_rng(0)
    drawn = z + rng.uniform(-1, 1, (1 if quick else 9, size))
    for start in [z, *np.clip(drawn, judge.low, judge.high)]:
        slsqp(by_differences, start, (judge.low, judge.high), steps, tolerance=1e-8)
    searches.append(judge.search("SLSQP, 10 starts"))
    judge = LimitedJudge(built)
    ends = {
        "bounds": [judge.low.tolist(), judge.high.tolist()],
        "seed": 1,
        "verbose": -9,
        "maxfevals": values,
    }
    evolution = cma.CMAEvolutionStrategy(z, 0.5, ends)
    while not evolution.stop():
        points = evolution.ask()
        evolution.tell(points, judge.penalised(np.stack(points)).tolist())
    searches.append(judge.search("CMA-ES"))
    judge = LimitedJudge(built)
    options = {
        "vectorized": True,
        "updating": "deferred",
        "popsize": 6,
        "maxiter": values // (6 * size),
        "polish": False,
        "rng": 1,
        "tol": 0,
    }
    pairs = list(zip(judge.low, judge.high, strict=True))
    optimize.differential_evolution(lambda x: judge.penalised(x.T), pairs, x0=z, **options)
    searches.append(judge.search("differential evolution"))
    return searches, cost, best


def compare_limited(name: str, quick: bool, picture: str | None = None) -> list[list[Any]]:
    """The rows of one limited problem; a picture of the searches' ways to the best gains where a
    file is given for it.
    """
    searches, cost, found = limited_searches(name, quick)
    if picture and len(found.names) == 2:
        ways = {
            s.method: np.exp(np.stack(s.points))
            for s in searches[1:]
            if s.method in ("SLSQP, exact slopes", "CMA-ES")
        }
        ij.plotting.paths(found, ways).savefig(picture)
    goal = WITHIN * min(float(s.seen.min()) for s in searches)
    rows = []
    for s in searches:
        at = s.reached(goal) if np.isfinite(goal) else None
        exact = cost if s.method in ("iblf_jax tune", "SLSQP, exact slopes") else 1.0
        best = float(s.seen.min())
        reached: list[Any] = ["never", "never"] if at is None else [at + 1, float(s.spent[at])]
        rows.append(
            [
                name,
                s.method,
                best if np.isfinite(best) else "none",
                *reached,
                len(s.seen),
                float(s.spent[-1]),
                float(s.times[-1]),
                exact,
            ]
        )
    return rows


BY_DERIVATIVES = ("sqp", "slsqp", "trust-constr", "uno")
WITHOUT_DERIVATIVES = ("differential-evolution", "cma", "optuna")
GENERATIONS = 300


def compare_solvers(name: str, solvers: list[str], quick: bool) -> list[list[Any]]:
    """A row for every solver of one limited problem."""
    scenario, tunables, goal, timing, study = limited_problem(name, quick)
    results = {}
    for solver in solvers:
        steps = GENERATIONS if solver in WITHOUT_DERIVATIVES else 60
        effort = ij.tuning.Effort(iterations=4 if quick else steps)
        for _ in range(1 if quick else 2):  # the first call compiles
            results[solver] = ij.tune(
                scenario,
                tunables,
                goal,
                solver=solver,
                effort=effort,
                progress=False,
                **timing,
                **study,
            )
    best = {solver: limited_objective(result) for solver, result in results.items()}
    least = min(best.values())
    return [
        [
            name,
            solver,
            f"{best[solver]:.5f}" if np.isfinite(best[solver]) else "none",
            100 * (best[solver] / least - 1) if np.isfinite(best[solver]) else "",
            int(result.history["evaluations"][-1]),
            int(result.probes),
            result.seconds,
            result.stopped.split(":")[0],
        ]
        for solver, result in results.items()
    ]


def limited_objective(result: ij.TuneResult) -> float:
    """The objective of the returned gains, infinite where they do not keep the limits."""
    setup = result.setup
    names = ("duration", "dt", "method", "backend", "perturbations", "runs", "seed", "risk")
    options = {name: getattr(setup, name) for name in names}
    built = TuningProblem.build(result.scenario, list(result.values), setup.objective, **options)
    found = evaluation.values(built, built.box.z[None])
    keeps = found.valid[0] and np.all(found.exact_excess[0] <= 0) and found.margin[0] >= 0
    return float(found.objective[0]) if keeps else np.inf


def attacked_problem(name: str) -> tuple[ij.Scenario, dict[str, Any], dict[str, float]]:
    """Scenario, perturbations and timing of one of `ATTACKED`: a few of 10,000 random runs leave
    their bounds.
    """

    def within(least, most, change=ij.value):
        return change(ij.uniform(least, most))

    sets = {"plant.mass": within(0.7, 1.3, ij.factor), "initial.q": within(-0.05, 0.05, ij.offset)}
    sets |= {"disturbance.acceleration_phase": within(0.0, 6.28)}
    if name == "attack, chain of three":
        start = chain(3)
        law = controllers.Backstepping(
            k1=start.controller.k1, K2=start.controller.K2, barrier=barriers.Quadratic()
        )
        sets |= {
            "initial.dq": within(-7.3, 7.3),
            "disturbance.acceleration_amplitude": within(-21.9, 21.9),
        }
        return dataclasses.replace(start, controller=law), sets, {"duration": 1.0, "dt": 1e-3}
    sets |= {"plant.payload": within(0.0, 0.4), "initial.dq": within(-15.9, 15.9)}
    sets |= {"disturbance.acceleration_amplitude": within(-42.4, 42.4)}
    return (
        ij.presets.zhang_yan_2024(law="tan", variant="corrected"),
        sets,
        {"duration": 1.0, "dt": 1e-3},
    )


def margins_of(scenario: ij.Scenario, sets: dict[str, Any], timing: dict[str, float]) -> Any:
    """The smallest margin [rad] of runs by the uniform numbers behind them, as a function of u (B,
    d), and d.
    """
    scenario = canonical(scenario)
    cube = unit_cube(scenario, sets)
    run = RunRequest(
        round(timing["duration"] / timing["dt"]), "rk4", constants=robot_constants(scenario)
    )
    fold = jax.tree.map(jnp.asarray, Quantities((Peak(1.0, "deficit"),)))

    @jax.jit
    def found(u):
        outcome = run_batch(
            scenario, jax.vmap(cube.values)(u), (fold,), jnp.asarray(timing["dt"]), run
        )
        fine = outcome.status & int(_falsify.UNINFORMATIVE) == 0
        return jnp.where(fine, -outcome.metrics["tuning_exact"][:, 0], 1.0)

    return lambda u: np.asarray(found(jnp.asarray(u))), cube.size


def cma_attack(margins: Any, size: int, values: int, seed: int) -> float:
    """The smallest margin that CMA-ES finds in so many values, from random points, anew where it
    has stopped.
    """
    import cma

    rng, best, search = np.random.default_rng(seed), np.inf, None
    for _ in range(values // 16):
        if search is None or search.stop():
            options = {
                "bounds": [0, 1],
                "seed": int(rng.integers(1, 2**31)),
                "verbose": -9,
                "popsize": 16,
            }
            search = cma.CMAEvolutionStrategy(rng.uniform(0.2, 0.8, size), 0.3, options)
        points = search.ask()
        seen = margins(np.stack(points))
        search.tell(points, seen.tolist())
        best = min(best, float(seen.min()))
    return best


def compare_attacks(name: str, quick: bool) -> list[list[Any]]:
    """How many searches found a run that leaves its bounds, and the median of the smallest margins
    that they found.
    """
    scenario, sets, timing = attacked_problem(name)
    seeds, least = (1, 208) if quick else (10, 60_000)
    attacks = [
        ij.falsify(
            scenario, sets, seed=seed, progress=False, iterations=1 if quick else 12, **timing
        )
        for seed in range(seeds)
    ]
    size = attacks[0].runs
    first = [
        int(np.argmax(np.any(a.history <= 0, axis=1))) + 1
        for a in attacks
        if np.any(a.history <= 0)
    ]
    ours = np.asarray([a.margin for a in attacks])
    rows = [
        [
            name,
            "falsify",
            size,
            float(np.mean(ours <= 0)),
            16.0 * max(first, default=np.inf),
            1e3 * float(np.median(ours)),
        ]
    ]
    random = ij.monte_carlo(scenario, sets, runs=least, seed=99, progress=False, **timing)
    fine = np.asarray(random.status) & int(_falsify.UNINFORMATIVE) == 0
    drawn = np.where(fine, np.asarray(random.metrics.margin).reshape(least, -1).min(axis=1), np.inf)
    for many in (1,) if quick else (1, 4, 8):
        best = drawn[: least // (many * size) * many * size].reshape(-1, many * size).min(axis=1)
        rows.append(
            [
                name,
                "random",
                many * size,
                float(np.mean(best <= 0)),
                1 / max(float(np.mean(drawn <= 0)), 1 / least),
            ]
        )
        rows[-1].append(1e3 * float(np.median(best)))
    margins, d = margins_of(scenario, sets, timing)
    for many in (1,) if quick else (1, 4):
        best = np.asarray([cma_attack(margins, d, many * size, seed) for seed in range(seeds)])
        rows.append(
            [
                name,
                "CMA-ES",
                many * size,
                float(np.mean(best <= 0)),
                "",
                1e3 * float(np.median(best)),
            ]
        )
    return rows


def report_solvers(args: argparse.Namespace) -> None:
    """Only the table of `compare_solvers`."""
    solvers = args.solvers.split(",")
    if args.solvers == "all":
        solvers = [*BY_DERIVATIVES, *WITHOUT_DERIVATIVES]
    problems = [args.problem] if args.problem else list(LIMITED)[: 1 if args.quick else None]
    rows = [row for name in problems for row in compare_solvers(name, solvers, args.quick)]
    columns = [
        "problem",
        "solver",
        "best within the limits",
        "above the best [%]",
        "values with derivatives",
        "plain values",
        "seconds",
        "ended by",
    ]
    report("Solvers of the same problem", columns, rows, args.json)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="half a second of motion, few values")
    parser.add_argument(
        "--problem",
        choices=("two_link", "chain_4", "chain_7", *LIMITED, *ATTACKED),
        help="one problem only",
    )
    parser.add_argument(
        "--starts",
        type=int,
        help="starts of tune; 8 on the chain of four and 1 elsewhere if not given",
    )
    parser.add_argument(
        "--seeds",
        type=int,
        default=3,
        help="searches by CMA-ES, and by tune where it has several starts",
    )
    parser.add_argument("--json", help="also write the table to this file")
    parser.add_argument(
        "--picture",
        help="draw the ways of the searches on the limited problem of two gains into this file",
    )
    parser.add_argument(
        "--solvers",
        help='names of solvers with commas between them, or "all": only compare these on the'
        " limited problems",
    )
    args = parser.parse_args()
    if args.solvers:
        report_solvers(args)
        return
    names = (
        [args.problem]
        if args.problem
        else (
            ["two_link", *list(LIMITED)[:1]]
            if args.quick
            else ["two_link", "chain_4", "chain_7", *LIMITED]
        )
    )
    if args.problem in ATTACKED or not (args.problem or args.quick):
        attacked = [
            row
            for name in ([args.problem] if args.problem else ATTACKED)
            for row in compare_attacks(name, args.quick)
        ]
        under = [
            "problem",
            "search",
            "runs a search",
            "share that found a violation",
            "runs to the first",
            "median smallest margin [mrad]",
        ]
        report("Attacks", under, attacked, args.json if args.problem else None)
    names = [name for name in names if name not in ATTACKED]
    limits = [
        row
        for name in names
        if name in LIMITED
        for row in compare_limited(name, args.quick, args.picture)
    ]
    names = [name for name in names if name not in LIMITED]
    found = [
        compare(name, args.quick, args.starts or STARTS[name], 1 if args.quick else args.seeds)
        for name in names
    ]
    columns = [
        "problem",
        "gains",
        "search",
        "first J",
        "best J",
        "rollouts to 0.5 %",
        "seconds to 0.5 %",
        "rollouts",
        "seconds",
    ]
    if limits:
        under = [
            "problem",
            "search",
            "best within the limits",
            "values to 0.5 %",
            "rollouts to 0.5 %",
            "values",
            "rollouts",
            "processor s",
        ]
        report("Under limits", [*under, "cost of one"], limits, None if found else args.json)
    if not found:
        return
    report(
        "Gain tuning",
        [*columns, "cost of one"],
        [row for rows, _ in found for row in rows],
        args.json,
    )
    columns = ["problem", "method", "within 0.5 %", "median best J", "expected rollouts to 0.5 %"]
    report("Methods", columns, [row for _, rows in found for row in rows], None)


if __name__ == "__main__":
    main()
