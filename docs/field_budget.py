"""The page "Laws with the same budget of tuning", with a figure and tables for each task, from the
results of `benchmarks/field/equal_budget.py`.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path += [str(BENCHMARKS), str(BENCHMARKS / "field")]

from entry import OWN, RESULTS
from entry_tables import escaped, markdown_table
from equal_budget import (
    BUDGET,
    LATER,
    LEVELS,
    NOISE,
    PERIODS,
    RANGE,
    SEEDS,
    SHARES,
    START,
    TASKS,
    TIE,
    ranks,
)
from matplotlib.figure import Figure

NAME = "field_equal_budget"
"""Of the page and of its figures."""
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
MARKERS = "osD^vP*"
NO_RESULT = {
    "shaw_cortez_2022": "stopped after nine minutes of a processor, in its first law: a run of"
    " 30,000 steps takes 0.4 s of a processor, and a law at least 645 runs; its reference leaves"
    " the bounds on purpose, so that only a law with a filter can keep them",
}
"""Task -> why it has no result, where it was tried."""
REMARKS = {
    "choi_2023": "The task was added after the results of the others, because it has limits of the"
    " input and a constraint. Its publication wants a speed of 24 m/s, and no distance beyond that"
    " of the constraint: the reference, 25.2 m behind the leading car, is one that the entry"
    " assumes for other laws. The law of the entry is not designed for this error, and its speed of"
    " 24 m/s, which is not tuned, limits its effort.",
}
"""Task -> what a reader of its ranks has to know."""
AT_END = 0.01
"""Distance to the end of a range, as a share of the gain, within which a gain is at the end."""
WIDE = 10.0
"""Largest ratio of the numbers of a linear axis."""


def results(folder: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Task -> result, those of `TASKS` first."""
    found = {path.stem: path for path in sorted(folder.glob("*.json"))}
    names = [name for name in TASKS if name in found]
    names += [name for name in found if name not in names]
    return {name: json.loads(found[name].read_text(encoding="utf-8")) for name in names}


def in_words(found: dict[str, dict[str, Any]]) -> str:
    """How many laws keep what, in a sentence that README and article have, too.  A law counts once
    for each task.
    """
    orders = [ranks(result) for result in found.values()]
    laws = sum(len(result["laws"]) for result in found.values())
    added = sum(law in LATER.get(name, ()) for name, one in found.items() for law in one["laws"])
    kept = sum(map(len, orders))
    near = sum(rank == 1 for order in orders for rank in order.values())
    results_and_orders = zip(found.values(), orders, strict=True)
    ranked = [result["laws"][law] for result, order in results_and_orders for law in order]
    robust = sum(not words_of(law["robustness"]) for law in ranked)
    at_end = sum(bool(gains_at_the_end(law, 1.0)) for law in ranked)
    ends = f"; {at_end} of the {kept} have a gain at the end of its range" if at_end else ""
    chosen = sum(name in found for name in TASKS)
    later = f" and on {len(found) - chosen} added later" if len(found) > chosen else ""
    of_laws = f" ({added} added after the results of the others)" if added else ""
    return (
        f"of {laws} pairs of a task and a tuned law{of_laws}, on {chosen} of the {len(TASKS)} tasks"
        f" chosen before the results{later}, {kept} keep the effort of the law of the"
        f" entry, the bounds and the constraints, {robust} of these also with the parameters,"
        f" periods and noise of the page, and {near} of the {kept} are within {100 * TIE:g} % of"
        f" the smallest error of their task{ends}"
    )


def write(folder: Path) -> None:
    """Writes the page and its figures."""
    found = results()
    for name, result in found.items():
        figure(result).savefig(folder / f"{NAME}_{name}.png", dpi=150)
    (folder / f"{NAME}.md").write_text(page(found), encoding="utf-8")


