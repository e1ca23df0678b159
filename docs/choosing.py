"""The page "Choosing a law": the table of `benchmarks/results/laws.json`, and what its numbers say.

`python benchmarks/laws.py --json benchmarks/results/laws.json` measures the table again.  A law
that is added to `CHOICES` there gets an entry in `ADVICE` here.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from measured import RESULTS, table


class Advice(NamedTuple):
    """When a law is the better choice, and when it is not."""

    better: str
    worse: str


ADVICE = {
    "Backstepping(Integral)": Advice(
        "the certificate of the paper's theorem counts. It stays inside the bounds at 10 ms, where"
        " `Backstepping` with the other barriers does not, because those run at 2 to 4.4 times its"
        " gains: at twice its gains it leaves the bounds, too, and at its gains the other"
        " barriers stay inside (lab notes)",
        "accuracy at a given effort counts; the other barriers have smaller errors",
    ),
    "Backstepping(Log)": Advice(
        "results are compared with the literature on logarithmic barriers",
        "the loop runs at 10 ms at the gains of this row, or the bounds are asymmetric and the"
        " plant has more than two levels",
    ),
    "Backstepping(Tan)": Advice(
        "the loop is fast; it has the least error of the four barriers",
        "there is a delay of 2 ms or more: at the gains of this effort it leaves the bounds",
    ),
    "Backstepping(TransformedError)": Advice(
        "the bounds are asymmetric and the law must be smooth",
        "the loop runs at 10 ms",
    ),
    "Backstepping(TransformedError), finite time": Advice(
        "the error must be in a band after a stated time; the error is 0.7 times that of the"
        " exponential decay at the same effort",
        "the loop runs at 10 ms; the gain near zero error is larger, and so is the ripple",
    ),
    "Backstepping(Integral), q measured": Advice(
        "the velocity is not measured, or the encoder is noisy: it has the least ripple of the"
        " table",
        "a certificate is needed; there is none for estimated velocities",
    ),
    "Saturated(auxiliary)": Advice(
        "the torque has a limit that is reached for a short time only, and a certificate must"
        " cover it; here the limit is 7 N m",
        "the limit is below the torque of the motion: with 1.3 times the masses it leaves the"
        " bounds",
    ),
    "AdaptiveParameters(masses)": Advice(
        "a claim for constant masses that are unknown is needed. The table does not show that it is"
        " better with wrong masses: its error is 14 mrad, and that of `Backstepping(Integral)`"
        " 1.1 mrad",
        "there are other disturbances, as here: it uses no observer, its error is ten times that"
        " of `Backstepping(Integral)`, and wrong masses raise it by a factor of 3.6, in place of"
        " 2.9",
    ),
    "AdaptiveRBF": Advice(
        "there is no model; wrong masses raise its error by a smaller factor than that of"
        " `Backstepping(Integral)`",
        "there is a model, or the peak torque counts: it has the largest one of the table",
    ),
    "AdaptiveRBF, normalised": Advice(
        "there is no model; error and peak torque are smaller than those of the Gaussians",
        "there is a model, or the loop is slow or has a delay: it leaves the bounds at 10 ms",
    ),
    "Backstepping, no bounds": Advice(
        "there are no bounds to keep", "a start or a disturbance comes near a bound"
    ),
    "BarrierBackstepping(TransformedError)": Advice(
        "the plant has more than two levels, or several levels have bounds; it has the least error"
        " of the laws that keep bounds",
        "the sensor is noisy: its ripple is more than twice that of `Backstepping(Integral)`",
    ),
    "BarrierBackstepping(Integral, Integral)": Advice(
        "positions and velocities have bounds",
        "the masses are uncertain: with masses that are 30 % wrong its error is six times as large",
    ),
    "DynamicSurface": Advice(
        "derivatives of the virtual control are too expensive; its row is close to that of"
        " `Backstepping(Integral)`, which has exact derivatives",
        "a claim of asymptotic stability is needed: its filter leaves ultimate boundedness",
    ),
    "SurfaceBarrier": Advice(
        "one barrier on the combination of position and velocity suffices",
        "each position has a bound of its own: it leaves the bounds here",
    ),
    "SafetyFilter": Advice(
        "a law without bounds exists already and must not leave them",
        "the loop is slow: at 10 ms it keeps the bounds, but with a large error",
    ),
    "ReferenceGovernor": Advice(
        "the law of the robot's controller cannot be changed, only its reference",
        "the reference must be followed closely: the governor moves it, and the error is more than"
        " a hundred times that of `Backstepping(Integral)`",
    ),
    "TerminalSlidingMode": Advice(
        "accuracy counts and no bound has to be guaranteed; it has the least errors of the table",
        "a bound must be kept: it stayed inside here, but claims nothing about bounds",
    ),
    "ComputedTorque": Advice(
        "the model is good and there are no bounds",
        "disturbances act: with 6.7 times its gains, its error is more than four times that of"
        " `Backstepping(Integral)`",
    ),
    "PDGravity": Advice(
        "only the gravity of the model is known", "the masses are uncertain or the loop is slow"
    ),
}
"""Law of the table -> what its theory and its row say."""

LOWER_IS_BETTER = (
    "error [mrad]",
    "peak torque [N m]",
    "error, masses +-30 % [mrad]",
    "error, encoder and 10 ms [mrad]",
    "ripple [N m]",
)
LONGEST = "delay [ms]"


def write(folder: Path) -> None:
    """Writes the page."""
    result = json.loads((RESULTS / "laws.json").read_text())
    (folder / "choosing_a_law.md").write_text(page(result), encoding="utf-8")


def page(result: dict[str, Any]) -> str:
    """The page of a result of `benchmarks/laws.py`."""
    rows = result["rows"]
    advice = []
    for name in (row["law"] for row in rows):
        better, worse = ADVICE[name]
        advice.append({"law": name, "the better choice where": better, "not where": worse})
    return "\n".join(
        [
            "# Choosing a law",
            "",
            "The gains of every law are scaled by one factor to the same {term}`effort`, the RMS"
            " torque above gravity of the first law, on the paper's arm with K2 = 2 N m s/rad. A"
            " law that reaches this effort with no factor runs at its own gains ('own'); compare"
            f" its torques as well as its errors. {of_own_gains(rows)} The effort is that of the"
            " entire run, and most of it belongs to the start. Errors are the largest ones in the"
            " second half of a run. 'left' is a run that leaves the bounds or diverges. The program"
            f" that measures the table describes every column: `{result['command']}`.",
            "",
            table(rows),
            "",
            "## What the numbers say",
            "",
            *best_of_each_column(rows),
            "",
            "The ranking holds for this setting: one arm, one motion, one disturbance, one K2 and"
            " one encoder; `ij.compare` gives the numbers of another scenario.",
            "",
            "## Why this gain and this encoder",
            "",
            "With the paper's K2 = 20 N m s/rad the first law leaves the bounds at a period of"
            " 10 ms, also without an encoder. The reason is the period: the largest eigenvalue of"
            " K2 M^-1 is 850 to 1010 1/s along the motion, and with a torque that is held for a"
            " period the loop is unstable from about 2/period = 200 1/s on. With K2 = 2 N m s/rad"
            " it is a tenth. With 4096 counts the steps of the encoder determine the error,"
            " because the velocity is their derivative; 65536 counts, as of an encoder before a"
            " gear, leave it as it is.",
            "",
            table(result["settings"]),
            "",
            "## Fewer messages",
            "",
            "An event trigger belongs to the loop and works with every law, so that it is no row of"
            f" the table. {saving(result['messages'])}",
            "",
            "## When to take which",
            "",
            table(advice),
            "",
        ]
    )


def of_own_gains(rows: list[dict[str, Any]]) -> str:
    """How many laws have a factor, in a sentence."""
    own = sum(row["factor"] == "own" for row in rows)
    return f"Of {len(rows)} laws {len(rows) - own} have a factor and {own} do not."


def saving(rows: list[dict[str, Any]]) -> str:
    """What the event trigger saves with the first law, and what it costs, in a sentence."""
    always, triggered = rows
    rate, error = "messages per s", "error [mrad]"
    return (
        f"With `{triggered['trigger']}` the first law sends {triggered[rate]:.3g} messages a second"
        f" in place of {always[rate]:.4g}, with the encoder and a period of 1 ms, and its error is"
        f" {triggered[error]:.3g} mrad in place of {always[error]:.3g} mrad."
    )


def best_of_each_column(rows: list[dict[str, Any]]) -> list[str]:
    """The best, the worst and the failed laws of each column; names of laws may have commas."""
    lines = []
    for column in LOWER_IS_BETTER:
        known = [row for row in rows if isinstance(row[column], float)]
        best, worst = (f(known, key=lambda row: row[column]) for f in (min, max))
        text = (
            f"- **{column}**: least with {best['law']} ({best[column]:.3g}), largest with"
            f" {worst['law']} ({worst[column]:.3g})"
        )
        left = [row["law"] for row in rows if row[column] == "left"]
        if left:
            text += f". Outside the bounds: {'; '.join(left)}"
        lines.append(text + ".")
    longest = max(row[LONGEST] for row in rows)
    names = [row["law"] for row in rows if row[LONGEST] == longest]
    none = [row["law"] for row in rows if row[LONGEST] == 0.0]
    text = f"- **{LONGEST}**: inside the bounds up to {longest:g} ms: {'; '.join(names)}"
    if none:
        text += f". With none of the tested delays: {'; '.join(none)}"
    lines.append(text + ".")
    return lines
