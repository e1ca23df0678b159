"""Laws with the same budget of tuning on the task of an entry: error against effort.

    python benchmarks/field/equal_budget.py --task NAME [NAME ...] [--laws LAW ...] [--quick]
        [--minutes M]

Every law of a task, that of the entry among them, is tuned with the same budget (`BUDGET`): two or
three of its gains (`GAINS`), the same objective, the same limits of the effort, the same ranges.
`BUDGET` has the numbers of one search: a search that has converged ends, one whose best gains a
single start came near begins again around them as long as that helps, and one without gains that
keep the requirements looks further.  The result has the runs that each law took.

    minimise    the RMS error |e1| of the entire run
    subject to  the RMS input above the steady input, of the entire run, <= a limit of the effort,
                the bounds and the constraints of the task

The limits are `LEVELS` times the effort of the law of the entry with its own gains.  Limits of
the input that the task has act on every law: its command is clipped.  A law that finds no gains
which keep limit, bounds and constraints has no error at that limit.  Gains that were found under a
smaller limit count under a larger one too.

The gains found under the published effort are then run with parameters that differ from those of
the model (`SHARES`), with periods (`PERIODS`), and with noise (`SEEDS` seeds, `NOISE`) at `PERIOD`.

The results go to results/NAME.json.  A result is refused, and goes to NAME.json.part, if two laws
have errors that agree to `DIGITS` digits, because one of them may be that of the other law.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import shlex
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import jax

jax.config.update("jax_enable_x64", True)

import entry
import jax.numpy as jnp
import numpy as np
from _timing import machine
from entry import OWN
from run_numbers import Numbers, measured
from task_laws import Task, first_sentence, laws_of, scaled_parameters, task_of, uncertain_of

import iblf_jax as ij
from iblf_jax import actuators, controllers, sensors
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.units import INPUT, POSITION
from iblf_jax.simulation.units import unit_text
from iblf_jax.tuning.objectives import Requirement
from iblf_jax.tuning.quantities import MetricResult
from iblf_jax.world import plants

TASKS = (
    "liu_2018",
    "goel_2020",
    "mcilvanna_2024",
    "zhang_yan_2024",
    "mahmud_2021",
    "shaw_cortez_2022",
)
"""The tasks that the page has, chosen before their results: three plants in strict-feedback form
and three arms with two joints, of at most 30,000 steps, whose own law has two gains or three.
One has limits of the input and a constraint.  Plants of three components take 100 s of a processor
for each law, most of it to compile."""
OF_ROBOTS = (
    "Backstepping(Integral)",
    "Backstepping(Log)",
    "BarrierBackstepping(TransformedError)",
    "SafetyFilter",
    "ComputedTorque",
    "PDGravity",
)
OF_CHAINS = tuple(
    f"BarrierBackstepping({barrier})"
    for barrier in (
        "Integral",
        "Log",
        "Tan",
        "TransformedError",
        "PrescribedPerformance",
        "no bounds",
    )
)
"""The laws beside that of the entry, chosen before any result; `--laws` takes any of `laws_of`."""
LATER = {
    "zhang_yan_2024": (
        "TerminalSlidingMode",
        "Backstepping(TransformedError)",
        "DynamicSurface",
        "Backstepping(Tan)",
        "Backstepping, no bounds",
        "Saturated(auxiliary)",
        "BarrierBackstepping(Integral, Integral)",
        "Backstepping(Integral), q measured",
        "AdaptiveParameters(masses)",
        "SurfaceBarrier",
        "ReferenceGovernor",
        "Backstepping(TransformedError), finite time",
    )
}
"""Task -> laws that were added after the results of the others: those of the page "Choosing a law"
whose programs compile as fast.  `AdaptiveRBF` was not tried."""
GAINS: dict[type, tuple[str, ...]] = {
    controllers.Backstepping: ("k1", "K2", "weight"),
    controllers.DynamicSurface: ("k1", "K2", "filter"),
    controllers.BarrierBackstepping: ("k[0]", "k[1]", "weights[1]"),
    controllers.SurfaceBarrier: ("a", "K"),
    controllers.TerminalSlidingMode: ("beta", "K"),
    controllers.ComputedTorque: ("Kp", "Kd"),
    controllers.PDGravity: ("Kp", "Kd"),
    controllers.AdaptiveRBF: ("k1", "K2"),
}
"""Law -> its gains that are tuned.  Weights are among them, because a barrier of another scale
needs another weight."""
OF_WRAPPERS = {
    controllers.SafetyFilter: "a1",
    controllers.Saturated: "auxiliary",
    controllers.AdaptiveParameters: "Gamma",
    controllers.ReferenceGovernor: "eta",
}
"""Law around another one -> its gain that is tuned, before two of the law inside."""
OF_ENTRIES = {
    "golestani_2022": ("kd", "c"),
    "mcilvanna_2024": ("k[0]", "k[1]", "weight"),
    "cao_2021": ("k1", "k2"),
    "choi_2023": ("clf_rate", "rate"),
    "pourmohammad_2023": ("Kp", "Kd", "K0"),
}
"""Entry -> gains of a law that its script defines."""
LEVELS = (0.7, 1.0, 1.4, 2.0, 2.8)
"""Limits of the effort, in efforts of the law of the entry."""
BUDGET = ij.tuning.Effort(values=128, starts=4, iterations=15)
"""Of each limit: points without derivatives, searches with them, and steps of each."""
SMALL = ij.tuning.Effort(values=8, starts=1, iterations=2)
RANGE = 100.0
"""A gain may become so many times smaller or larger than it is at the start."""
START = 0.05
"""Share of the duration whose effort is stated apart."""
SHARES = (0.7, 0.8, 0.9, 1.1, 1.2, 1.3)
"""Factors of the uncertain parameters."""
PERIODS = (1e-3, 2e-3, 5e-3, 1e-2)
PERIOD = 2e-3
"""s."""
SEEDS = 5
NOISE = 1e-3
"""Standard deviation, as a share of half the least distance of the bounds, and for further levels
of their largest value in the published run."""
TOLERANCE = 1e-3
"""By which an effort may exceed its limit, relatively."""
TIE = 0.05
"""Laws whose errors differ by less, relatively, have one rank: so far apart are results of one law
with this budget (`tests/project/test_field_budget.py`)."""
DIGITS = 9
"""To which the errors of two laws may not agree."""
ONE_LAW = {"BarrierBackstepping(Integral)", "BarrierBackstepping(Log)"}
"""Laws that may agree: the slopes of these barriers differ by a factor of 2, so that the laws
differ by a weight, and not at all where every level has a barrier."""
QUICK_DURATION = 0.2
"""s."""

# ---------------------------------------------------------------------------- tuning


def gains_of(name: str, law: Any, own: bool) -> tuple[str, ...]:
    """Paths of the gains of a law that are tuned, two or three; empty if it has not so many."""
    found = GAINS.get(type(law), ())
    if type(law) in OF_WRAPPERS:
        found = (OF_WRAPPERS[type(law)], *GAINS.get(type(unwrapped(law)), ())[:2])
    if own:
        found = OF_ENTRIES.get(name, found)
    return tuple(f"controller.{gain}" for gain in found)


def starts_of(scenario: ij.Scenario, paths: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Path -> value of the gain from which its range is."""
    known = {one.path: np.asarray(one.value) for one in ij.parameters(scenario)}
    found = {}
    for path in paths:
        leaf, _, index = path.partition("[")
        found[path] = known[leaf][int(index[:-1])] if index else known[leaf]
    return found