def page(found: dict[str, dict[str, Any]]) -> str:
    """The page of some results."""
    seconds = sum(result["processor_seconds"] for result in found.values())
    lacking = [
        f"{escaped(name)} ({NO_RESULT.get(name, 'not tried')})"
        for name in TASKS
        if name not in found
    ]
    chosen = f" The page has {len(found)} tasks, which took {seconds:.0f} s of a processor."
    if lacking:
        chosen += f" Chosen, but without a result: {', '.join(lacking)}."
    sections = [
        "# Laws with the same budget of tuning",
        "Each law of a task is tuned with the same budget, that of the entry among them, and the"
        " result is a curve of its error against its effort. One command computes a task:",
        "```bash\npython benchmarks/field/equal_budget.py --task zhang_yan_2024\n```",
        "`--laws` takes other laws of the package, and `--task` any entry of the"
        " [benchmark of the field](field.md) whose law has two gains or three." + chosen,
        "## What is equal, and what is not",
        "\n".join(f"- {line}" for line in method()),
        "## Which laws keep what",
        "Each cell has the rank of a law by its error, under the effort of the law of the"
        " entry. A dash is a law that found no gains which keep this effort, the bounds and the"
        " constraints; an empty cell is one that is not in the task. A cross (×) marks gains that"
        " do not keep bounds or constraints in a run with the parameters, periods or noise below,"
        " and a plus (+) a gain at the end of its range, beyond which the error might be smaller."
        " Ranks of different tasks have different laws beside them, so they are not averaged.",
        f"Together {in_words(found)}.",
        overview(found),
        *(section(name, result) for name, result in found.items()),
    ]
    return "\n\n".join(sections) + "\n"


def method() -> list[str]:
    """What is equal, a sentence or a few for each item."""
    numbers = ", ".join(f"{level:g}" for level in LEVELS)
    periods = ", ".join(f"{1e3 * period:g}" for period in PERIODS)
    return [
        "**Gains**: two or three of each law, named in its table, each within a factor of"
        f" {RANGE:g} of its start. A gain may have a number for each component. The law of the"
        " entry starts at its own gains, the others at its rates (`task_laws.py`).",
        f"**Budget**: for each limit of the effort `ij.tune` has {BUDGET.values} points without"
        f" derivatives, and {BUDGET.starts} searches of at most {BUDGET.iterations} steps with"
        " them. A search that has converged ends, one whose best gains a single start came near"
        " begins again around them as long as that helps, and one without gains that keep the"
        " requirements looks at further points. The runs that each law took therefore differ, and"
        " are in its table.",
        "**Objective**: the RMS error of the first level, over all components and the entire run."
        " Error and effort are those of the same time.",
        "**Effort**: the RMS input above the one that balances gravity, or above the steady input"
        f" of a plant. Its limits are {numbers} times that of the law of the entry with its own"
        f" gains. The start, which is {100 * START:g} % of the run, and the rest are stated apart.",
        "**Task**: bounds of all levels and constraints are requirements of the tuning. Limits of"
        " the input clip the command of every law. Tasks without them have no such limit.",
        "**Observer**: that of the task, for every law whose formula has an estimate of the"
        " disturbance. `ComputedTorque` and `PDGravity` have it, too, which in their classical form"
        ' have none. A law "q measured" has an observer of the velocity as well.',
        "**Not tuned**: boxes, limits and time constants of a law. They follow from the published"
        " run (`task_laws.py`): the limit of `Saturated` is 1.2 times its largest input, and bounds"
        " of velocities that a law requires are 3 times its largest velocities.",
        "**Robustness**: the gains under the published effort, with parameters of the plant that"
        f" are {', '.join(f'{x:g}' for x in SHARES)} times those of the model, with periods of"
        f" {periods} ms, and with {SEEDS} seeds of noise at 2 ms, whose standard deviation is"
        f" {NOISE:g} times half the least distance of the bounds. They are not tuned for it.",
        "**Chosen before results**: the tasks, and the laws but those of *Choosing a law* that were"
        f" added later, on {' and '.join(map(escaped, LATER))}, with the same budget, limits and"
        " ranges. Two tasks of the first choice,"
        " golestani\\_2022 and zhang\\_2022, were left out for their time: plants of three"
        " components take 100 s of a processor for each law. The limits of the effort, the range of"
        " the gains and the weights among them were chosen after a trial on liu\\_2018, in which no"
        " law kept half of the effort, and one law kept no limit without its weight. The law of"
        " mcilvanna\\_2024 got its weight later: without it the error was the same under all"
        f" limits. The {100 * TIE:g} % of the rank were chosen after the results, from the"
        " differences below.",
        "**Rank**: one more than the number of laws whose error is smaller by more than"
        f" {100 * TIE:g} %, among those that keep the limit of the effort, the bounds and the"
        " constraints. Smaller differences are those of the search: on liu\\_2018 the published law"
        " ends 4 % below its row if its weight is not tuned, and Integral and Log, whose slopes"
        " differ by a factor of 2, give one law up to a weight.",
        "**Figures**: the grey line is the effort of the law of the entry with its own"
        " gains, and the star its error. A bar is the range of the errors of the gains under"
        " this effort on other plants, with periods and with noise. A cross is a law of which"
        " some of these runs do not keep the bounds.",
        "**Not equal**: the runs that the search took, the number of numbers in the gains of a"
        " law, and how near to its best gains a law comes with this budget. Other gains, more of"
        " them, or another objective can change the order. Most of the error and of the effort"
        " may belong to the start, as on the paper's arm; the tables have the error of the"
        " second half for this reason.",
    ]


