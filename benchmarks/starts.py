"""How many tunings from random starts end at the best known gains, and what a tuning costs.

    python benchmarks/starts.py [BEFORE [AFTER]] [--problem NAME] [--count 8] [--seed 0]
    [--reference POINTS] [--peers] [--quick] [--json FILE]

Each of the problems is tuned `--count` times with the default effort, from gains within a factor e
of the scenario's in every number.  Every tuning has a seed of its own, also for the points that it
evaluates to find its starts; scales and limits are the same for all.  The first tuning is from the
scenario's own gains.  A tuning that breaks a requirement, or whose objective changes by more than
LARGEST_CHANGE at an eighth of the time step, counts as one that does not end at the best: such
gains are good at one time step only.

The best known objective is that of BEST_KNOWN and of all tunings, and with `--reference` also of a
long search from the scenario's own gains: so many points without derivatives, and REFERENCE_STARTS
starts that are taken nearly to their ends.

FILE has all tunings besides the table, each with its commit, and is written after each of them.
The problems with as many tunings of the same commit in it are not measured again; those of other
commits stay in it until their problem is.

With `--peers` each problem is tuned once by `tune` from its own gains, and then by other methods
for as many seconds of a processor, all with programs at hand and with the compiled batches of this
package: CMA-ES (`cma`, 64 points a generation, restarted where it stops) and Optuna's TPE (16
points at a time) on the objective + PENALTY times the largest excess, and SciPy's SLSQP with exact
derivatives from one after another of the best of 256 points.

AFTER is by default the working tree.  With BEFORE the same is done by the package of that commit,
and the best known objective is that of all tunings of both.  Seconds are those of the processor, in
a process for each commit whose programs are compiled before.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
from _timing import commit, report, write_results
from losses import checked_out
from tuning import PENALTY, chain, limited_problem, slsqp

import iblf_jax as ij
from iblf_jax import actuators, barriers, controllers, references
from iblf_jax.tuning import TuningProblem, _tune, evaluation, starts
from iblf_jax.tuning.options import EFFORTS, Effort
from iblf_jax.tuning.search import Search
from iblf_jax.tuning.solvers._base import violations

WITHIN = 1.005
"""Largest objective, relative to the best known one, of a tuning that ends at the best gains."""
LARGEST_CHANGE = 0.02
"""Largest relative change of the objective at an eighth of the time step.  It is 1.3 % for
"velocity bounds", and 17 % and more for gains with which a loop chatters or runs away."""
REFERENCE_STARTS = 96
"""Number of starts of a long search."""
o = ij.objectives


class Problem(NamedTuple):
    """A scenario and what is tuned in it."""

    scenario: ij.Scenario
    gains: list[Any]
    torque: float
    """Limit of the peak torque, relative to the start."""
    margin: float | None = None
    """Limit of the margin, relative to the start."""
    duration: float = 0.5
    terms: Any = None
    """Further terms and requirements."""
    backend: str = "auto"
    dt: float = 1e-3
    goal: Any = None
    """The objective in place of tracking, effort and rate of the torque."""
    study: dict[str, Any] = {}  # noqa: RUF012
    """Perturbations, their number of runs, and the risk."""


def two_links(law: str) -> ij.Scenario:
    """The arm of the paper under another law, with a payload that its model does not know."""
    scenario = ij.presets.zhang_yan_2024(law=law, variant="corrected")
    plant = dataclasses.replace(scenario.plant, payload=0.3)
    return dataclasses.replace(scenario, plant=plant, model=scenario.plant)


def chain_with_mapping() -> Problem:
    """Three joints within funnels."""
    start = chain(3)
    k1, K2 = start.controller.k1, start.controller.K2
    law = controllers.Backstepping(k1=k1, K2=K2, barrier=barriers.TransformedError())
    scenario = ij.with_parts(start, controller=law)
    return Problem(scenario, ["controller.k1", "controller.K2", "observer.kf"], 1.0, 0.9, 0.6)


def sampled_computed_torque() -> Problem:
    """Motors and a sampled law."""
    scenario = ij.with_parts(
        ij.presets.zhang_yan_2024(variant="corrected"),
        controller=controllers.ComputedTorque(Kp=[60.0, 60.0], Kd=[12.0, 12.0]),
        actuator=actuators.Motor(bandwidth=150.0),
        sampling=ij.Sampling(period=2e-3),
    )
    return Problem(scenario, ["controller.Kp", "controller.Kd", "observer.kf"], 0.85)


def sampled_with_rate_limit() -> Problem:
    """Drives whose torque has a largest rate, and a sampled law."""
    scenario = ij.with_parts(
        two_links("log"),
        actuator=actuators.Motor(bandwidth=150.0, rate_limit=600.0),
        sampling=ij.Sampling(period=2e-3),
    )
    gains = ["controller.k1", "controller.K2", ij.tunable("observer.kf", tied=True)]
    return Problem(scenario, gains, 0.9)


def far_start() -> Problem:
    """The first gain is a factor of 150 below that of the preset."""
    start = two_links("log")
    scenario = ij.with_parameters(start, {"controller.k1": start.controller.k1 / 150.0})
    wide = [ij.tunable("controller.k1", 1e-3, 300.0), "controller.K2", "observer.kf"]
    return Problem(scenario, wide, 0.95)


def adaptive_network() -> Problem:
    """A law with a network that learns while the arm moves."""
    law = controllers.AdaptiveNetwork(k1=2.0, K2=20.0, nodes=3)
    scenario = ij.with_parts(two_links("log"), controller=law)
    return Problem(scenario, ["controller.k1", "controller.K2", "controller.Gamma"], 0.8, 0.9)


def with_law(law: Any, gains: list[str], torque: float, **options: Any) -> Problem:
    """The two links under another law."""
    return Problem(ij.with_parts(two_links("log"), controller=law), gains, torque, **options)


def with_step(scenario: ij.Scenario) -> ij.Scenario:
    """A preset of two joints that goes from rest to rest."""
    step = references.SmoothStep(start=[0.65, 0.65], end=[0.45, 0.5], duration=0.5)
    return ij.with_parts(scenario, reference=step)


def settling_chain() -> Problem:
    """Four joints that are to settle."""
    goal = o.settle(0.02) + 0.3 * o.effort() + 0.02 * o.torque_rate()
    gains = ["controller.k1", "controller.K2", "observer.kf"]
    return Problem(chain(4), gains, 0.95, goal=goal)


def perturbed() -> Problem:
    """The worst tenth of 16 runs."""
    drawn = {
        "plant.mass": ij.factor(ij.uniform(0.8, 1.2)),
        "initial.q": ij.offset(ij.uniform(-0.03, 0.03)),
    }
    study = {"perturbations": drawn, "runs": 16, "risk": "cvar"}
    gains = ["controller.k1", "controller.K2"]
    return Problem(two_links("integral"), gains, 1.1, study=study)


def sampled_surface() -> Problem:
    """Filtered virtual commands, a sampled law and motors."""
    law = controllers.DynamicSurface(k1=2.0, K2=20.0, filter=[0.02, 0.02])
    scenario = ij.with_parts(
        two_links("log"),
        controller=law,
        actuator=actuators.Motor(bandwidth=150.0),
        sampling=ij.Sampling(period=2e-3),
    )
    return Problem(scenario, ["controller.k1", "controller.K2", "controller.filter"], 0.9)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "two links, tan (6)": lambda: Problem(
        two_links("tan"), ["controller.k1", "controller.K2", "observer.kf"], 1.0, 0.9
    ),
    "two links, low torque, late error (4)": lambda: Problem(
        two_links("integral"),
        ["controller.k1", "controller.K2"],
        0.7,
        terms=o.error_below(0.01, after=0.3),
    ),
    "chain of three, mapping, funnels (9)": chain_with_mapping,
    "computed torque, motor, sampled (6)": sampled_computed_torque,
    "pendulum with drive, order 3 (4)": lambda: Problem(
        ij.presets.motor_driven_pendulum(), ["controller.k", "observer.gain[1]"], 0.9, 0.9
    ),
    "flexible joints, order 4 (10)": lambda: Problem(
        ij.presets.flexible_joint_two_link(), ["controller.k", "observer.kf"], 0.95, 0.9
    ),
    "adaptive network (6)": adaptive_network,
    "far start (6)": far_start,
    "velocity bounds (6)": lambda: Problem(
        ij.presets.zhang_yan_2024_full_state(),
        ["controller.k", "observer.kf"],
        0.9,
        terms=o.velocity_margin_above(0.5),
    ),
    "ur5, logarithmic (14)": lambda: Problem(
        ij.presets.ur5(law="log"),
        [
            "controller.k1",
            "controller.K2",
            ij.tunable("observer.kf", tied=True),
            ij.tunable("controller.o", tied=True),
        ],
        0.97,
        0.9,
        0.3,
        backend="native",
    ),
    # Written after the choice of starts and before it was measured on them.
    "vessel on an ellipse (12)": lambda: Problem(
        ij.presets.vessel(), ["controller.k", "observer.gain"], 0.9, 0.9, duration=20.0, dt=0.02
    ),
    "two links with drives, order 3 (8)": lambda: Problem(
        ij.presets.motor_driven_two_link(), ["controller.k", "observer.kf"], 0.9, 0.9
    ),
    "chain of four, settling (12)": settling_chain,
    "two links, smooth step, tan (6)": lambda: Problem(
        with_step(two_links("tan")), ["controller.k1", "controller.K2", "observer.kf"], 0.9, 0.9
    ),
    "flexible joints, smooth step, order 4 (10)": lambda: Problem(
        with_step(ij.presets.flexible_joint_two_link()), ["controller.k", "observer.kf"], 0.95
    ),
    "dynamic surface, motor, sampled (6)": sampled_surface,
    "radial basis functions (6)": lambda: with_law(
        controllers.AdaptiveRBF(k1=2.0, K2=20.0, nodes=16),
        ["controller.k1", "controller.K2", "controller.Gamma"],
        0.8,
        margin=0.9,
    ),
    "terminal sliding mode (6)": lambda: with_law(
        controllers.TerminalSlidingMode(beta=[1.0, 1.0], K=[20.0, 20.0], layer=[0.05, 0.05]),
        ["controller.beta", "controller.K", "controller.layer"],
        0.9,
    ),
    "two links, worst tenth of 16 runs (4)": perturbed,
    # Written after the comparison at half the step and before it was measured on it.
    "two links in a funnel (6)": lambda: Problem(
        ij.presets.zhang_yan_2024_funnel(),
        ["controller.k1", "controller.K2", "observer.kf"],
        0.9,
    ),
    # Written after the points at the ends of the ranges and before it was measured on them.
    "motor with rate limit, sampled (5)": sampled_with_rate_limit,
}
"""Name with the number of gains -> problem."""


BEST_KNOWN = {
    "two links, tan (6)": 1.2070,
    "two links, low torque, late error (4)": 1.0608,
    "chain of three, mapping, funnels (9)": 1.1136,
    "computed torque, motor, sampled (6)": 1.4193,
    "pendulum with drive, order 3 (4)": 1.0429,
    "flexible joints, order 4 (10)": 1.3510,
    "adaptive network (6)": 1.1158,
    "far start (6)": 1.2791,
    "velocity bounds (6)": 1.6570,
    "ur5, logarithmic (14)": 0.82654,
    "vessel on an ellipse (12)": 1.1434,
    "two links with drives, order 3 (8)": 1.4855,
    "chain of four, settling (12)": 1.5381,
    "two links, smooth step, tan (6)": 0.8941,
    "flexible joints, smooth step, order 4 (10)": 1.0613,
    "dynamic surface, motor, sampled (6)": 1.0771,
    "radial basis functions (6)": 1.1042,
    "terminal sliding mode (6)": 1.4995,
    "two links, worst tenth of 16 runs (4)": 1.1662,
    "two links in a funnel (6)": 1.0433,
    "motor with rate limit, sampled (5)": 1.0863,
}
"""The best objective of all tunings and long searches in the lab notes (README.md), of gains that
the time step resolves."""
WORKING_TREE = "working tree"
"""In place of the commit of a tree with changes, whose tunings are measured again."""
Tuning = dict[str, Any]
"""What `tuning` returns, with the problem, the commit and the seed; a long search has the seed
None."""


def built(name: str) -> TuningProblem:
    """A problem, with limits relative to its start."""
    if name not in PROBLEMS:
        scenario, gains, goal, timing, study = limited_problem(name, False)
        return TuningProblem.build(scenario, gains, goal, **timing, **study)
    problem = PROBLEMS[name]()
    timing = {"duration": problem.duration, "dt": problem.dt}
    start = ij.simulate(problem.scenario, **timing).metrics
    goal = problem.goal
    if goal is None:
        goal = o.tracking() + 0.3 * o.effort() + 0.02 * o.torque_rate()
    goal += o.peak_torque_below(problem.torque * float(np.max(start.peak_torque)))
    if problem.margin is not None:
        goal += o.margin_above(problem.margin * float(np.min(start.margin)))
    if problem.terms is not None:
        goal += problem.terms
    options = timing | problem.study | {"backend": problem.backend}
    return TuningProblem.build(problem.scenario, problem.gains, goal, **options)


def tunings(name: str, count: int, first: int, points: int) -> Iterator[Tuning]:
    """The tunings of one problem by the package that is imported, and last the long search of so
    many points, if it is not 0.
    """
    problem = built(name)
    box = problem.box
    normal = EFFORTS["normal"]
    # The first one compiles and does not count.
    tuning(problem, box.z, first, dataclasses.replace(normal, iterations=1))
    for seed in range(first, first + count):
        z = box.z
        if seed > first:
            z = z + np.random.default_rng(100 + seed).uniform(-1, 1, problem.size)
        yield {"seed": seed, **tuning(problem, np.clip(z, box.low, box.high), seed, normal)}
    if points:
        long = Effort(values=points, starts=REFERENCE_STARTS, iterations=120, selection=20)
        yield {"seed": None, **tuning(problem, box.z, first, long)}


def tuning(problem: TuningProblem, z: np.ndarray, seed: int, effort: Effort) -> Tuning:
    """A tuning of a problem from the coordinates z, (p,)."""
    moved = dataclasses.replace(
        problem,
        box=dataclasses.replace(problem.box, z=z),
        options=dataclasses.replace(problem.options, seed=seed),
    )
    phases: dict[str, Tuning] = {}
    began = time.process_time()
    search = _tune.search_of(moved, ij.tuning.SQP(), "forward", effort)

    def note(search: Search) -> None:
        state = search.state
        phases[f"{state.phase}.{state.phases_around}"] = {
            "objective": float(state.incumbent_key[1]),
            "near_best": int(state.valleys[2]),
            "evaluations": state.evaluations,
            "values": state.plain_values,
            "seconds": time.process_time() - began,
        }

    stopped = search.run(effort.iterations, note)
    seconds = time.process_time() - began
    outcome = _tune._outcome(search, stopped)
    violation, objective = search.state.incumbent_key
    fine = problem.at_half_the_step.at_half_the_step.at_half_the_step
    at_fine = float(evaluation.values(fine, outcome.z[None]).objective[0])
    is_resolved = abs(at_fine - objective) <= LARGEST_CHANGE * abs(objective)
    return {
        "objective": float(objective) if violation <= 0 and is_resolved else np.inf,
        "seconds": seconds,
        "evaluations": search.state.evaluations,
        "values": search.state.plain_values,
        "converged": outcome.stopped.startswith("converged"),
        "stopped": outcome.stopped,
        "unresolved": search.state.unresolved,
        "starts_near_best": int(search.state.valleys[2]),
        "phases": phases,
    }


def measured(tree: Path, name: str, *numbers: int) -> Iterator[Tuning]:
    """As `tunings`, in a process that imports the package of a tree."""
    environment = os.environ | {"PYTHONPATH": str(tree)}
    words = [sys.executable, __file__, "--problem", name, "--worker"]
    for option, number in zip(("--count", "--seed", "--reference"), numbers, strict=True):
        words += [option, str(number)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment) as run:
        for line in run.stdout:
            yield json.loads(line)
    if run.returncode:
        raise SystemExit(f"{name}: the process that tunes it ended with {run.returncode}")


COLUMNS = [
    *("problem", "commit", "best known", "within 0.5 %", "from its own start, gap %"),
    *("largest gap %", "called converged above 2 %", "values", "with derivatives", "processor s"),
]


def table(found: list[Tuning]) -> list[list[Any]]:
    """The rows of all tunings, one of each problem and commit."""
    rows = []
    for name, tree in dict.fromkeys((x["problem"], x["commit"]) for x in found):
        of_problem = [x for x in found if x["problem"] == name]
        best = min(BEST_KNOWN.get(name, np.inf), *(x["objective"] for x in of_problem))
        own = [x for x in of_problem if x["commit"] == tree and x["seed"] is not None]
        if own:
            rows.append(row(name, tree, own, best))
    return rows


def row(name: str, commit: str, found: list[Tuning], best: float) -> list[Any]:
    """The row of one problem and one commit."""
    objectives = np.sort([x["objective"] for x in found])
    reached = f"{int(np.sum(objectives <= WITHIN * best))} of {len(found)}"
    if not np.isfinite(best):
        reached = "none is feasible"
    own = 100 * (found[0]["objective"] / best - 1)
    false = sum(x["converged"] and x["objective"] > 1.02 * best for x in found)
    gap = 100 * (float(objectives[-1]) / best - 1)
    numbers = [
        float(np.median([x[k] for x in found])) for k in ("values", "evaluations", "seconds")
    ]
    return [name, commit, best, reached, own, gap, false, *numbers]


def tunings_in(file: str | None) -> list[Tuning]:
    """The tunings in a file of results; none if there is no such file."""
    if file is None or not Path(file).exists():
        return []
    return json.loads(Path(file).read_text())["tunings"]


def present_commit() -> str:
    """The commit of the working tree, or WORKING_TREE if it has changes."""
    here = commit()
    return here[:8] if len(here.split()) == 1 else WORKING_TREE


class TimeUpError(Exception):
    """A method has used its processor time."""


class Judge:
    """A problem for methods that know nothing of this package, for so many processor seconds."""

    def __init__(self, problem: TuningProblem, seconds: float):
        self.problem = problem
        self.best = np.inf
        self.values = 0
        self.slopes = 0
        self.ends = time.process_time() + seconds

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """The objective with its penalty at points, (S, p)."""
        self.check_time()
        found = evaluation.values(self.problem, z)
        self.values += len(z)
        excess = violations(found)
        self.note(np.where(found.valid, found.objective, np.inf), excess)
        penalised = found.objective + PENALTY * excess
        return np.where(found.valid & np.isfinite(penalised), penalised, 1e6)

    def derivatives(self, z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Objective, excesses and their gradients at a point, (p,), by the program of `tune`."""
        self.check_time()
        rows = np.tile(z, (_tune.STARTS_TOGETHER, 1))
        found = evaluation.forward_derivatives(self.problem, self.problem.candidates(rows))
        found = jax.tree.map(lambda x: np.asarray(x)[0], found)
        self.slopes += 1
        excess = max(
            float(np.max(found.value.exact_excess, initial=0.0)), -float(found.value.margin)
        )
        self.note(np.array([found.value.objective]), np.array([max(excess, 0.0)]))
        owner = self.problem.search_space(1).constraints.owner
        limits = range(len(found.value.exact_excess))
        worst = [np.flatnonzero(owner == r)[np.argmax(found.pieces[0, owner == r])] for r in limits]
        slopes = found.piece_gradients[0][:, worst].T
        return float(found.value.loss), found.pieces[0, worst], found.gradient, slopes

    def check_time(self) -> None:
        """Raises TimeUpError after the last second."""
        if time.process_time() > self.ends:
            raise TimeUpError

    def note(self, objective: np.ndarray, excess: np.ndarray) -> None:
        """Keeps the best objective of points that keep the requirements."""
        self.best = min(self.best, float(np.min(np.where(excess <= 0, objective, np.inf))))


