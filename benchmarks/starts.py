"""How many tunings from random starts end at the best known gains, and what a tuning costs.

    python benchmarks/starts.py [BEFORE [AFTER]] [--problem NAME] [--count 8] [--quick]
    [--json FILE]

Each of the problems is tuned `--count` times with the default effort, from gains within a factor e
of the scenario's in every number.  Every tuning has a seed of its own, also for the points that it
evaluates to find its starts; scales and limits are the same for all.  The first tuning is from the
scenario's own gains.  A tuning that breaks a requirement counts as one that does not end at the
best.

AFTER is by default the working tree.  With BEFORE the same is done by the package of that commit,
and the best known objective is that of all tunings of both.  Seconds are those of the processor, in
a process for each commit whose programs are compiled before.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
from _timing import report
from losses import checked_out
from tuning import chain, limited_problem

import iblf_jax as ij
from iblf_jax import actuators, barriers, controllers
from iblf_jax.tuning import TuningProblem, _tune
from iblf_jax.tuning.options import EFFORTS

WITHIN = 1.005
"""Largest objective, relative to the best known one, of a tuning that ends at the best gains."""
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
}
"""Name with the number of gains -> problem."""


def built(name: str) -> TuningProblem:
    """A problem, with limits relative to its start."""
    if name not in PROBLEMS:
        scenario, gains, goal, timing, study = limited_problem(name, False)
        return TuningProblem.build(scenario, gains, goal, **timing, **study)
    problem = PROBLEMS[name]()
    start = ij.simulate(problem.scenario, duration=problem.duration, dt=1e-3).metrics
    goal = o.tracking() + 0.3 * o.effort() + 0.02 * o.torque_rate()
    goal += o.peak_torque_below(problem.torque * float(np.max(start.peak_torque)))
    if problem.margin is not None:
        goal += o.margin_above(problem.margin * float(np.min(start.margin)))
    if problem.terms is not None:
        goal += problem.terms
    timing = {"duration": problem.duration, "dt": 1e-3, "backend": problem.backend}
    return TuningProblem.build(problem.scenario, problem.gains, goal, **timing)


def tunings(name: str, count: int) -> list[dict[str, float]]:
    """The tunings of one problem by the package that is imported."""
    problem = built(name)
    box = problem.box
    effort = EFFORTS["normal"]
    found = []
    for seed in range(-1, count):  # the first one compiles and does not count
        z = box.z
        if seed > 0:
            z = z + np.random.default_rng(100 + seed).uniform(-1, 1, problem.size)
        moved = dataclasses.replace(
            problem,
            box=dataclasses.replace(box, z=np.clip(z, box.low, box.high)),
            options=dataclasses.replace(problem.options, seed=max(seed, 0)),
        )
        began = time.process_time()
        search = _tune.search_of(moved, ij.tuning.SQP(), "forward", effort)
        stopped = search.run(effort.iterations if seed >= 0 else 1)
        seconds = time.process_time() - began
        outcome = _tune._outcome(search, stopped)
        violation, objective = search.state.incumbent_key
        found.append(
            {
                "objective": float(objective) if violation <= 0 else np.inf,
                "seconds": seconds,
                "evaluations": search.state.evaluations,
                "converged": outcome.stopped.startswith("converged"),
            }
        )
    return found[1:]


def measured(tree: Path, name: str, count: int) -> list[dict[str, float]]:
    """The tunings of one problem, in a process that imports the package of a tree."""
    environment = os.environ | {"PYTHONPATH": str(tree)}
    words = [sys.executable, __file__, "--problem", name, "--count", str(count), "--worker"]
    run = subprocess.run(words, capture_output=True, text=True, env=environment)
    if run.returncode:
        raise SystemExit(f"{name}: {run.stderr.strip().splitlines()[-1]}")
    return json.loads(run.stdout.splitlines()[-1])


def row(name: str, commit: str, found: list[dict[str, float]], best: float) -> list[Any]:
    """The row of one problem and one commit."""
    objectives = np.sort([x["objective"] for x in found])
    reached = f"{int(np.sum(objectives <= WITHIN * best))} of {len(found)}"
    if not np.isfinite(best):
        reached = "none is feasible"
    own = 100 * (found[0]["objective"] / best - 1)
    false = sum(x["converged"] and x["objective"] > 1.02 * best for x in found)
    gap = 100 * (float(objectives[-1]) / best - 1)
    seconds = float(np.median([x["seconds"] for x in found]))
    evaluations = float(np.median([x["evaluations"] for x in found]))
    return [name, commit, best, reached, own, gap, false, evaluations, seconds]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", nargs="?", help="a commit to compare with")
    parser.add_argument("after", nargs="?", help="by default the working tree")
    parser.add_argument("--problem", help="one problem, also one of `LIMITED` of tuning.py")
    parser.add_argument("--count", type=int, default=8, help="tunings of a problem")
    parser.add_argument("--quick", action="store_true", help="two tunings of the first problem")
    parser.add_argument("--json", help="also write the table to this file")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        print(json.dumps(tunings(args.problem, args.count)))
        return
    names = [args.problem] if args.problem else list(PROBLEMS)[: 1 if args.quick else None]
    count = 2 if args.quick else args.count
    commits = [args.after] if args.before is None else [args.before, args.after]
    rows = []
    for name in names:
        found = {}
        for commit in commits:
            with checked_out(commit) as tree:
                found[commit or "working tree"] = measured(tree, name, count)
        best = min(x["objective"] for of_commit in found.values() for x in of_commit)
        rows += [row(name, commit, x, best) for commit, x in found.items()]
        print(*rows[-len(found) :], sep="\n", file=sys.stderr, flush=True)
    columns = ["problem", "commit", "best known", "within 0.5 %", "from its own start, gap %"]
    columns += ["largest gap %", "called converged above 2 %", "evaluations", "processor s"]
    report("Random starts", columns, rows, args.json)


if __name__ == "__main__":
    main()