def overview(found: dict[str, dict[str, Any]]) -> str:
    """A row for each law with its rank on each task."""
    laws = list(dict.fromkeys(law for result in found.values() for law in result["laws"]))
    rows = []
    for law in laws:
        cells = []
        for result in found.values():
            if law not in result["laws"]:
                cells.append("")
                continue
            order = ranks(result)
            cells.append(_rank(order[law], result["laws"][law]) if law in order else "–")
        taken = [cell for cell in cells if cell]
        kept = sum(cell != "–" for cell in taken)
        rows.append([_narrow(law), f"{kept} of {len(taken)}", *cells])
    return markdown_table(["law", "kept", *map(escaped, found)], rows)


def _rank(rank: int, law: dict[str, Any]) -> str:
    """A rank with what its reader has to know."""
    left = " ×" if words_of(law["robustness"]) else ""
    return str(rank) + left + (" +" if gains_at_the_end(law, 1.0) else "")


def further_runs(robust: dict[str, Any]) -> list[Any]:
    """The errors on other plants, with periods and with noise, or what a run does not keep."""
    return [*robust["masses"].values(), *robust["periods"].values(), *robust["noise"]]


def words_of(robust: dict[str, Any]) -> list[str]:
    """What these runs do not keep."""
    return [value for value in further_runs(robust) if isinstance(value, str)]


def gains_at_the_end(law: dict[str, Any], level: float) -> list[str]:
    """The gains of a law that end within `AT_END` of an end of their range under a limit."""
    found = []
    for path, values in _row(law, level).get("gains", {}).items():
        logs = (abs(math.log(x / y)) for x, y in zip(values, law["gains"][path], strict=True))
        if max(logs) > math.log(RANGE) - AT_END:
            found.append(path)
    return found


def _narrow(law: str) -> str:
    """A name with a place at which a narrow column may break it."""
    return escaped(law).replace("(", "\u200b(")