def tunables(scenario: ij.Scenario, paths: tuple[str, ...]) -> list[Any]:
    """The gains with their ranges."""
    starts = starts_of(scenario, paths)
    return [ij.tunable(path, value / RANGE, value * RANGE) for path, value in starts.items()]


def objective_of(fold: Numbers, limit: float, level: float) -> Any:
    """The error, under a limit of the effort and the constraints of the task."""
    effort = MetricResult(fold, "effort")
    found = ij.objectives.metric(fold, "error")
    found += Requirement(effort, limit=level * limit, scale=limit, name="effort")
    if fold.constraints or fold.bounded:
        violation = MetricResult(fold, "violation")
        found += Requirement(violation, limit=0.0, scale=1.0, name="constraints")
    return found


def front(
    scenario: ij.Scenario,
    paths: tuple[str, ...],
    task: Task,
    fold: Numbers,
    limit: float,
    budget: Any,
) -> tuple[list[dict[str, Any]], dict[float, ij.Scenario]]:
    """The best gains under each limit of the effort, and the scenarios that have them."""
    rows, scenarios, candidates = [], {}, []
    for level in LEVELS:
        tuned = ij.tune(
            scenario,
            tunables(scenario, paths),
            objective_of(fold, limit, level),
            duration=task.duration,
            dt=task.dt,
            effort=budget,
            progress=False,
        )
        found = measured(tuned.scenario, task, fold)
        found["gains"] = {path: np.ravel(tuned.values[path]).tolist() for path in paths}
        candidates.append((found, tuned.scenario))
        kept = [
            (one, its)
            for one, its in candidates
            if not one["left"] and one["effort"] <= level * limit * (1.0 + TOLERANCE)
        ]
        row = {"level": level, "points": tuned.probes, "derivatives": tuned.evaluations}
        if kept:
            best, scenarios[level] = min(kept, key=lambda pair: pair[0]["error"])
            rows.append(row | best)
        else:
            above = "its effort is above the limit"
            rows.append(row | {"left": found["left"] or above})
    return rows, scenarios


