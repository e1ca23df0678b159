"""What a change costs: the working tree, or the commit AFTER, against another commit, in turns.

    python benchmarks/losses.py [BEFORE [AFTER]] [--quick] [--fail PERCENT] [--json FILE]

BEFORE is by default the commit that `benchmarks/baseline` names.  Every number is one of a fresh
process that imports the package of its tree: processor seconds, those of the compilers that it
starts included, and counts of operations, which are exact.  The trees take turns (`change` says
what of the turns counts).  A row that lost more than 5 % is measured again a few times before it is
named.

With --quick the arm of six joints, whose first result takes half a minute, is left out.  The exit
status is 1 if a row lost more than PERCENT.

Whoever accepts a loss writes the new commit into `benchmarks/baseline` and the reason into the
commit's message.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from _timing import ARM, ROOT, report

BASELINE = ROOT / "benchmarks" / "baseline"
NAMED = 0.05
"""A loss of more than this share is named."""
ROUNDS, MORE_ROUNDS = 2, 4
"""Turns of each tree: of every row, and further ones of a row that seems to have lost."""

PREAMBLE = """
import json, resource
def used():
    whose = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(sum(resource.getrusage(each)[:2]) for each in whose)
def seconds(call):
    start = used()
    call()
    return used() - start
def least(call, repeats):
    return min(seconds(call) for _ in range(repeats))
import jax
"""
STUDY = """
import iblf_jax as ij
paper = ij.presets.zhang_yan_2024()
unknown = {"plant.mass[1]": ij.factor(ij.uniform(0.9, 1.1))}
def study(runs, steps):
    ij.monte_carlo(paper, unknown, runs=runs, duration=steps * 1e-3, dt=1e-3, progress=False)