def section(name: str, result: dict[str, Any]) -> str:
    """The figure and the tables of a task."""
    length, force = result["units"]
    at_one = {law: _row(one, 1.0) for law, one in result["laws"].items()}
    order = ranks(result)
    laws = sorted(result["laws"], key=lambda law: at_one[law].get("error", math.inf))
    headings = ["rank", "law", f"error [{length}]", f"second half [{length}]", f"effort [{force}]"]
    headings += [f"of the start [{force}]", f"of the rest [{force}]", f"peak input [{force}]"]
    numbers = ("error", "late_error", "effort", "start_effort", "rest_effort", "peak_input")
    rows = []
    for law in laws:
        row = at_one[law]
        if row["left"]:
            rows.append(["–", _narrow(law), row["left"], *[""] * 5])
            continue
        rows.append([str(order[law]), _narrow(law), *(_number(row[key]) for key in numbers)])
    own = result["own"]
    rows.append(["", "gains of the entry", *(_number(own[key]) for key in numbers)])
    machine = result["machine"]
    where = (
        f"`{result['command']}`: {result['processor_seconds']:.0f} s of {machine['processor']},"
        f" {machine['cores']} cores; Python {machine['python']}, jax {machine['jax']}, iblf_jax"
        f" {machine['iblf_jax']}, commit {machine['commit'][:12]}, {machine['date']}."
    )
    for law, one in result["laws"].items():
        if "commit" in one:
            where += f" {escaped(law)}: commit {one['commit'][:12]}, later than the others."
    return "\n\n".join(
        [
            f"## {escaped(result['title'])}",
            task_in_words(name, result),
            f"![{description(result)}]({NAME}_{name}.png)",
            under_one(result, at_one),
            markdown_table(headings, rows),
            "Error under each limit of the effort, in efforts of the law of the entry. A plus (+)"
            " marks a gain that ends at an end of its range under one of them:",
            fronts(result, laws),
            f"Error [{length}] of the gains under the effort of the law of the entry, on other"
            " plants, with periods and with noise:",
            robustness(result, laws),
            where,
        ]
    )


def under_one(result: dict[str, Any], at_one: dict[str, dict[str, Any]]) -> str:
    """Between which numbers the errors under the effort of the law of the entry are."""
    errors = [row["error"] for row in at_one.values() if not row["left"]]
    words = f"Under the effort of the law of the entry {len(errors)} of {len(at_one)} laws"
    if not errors:
        return f"{words} keep what the task has:"
    low, high = _number(min(errors)), _number(max(errors))
    return f"{words} keep what the task has, with errors from {low} to {high} {result['units'][0]}:"


def task_in_words(name: str, result: dict[str, Any]) -> str:
    """What the task has, and which laws are not in it."""
    text = f"[The entry](gallery/{name}.md); {result['duration']:g} s."
    text += f" The law of the entry: {escaped(result['own_law'])}."
    if result["input_limits"]:
        limits = "; ".join(f"{low:g} to {high:g}" for low, high in result["input_limits"])
        text += f" Limits of the input: {limits} {result['units'][1]}."
    if result["constraints"]:
        text += f" Constraints: {escaped('; '.join(result['constraints']))}."
    uncertain = ", ".join(f"`{path}`" for path in result["uncertain"])
    text += f" Uncertain parameters: {uncertain}." if uncertain else " None is uncertain."
    left_out: dict[str, list[str]] = {}
    for law, reason in result["not_applicable"].items():
        left_out.setdefault(escaped(reason), []).append(escaped(law))
    for reason, laws in left_out.items():
        text += f" Not in the table ({reason}): {'; '.join(laws)}."
    return f"{text} {REMARKS[name]}" if name in REMARKS else text


def _row(law: dict[str, Any], level: float) -> dict[str, Any]:
    """The row of a limit of the effort."""
    return next(row for row in law["front"] if row["level"] == level)


