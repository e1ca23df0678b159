"""The table "How it compares" of the README and of the article, made of `benchmarks/results`.

    python benchmarks/comparison.py            prints the table
    python benchmarks/comparison.py --write    puts it into README.md and paper/paper.md
    python benchmarks/comparison.py --check    fails if one of them has another table

Every number comes from the file of the program that its row names; nothing is measured here.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "benchmarks"))

import withdrawn

RESULTS = ROOT / "benchmarks" / "results"
FILES = (ROOT / "README.md", ROOT / "paper" / "paper.md")
LANDING = ROOT / "docs" / "index.md"
"""The first page of the site, which has three of the numbers."""
ON_LANDING = {
    "throughput": "4096 closed loops on a CPU{ours}; plain JAX: {other}",
    "latency": "a run of 20 s by RK4{ours}; SciPy LSODA: {other}",
    "arm": "iiwa 14 with law and observer{ours}; MuJoCo, the plant alone: {other}",
}
"""The benchmarks of these numbers, and the words for a narrow column."""
BEGIN, END = "<!-- comparison -->\n", "<!-- end of comparison -->"

Conditions = dict[str, Any]
"""Column of a result -> the value that chooses a row."""


class Comparison(NamedTuple):
    """A row: one task, one number of iblf_jax and those of other software."""

    task: str
    benchmark: str
    """Name of the program and of the file of its results."""
    column: str
    """The column with the number."""
    unit: str
    better: str
    """ "more" or "less"."""
    ours: Conditions
    others: dict[str, Conditions]
    """Other software -> the conditions that choose its row."""
    beside: dict[str, Callable[[float], str]] = {}  # noqa: RUF012 - a constant
    """Column -> words for its value, which the row states as well, because the number alone would
    mislead."""
    has_ratio: bool = True
    """Whether both programs compute the same task with errors of one size."""


ENVIRONMENT = ("commit", "iblf_jax", "jax", "python", "processor", "cores", "peers")
"""What all shown results must have in common, of `machine` in a result."""
ERROR = "largest error [rad]"


def words(value: float) -> str:
    """A number with two digits."""
    rounded = float(f"{value:.2g}")
    if rounded < 1e6:
        return f"{rounded:,.10g}"
    return f"{rounded / 1e6:,.10g} million"


def error_in_words(error: float) -> str:
    """The largest error of a row [rad]."""
    if error < 1e-6:
        return f"largest error {words(1e9 * error)} nrad"
    return f"largest error {words(1e6 * error)} \N{MICRO SIGN}rad"


LOOP = {"loop": "paper", "type": "float64", "runs": 4096}
ON_GPU = {"loop": "paper", "type": "float32", "runs": 65536}
ARM_ON_GPU = {"loop": "iiwa14", "type": "float32", "runs": 65536}
ARM_ON_CPU = {"type": "float64"}
RARE = {"case": "1e-6, 50 numbers"}
COMPARISONS = (
    Comparison(
        "4096 closed loops of the paper's arm, CPU",
        "throughput",
        "steps/s per core",
        "steps/s per core",
        "more",
        LOOP | {"row": "native"},
        {
            "the same loop in plain JAX": LOOP | {"row": "textbook"},
            "diffrax with the same method": LOOP | {"row": "diffrax"},
        },
        {"steps": "in {:,.0f} steps".format},
    ),
    Comparison(
        "one run of 20 s, called from Python; RK4 at 0.5 ms, and LSODA with steps of its own that"
        " calls the compiled right-hand side",
        "latency",
        "processor ms",
        "ms of a processor",
        "less",
        {"row": "native, user's call, 0.5 ms"},
        {"SciPy LSODA, relative tolerance 1e-6": {"row": "LSODA, compiled field"}},
        {ERROR: error_in_words},
    ),
    Comparison(
        "65,536 closed loops of the paper's arm, H200",
        "gpu",
        "steps/s",
        "steps/s",
        "more",
        ON_GPU | {"row": "gpu"},
        {"the same loop in plain JAX": ON_GPU | {"row": "textbook"}},
    ),
    Comparison(
        "iiwa 14 with law and observer; MuJoCo simulates the plant alone; both RK4 at 1 ms in"
        " float64, CPU",
        "arm",
        "steps/s per core",
        "steps/s per core",
        "more",
        ARM_ON_CPU | {"row": "native, standard metrics"},
        {"MuJoCo `rollout`": ARM_ON_CPU | {"row": "MuJoCo rollout, plant alone"}},
        has_ratio=False,
    ),
    Comparison(
        "iiwa 14 with a PD law and gravity compensation, which all three compute, H200",
        "gpu",
        "steps/s",
        "steps/s",
        "more",
        ARM_ON_GPU | {"row": "gpu"},
        {
            "MJX": ARM_ON_GPU | {"row": "MJX"},
            "MuJoCo Warp": ARM_ON_GPU | {"row": "MuJoCo Warp"},
        },
    ),
    Comparison(
        "tuning of two gains under limits, by rollouts of this package",
        "tuning",
        "processor s",
        "s of a processor",
        "less",
        {"search": "iblf_jax tune"},
        {
            "SLSQP with exact derivatives": {"search": "SLSQP, exact slopes"},
            "CMA-ES": {"search": "CMA-ES"},
        },
        {"rollouts to 0.5 %": "{:.0f} rollouts to 0.5 % above the best".format},
    ),
    Comparison(
        "failure probability of 1e-6, 50 variables, by subset simulation",
        "rare_failures",
        "points",
        "runs",
        "less",
        RARE | {"estimator": "subset"},
        {"OpenTURNS": RARE | {"estimator": "OpenTURNS, subset"}},
        {"covered": "{:.0%} of the 95 % intervals are right".format},
    ),
)


def result_of(benchmark: str) -> dict[str, Any]:
    """The result of a benchmark: its rows, and the machine that measured them."""
    return dict(json.loads((RESULTS / f"{benchmark}.json").read_text()))


def value_of(comparison: Comparison, conditions: Conditions, column: str = "") -> float:
    """The number of the only row of a result that meets the conditions, in the compared column or
    in another one.
    """
    rows = result_of(comparison.benchmark)["rows"]
    found = [row for row in rows if all(row[key] == value for key, value in conditions.items())]
    if len(found) != 1:
        raise LookupError(f"{comparison.benchmark}.json has {len(found)} rows with {conditions}")
    return float(found[0][column or comparison.column])


def beside(comparison: Comparison, conditions: Conditions) -> str:
    """The further values of a row, in words."""
    values = [
        in_words(value_of(comparison, conditions, column))
        for column, in_words in comparison.beside.items()
    ]
    of_ours, errors = (
        errors_of(comparison.benchmark, one) for one in (comparison.ours, conditions)
    )
    values += map(error_in_words, errors)
    if of_ours and not errors:
        values.append("its error was not measured")
    return "".join(f", {value}" for value in values)


def in_short(comparison: Comparison, conditions: Conditions) -> str:
    """The number of a row with its unit, without the words after it."""
    unit, _, _ = comparison.unit.partition(" ")
    return f"{words(value_of(comparison, conditions))} {unit}"


def errors_of(benchmark: str, conditions: Conditions) -> list[float]:
    """The largest error of a row whose benchmark measures times only [rad], of `errors.py`; empty
    for a row that has none.
    """
    rows = result_of("errors")["rows"]
    named = {"benchmark": benchmark, "row": conditions.get("row")}
    return [float(row[ERROR]) for row in rows if named.items() <= row.items()]


def environment(benchmarks: Sequence[str]) -> str:
    """Where these benchmarks were measured, in sentences.

    Raises:
      LookupError: not all of them were measured at one commit, on one machine and with the same
        versions, so that rows of one table would not be comparable.
    """
    machines = [result_of(name)["machine"] for name in benchmarks]
    common = machines[0]
    for name, machine in zip(benchmarks, machines, strict=True):
        differing = [key for key in ENVIRONMENT if machine.get(key) != common.get(key)]
        if differing:
            raise LookupError(f"{name}.json and {benchmarks[0]}.json differ in {differing}")
    dates = " and ".join(sorted({machine["date"] for machine in machines}))
    return (
        f"All of it was measured on {dates}, at commit {common['commit'][:8]}, on"
        f" {common['cores']} cores of an {common['processor']}: iblf_jax {common['iblf_jax']}, JAX"
        f" {common['jax']}, Python {common['python']}; other software: {common['peers']}."
    )


def ratio(comparison: Comparison, name: str) -> float:
    """How many times better this package is than other software; below 1 it is worse."""
    ours = value_of(comparison, comparison.ours)
    other = value_of(comparison, comparison.others[name])
    return other / ours if comparison.better == "less" else ours / other


def row(comparison: Comparison) -> str:
    """A row of the table."""
    others = []
    for name, conditions in comparison.others.items():
        value = in_short(comparison, conditions)
        if comparison.has_ratio:
            value += f" ({words(ratio(comparison, name))})"
        others.append(f"{name}: {value}{beside(comparison, conditions)}")
    ours = words(value_of(comparison, comparison.ours))
    cells = [
        comparison.task,
        f"{ours} {comparison.unit}{beside(comparison, comparison.ours)}",
        "; ".join(others),
        f"`benchmarks/{comparison.benchmark}.py`",
    ]
    return "| " + " | ".join(cells) + " |"


def left_out() -> str:
    """What has no row, and the reason, in sentences."""
    rows = result_of("constraints")["rows"]
    effort = {row["law"]: row["effort [N m]"] for row in rows}
    return (
        "Model predictive control is left out, because the runs of `benchmarks/constraints.py` are"
        " no comparison of equals: it has a period of 20 ms and an RMS torque of"
        f" {effort['MPC (CasADi)']:.2g} N m, the safety filter beside it a period of 1 ms and"
        f" {effort['safety_filter']:.2g} N m; it is called from Python once a period, where the"
        " loop of the filter is one compiled program; and it solves to convergence by IPOPT,"
        " without real-time iterations."
    )


def table() -> str:
    """The table as Markdown, which rows are withdrawn, and what has no row."""
    shown = [x for x in COMPARISONS if x.benchmark not in withdrawn.BENCHMARKS]
    removed = [x.task for x in COMPARISONS if x.benchmark in withdrawn.BENCHMARKS]
    head = [
        "| task | iblf_jax | other software (ratio; below 1 it is better) | measured by |",
        "|---|---|---|---|",
    ]
    lines = [*head, *map(row, shown)]
    lines += [
        "",
        "The errors of the first and the third row are those of `benchmarks/errors.py`. A row whose"
        " programs compute different tasks has no ratio."
        f" {environment([*(x.benchmark for x in shown), 'errors'])}",
    ]
    if removed:
        names = " and ".join(f'"{task}"' for task in removed)
        reason = f"because they were {withdrawn.REASON}; they will be measured again."
        lines += ["", f"The rows {names} are withdrawn, {reason}"]
    lines += ["", left_out()]
    return "\n".join(lines) + "\n"


def three_numbers() -> str:
    """The numbers of the landing page as a list, each with a link, and which other software is
    better in a row that the page does not have.
    """
    lines = []
    for benchmark, text in ON_LANDING.items():
        chosen = next(x for x in COMPARISONS if x.benchmark == benchmark)
        conditions = next(iter(chosen.others.values()))
        number = f"{words(value_of(chosen, chosen.ours))} {chosen.unit}"
        other = in_short(chosen, conditions) + beside(chosen, conditions)
        described = text.format(ours=beside(chosen, chosen.ours), other=other)
        # A narrow column.
        described = re.sub(", in [0-9,]+ steps", "", described).replace("largest error", "error")
        lines.append(f"- [**{number}**](benchmarks.md): {described}")
    for worse in COMPARISONS:
        if worse.benchmark in withdrawn.BENCHMARKS or not worse.has_ratio:
            continue
        names = " and ".join(name for name in worse.others if ratio(worse, name) < 1.0)
        if names:
            lines.append(f"- Better are [{names}](benchmarks.md): {worse.task}")
    return "\n".join(lines) + "\n"


def replaced(text: str, made: Callable[[], str] = table) -> str:
    """A text with the table, or what else is made, between its marks."""
    pattern = re.escape(BEGIN) + ".*?" + re.escape(END)
    if not re.search(pattern, text, re.DOTALL):
        raise LookupError(f"the text has no place for the table, from {BEGIN!r} to {END!r}")
    new = f"{BEGIN}{made()}{END}"
    return re.sub(pattern, lambda _: new, text, flags=re.DOTALL)


def outdated() -> list[Path]:
    """The files whose numbers are not those of the results."""
    return [path for path, text in current().items() if text != path.read_text(encoding="utf-8")]


def current() -> dict[Path, str]:
    """Every file with the numbers of the results."""
    texts = {path: path.read_text(encoding="utf-8") for path in (*FILES, LANDING)}
    made = {path: three_numbers if path == LANDING else table for path in texts}
    return {path: replaced(text, made[path]) for path, text in texts.items()}


def main() -> int:
    """Prints, writes or checks the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--write", action="store_true")
    action.add_argument("--check", action="store_true")
    options = parser.parse_args()
    if options.write:
        for path, text in current().items():
            path.write_text(text, encoding="utf-8")
        return 0
    if options.check:
        names = [str(path.relative_to(ROOT)) for path in outdated()]
        if names:
            print(f"{', '.join(names)}: run python benchmarks/comparison.py --write")
        return int(bool(names))
    print(table())
    return 0


if __name__ == "__main__":
    sys.exit(main())
