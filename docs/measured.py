"""The page of benchmarks: a table and a plot of each file `benchmarks/results/NAME.json`.

`python benchmarks/NAME.py --json benchmarks/results/NAME.json` writes such a file.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks"))

import withdrawn
from entry_tables import markdown_table
from gallery import ROOT

RESULTS = ROOT / "benchmarks" / "results"


class Plot(NamedTuple):
    """What is drawn of one result."""

    names: tuple[str, ...]
    """Columns whose words name a row."""
    values: str
    """The column that is drawn."""
    words: str
    """What stands above the table: what was measured, and which way is better."""
    only: dict[str, Any] = {}  # noqa: RUF012 - a constant
    """Column -> what it has in the rows that are drawn; all rows if nothing is said."""


PLOTS = {
    "latency": Plot(("row",), "processor ms", "A single run, as in a notebook; less is better."),
    "throughput": Plot(
        ("row", "type"),
        "steps/s per core",
        "Many runs of the paper's loop at once, by the classical Runge-Kutta method; more is"
        " better.",
        {"loop": "paper", "runs": 4096},
    ),
    "errors": Plot(
        ("benchmark", "row"),
        "largest error [rad]",
        "The largest errors of the rows that are compared above and in the section on seven joints;"
        " MuJoCo has the plant alone, without torques. Less is better.",
    ),
    "gpu": Plot(
        ("loop", "type", "runs", "row"),
        "steps/s",
        "Many runs on a GPU; the rows of the iiwa14, with a PD law and gravity compensation, are a"
        " run of their own. More is better.",
    ),
    "arm": Plot(
        ("row", "type"),
        "steps/s per core",
        "Seven joints, compared with other software; more is better.",
    ),
    "export": Plot(
        ("law", "type"),
        "cycles",
        "One call of a law in C, as `ij.export` writes it; less is better.",
    ),
    "ros2": Plot(
        ("case", "period [ms]", "priority"),
        "distance [rad]",
        "A law and a robot as two processes under ROS 2: the largest distance from the same run by"
        " `cosimulate`; the how-to page explains the rows. Less is better.",
    ),
    "constraints": Plot(
        ("law",),
        "us a step",
        "The constraints that each law satisfies, and the processor time of a step; less is"
        " better. Compare the times of the laws of this package only: their periods are 1 ms, in"
        " one compiled loop; the model predictive controller has 20 ms, another effort and is"
        " called from Python.",
    ),
    "laws": Plot(
        ("law",),
        "error [mrad]",
        "Laws whose gains have one factor, where one gives the effort of the first law; the page on"
        " choosing a law has the details. Less is better.",
    ),
    "proofs": Plot(
        ("case", "K2", "kf", "level", "parameters"),
        "boxes",
        "Proofs of invariant level sets with outward rounding: boxes of the search, the share of"
        " the volume that was proved, and the seconds of a call with a compiled kernel; less is"
        " better.",
    ),
    "rare_failures": Plot(
        ("case", "estimator"),
        "variation",
        "Probabilities of rare failures that are known: mean of the estimates, relative to the"
        " exact value, their coefficient of variation, the one that the estimator reports, and the"
        " share of its 95 % intervals that contain the exact value.",
    ),
    "armour": Plot(
        ("controller", "masses", "constants"),
        "position [mrad]",
        "Half-width of the tube of two controllers with uncertain masses; the page on guarantees"
        " over sets explains the columns. A tube that is not proved is no guarantee.",
    ),
    "tuning": Plot(
        ("search",),
        "rollouts to 0.5 %",
        "Two gains under a torque limit and a margin: rollouts until 0.5 % above the best, and the"
        " processor seconds of the entire search, in which the order is another one; less is"
        " better.",
    ),
}


def write(page: Path) -> None:
    """Writes the page, and its pictures beside it."""
    parts = [
        "# Benchmarks\n\nEach table is the output of one program in `benchmarks/`;"
        " `python benchmarks/NAME.py` measures it again. Compare rows within a table only, because"
        " the machines are shared. Columns *a core* count processor time. The"
        " [lab notes](lab_notes.md) describe the experiments.\n"
    ]
    for name, plot in PLOTS.items():
        if name in withdrawn.BENCHMARKS:
            parts.append(
                f"## `benchmarks/{name}.py`\n\n{plot.words} The table is withdrawn, because it was"
                f" {withdrawn.REASON}; it will be measured again.\n"
            )
            continue
        result = json.loads((RESULTS / f"{name}.json").read_text())
        draw(plot, result["rows"], page.with_name(f"benchmark_{name}.png"))
        machine = result["machine"]
        where = (
            f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}, jax"
            f" {machine['jax']}, {machine['date']}"
        )
        parts.append(
            f"## {result['title']}\n\n{plot.words} `{result['command']}`; {where}.\n\n"
            f"![{result['title']}: {plot.values} of the rows of the table](benchmark_{name}.png)"
            f"\n\n{table(result['rows'])}\n"
        )
    page.write_text("\n".join(parts))


def table(rows: list[dict[str, Any]]) -> str:
    """Rows as Markdown."""
    cells = [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row.values()] for row in rows]
    return markdown_table(list(rows[0]), cells)


def draw(plot: Plot, rows: list[dict[str, Any]], path: Path) -> None:
    """Points on a logarithmic axis, in the order of the table."""
    from iblf_jax.plotting._style import new_figure, styled

    selected = [row for row in rows if all(row[name] == value for name, value in plot.only.items())]
    drawn = [row for row in selected if isinstance(row[plot.values], (int, float))]
    with styled():
        figure = new_figure(7.5, 0.8 + 0.26 * len(drawn))
        axes = figure.subplots()
        names = [", ".join(str(row[name]) for name in plot.names) for row in drawn]
        values = [float(f"{row[plot.values]:.3g}") for row in drawn]
        axes.plot(values, names, "o")
        for name, value in zip(names, values, strict=True):
            axes.annotate(f"{value:,g}", (value, name), xytext=(6, -3), textcoords="offset points")
        axes.set_xscale("log")
        axes.margins(x=0.15)
        axes.invert_yaxis()
        axes.set_xlabel(plot.values)
        figure.savefig(path, dpi=110)
