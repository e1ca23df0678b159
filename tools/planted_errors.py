#!/usr/bin/env python3
"""Plants errors in a copy of the last commit, one at a time, and prints which tests find them.

    python tools/planted_errors.py                        all errors, each with all default tests
    python tools/planted_errors.py --nearest              with the tests that are nearest to it
    python tools/planted_errors.py --only "a sign"        errors whose description has these words
    python tools/planted_errors.py -m "not release"       with the slow tests, too
    python tools/planted_errors.py tests/control          with these tests

The share that the default tests find measures what they protect.  The tests that are nearest to an
error run first, and the first test that fails ends the search (`-x`): they are those of the folder
of tests that mirrors the folder of the error, and those that use its file directly, as
`tools/select_tests.py` knows them.

The errors were chosen before anybody looked for tests that find them: keep it so.  An error that
no longer fits its file is replaced by one of the same kind.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from select_tests import ROOT, Graph


class Fault(NamedTuple):
    """An error of one line."""

    what: str
    file: str
    """In the package."""
    old: str
    """Stands exactly once in the file."""
    new: str


FAULTS = (
    Fault(
        "a sign in a law: the leakage lets the weights of the network grow",
        "control/controllers/adaptive_rbf.py",
        "(S[:, None] * e2 + self.sigma * state)",
        "(S[:, None] * e2 - self.sigma * state)",
    ),
    Fault(
        "a factor 2 in a barrier: V1 of the tangent barrier, but not its slope",
        "control/barriers/tan.py",
        "k**2 / math.pi * jnp.sin(",
        "k**2 / (2.0 * math.pi) * jnp.sin(",
    ),
    Fault(
        "a torque that is not limited on its negative side",
        "control/actuators/motor.py",
        "v = jnp.clip(command, lower, self.limit)",
        "v = jnp.minimum(command, self.limit)",
    ),
    Fault(
        "a gain of an observer without its factor 2",
        "control/observers/extended_state.py",
        "return 2.0 * self.bandwidth, self.bandwidth**2",
        "return self.bandwidth, self.bandwidth**2",
    ),
    Fault(
        "the derivative of a bound with the other sign",
        "world/bounds.py",
        "return self.dq_d - self.dlower",
        "return self.dlower - self.dq_d",
    ),
    Fault(
        "the inertia of a load that is there from the start, though its weight comes later",
        "world/robots/payload.py",
        '            ("inertia", share * self.inertia),\n',
        "",
    ),
    Fault(
        "two weights of the Runge-Kutta method of order 4 in the wrong order",
        "simulation/integrators.py",
        "b=(1 / 6, 1 / 3, 1 / 3, 1 / 6)",
        "b=(1 / 6, 1 / 3, 1 / 6, 1 / 3)",
    ),
    Fault(
        "a metric along the wrong axis: level and component of a violation are exchanged",
        "simulation/metrics.py",
        "acc.first // n + 3, acc.first % n",
        "acc.first % n + 3, acc.first // n",
    ),
    Fault(
        "a sampled loop whose commands arrive a period late",
        "simulation/sampling.py",
        "old = command_at(commands, age)",
        "old = command_at(commands, age + 1.0)",
    ),
    Fault(
        "a wrong unit: process noise with dt in the place of its root",
        "simulation/noise.py",
        "return jnp.sqrt(dt / parts) * total",
        "return dt / parts * total",
    ),
    Fault(
        "integrals of metrics that leave the last instant out",
        "engine/time_step.py",
        "0.5 * (times.previous_piece_length + ahead), step",
        "ahead, step",
    ),
    Fault(
        "a key of a cache that leaves the keywords of a partial function out",
        "core/exact_keys.py",
        "self.of((value.func, value.args, keywords), module)",
        "self.of((value.func, value.args), module)",
    ),
    Fault(
        "an interval that is not rounded outward: the lower end of a square root",
        "kernels/c/interval.h",
        "{low * ULP - low, high}",
        "{-low, high}",
    ),
    Fault(
        "a seed that is ignored",
        "studies/study_setup.py",
        "jax.random.PRNGKey(options.seed)",
        "jax.random.PRNGKey(0)",
    ),
    Fault(
        "the wrong quantile in an interval of confidence",
        "studies/rare_events/limit_state.py",
        "width = ndtri(0.5 + confidence / 2)",
        "width = ndtri(confidence)",
    ),
    Fault(
        "a field that a file does not have: the recorded state of the actuator",
        "files/results.py",
        '    "actuator_state": "actuator",\n',
        "",
    ),
    Fault(
        "lower and upper bounds exchanged in exported C",
        "deployment/c/law.c",
        "memcpy(lower, result, ${joints} * sizeof *lower);\n"
        "  memcpy(upper, result + ${joints}, ${joints} * sizeof *upper);",
        "memcpy(upper, result, ${joints} * sizeof *upper);\n"
        "  memcpy(lower, result + ${joints}, ${joints} * sizeof *lower);",
    ),
    Fault(
        "an inequality of a certificate that is reversed: the gain of the observer",
        "certificates/claims/theorem.py",
        "(kf_2, gains.kf - LOWEST_KF[2],",
        "(kf_2, LOWEST_KF[2] - gains.kf,",
    ),
    Fault(
        "a tuner that ignores requirements",
        "tuning/solvers/_base.py",
        "np.max(value.exact_excess, axis=1, initial=0.0)",
        "np.min(value.exact_excess, axis=1, initial=0.0)",
    ),
    Fault(
        "a missing square: the precision of identified parameters",
        "identification/statistics.py",
        "information * scale[:, None] * scale / lacking**2",
        "information * scale[:, None] * scale / lacking",
    ),
)


def planted(text: str, fault: Fault) -> str:
    """The text of a file with an error in it; ValueError if it has not exactly one place for it."""
    if text.count(fault.old) != 1:
        raise ValueError(f"{fault.file} has {text.count(fault.old)} times {fault.old!r}")
    return text.replace(fault.old, fault.new)


def stages(graph: Graph, fault: Fault) -> list[list[str]]:
    """The test files that are nearest to an error, and all others that reach its file."""
    distances = graph.reaching(f"iblf_jax/{fault.file}")
    order = sorted(distances.keys() - {OWN}, key=lambda test: (distances[test], test))
    mirrored = f"tests/{Path(fault.file).parts[0]}/"
    least = distances[order[0]]
    nearest = [x for x in order if x.startswith(mirrored) or distances[x] == least]
    return [nearest, [x for x in order if x not in nearest]]


def failures(copy: Path, tests: Sequence[str], marks: str | None) -> list[str]:
    """The tests that fail in a copy of the repository, up to the first; empty if none does."""
    command = [sys.executable, "-m", "pytest", "-x", "-rfE", "--tb=no", "-p", "no:cacheprovider"]
    command += ["--dist", "load"]  # in the order of the files
    if marks is not None:
        command += ["-m", marks]
    done = subprocess.run(
        [*command, *tests],
        cwd=copy,
        env=os.environ | {"PYTHONPATH": str(copy), "CI": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode in (0, NO_TESTS):
        return []
    found = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return found or [f"{done.stdout}{done.stderr}"[-2000:]]


OWN = "tests/project/test_planted_errors.py"
"""Its tests fail where an error is planted, because its place is changed."""
NO_TESTS = 5
"""Exit code of pytest where it collects no test."""


def search(copy: Path, graph: Graph, fault: Fault, options: argparse.Namespace) -> bool:
    """Plants an error, prints the tests that find it, and takes it out again."""
    file = copy / "iblf_jax" / fault.file
    text = file.read_text(encoding="utf-8")
    file.write_text(planted(text, fault), encoding="utf-8")
    sets = [options.tests] if options.tests else stages(graph, fault)
    begin, found = time.monotonic(), []
    for tests in sets[: 1 if options.nearest else None]:
        found = found or (failures(copy, tests, options.m) if tests else [])
    file.write_text(text, encoding="utf-8")
    words = f"found by {', '.join(found)}" if found else "NOT FOUND"
    seconds = time.monotonic() - begin
    print(f"{fault.what} ({fault.file})\n    {words}, {seconds:.0f} s", flush=True)
    return bool(found)


def main() -> int:
    """Plants the errors; 1 if one of them was not found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nearest", action="store_true", help="run the nearest tests only")
    parser.add_argument("--only", default="", help="words in the descriptions of the errors")
    parser.add_argument("-m", metavar="MARKS", help="as that of pytest; the default tests")
    parser.add_argument("tests", nargs="*", help="files of tests, in the place of the nearest ones")
    options = parser.parse_args()
    graph = Graph()
    faults = [fault for fault in FAULTS if options.only in fault.what]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        worktree = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*worktree, "add", "--quiet", "--detach", str(copy), "HEAD"], check=True)
        try:
            found = [search(copy, graph, fault, options) for fault in faults]
        finally:
            subprocess.run([*worktree, "remove", "--force", str(copy)], check=True)
    print(f"{sum(found)} of {len(found)} errors found")
    return 0 if all(found) else 1


if __name__ == "__main__":
    sys.exit(main())