def finite_box(problem: TuningProblem) -> tuple[np.ndarray, np.ndarray]:
    """The ranges in which `tune` takes its points, (p,) each."""
    box = problem.box
    low = np.where(np.isfinite(box.low), box.low, box.z - starts.UNLIMITED)
    return low, np.where(np.isfinite(box.high), box.high, box.z + starts.UNLIMITED)


def by_cma(judge: Judge) -> None:
    """CMA-ES until the time is up."""
    import cma

    low, high = finite_box(judge.problem)
    ends = {"bounds": [low.tolist(), high.tolist()], "popsize": 64, "verbose": -9}
    for seed in range(1, 1000):
        evolution = cma.CMAEvolutionStrategy(judge.problem.box.z, 0.5, ends | {"seed": seed})
        while not evolution.stop():
            points = evolution.ask()
            evolution.tell(points, judge(np.stack(points)).tolist())


def by_tpe(judge: Judge) -> None:
    """Optuna's TPE until the time is up."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    low, high = finite_box(judge.problem)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=1))
    study.enqueue_trial({f"z{i}": float(x) for i, x in enumerate(judge.problem.box.z)})
    ranges = list(zip(low.tolist(), high.tolist(), strict=True))
    while True:
        trials = [study.ask() for _ in range(16)]
        points = [[t.suggest_float(f"z{i}", *x) for i, x in enumerate(ranges)] for t in trials]
        for trial, found in zip(trials, judge(np.array(points)).tolist(), strict=True):
            study.tell(trial, found)


def by_slsqp(judge: Judge) -> None:
    """SLSQP from one after another of the best points until the time is up."""
    problem = judge.problem
    points = np.concatenate([problem.box.z[None], starts.spread_points(problem.box, 255, 1)])
    order = np.argsort(judge(points), kind="stable")
    for start in points[order]:
        slsqp(judge.derivatives, start, finite_box(problem), steps=60, tolerance=1e-6)


PEERS: dict[str, Callable[[Judge], None]] = {
    "CMA-ES": by_cma,
    "Optuna's TPE": by_tpe,
    "SLSQP": by_slsqp,
}


def peers(name: str) -> list[list[Any]]:
    """The rows of one problem: `tune`, and the other methods for its processor time."""
    for module in ("cma", "optuna"):  # their imports do not count
        importlib.import_module(module)
    problem = built(name)
    tuning(problem, problem.box.z, 0, dataclasses.replace(EFFORTS["normal"], iterations=1))
    own = tuning(problem, problem.box.z, 0, EFFORTS["normal"])
    Judge(problem, np.inf).derivatives(problem.box.z)  # compiles where `tune` had fewer starts
    rows = [[name, "tune", own["objective"], own["values"], own["evaluations"], own["seconds"]]]
    for method, solve in PEERS.items():
        judge = Judge(problem, own["seconds"])
        began = time.process_time()
        with contextlib.suppress(TimeUpError):
            solve(judge)
        seconds = time.process_time() - began
        rows.append([name, method, judge.best, judge.values, judge.slopes, seconds])
    return rows


def report_peers(names: list[str], file: str | None) -> None:
    """Prints the table of `--peers`; the objective as its gap to the best of all methods."""
    rows = []
    for name in names:
        found = peers(name)
        best = min(x[2] for x in found)
        rows += [[*x[:2], 100 * (x[2] / best - 1), *x[3:]] for x in found]
        print(*rows[-len(found) :], sep="\n", file=sys.stderr, flush=True)
    columns = ["problem", "method", "above the best %", "values", "with derivatives", "processor s"]
    report("Equal processor time", columns, rows, file)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", nargs="?", help="a commit to compare with")
    parser.add_argument("after", nargs="?", help="by default the working tree")
    parser.add_argument("--problem", help="one problem, also one of `LIMITED` of tuning.py")
    parser.add_argument("--count", type=int, default=8, help="tunings of a problem")
    parser.add_argument("--seed", type=int, default=0, help="of the first tuning")
    parser.add_argument("--reference", type=int, default=0, help="points of a long search")
    parser.add_argument("--peers", action="store_true", help="other methods in the same time")
    parser.add_argument("--quick", action="store_true", help="two tunings of the first problem")
    parser.add_argument("--json", help="also write the table to this file")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        for found in tunings(args.problem, args.count, args.seed, args.reference):
            print(json.dumps(found), flush=True)
        return
    names = [args.problem] if args.problem else list(PROBLEMS)[: 1 if args.quick else None]
    if args.peers:
        report_peers(names, args.json)
        return
    count = 2 if args.quick else args.count
    trees = [args.after] if args.before is None else [args.before, args.after]
    title = "Random starts"
    found = tunings_in(args.json)
    commits = [tree_of or present_commit() for tree_of in trees]
    for name, (tree_of, of_tree) in itertools.product(names, zip(trees, commits, strict=True)):
        label = {"problem": name, "commit": of_tree}
        is_complete = sum(x | label == x for x in found) == count + (args.reference > 0)
        if is_complete and of_tree != WORKING_TREE:
            continue
        found = [
            x
            for x in found
            if x["problem"] != name or (x["commit"] in commits and x["commit"] != of_tree)
        ]
        with checked_out(tree_of) as tree:
            for x in measured(tree, name, count, args.seed, args.reference):
                found.append(label | x)
                if args.json:
                    write_results(title, COLUMNS, table(found), args.json, {"tunings": found})
        print(*table([x for x in found if x["problem"] == name]), sep="\n", file=sys.stderr)
    report(title, COLUMNS, table(found), args.json, {"tunings": found})


if __name__ == "__main__":
    main()