# ---------------------------------------------------------------------------- robustness


def robustness(
    scenario: ij.Scenario, task: Task, fold: Numbers, uncertain: tuple[str, ...]
) -> dict[str, Any]:
    """The errors on other plants, with periods and with noise, or what a run does not keep."""

    def error(one, seed=0):
        found = measured(one, task, fold, seed)
        return found["left"] or found["error"]

    sigma = np.concatenate([task.half_width[None], task.levels[1:]]) * NOISE

    def sampled(period, share):
        steps = max(1, round(period / task.dt))
        sensor = sensor_of(scenario, sigma * share)
        return ij.with_parts(scenario, sensor=sensor, sampling=ij.Sampling(steps * task.dt))

    masses = {}
    for share in SHARES if uncertain else ():
        scaled = scaled_parameters(scenario, uncertain, share)
        masses[str(share)] = error(ij.with_parameters(scenario, scaled))
    return {
        "masses": masses,
        "periods": {str(period): error(sampled(period, 0.0)) for period in PERIODS},
        "noise": [error(sampled(PERIOD, 1.0), seed) for seed in range(SEEDS)],
    }


def sensor_of(scenario: ij.Scenario, sigma: np.ndarray) -> Any:
    """Sensors of all levels with white noise."""
    if plants.is_chain(scenario.plant):
        return sensors.Levels(tuple(sensors.Direct(noise=row) for row in sigma))
    return sensors.Encoder(velocity=sensors.Measured(noise=sigma[1]), noise=sigma[0])


# ---------------------------------------------------------------------------- a task


@ij.component
class InputLimits(actuators.Actuator):
    """The command of any law, clipped to the limits of the task; equal limits remove an input."""

    lower: ij.Leaf = ij.leaf(INPUT)
    upper: ij.Leaf = ij.leaf(INPUT)

    def deliver(self, command, dq, state):
        """The clipped command."""
        limited = (command < self.lower) | (command > self.upper)
        return actuators.Delivered(jnp.clip(command, self.lower, self.upper), limited, ())


def numbers_of(task: Task, made: entry.Reproduction) -> Numbers:
    """The metric of a task."""
    bounded = tuple(i for i, x in enumerate(task.scenario.bounds) if i > 0 and x is not None)
    constraints = tuple(made.constraints.values())
    return Numbers(START * task.duration, 0.5 * task.duration, constraints, bounded)


