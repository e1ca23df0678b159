"""The page "Choosing a law": the table of `benchmarks/results/laws.json`, and what its numbers say;
and laws with the same budget of tuning on the same arm, of `benchmarks/field/results`.

`python benchmarks/laws.py --json benchmarks/results/laws.json` measures the table again, and
`python benchmarks/field/equal_budget.py --task zhang_yan_2024` the other one.  A law that is added
to `CHOICES` in the first program gets an entry in `ADVICE` here.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from gallery import ROOT
from measured import RESULTS, table


class Advice(NamedTuple):
    """What a law claims to keep, when it is the better choice, and when it is not."""

    keeps: str
    """The bounds that its theory covers; `NOTHING` if it claims none."""
    better: str
    worse: str


NOTHING = ""
POSITIONS = "positions"


ADVICE = {
    "Backstepping(Integral)": Advice(
        POSITIONS,
        "the certificate of the paper's theorem counts",
        "accuracy at a given effort counts and the gains are not tuned; the other barriers have"
        " smaller errors then",
    ),
    "Backstepping(Log)": Advice(
        POSITIONS,
        "results are compared with the literature on logarithmic barriers",
        "the loop runs at 10 ms and the gains of this row are not tuned for it, or the bounds are"
        " asymmetric and the plant has more than two levels",
    ),
    "Backstepping(Tan)": Advice(
        POSITIONS,
        "the loop is fast; it has the least error of the four barriers",
        "there is a delay of 2 ms or more: at the gains of this effort it leaves the bounds",
    ),
    "Backstepping(TransformedError)": Advice(
        POSITIONS,
        "the bounds are asymmetric and the law must be smooth",
        "the loop runs at 10 ms and the gains of this row are not tuned for it",
    ),
    "Backstepping(TransformedError), finite time": Advice(
        POSITIONS,
        "the error must be in a band after a stated time; the error is 0.7 times that of the"
        " exponential decay at the same effort",
        "the loop runs at 10 ms and the gains of this row are not tuned for it; the gain near zero"
        " error is larger, and so is the ripple",
    ),
    "Backstepping(Integral), q measured": Advice(
        POSITIONS,
        "the velocity is not measured, or the encoder is noisy: it has the least ripple of the"
        " table",
        "a certificate is needed; there is none for estimated velocities",
    ),
    "Saturated(auxiliary)": Advice(
        "positions and torque",
        "the torque has a limit that is reached for a short time only, and a certificate must"
        " cover it; here the limit is 7 N m",
        "the limit is below the torque of the motion: with 1.3 times the masses it leaves the"
        " bounds",
    ),
    "AdaptiveParameters(masses)": Advice(
        POSITIONS,
        "a claim for constant masses that are unknown is needed. The table does not show that it is"
        " better with wrong masses: its error is 14 mrad with its own gains, and that of"
        " `Backstepping(Integral)` 1.1 mrad",
        "there are other disturbances, as here: it uses no observer, its error is ten times that"
        " of `Backstepping(Integral)`, and wrong masses raise it by a factor of 3.6, in place of"
        " 2.9",
    ),
    "AdaptiveRBF": Advice(
        POSITIONS,
        "there is no model; wrong masses raise its error by a smaller factor than that of"
        " `Backstepping(Integral)`",
        "there is a model, or the peak torque counts: with its own gains it has the largest one of"
        " the table",
    ),
    "AdaptiveRBF, normalised": Advice(
        POSITIONS,
        "there is no model; with the same k1 and K2 and other rates of adaptation, error and peak"
        " torque are smaller than those of the Gaussians",
        "there is a model, or the loop is slow or has a delay: it leaves the bounds at 10 ms",
    ),
    "Backstepping, no bounds": Advice(
        NOTHING, "there are no bounds to keep", "a start or a disturbance comes near a bound"
    ),
    "BarrierBackstepping(TransformedError)": Advice(
        POSITIONS,
        "the plant has more than two levels, or several levels have bounds; it has the least error"
        " of the laws that keep bounds",
        "the sensor is noisy: its ripple is more than twice that of `Backstepping(Integral)`",
    ),
    "BarrierBackstepping(Integral, Integral)": Advice(
        "positions and velocities",
        "positions and velocities have bounds",
        "the masses are uncertain: its error is more than five times as large with masses that are"
        " 30 % wrong",
    ),
    "DynamicSurface": Advice(
        POSITIONS,
        "derivatives of the virtual control are too expensive; its row is close to that of"
        " `Backstepping(Integral)`, which has exact derivatives",
        "a claim of asymptotic stability is needed: its filter leaves ultimate boundedness",
    ),
    "SurfaceBarrier": Advice(
        "a sum of position and velocity",
        "one barrier on the combination of position and velocity suffices",
        "each position has a bound of its own: it leaves the bounds here",
    ),
    "SafetyFilter": Advice(
        POSITIONS,
        "a law without bounds exists already and must not leave them",
        "the loop is slow: at 10 ms it keeps the bounds, but with a large error",
    ),
    "ReferenceGovernor": Advice(
        POSITIONS,
        "the law of the robot's controller cannot be changed, only its reference",
        "the reference must be followed closely: the governor moves it, and the error is more than"
        " a hundred times that of `Backstepping(Integral)`",
    ),
    "TerminalSlidingMode": Advice(
        NOTHING,
        "accuracy counts and no bound has to be guaranteed; it has the least errors of the table",
        "a bound must be kept: it stayed inside here, but claims nothing about bounds",
    ),
    "ComputedTorque": Advice(
        NOTHING,
        "the model is good and there are no bounds",
        "disturbances act: with 6.7 times its gains, its error is more than four times that of"
        " `Backstepping(Integral)`",
    ),
    "PDGravity": Advice(
        NOTHING,
        "only the gravity of the model is known",
        "the masses are uncertain or the loop is slow",
    ),
}
"""Law of the table -> what its theory and its row say."""

TASK = "zhang_yan_2024"
"""The task of the laws with the same budget of tuning: the arm of the table."""
LIMIT = 1.0
"""The limit of the effort that is shown, in efforts of the law of the entry."""
OWN = "own"
"""The factor of a law that no factor gives the effort of the first one; its gains are its own."""
SLOW = "error, encoder and 10 ms [mrad]"
WRONG = "error, masses +-30 % [mrad]"

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
    (folder / "choosing_a_law.md").write_text(page(result, with_tuning()), encoding="utf-8")


def with_tuning() -> dict[str, Any]:
    """The stored result of laws with the same budget of tuning."""
    file = ROOT / "benchmarks" / "field" / "results" / f"{TASK}.json"
    return dict(json.loads(file.read_text(encoding="utf-8")))


def page(result: dict[str, Any], tuned: dict[str, Any]) -> str:
    """The page of a result of `benchmarks/laws.py`, and of one of `equal_budget.py`."""
    rows = result["rows"]
    return "\n".join(
        [
            "# Choosing a law",
            "",
            f"Four questions lead to a law, and {len(rows)} laws on one task show with numbers what"
            " the choice costs. `ij.compare` gives the numbers of a scenario of your own.",
            "",
            "## Four questions",
            "",
            *four_questions(result, tuned),
            "",
            "## With the same budget of tuning",
            "",
            *same_budget(tuned),
            "",
            "## The table",
            "",
            "One arm, one motion and one disturbance. One factor on all gains of a law gives it the"
            " {term}`effort` of the first law, where there is such a factor; a law without one runs"
            " at gains of its own ('own'), and its errors are not comparable. The laws are not"
            " tuned, so that a law leaves its bounds here at gains that another loop needs: the"
            " section above has laws that are. Errors are the largest ones in the second half of a"
            " run. 'left' is a run that leaves the bounds or diverges. *Keeps bounds* says what"
            " the theory of a law covers,"
            " with continuous time and its own gains; 'left' in the other columns says where that"
            " did not suffice. The last section describes"
            " [how it was measured](#how-it-was-measured).",
            "",
            table([with_bounds(row) for row in rows]),
            "",
            "## Best and worst of each column",
            "",
            "Least and largest are those of the laws with a factor.",
            "",
            *best_of_each_column(rows),
            "",
            "## Each law: where, and where not",
            "",
            "A law with gains of its own has another effort than the others: what is said of its"
            " error and theirs is what the table has, and not that one law is better.",
            "",
            table(advice(rows)),
            "",
            "## How it was measured",
            "",
            "The effort is the RMS torque above gravity of the entire run, on the paper's arm with"
            f" K2 = 2 N m s/rad; most of it belongs to the start. {of_own_gains(rows)} The ranking"
            " holds for this setting:"
            " one arm, one motion, one disturbance, one K2 and one encoder. The program that"
            f" measures the table describes every column: `{result['command']}`.",
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
        ]
    )


class TunedLaw(NamedTuple):
    """What a law with the same budget of tuning reached; words in the place of a number say what a
    run does not keep.
    """

    gains: tuple[str, ...]
    runs: str
    """Numbers of points without derivatives and with them."""
    error: float
    """RMS over the entire run [mrad]."""
    late: float
    """RMS over its second half [mrad]."""
    slow: Any
    """The error with the longest period [mrad]."""
    wrong: Any
    """The larger error with the least and the largest parameters [mrad]."""


def tuned_laws(tuned: dict[str, Any]) -> dict[str, TunedLaw]:
    """Name -> numbers of the laws that keep effort and bounds at the published effort."""
    found = {}
    for name, law in tuned["laws"].items():
        row = next(row for row in law["front"] if row["level"] == LIMIT)
        if row["left"]:
            continue
        gains = tuple(path.removeprefix("controller.") for path in law["gains"])
        runs = f"{row['points']} + {row['derivatives']}"
        periods, masses = (law["robustness"][key] for key in ("periods", "masses"))
        slow = _milli(periods[max(periods, key=float)])
        ends = [_milli(masses[f(masses, key=float)]) for f in (min, max)]
        words = [x for x in ends if isinstance(x, str)]
        errors = 1e3 * row["error"], 1e3 * row["late_error"]
        found[name] = TunedLaw(gains, runs, *errors, slow, words[0] if words else max(ends))
    return found


def _milli(value: Any) -> Any:
    """A number times 1000; words as they are."""
    return value if isinstance(value, str) else 1e3 * value


def longest_period(tuned: dict[str, Any]) -> float:
    """The longest period at which the tuned laws ran [ms]."""
    periods = next(law["robustness"]["periods"] for law in tuned["laws"].values())
    return 1e3 * max(map(float, periods))


def inside_at_longest(tuned: dict[str, Any]) -> str:
    """Which tuned laws stay inside their bounds at the longest period, and how far their errors
    are apart, in a sentence.
    """
    laws = tuned_laws(tuned)
    errors = {name: law.slow for name, law in laws.items() if not isinstance(law.slow, str)}
    spread = 100.0 * (max(errors.values()) / min(errors.values()) - 1.0)
    who = f"all {len(laws)}" if len(errors) == len(laws) else f"{len(errors)} of {len(laws)}"
    return (
        f"With the same budget of tuning {who} laws stay inside the bounds at"
        f" {longest_period(tuned):g} ms, and their errors differ by at most {spread:.2g} %"
    )


def same_budget(tuned: dict[str, Any]) -> list[str]:
    """The section on laws with the same budget of tuning: budget, table, and what was measured."""
    budget, machine = tuned["budget"], tuned["machine"]
    shares = sorted(map(float, next(iter(tuned["laws"].values()))["robustness"]["masses"]))
    rows = [
        {
            "law": name,
            "tuned gains": ", ".join(law.gains),
            "runs": law.runs,
            "error [mrad]": law.error,
            "error, second half [mrad]": law.late,
            f"error, {longest_period(tuned):g} ms [mrad]": law.slow,
            f"error, masses {shares[0]:g} and {shares[-1]:g} [mrad]": law.wrong,
        }
        for name, law in tuned_laws(tuned).items()
    ]
    return [
        f"The same arm, for {tuned['duration']:g} s. `ij.tune` has the same budget for each law:"
        f" {budget['points']} points without derivatives and {budget['starts']} searches of at"
        f" most {budget['steps']} steps with them, of which a law may need fewer. It begins again"
        " where a single search came near the best gains, and looks further where it finds no"
        " gains (the column *runs* has both numbers). It"
        " minimises the RMS error of the entire run under an effort of"
        f" {tuned['own']['effort']:.3g} N m, that of the paper's law at the published"
        " gains, most of which belongs to the start; so does most of the error. The last columns"
        " have the same gains with a longer period and exact measurements, and with masses that"
        " the model does not have: they are not tuned for it. "
        f"{inside_at_longest(tuned)}: on this task the gains decide that, and not the barrier.",
        "",
        table(rows),
        "",
        "*law of the entry* is `Backstepping(Integral)` as printed. Only these laws have been tuned"
        " so; [the same for other tasks](../field_equal_budget.md), with curves over the effort,"
        f" is another page. Measured by `{tuned['command']}`, {machine['date']}: iblf_jax"
        f" {machine['iblf_jax']}, JAX {machine['jax']}, Python {machine['python']}, commit"
        f" {machine['commit'][:8]}.",
    ]


def four_questions(result: dict[str, Any], tuned: dict[str, Any]) -> list[str]:
    """The decision list; every number and every list of laws in it is one of the tables."""
    rows = {row["law"]: row for row in result["rows"]}
    bounded = [name for name in rows if ADVICE[name].keeps]
    slow = [name for name in bounded if isinstance(rows[name][SLOW], float)]
    wrong = [name for name in bounded if not isinstance(rows[name][WRONG], float)]
    first, measured = rows["Backstepping(Integral)"], rows["Backstepping(Integral), q measured"]
    longest = max(rows[name][LONGEST] for name in bounded)
    patient = [name for name in bounded if rows[name][LONGEST] == longest]
    growth = first[WRONG] / first["error [mrad]"]
    least = _least(slow, rows, SLOW)
    return [
        "1. **What is bounded?**",
        "   - *Positions*: `Backstepping` with a barrier. Begin with `Integral`, whose theorem"
        " `ij.certify` checks; the questions below say when to leave it.",
        "   - *Positions and velocities, or several levels of a plant*: `BarrierBackstepping` with"
        " a barrier for each.",
        "   - *The torque, too*: `Saturated` around such a law; the limit must be above the torque"
        " of the motion.",
        "   - *The tip, or a law exists already*: `SafetyFilter` around it. If only the reference"
        " of that law can be changed: `ReferenceGovernor`.",
        "   - *Nothing*: `ComputedTorque`, or `TerminalSlidingMode` where accuracy counts.",
        "2. **What is measured?**",
        "   - *Positions and velocities*: every law.",
        "   - *Positions only, or a noisy encoder*: `Backstepping` with `observers.StateObserver`."
        f" Its ripple is {measured['ripple [N m]']:.2g} N m, and {first['ripple [N m]']:.2g} N m"
        " with a filtered difference as velocity; there is no certificate for it.",
        "3. **What is uncertain?**",
        "   - *A disturbance*: a law with an observer, as in the first rows of the table.",
        "   - *The masses*: the error of the first law grows by a factor of"
        f" {growth:.2g} if they are 30 % wrong. Outside the bounds then: {_or(wrong)}. If a claim"
        " for unknown masses is needed: `AdaptiveParameters`.",
        "   - *The whole model*: `AdaptiveRBF`, which needs none.",
        "4. **How fast is the loop?** `ij.recommended_period` computes the period of a scenario.",
        f"   - *1 ms and faster*: {_least(bounded, rows)} has the least error of the laws that keep"
        " bounds and have a factor.",
        f"   - *10 ms*: {inside_at_longest(tuned)}. Tune the gains, and choose the law by the"
        " other questions. At the gains of the second table, which are not tuned, these stay inside"
        f" with an encoder: {'; '.join(slow)}. Of those with a factor {least} has the least error"
        f" ({rows[least][SLOW]:.2g} mrad).",
        f"   - *A delay*: up to {longest:g} ms {_or(patient)}.",
        f"   - *Messages are expensive*: an event trigger, with any law. "
        f"{saving(result['messages'])}",
    ]


def _or(names: list[str]) -> str:
    """Names in a sentence; names of laws may have commas."""
    return " or ".join(names) if len(names) < 3 else "; ".join(names)


def _least(names: list[str], rows: dict[str, dict[str, Any]], column: str = "error [mrad]") -> str:
    """The law with the least error, of those among some that have a factor."""
    known = [name for name in names if is_comparable(rows[name], column)]
    return min(known, key=lambda name: rows[name][column])


def is_comparable(row: dict[str, Any], column: str) -> bool:
    """Whether a law has the effort of the first one, and a number in a column."""
    return row["factor"] != OWN and isinstance(row[column], float)


def with_bounds(row: dict[str, Any]) -> dict[str, Any]:
    """A row with the column "keeps bounds" behind the name of its law."""
    numbers = {column: value for column, value in row.items() if column != "law"}
    return {
        "law": row["law"],
        "keeps bounds": ADVICE[row["law"]].keeps or "no claim",
        **numbers,
    }


def advice(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """The rows of the table that says where each law is the better choice."""
    found = []
    for row in rows:
        name = row["law"]
        _, better, worse = ADVICE[name]
        law = f"{name}, own gains" if row["factor"] == OWN else name
        found.append({"law": law, "the better choice where": better, "not where": worse})
    return found


def of_own_gains(rows: list[dict[str, Any]]) -> str:
    """How many laws have a factor, in a sentence."""
    own = sum(row["factor"] == OWN for row in rows)
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
    """The best and the worst law of each column, of those with a factor, and all laws that leave
    the bounds; names of laws may have commas.
    """
    lines = []
    for column in LOWER_IS_BETTER:
        known = [row for row in rows if is_comparable(row, column)]
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
