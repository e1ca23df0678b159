#!/usr/bin/env python3
"""Plants errors in a copy of the last commit, one at a time, and prints which tests find them.

    python tools/planted_errors.py                        all errors, each with all default tests
    python tools/planted_errors.py --nearest              with the tests that are nearest to it
    python tools/planted_errors.py --only "a sign"        errors whose description has these words
    python tools/planted_errors.py -m "not release"       with the slow tests, too
    python tools/planted_errors.py tests/control          with these tests
    python tools/planted_errors.py --set drawn            twenty others, drawn by the last commit
    python tools/planted_errors.py --set drawn --seed X   and by the hash X; --list prints them

The share that the default tests find measures what they protect.  The tests that are nearest to an
error run first, and the first test that fails ends the search (`-x`): they are those of the folder
of tests that mirrors the folder of the error.  Then come all others that reach its file, as
`tools/select_tests.py` knows them.

All errors were chosen before anybody looked for tests that find them: keep it so.  Tests were
written for those of `FIRST` that no test found, so that their share says what is protected, not
how good the tests are at errors that nobody knows.  `FURTHER` says that, and is counted apart: its
errors were drawn after the tests in which they count were written.  Whoever writes tests for them
draws others: `drawn` takes statements by the hash of a commit and changes each of them by a rule,
so that nobody chooses.  An error that no longer fits its file is replaced by one of the same kind.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from select_tests import ROOT, Graph


class Fault(NamedTuple):
    """An error of one line."""

    what: str
    file: str
    """In the package."""
    old: str
    """Stands exactly once in the file."""
    new: str


FIRST = (
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

FURTHER = (
    Fault(
        "virtual controls without the estimate of the disturbance",
        "control/controllers/_levels.py",
        "state_curve = _curve_of_state(model, t, x, d_hat)\n    time_curve",
        "state_curve = _curve_of_state(model, t, x, 0.0 * d_hat)\n    time_curve",
    ),
    Fault(
        "the anchor of a joint with the other sign",
        "world/robots/tree.py",
        "link, pose = len(names) - 1, (-anchor, np.eye(3))",
        "link, pose = len(names) - 1, (anchor, np.eye(3))",
    ),
    Fault(
        "a weight of the estimated error with the index of another stage",
        "simulation/error_estimate.py",
        "x + newest_first[2 * k + 1] * middle",
        "x + newest_first[2 * k] * middle",
    ),
    Fault(
        "a comparison that is reversed: forward mode for many numbers",
        "engine/thresholds.py",
        "return numbers <= MAX_FORWARD_NUMBERS",
        "return numbers >= MAX_FORWARD_NUMBERS",
    ),
    Fault(
        "operands of a scalar program along the wrong axis",
        "kernels/rules.py",
        "flat = zip(*(x.ravel().tolist() for x in operands), strict=True)",
        "flat = zip(*(x.T.ravel().tolist() for x in operands), strict=True)",
    ),
    Fault(
        "a truth value of a data set that is reversed",
        "studies/dataset.py",
        'variables["started_outside"] = (dims, outside, {',
        'variables["started_outside"] = (dims, ~outside, {',
    ),
    Fault(
        "the smaller of two scales of a stationary point",
        "tuning/solvers/sqp.py",
        "slope_scale = max(slope_scale, state.penalty)",
        "slope_scale = min(slope_scale, state.penalty)",
    ),
    Fault(
        "a level that a claim covers counts as one that is observed only",
        "certificates/claims/_base.py",
        "return observed_only(line, why_not) if why_not else line",
        "return observed_only(line, why_not) if not why_not else line",
    ),
    Fault(
        "the rate of a reference with the other sign",
        "proofs/arm_motion.py",
        "return along(lambda t: reference(parts, t), (t,), (jnp.ones_like(t),))",
        "return along(lambda t: reference(parts, t), (t,), (-jnp.ones_like(t),))",
    ),
    Fault(
        "percentiles of all values, also those that are not finite",
        "deployment/ros2/robot_motion.py",
        "np.percentile(finite, share)",
        "np.percentile(values, share)",
    ),
    Fault(
        "a wrong key: the requirements of a file of a tuning are not read",
        "files/tuning.py",
        'data.get("requirement", [])\n    if not isinstance(terms',
        'data.get("requirements", [])\n    if not isinstance(terms',
    ),
    Fault(
        "a wrong index: the part of the first log is held back of all logs",
        "identification/shooting.py",
        "not_fitted = round(held_back[i] * count)",
        "not_fitted = round(held_back[0] * count)",
    ),
    Fault(
        "a product in the place of a quotient: residuals in standard deviations",
        "plotting/_identification.py",
        "[one.after / max(one.noise, 1e-12) for one in known.fit]",
        "[one.after * max(one.noise, 1e-12) for one in known.fit]",
    ),
    Fault(
        "segments of a program of intervals that leave their last operation out",
        "kernels/enclosure.py",
        "parts = [order[k : k + SEGMENT] for k in range(0, len(order), SEGMENT)]",
        "parts = [order[k : k + SEGMENT - 1] for k in range(0, len(order), SEGMENT)]",
    ),
    Fault(
        "an option of a robot file that is ignored",
        "world/robots/mjcf.py",
        "_explicit(body, where, bool(c.balanceinertia))",
        "_explicit(body, where, False)",
    ),
    Fault(
        "a missing step: torques that are not exchanged with their joints",
        "identification/regression.py",
        "changed(lambda x, order=order: x[:, order]), motion.tau[:, order]",
        "changed(lambda x, order=order: x[:, order]), motion.tau",
    ),
    Fault(
        "a comparison that is reversed: results of calls are stored in the place of numbers",
        "kernels/emit_c.py",
        'if nodes[i].op != "call":\n                read_last',
        'if nodes[i].op == "call":\n                read_last',
    ),
    Fault(
        "records along the wrong axis",
        "kernels/packed.py",
        "array.transpose(2, 0, 1).reshape",
        "array.transpose(2, 1, 0).reshape",
    ),
    Fault(
        "a band of the bounds of another joint",
        "plotting/_panels.py",
        "curve[low_field][:, joint], curve[high_field][:, joint]",
        "curve[low_field][:, joint], curve[high_field][:, 0]",
    ),
    Fault(
        "a clock of a simulated robot that goes back",
        "deployment/ros2/simulated_robot.py",
        "self.origin += round(simulation.period * NANOSECONDS)",
        "self.origin -= round(simulation.period * NANOSECONDS)",
    ),
)
"""At random lines of functions: one in each of 13 folders of the package, and seven more in
proportion to their lines."""

# ------------------------------------------------------------ errors that a hash draws

FOLDERS = (
    *("world", "control", "simulation", "engine", "kernels", "studies", "certificates", "proofs"),
    *("tuning", "identification", "files", "plotting", "deployment"),
)
"""Each of them has at least one drawn error."""
DRAWN = 20
OTHER: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.MatMult: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Pow: ast.Mult,
    ast.USub: ast.UAdd,
}
"""Operator -> the one in its place."""
NOT_DRAWN = (ast.FunctionDef, ast.ClassDef, ast.Raise, ast.Assert, ast.Try, ast.With)


def changes(statement: ast.stmt) -> list[tuple[ast.AST, str, Any]]:
    """What may be changed in a statement, without the statements in it: (node, field, other value)
    for each operator, number, truth value and pair of arguments.  Texts stay.
    """
    nodes: list[ast.AST] = [x for x in ast.iter_child_nodes(statement) if isinstance(x, ast.expr)]
    found: list[tuple[ast.AST, str, Any]] = []
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.JoinedStr):
            continue
        nodes += ast.iter_child_nodes(node)
        operator = getattr(node, "op", None)
        if type(operator) in OTHER:
            found.append((node, "op", OTHER[type(operator)]()))
        elif isinstance(node, ast.Compare) and type(node.ops[0]) in OTHER:
            found.append((node, "ops", [OTHER[type(node.ops[0])](), *node.ops[1:]]))
        elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
            found.append((node, "value", not node.value))
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            found.append((node, "value", node.value + 1))
        elif isinstance(node, ast.Call) and len(node.args) > 1:
            found.append((node, "args", [node.args[1], node.args[0], *node.args[2:]]))
    return found


def statements(text: str) -> list[ast.stmt]:
    """The statements of functions in which something may be changed."""
    functions = (x for x in ast.walk(ast.parse(text)) if isinstance(x, ast.FunctionDef))
    inside = {id(x): x for f in functions for y in f.body for x in ast.walk(y)}.values()
    return [
        x for x in inside if isinstance(x, ast.stmt) and not isinstance(x, NOT_DRAWN) and changes(x)
    ]


def changed(text: str, place: int, random: Random) -> Fault:
    """An error in a statement."""
    statement = statements(text)[place]
    body = getattr(statement, "body", None)
    end = body[0].lineno - 1 if body else statement.end_lineno
    lines = text.splitlines()[statement.lineno - 1 : end]
    setattr(*random.choice(changes(statement)))
    if body:
        statement.body, statement.orelse = [], []  # type: ignore[attr-defined]
    new = textwrap.indent(ast.unparse(statement), " " * statement.col_offset)
    if lines[0].lstrip().startswith("elif"):
        new = new.replace("if", "elif", 1)
    return Fault(f"drawn: {' '.join(new.split())}", "", "\n".join(lines) + "\n", new + "\n")


def drawn(commit: str) -> tuple[Fault, ...]:
    """One error in each of `FOLDERS`, and others in proportion to their statements; no two of them
    in one file.
    """
    random, package = Random(commit), ROOT / "iblf_jax"
    paths = [path for folder in FOLDERS for path in sorted((package / folder).rglob("*.py"))]
    texts = {path: path.read_text(encoding="utf-8") for path in paths}
    places = [(path, i) for path in paths for i in range(len(statements(texts[path])))]
    found: dict[Path, Fault] = {}
    while len(found) < DRAWN:
        folder = FOLDERS[len(found)] if len(found) < len(FOLDERS) else "."
        path, place = random.choice([x for x in places if package / folder in x[0].parents])
        fault = changed(texts[path], place, random)
        if path not in found and texts[path].count(fault.old) == 1:
            found[path] = fault._replace(file=path.relative_to(package).as_posix())
    return tuple(found.values())


SETS = {"first": FIRST, "further": FURTHER}


def planted(text: str, fault: Fault) -> str:
    """The text of a file with an error in it; ValueError if it has not exactly one place for it."""
    if text.count(fault.old) != 1:
        raise ValueError(f"{fault.file} has {text.count(fault.old)} times {fault.old!r}")
    return text.replace(fault.old, fault.new)


def words_of(path: Path) -> set[str]:
    """The words in the names of a file and its folders."""
    return set(re.split(r"[/_]", path.with_suffix("").as_posix()))


def stages(graph: Graph, fault: Fault) -> list[list[str]]:
    """The test files that are nearest to an error, and all others that reach its file.

    The nearest ones are those of the folder of tests that mirrors the folder of the error.  Files
    that have a word of their name in common with the file of the error come first.
    """
    distances = graph.reaching(f"iblf_jax/{fault.file}")
    folder, *rest = Path(fault.file).parts

    def place(test: str) -> tuple[bool, int, str]:
        shared = words_of(Path(*rest)) & words_of(Path(Path(test).name))
        return not shared, distances[test], test

    order = sorted(distances.keys() - {OWN}, key=place)
    nearest = [x for x in order if x.startswith(f"tests/{folder}/")]
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
    parser.add_argument(
        "--set", choices=(*SETS, "drawn", "all"), default="all", help="which errors"
    )
    parser.add_argument("--seed", metavar="HASH", help="of the errors that are drawn")
    parser.add_argument("--list", action="store_true", help="print the errors only")
    parser.add_argument("--only", default="", help="words in the descriptions of the errors")
    parser.add_argument("-m", metavar="MARKS", help="as that of pytest; the default tests")
    parser.add_argument("tests", nargs="*", help="files of tests, in the place of the nearest ones")
    options = parser.parse_args()
    sets = {name: faults for name, faults in SETS.items() if options.set in (name, "all")}
    if options.set == "drawn":
        last = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
        )
        sets = {"drawn": drawn(options.seed or last.stdout.strip())}
    if options.list:
        for fault in (fault for faults in sets.values() for fault in faults):
            print(f"{fault.file}\n-{fault.old.rstrip()}\n+{fault.new.rstrip()}")
        return 0
    graph = Graph()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        worktree = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*worktree, "add", "--quiet", "--detach", str(copy), "HEAD"], check=True)
        try:
            found = {
                name: [search(copy, graph, x, options) for x in faults if options.only in x.what]
                for name, faults in sets.items()
            }
        finally:
            subprocess.run([*worktree, "remove", "--force", str(copy)], check=True)
    for name, results in found.items():
        print(f"{sum(results)} of {len(results)} {name} errors found")
    return 0 if all(map(all, found.values())) else 1


if __name__ == "__main__":
    sys.exit(main())