def chosen_laws(name: str, task: Task) -> tuple[str, ...]:
    """The names of the laws beside that of an entry on its task."""
    first = OF_CHAINS if plants.is_chain(task.scenario.plant) else OF_ROBOTS
    return (*first, *LATER.get(name, ()))


def laws_on(
    task: Task,
    own: Any,
    names: tuple[str, ...],
    reasons: dict[str, str],
    uncertain: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Name -> law and its parts, or why it does not apply; without the law of the entry."""
    found = laws_of(task, uncertain)
    if unknown := sorted(set(names) - set(found)):
        raise entry.EntryError([f"--laws: {unknown} are unknown; choose from {sorted(found)}"])
    laws = {name: reasons.get(name, found[name]) for name in names}
    structure = jax.tree.structure(own)
    for name, choice in laws.items():
        if not isinstance(choice, str) and jax.tree.structure(choice.law) == structure:
            laws[name] = "it is the law of the entry with other gains"
    return laws


def scenarios_of(
    task: Task, names: tuple[str, ...], made: entry.Reproduction
) -> tuple[dict[str, ij.Scenario], dict[str, str]]:
    """Name -> scenario of each law that applies, that of the entry first; and name -> why another
    one does not.
    """
    scenarios, reasons = {OWN: task.scenario}, {}
    own, uncertain = task.scenario.controller, uncertain_of(made)
    for name, choice in laws_on(task, own, names, made.not_applicable, uncertain).items():
        if isinstance(choice, str):
            reasons[name] = choice
            continue
        scenarios[name] = ij.with_parts(task.scenario, controller=choice.law, **choice.parts)
    return scenarios, reasons


def limited(scenario: ij.Scenario, contents: entry.Entry) -> ij.Scenario:
    """The scenario with the limits of the input that every law keeps."""
    if not contents.input_limits:
        return scenario
    if not isinstance(scenario.actuator, actuators.Ideal):
        raise entry.EntryError(["a task with limits of the input needs an ideal actuator"])
    sides = [[getattr(x, side) for x in contents.input_limits] for side in ("lower", "upper")]
    lower, upper = (np.broadcast_to(np.array(side), scenario.plant.n) for side in sides)
    return ij.with_parts(scenario, actuator=InputLimits(lower, upper))


def compare(
    folder: Path,
    names: list[str] | None = None,
    quick: bool = False,
    minutes: float = math.inf,
) -> dict[str, Any]:
    """The result of a task, with the laws that begin within some minutes.

    Raises:
      EntryError: the law of the entry has no two gains.
    """
    began, end = time.process_time(), time.monotonic() + 60.0 * minutes
    contents = entry.load(folder)
    dt = contents.run.dt
    duration = dt * round(QUICK_DURATION / dt) if quick else contents.run.duration
    task, made = task_of(folder, duration)
    task = task._replace(scenario=limited(task.scenario, contents))
    budget = SMALL if quick else BUDGET
    fold = numbers_of(task, made)
    own = measured(task.scenario, task, fold)
    uncertain = uncertain_of(made)
    chosen = tuple(names or chosen_laws(folder.name, task))
    scenarios, reasons = scenarios_of(task, chosen, made)
    laws = {}
    for name, scenario in scenarios.items():
        paths = gains_of(folder.name, scenario.controller, name == OWN)
        if len(paths) not in (2, 3):
            reasons[name] = "it has no two or three gains in GAINS or OF_ENTRIES"
            continue
        if time.monotonic() > end:
            reasons[name] = f"not begun within {minutes:g} minutes"
            continue
        used = time.process_time()
        try:
            rows, found = front(scenario, paths, task, fold, own["effort"], budget)
        except ValueError as error:
            reasons[name] = first_sentence(error)
            continue
        robust = robustness(found[1.0], task, fold, uncertain) if 1.0 in found else None
        seconds = round(time.process_time() - used, 1)
        starts = {path: np.ravel(x).tolist() for path, x in starts_of(scenario, paths).items()}
        laws[name] = {"gains": starts, "front": rows, "robustness": robust, "seconds": seconds}
        print(f"{folder.name}: {name}: {seconds} s of a processor", flush=True)
    if OWN in reasons:
        raise entry.EntryError([f"the law of the entry cannot be tuned: {reasons[OWN]}"])
    return {
        "title": contents.title,
        "machine": machine(),
        "processor_seconds": round(time.process_time() - began, 1),
        "duration": task.duration,
        "dt": task.dt,
        "units": [unit_text(task.scenario, unit) for unit in (POSITION, INPUT)],
        "budget": {"points": budget.values, "starts": budget.starts, "steps": budget.iterations},
        "start": START * task.duration,
        "input_limits": [[x.lower, x.upper] for x in contents.input_limits],
        "constraints": list(made.constraints),
        "uncertain": list(uncertain),
        "own_law": contents.law_in_words,
        "own": own,
        "laws": laws,
        "not_applicable": reasons,
    }


def equal_laws(laws: dict[str, Any]) -> list[str]:
    """Which laws have errors that agree, a sentence for each pair."""
    found = []
    for one, other in itertools.combinations(laws, 2):
        if {one, other} == ONE_LAW:
            continue
        first = [row.get("error", math.nan) for row in laws[one]["front"]]
        second = [row.get("error", math.nan) for row in laws[other]["front"]]
        if np.any(np.isclose(first, second, rtol=10.0**-DIGITS, atol=0.0)):
            found.append(f"{one!r} and {other!r} agree to {DIGITS} digits")
    return found


def ranks(result: dict[str, Any], level: float = 1.0) -> dict[str, int]:
    """Law -> rank by the error, of the laws that keep the limit of the effort and the bounds: one
    more than the number of laws whose error is smaller by more than `TIE`.
    """
    errors = {
        name: row["error"]
        for name, law in result["laws"].items()
        for row in law["front"]
        if row["level"] == level and not row["left"]
    }
    return {
        name: 1 + sum(other < (1.0 - TIE) * error for other in errors.values())
        for name, error in sorted(errors.items(), key=lambda pair: pair[1])
    }


def main() -> int:
    """Compares the laws on the named tasks; the exit code is the number of those that failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", nargs="+", metavar="NAME", default=TASKS, help="entries")
    parser.add_argument("--laws", nargs="+", metavar="LAW", help="in place of those of the page")
    parser.add_argument("--quick", action="store_true", help="0.2 s of motion, a small budget")
    parser.add_argument("--minutes", type=float, default=math.inf, help="no law begins later")
    parser.add_argument("--out", type=Path, help="folder of the results")
    args = parser.parse_args()
    out = args.out or entry.RESULTS
    if args.out is None and (args.quick or args.laws):
        # A part of a comparison must not take the place of an entire one.
        out = Path(tempfile.mkdtemp())
        print(f"parts of a comparison are written to {out}")
    out.mkdir(parents=True, exist_ok=True)
    failed = 0
    for name in args.task:
        words = ["python", "benchmarks/field/equal_budget.py", "--task", name]
        words += ["--minutes", f"{args.minutes:g}"] * (args.minutes < math.inf)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the result states what a run does not keep
                result = compare(entry.ENTRIES / name, args.laws, args.quick, args.minutes)
        except entry.EntryError as error:
            failed += 1
            print(f"{name}: failed: {error}")
            continue
        text = json.dumps({"command": shlex.join(words), **result}, indent=1)
        faults = equal_laws(result["laws"])
        file = f"{name}.json"
        if faults:
            failed += 1
            file += ".part"
            print(f"{name}: refused, see {out / file}: {'; '.join(faults)}")
        (out / file).write_text(text + "\n", encoding="utf-8")
        print(f"{name}: {result['processor_seconds']} s; ranks {ranks(result)}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
