"""All applicable laws of the package on the task of each entry, at the effort of the published law
where one factor on their gains gives it.

    python benchmarks/field/measure.py [NAME ...] [--quick] [--processes N] [--out FOLDER]

The published law, the one of the entry's `scenario`, sets the effort: the RMS input above the one
that balances gravity.  For a plant in strict-feedback form it is the RMS of all its inputs above
the plant's own steady input, which is zero where the plant states none.  The gains of every other
law are scaled by one factor to this effort (`ij.compare`).  Columns:

- `factor`: of the gains; "own" for a law that has no factor in [1/32, 32] with this effort, and
  runs at the gains of `laws_of`.
- `effort`: as a share of that of the published law.
- `RMS error`, `error`: RMS and largest |e1| of all components in the second half of the run.
- `peak input`: largest input of the entire run.
- `margin`: least distance to any bound of the scenario over the entire run, as a share of half the
  distance of these bounds; bounds of the first level at every step, others at the recorded samples.
- `error, parameters`, `margin, parameters`: the worse of two plants whose uncertain parameters are
  0.8 and 1.2 times those of the entry; the model is the one of the entry.
- `error, sampled`, `margin, sampled`: law and observer run once in `PERIOD`, or in the nearest
  whole number of steps, and read exact sensors; also where the task has a period of its own, which
  the other columns keep.
- `error, noise`, `margin, noise`: the same with white noise on every level, whose standard
  deviation is `NOISE` times half the least distance of the bounds, and of the further levels
  `NOISE` times their largest value in the published run.

"left" is a run that leaves its bounds or diverges, and "step" one for which the entry's time step
is too large.  A table is refused if two laws have an error that agrees to `DIGITS` digits and no
[[equal_rows]] of `entry.toml` gives the reason, or if a law with a factor has an effort outside
1 +- `EFFORT`, because its runs may be those of another law.

The results go to results/NAME.json when all laws are measured, and to NAME.json.part after each
law.  With `--quick` or `--only` they go to a temporary folder unless `--out` names one.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import math
import multiprocessing
import os
import shlex
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import jax

jax.config.update("jax_enable_x64", True)

import entry
import laws
import matplotlib
import numpy as np
from _timing import machine
from entry import PUBLISHED
from task_laws import Task, first_sentence, laws_of, task_of, with_standard_metrics

import iblf_jax as ij
from iblf_jax import sensors
from iblf_jax.core.units import INPUT, POSITION
from iblf_jax.simulation.units import unit_text
from iblf_jax.world import plants

PERIOD = 2e-3
"""s."""
NOISE = 1e-3
SHARES = (0.8, 1.2)
"""Factors of the uncertain parameters."""
UNCERTAIN = ("mass", "payload", "inertia")
"""Beginnings of the names of uncertain parameters, where an entry does not name them."""
LEFT, OWN, STEP = "left", "own", "step"
DIGITS = 12
"""To which the errors of two laws may not agree."""
EFFORT = 0.01
"""Largest difference of an effort from that of the published law, of laws with a factor."""
QUICK_DURATION = 0.1
"""s."""
QUICK_LAWS = 2

# ---------------------------------------------------------------------------- runs


class Row(NamedTuple):
    """The numbers of a law, and why no factor of its gains gives the effort of the first one."""

    values: list[Any]
    reason: str


def row(name: str, choice: laws.Choice, task: Task, uncertain: tuple[str, ...]) -> Row:
    """Measures a law."""
    base = ij.with_parts(task.scenario, **choice.parts)
    compared = ij.compare(base, {PUBLISHED: base.controller, name: choice.law}, **task.options)
    run = compared.equal_effort.get(name, compared.rollouts[name])
    factor: Any = OWN
    if name in compared.equal_effort:
        factor = float(compared.factors[name])
    one = run.scenario
    perturbed = [
        with_standard_metrics(
            ij.with_parameters(one, scaled_parameters(one, uncertain, share)), task.options
        )
        for share in (SHARES if uncertain else ())
    ]
    exact, noisy = sampled_runs(one, task)
    own = float(compared.rollouts[PUBLISHED].metrics.effort_above_gravity)
    effort = float(run.metrics.effort_above_gravity) / own
    values = [name, factor, effort if np.isfinite(effort) else LEFT, *accuracy(run, task)]
    values += worst([error_and_margin(x, task) for x in perturbed])
    return Row(
        [*values, *error_and_margin(exact, task), *error_and_margin(noisy, task)],
        compared.reasons.get(name, ""),
    )


def scaled_parameters(
    scenario: ij.Scenario, uncertain: tuple[str, ...], share: float
) -> dict[str, Any]:
    """Path -> value times a factor; of the plant only, so that the model remains."""
    known = {parameter.path: parameter.value for parameter in ij.parameters(scenario)}
    return {path: share * np.asarray(known[path]) for path in uncertain}


def sampled_runs(scenario: ij.Scenario, task: Task) -> tuple[ij.Rollout, ij.Rollout]:
    """Sampled runs without and with noise; both have one structure."""
    period = period_of(task)
    sigma = np.concatenate([task.half_width[None], task.levels[1:]]) * NOISE
    return tuple(
        with_standard_metrics(
            ij.with_parts(
                scenario, sensor=sensor_of(scenario, sigma * share), sampling=ij.Sampling(period)
            ),
            task.options,
        )
        for share in (0.0, 1.0)
    )


def sensor_of(scenario: ij.Scenario, sigma: np.ndarray) -> Any:
    """Sensors of all levels with white noise."""
    if plants.is_chain(scenario.plant):
        return sensors.Levels(tuple(sensors.Direct(noise=row) for row in sigma))
    return sensors.Encoder(velocity=sensors.Measured(noise=sigma[1]), noise=sigma[0])


def failure_of(run: ij.Rollout, task: Task) -> str:
    """Whether a run has left the bounds of the task, or its step is too large; "" if neither."""
    flags = ij.Status.BOUND_VIOLATED | ij.Status.NOT_FINITE | ij.Status.SINGULAR_GAIN
    if any(task.scenario.bounds[1:]):
        flags |= ij.Status.VELOCITY_VIOLATED | ij.Status.STATE_BOUND_VIOLATED
    if task.scenario.regions:
        flags |= ij.Status.REGION_VIOLATED
    status = int(run.status)
    if status & int(flags):
        return LEFT
    return STEP if status & int(ij.Status.STEP_TOO_LARGE) else ""


def accuracy(run: ij.Rollout, task: Task) -> list[Any]:
    """RMS and largest error, peak input and margin."""
    failure = failure_of(run, task)
    peak = float(np.max(np.asarray(run.metrics.peak_torque)))
    if failure:
        return [failure, failure, peak if np.isfinite(peak) else failure, failure]
    e1 = np.asarray(run.e1)[len(run.t) // 2 :]
    return [float(np.sqrt(np.mean(e1**2))), float(np.abs(e1).max()), peak, margin(run, task)]


def error_and_margin(run: ij.Rollout, task: Task) -> list[Any]:
    """Largest error and margin."""
    _, error, _, least = accuracy(run, task)
    return [error, least]


def margin(run: ij.Rollout, task: Task) -> float:
    """The least distance to a bound of the task: for level 1 as a share of the distance between
    the reference and that bound, 1 - max |xi|, for other levels of half the distance of the bounds.
    """
    found = [float(np.min(np.asarray(run.metrics.xi_margin)))]
    if any(task.scenario.bounds[1:]):
        lower, upper = run.level_lower[:, 1:], run.level_upper[:, 1:]
        x = run.x[:, 1 : 1 + lower.shape[1]]
        share = np.minimum(x - lower, upper - x) / (0.5 * (upper - lower))
        found.append(float(np.nanmin(share)))
    return min(found)


def worst(values: list[list[Any]]) -> list[Any]:
    """The larger error and the smaller margin of several runs; "left" if one of them left."""
    if not values:
        return ["-", "-"]
    for state in (LEFT, STEP):
        if any(state in pair for pair in values):
            return [state, state]
    errors, margins = zip(*values, strict=True)
    return [max(errors), min(margins)]


# ---------------------------------------------------------------------------- refused tables


def faults_of_rows(rows: list[dict[str, Any]], allowed: Sequence[entry.EqualRows]) -> list[str]:
    """Why a table cannot be right, a sentence for each row or pair of rows; empty if it can be."""
    reasons = {frozenset((pair.law, pair.other)) for pair in allowed}
    found = []
    for row in rows:
        if row["factor"] != OWN and not _is_equal_effort(row["effort"]):
            found.append(
                f"{row['law']!r} has the factor {row['factor']:.6g} and the effort"
                f" {row['effort']}, where 1 +- {EFFORT:g} is expected"
            )
    for one, other in itertools.combinations(rows, 2):
        names = [name for name in one if "error" in name and _agree(one[name], other[name])]
        is_allowed = frozenset((one["law"], other["law"])) in reasons
        if names and not is_allowed:
            found.append(
                f"{one['law']!r} and {other['law']!r} agree to {DIGITS} digits in"
                f" {', '.join(names)}; if both laws do the same, state the reason in an"
                " [[equal_rows]] of entry.toml"
            )
        if is_allowed and not names:
            found.append(
                f"{one['law']!r} and {other['law']!r} differ, although an [[equal_rows]] of"
                " entry.toml gives a reason why they agree; remove it"
            )
    return found


def _is_equal_effort(effort: Any) -> bool:
    return isinstance(effort, float) and abs(effort - 1.0) <= EFFORT


def _agree(one: Any, other: Any) -> bool:
    """Whether two cells are the same number."""
    if not isinstance(one, float) or not isinstance(other, float):
        return False
    return math.isclose(one, other, rel_tol=10.0**-DIGITS)


# ---------------------------------------------------------------------------- entries


def columns(scenario: ij.Scenario) -> list[str]:
    """The headings of the table."""
    length, force = unit_text(scenario, POSITION), unit_text(scenario, INPUT)
    return [
        "law",
        "factor",
        "effort",
        f"RMS error [{length}]",
        f"error [{length}]",
        f"peak input [{force}]",
        "margin",
        f"error, parameters [{length}]",
        "margin, parameters",
        f"error, sampled [{length}]",
        "margin, sampled",
        f"error, noise [{length}]",
        "margin, noise",
    ]


def uncertain_of(made: entry.Reproduction) -> tuple[str, ...]:
    """The uncertain parameters of an entry, without those that are zero."""
    known = {parameter.path: parameter.value for parameter in ij.parameters(made.scenario)}
    paths = made.uncertain
    if paths is None:
        paths = tuple(path for path in known if is_uncertain(path))
    return tuple(path for path in paths if np.any(np.asarray(known[path]) != 0.0))


def is_uncertain(path: str) -> bool:
    """Whether a path is that of a mass, a payload or an inertia of the plant."""
    return path.startswith("plant.") and path.rsplit(".", 1)[-1].startswith(UNCERTAIN)


def measure(
    folder: Path,
    save: Callable[[dict[str, Any]], None],
    *,
    quick: bool = False,
    only: list[str] | None = None,
) -> None:
    """Measures an entry, and saves its results after each law."""
    matplotlib.use("Agg")
    contents = entry.load(folder)
    dt = contents.run.dt
    duration = dt * round(QUICK_DURATION / dt) if quick else contents.run.duration
    task, made = task_of(folder, duration)
    uncertain = uncertain_of(made)
    chosen = {PUBLISHED: laws.Choice(task.scenario.controller)} | laws_of(task, uncertain)
    equal = [name for pair in contents.equal_rows for name in (pair.law, pair.other)]
    for place, names in (
        ("example.py: not_applicable", list(made.not_applicable)),
        ("entry.toml: [[equal_rows]]", equal),
    ):
        unknown = sorted(set(names) - set(chosen))
        if unknown:
            raise entry.EntryError([f"{place} has {unknown}, of which `measure.py` knows no law"])
    reasons = {name: words for name, words in chosen.items() if isinstance(words, str)}
    reasons |= made.not_applicable
    applicable = [name for name in chosen if name not in reasons]
    unknown = sorted(set(only or ()) - set(applicable))
    if unknown:
        raise entry.EntryError([f"--only: {unknown} do not apply; choose from {applicable}"])
    headings = columns(task.scenario)
    result = {
        "title": contents.title,
        "machine": machine(),
        "duration": task.duration,
        "dt": task.dt,
        "period": period_of(task),
        "noise": NOISE,
        "uncertain": list(uncertain),
        "input": plants.input_name(task.scenario.plant) if is_chain(task) else "torque",
        "rows": [],
        "no_factor": {},
        "not_applicable": reasons,
        "failed": {},
    }
    for name in only or applicable:
        if quick and len(result["rows"]) == QUICK_LAWS:
            break
        try:
            found = row(name, chosen[name], task, uncertain)
        except ValueError as error:
            reasons[name] = first_sentence(error)
        except Exception as error:  # a law that fails must not stop the others
            result["failed"][name] = f"{type(error).__name__}: {first_sentence(error)}"
        else:
            result["rows"].append(dict(zip(headings, found.values, strict=True)))
            if found.reason:
                result["no_factor"][name] = found.reason
        outcome = {**reasons, **result["failed"]}.get(name, "measured")
        print(f"{folder.name}: {name}: {outcome}", flush=True)
        save(result)
    if PUBLISHED in result["failed"] | reasons:
        raise entry.EntryError(["the published law could not be measured"])
    if result["failed"]:
        raise entry.EntryError([f"the runs of {sorted(result['failed'])} failed"])
    if faults := faults_of_rows(result["rows"], contents.equal_rows):
        raise entry.EntryError(faults)


def period_of(task: Task) -> float:
    """The period of the sampled runs [s], a whole number of steps."""
    return task.dt * max(1, round(PERIOD / task.dt))


def is_chain(task: Task) -> bool:
    """Whether the plant is one in strict-feedback form."""
    return plants.is_chain(task.scenario.plant)


def write(folder: Path, out: Path, flags: list[str], **options: Any) -> None:
    """Measures an entry and writes its file; a measurement that stops leaves the former file."""
    out.mkdir(parents=True, exist_ok=True)
    part = out / f"{folder.name}.json.part"
    command = shlex.join(["python", "benchmarks/field/measure.py", folder.name, *flags])

    def save(result: dict[str, Any]) -> None:
        text = json.dumps({"command": command, **result}, indent=1)
        part.write_text(text + "\n", encoding="utf-8")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the table reports runs that leave the bounds
        measure(folder, save, **options)
    part.replace(out / f"{folder.name}.json")


def main() -> int:
    """Measures the named entries; the exit code is the number of those that failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="entries; all if none is given")
    parser.add_argument("--quick", action="store_true", help="0.1 s of motion, two laws")
    parser.add_argument("--processes", type=int, default=1, help="entries at the same time")
    parser.add_argument("--out", type=Path, help="folder of the results")
    parser.add_argument("--only", nargs="+", metavar="LAW", help="these rows")
    args = parser.parse_args()
    chosen = [entry.ENTRIES / name for name in args.names] or entry.folders()
    flags = ["--quick"] if args.quick else []
    if args.only:
        flags += ["--only", *args.only]
    options = {"quick": args.quick, "only": args.only}
    out = args.out or entry.RESULTS
    if args.out is None and (args.quick or args.only):
        # A part of a measurement must not take the place of an entire one.
        out = Path(tempfile.mkdtemp())
        print(f"parts of a measurement are written to {out}")
    failed = 0
    for name, error in outcomes(chosen, args.processes, out, flags, options):
        failed += error is not None
        print(f"{name}: {'measured' if error is None else f'failed: {error}'}", flush=True)
    print(f"{len(chosen) - failed} of {len(chosen)} entries measured")
    return failed


def outcomes(chosen, processes, out, flags, options):
    """Measures entries; the name of each with None, or with the reason why it failed."""
    call = functools.partial(write, out=out, flags=flags, **options)
    if processes == 1:
        for folder in chosen:
            yield folder.name, reason_of(lambda folder=folder: call(folder))
        return
    # A few threads of a kernel for each process; the last entries use what the others leave.
    os.environ.setdefault("IBLF_JAX_THREADS", str(max(2, (os.cpu_count() or 1) // processes)))
    # JAX hangs in processes that are forked.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, max_tasks_per_child=1) as pool:
        started = {pool.submit(call, folder): folder.name for folder in chosen}
        for future in as_completed(started):
            yield started[future], reason_of(future.result)


def reason_of(call) -> str | None:
    """Runs a call; why it failed, or None."""
    try:
        call()
    except Exception as error:  # one entry must not stop the others
        return f"{type(error).__name__}: {error}"
    return None


if __name__ == "__main__":
    sys.exit(main())