"""


class Measure(NamedTuple):
    """A program that prints numbers, one for each of its rows."""

    rows: tuple[str, ...]
    code: str
    """Makes the list `found`; the lists of all processes of a turn have a number for each row."""
    starts: int = 1
    """Processes of a turn, one after the other, which share a cache that is empty at first; the
    code knows the number `process` of its own, from 0."""
    quick: bool = True
    rounds: int = ROUNDS
    is_exact: bool = False
    """Counts, which are not measured again."""


MEASURES = (
    Measure(
        ("import iblf_jax after jax [s]",),
        "def call():\n    import iblf_jax\nfound = [seconds(call)]",
        rounds=3,
    ),
    Measure(
        ("first simulate, empty cache [s]", "first simulate, second process [s]"),
        f"{STUDY}found = [seconds(lambda: ij.simulate(paper, duration=1.0, dt=1e-3))]",
        starts=2,
    ),
    Measure(
        (
            "first monte_carlo, empty cache [s]",
            "first monte_carlo, second process [s]",
            "monte_carlo, 65,536 runs of 1,000 steps [s]",
            "monte_carlo, 4,096 runs of 10,000 steps [s]",
        ),
        f"{STUDY}"
        "found = [seconds(lambda: study(256, 1000))]\n"
        "sizes = [(65_536, 1000), (4_096, 10_000)] if process == 1 else []\n"
        "found += [least(lambda size=size: study(*size), 2) for size in sizes]",
        starts=2,
    ),
    Measure(
        ("operations of a step and run, paper", "operations of a step and run, ur5"),
        "import iblf_jax as ij\n"
        "each = (ij.presets.zhang_yan_2024(), ij.presets.ur5())\n"
        'found = [ij.explain(x).counts["a step and run"].total() for x in each]',
        rounds=1,
        is_exact=True,
    ),
    Measure(
        ("first simulate of an arm, empty cache [s]", "first simulate of an arm, second [s]"),
        f"{ARM}found = [seconds(lambda: ij.simulate(arm, duration=1.5, dt=1e-3))]",
        starts=2,
        quick=False,
    ),
)


def measured(tree: Path, measure: Measure) -> list[float]:
    """One turn of a tree, its numbers in the order of the rows."""
    found: list[float] = []
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"PYTHONPATH": str(tree), "XDG_CACHE_HOME": cache}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # it would compile all in each process
        for process in range(measure.starts):
            code = f"{PREAMBLE}process = {process}\n{measure.code}\nprint(json.dumps(found))"
            run = subprocess.run(
                [sys.executable, "-c", code],
                capture_output=True,
                text=True,
                env=environment,
                cwd=cache,
            )
            if run.returncode:
                reason = run.stderr.strip().splitlines()[-1]
                raise SystemExit(f"{tree.name} cannot run '{measure.rows[0]}': {reason}")
            found += json.loads(run.stdout.splitlines()[-1])
    return found


def change(before: Sequence[float], after: Sequence[float]) -> float:
    """The share by which a number grew, by its turns in both trees.

    It is the smaller one of two: that of the smallest numbers, as other programs only add to them,
    and the median of the turns, since both trees of a turn meet much the same machine.  One lucky
    turn before, or some unlucky ones after, are thus no loss.
    """
    turns = [second / first for first, second in zip(before, after, strict=True)]
    return min(min(after) / min(before), statistics.median(turns)) - 1.0


def compared(trees: Sequence[Path], measure: Measure) -> list[list[float]]:
    """Rows of one measure: the smallest numbers before and after, and the change."""
    turns: list[list[list[float]]] = [[], []]
    for number in range(measure.rounds + MORE_ROUNDS):
        for tree, own in zip(trees, turns, strict=True):
            own.append(measured(tree, measure))
        if number + 1 < measure.rounds:
            continue
        columns = zip(*(zip(*own, strict=True) for own in turns), strict=True)
        rows = [[min(before), min(after), change(before, after)] for before, after in columns]
        if measure.is_exact or not any(share > NAMED for *_, share in rows):
            break
    return rows


def verdict(rows: Sequence[Sequence], fail: float) -> tuple[str, bool]:
    """What lost more than NAMED, and whether a row lost more than `fail` percent."""
    lost = {str(name): percent for name, *_, percent in rows if percent > 100 * NAMED}
    if not lost:
        return f"no row lost more than {100 * NAMED:.0f} %", False
    named = [f"{name} {percent:+.0f} %" for name, percent in lost.items()]
    return f"lost: {'; '.join(named)}", max(lost.values()) > fail


def table(trees: Sequence[Path], measures: Sequence[Measure]) -> list[list]:
    """All rows: name, before, after and the change in percent."""
    rows: list[list] = []
    for measure in measures:
        for name, (before, after, share) in zip(
            measure.rows, compared(trees, measure), strict=True
        ):
            rows.append([name, before, after, 100 * share])
            print(f"{name}: {before:.4g} -> {after:.4g}", file=sys.stderr, flush=True)
    return rows


def is_known(commit: str) -> bool:
    """Whether this clone has a commit."""
    words = ["git", "-C", str(ROOT), "cat-file", "-e", f"{commit}^{{commit}}"]
    return subprocess.run(words, capture_output=True).returncode == 0


@contextlib.contextmanager
def checked_out(commit: str | None) -> Iterator[Path]:
    """The files of a commit in a folder for a while; the working tree if there is none."""
    if commit is None:
        yield ROOT
        return
    worktree = ["git", "-C", str(ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / commit.replace("/", "_")
        subprocess.run([*worktree, "add", "--quiet", "--detach", str(tree), commit], check=True)
        try:
            yield tree
        finally:
            subprocess.run([*worktree, "remove", "--force", str(tree)], check=True)


def main() -> int:
    """Prints the table and the verdict; 1 if a row lost too much."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", nargs="?", help="by default that of benchmarks/baseline")
    parser.add_argument("after", nargs="?", help="by default the working tree")
    parser.add_argument("--quick", action="store_true", help="without the arm of six joints")
    parser.add_argument("--fail", type=float, default=float("inf"), metavar="PERCENT")
    parser.add_argument("--json", help="also write the table to this file")
    args = parser.parse_args()
    before = args.before or BASELINE.read_text(encoding="utf-8").split()[0]
    if not is_known(before):
        print(f"Nothing is compared: the commit {before} is not in this clone.")
        return 0
    measures = [x for x in MEASURES if x.quick or not args.quick]
    with checked_out(before) as first, checked_out(args.after) as second:
        rows = table((first, second), measures)
    words, failed = verdict(rows, args.fail)
    columns = ["processor seconds, and counts", "before", "after", "change, %"]
    title = f"{args.after or 'Working tree'} against {before}"
    report(title, columns, rows, args.json, {"verdict": words})
    print(words)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
