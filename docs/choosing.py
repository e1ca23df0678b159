"""The page "Choosing a law": the table of `benchmarks/results/laws.json`, and what its numbers say.

`python benchmarks/laws.py --json benchmarks/results/laws.json` measures the table again.  A law
that is added to `CHOICES` there gets an entry in `WORDS` here.
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


WORDS = {
    "Backstepping(Integral)": Advice(
        "the paper's law, with the certificate of its theorem",
        "accuracy counts for more than the gain factor",
    ),
    "Backstepping(Log)": Advice(
        "a comparison with the literature on logarithmic barriers",
        "the bounds are asymmetric and the plant has more than two levels",
    ),
    "Backstepping(Tan)": Advice(
        "bounds may become wide: the barrier tends to the quadratic one",
        "the tube is asymmetric and the plant has more than two levels",
    ),
    "Backstepping(Mapping)": Advice(
        "the bounds are asymmetric and the law must be smooth",
        "the torque may not grow near a bound",
    ),
    "Backstepping, no bounds": Advice(
        "there are no bounds to keep", "a start or a disturbance comes near a bound"
    ),
    "BarrierBackstepping(Mapping)": Advice(
        "the plant has more than two levels, or several levels have bounds; the gain of the"
        " velocities scales with the inertia",
        "the certificate of the paper's theorem is needed",
    ),
    "FullState": Advice("positions and velocities have bounds", "only the positions have bounds"),
    "DynamicSurface": Advice(
        "derivatives of the virtual control are too expensive", "the error of its filter matters"
    ),
    "SurfaceBarrier": Advice(
        "a single barrier on the combination of position and velocity suffices",
        "each position has a bound of its own, which it does not keep",
    ),
    "SafetyFilter": Advice(
        "a law without bounds exists already and must not leave them",
        "the law itself can have a barrier",
    ),
    "ReferenceGovernor": Advice(
        "a law of the robot's controller cannot be changed, only its reference",
        "the reference must be followed closely",
    ),
    "ComputedTorque": Advice("there are no bounds and the model is exact", "there are bounds"),
    "PDGravity": Advice(
        "only the gravity of the model is known", "the motion is fast or must be accurate"
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
    advice = [
        {"law": name, "the better choice where": WORDS[name].better, "not where": WORDS[name].worse}
        for name in (row["law"] for row in rows)
    ]
    return "\n".join(
        [
            "# Choosing a law",
            "",
            "The gains of every law are scaled to the same effort, the RMS torque above gravity of"
            " the first law, on the paper's arm with K2 = 2 N m s/rad. A law that reaches this"
            " effort with no factor runs at its own gains ('own'); compare its torques as well as"
            " its errors. Errors are the largest ones in the second half of a run. 'left' is a run"
            " that leaves the bounds. The program that measures the table describes every column:"
            f" `{result['command']}`.",
            "",
            table(rows),
            "",
            "## What the numbers say",
            "",
            *best_of_each_column(rows),
            "",
            "The numbers belong to one arm, one motion and one disturbance; `ij.compare` gives"
            " those of another scenario.",
            "",
            "## When to take which",
            "",
            table(advice),
            "",
        ]
    )


def best_of_each_column(rows: list[dict[str, Any]]) -> list[str]:
    """A sentence for each column, from its numbers."""
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
            text += f"; {', '.join(left)} left the bounds"
        lines.append(text + ".")
    longest = max(row[LONGEST] for row in rows)
    names = [row["law"] for row in rows if row[LONGEST] == longest]
    none = [row["law"] for row in rows if row[LONGEST] == 0.0]
    text = f"- **{LONGEST}**: {', '.join(names)} stayed inside the bounds up to {longest:g} ms"
    if none:
        text += f"; {', '.join(none)} with none of the tested delays"
    lines.append(text + ".")
    return lines