def _number(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def fronts(result: dict[str, Any], laws: list[str]) -> str:
    """The errors of each law under each limit, and the runs that it took."""
    rows = []
    for law in laws:
        one = result["laws"][law]
        cells = [_number(row.get("error", "–")) for row in one["front"]]
        ends = {path for row in one["front"] for path in gains_at_the_end(one, row["level"])}
        gains = ", ".join(
            f"`{path.removeprefix('controller.')}`{' (+)' * (path in ends)}"
            for path in one["gains"]
        )
        runs = sum(row["points"] for row in one["front"])
        slopes = sum(row["derivatives"] for row in one["front"])
        rows.append([_narrow(law), gains, *cells, f"{runs} + {slopes}"])
    levels = [f"{level:g}" for level in LEVELS]
    return markdown_table(["law", "gains", *levels, "runs without + with derivatives"], rows)


def robustness(result: dict[str, Any], laws: list[str]) -> str:
    """The errors of the tuned gains on other plants, with periods, and with noise."""
    rows = []
    for law in laws:
        robust = result["laws"][law]["robustness"]
        if robust is None:
            continue
        masses = [_worse(robust["masses"], f"{1 - x:.1f}", f"{1 + x:.1f}") for x in (0.1, 0.2, 0.3)]
        periods = [_number(robust["periods"][str(period)]) for period in PERIODS]
        rows.append([_narrow(law), *masses, *periods, _spread(robust["noise"])])
    headings = ["law", "±10 %", "±20 %", "±30 %", *(f"{1e3 * x:g} ms" for x in PERIODS)]
    return markdown_table([*headings, "noise, 2 ms"], rows)


def _worse(errors: dict[str, Any], *shares: str) -> str:
    """The larger of some errors, or what one of the runs does not keep."""
    values = [errors[share] for share in shares if share in errors]
    if not values:
        return ""
    words = [value for value in values if isinstance(value, str)]
    return words[0] if words else _number(max(values))


def _spread(values: list[Any]) -> str:
    """The range of the errors of some seeds, or how many of them do not keep what."""
    words = [value for value in values if isinstance(value, str)]
    if words:
        return f"{len(words)} of {len(values)}: {words[0]}"
    low, high = _number(min(values)), _number(max(values))
    return low if low == high else f"{low} to {high}"


# ---------------------------------------------------------------------------- figures


def figure(result: dict[str, Any]) -> Figure:
    """Error against effort of each law.  A bar is the range of the errors of the gains under the
    published effort on other plants, with periods and with noise, and a cross a law of which some
    of these runs leave the bounds.
    """
    length, force = result["units"]
    height = 3.6 + 0.12 * len(result["laws"])
    drawn = Figure(figsize=(7.2, height), layout="constrained")
    axes = drawn.add_subplot()
    others = [law for law in result["laws"] if law != OWN]
    for law in result["laws"]:
        style = {"color": "black", "marker": "o", "ms": 9, "mfc": "none", "ls": "--", "zorder": 3}
        if law != OWN:
            i, n = others.index(law), len(COLOURS)
            style = {"color": COLOURS[i % n], "marker": MARKERS[(i + i // n) % n], "ms": 5}
        _draw(axes, law, result["laws"][law], style)
    own = result["own"]
    axes.plot(
        own["effort"],
        own["error"],
        "*",
        color="none",
        mec="black",
        ms=14,
        label="gains of the entry",
    )
    axes.axvline(own["effort"], color="0.7", lw=0.8, zorder=0)
    if _is_wide(axes.dataLim.intervalx):
        axes.set_xscale("log")
    if _is_wide(axes.dataLim.intervaly):
        axes.set_yscale("log")
    axes.set(xlabel=f"effort [{force}]", ylabel=f"RMS error [{length}]")
    axes.grid(visible=True, which="both", color="0.92", lw=0.6)
    drawn.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return drawn


def _is_wide(ends: Any) -> bool:
    """Whether an axis is one of logarithms."""
    return float(ends[1]) > WIDE * float(ends[0])


def _draw(axes: Any, name: str, law: dict[str, Any], style: dict[str, Any]) -> None:
    """The curve of a law."""
    kept = [row for row in law["front"] if not row["left"]]
    label = name if kept else f"{name}: no error"
    x, y = [row["effort"] for row in kept], [row["error"] for row in kept]
    axes.plot(x, y, lw=1.2, label=label, **style)
    if law["robustness"] is None:
        return
    values = further_runs(law["robustness"])
    errors = [value for value in values if isinstance(value, float)]
    at = _row(law, 1.0)
    if errors:
        axes.vlines(at["effort"], min(errors), max(errors), style["color"], lw=3.0, alpha=0.35)
    if len(errors) < len(values):
        axes.plot(at["effort"], at["error"], "x", color=style["color"], ms=13, mew=1.5)


def description(result: dict[str, Any]) -> str:
    """What the figure shows, in words."""
    order = ranks(result)
    first = min(order, key=order.__getitem__) if order else "no law"
    first = f"the {OWN}" if first == OWN else first
    return (
        f"RMS error against effort of {len(result['laws'])} laws; under the effort of the law of"
        f" the entry {first} has the smallest error of {len(order)}. Bars: range on other plants,"
        " with periods and noise; crosses: some of these runs do not keep the bounds"
    )
