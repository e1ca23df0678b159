"""What `certify` gives back: a `Certificate`, which is a list of `Line`s, and the traces that the
figure shows.

A line is one inequality of the theorem: what was checked, by what margin it holds (positive:
  holds), where and when the margin is
smallest, and the verdict.  "Not applicable" is a verdict of its own: no claim was made, so none was
broken.
"""

from __future__ import annotations

import dataclasses
import html
import math
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core import checks, tables
from iblf_jax.core.presentation import present

HOLDS, FAILS, NOT_APPLICABLE = "holds", "fails", "not applicable"
OWN_INEQUALITY = "inequality, own V"
"""Name of the inequality that a law states of itself."""
FEW = 3
"""Lines that do not apply are named up to this number."""
SEEN_ONLY = "no claim, only seen ("
"""Beginning of the note of a line that was seen to hold, and that nothing claims."""


@dataclasses.dataclass(frozen=True)
class Line:
    """One inequality of the theorem and what became of it."""

    name: str
    """Short name, unique in a certificate."""
    equation: str
    """Number in the paper."""
    statement: str
    """The inequality that was checked."""
    verdict: str
    """"holds", "fails" or "not applicable"."""
    margin: float | None = None
    """Smallest distance to breaking it, positive if it holds, in `unit`; None where there is
    nothing to measure."""
    tolerance: float = 0.0
    """How far below zero the margin may be by rounding and by the integrator's error."""
    value: float | None = None
    """The number that the line is about, where it is about one (rho, F_d), in `unit`."""
    unit: str = "1"
    joint: int | None = None
    """The joint with the smallest margin; None if the inequality is about all joints together."""
    time: float | None = None
    """When the margin is smallest [s]."""
    run: int | None = None
    """In a certificate over many runs: the run with the smallest margin."""
    note: str = ""
    """The reason of "not applicable", or what else should be known."""
    counts: bool = True
    """Whether the verdict enters `Certificate.verdict`; what is only measured does not."""
    first: float | None = None
    """The first instant at which a line about instants is broken [s]; None if none is."""

    @property
    def applies(self) -> bool:
        """Whether the line says something of this run: a verdict, or a number that was measured
        beside the claims.
        """
        return self.verdict != NOT_APPLICABLE or (self.value is not None and not self.counts)

    def where(self) -> str:
        """Run, joint and time of the smallest margin, and when the line was first broken, in
        words.
        """
        if self.margin is None and self.value is None:
            return ""
        parts = [] if self.run is None else [f"run {self.run}"]
        parts += [] if self.joint is None else [f"joint {self.joint}"]
        parts += [] if self.time is None else [f"t = {self.time:.4g} s"]
        parts += [] if self.first is None else [f"first broken at t = {self.first:.4g} s"]
        return ", ".join(parts)


class Traces(NamedTuple):
    """What `Certificate.plot` shows: arrays over the T recorded samples of one run; NaN where
    nothing is claimed.
    """

    t: np.ndarray
    V: np.ndarray
    envelope: np.ndarray
    """Right-hand side of (3.20) or (3.28)."""
    left: np.ndarray
    """V2' + rho V2 - 1/2 |f'|^2 (case 1: without |f'|) [1/s]."""
    dropped: np.ndarray
    """Sum of the two terms that the printed proof drops [1/s]."""
    xi: np.ndarray
    xi_bound: np.ndarray
    e2: np.ndarray
    """|e2| [rad/s]."""
    e2_bound: np.ndarray
    f_tilde: np.ndarray
    """|f_tilde| [N m]."""
    f_tilde_bound: np.ndarray
    held: np.ndarray
    """bool: the guard or a torque limit was at work; nothing is claimed there."""


@dataclasses.dataclass(frozen=True, eq=False)
class Certificate:
    """Theorem 2, inequality by inequality, for one run or for many.  `holds`, `lines`,
    `cert["inequality, case 2"]`, `plot()`.
    """

    heading: str
    """Law, barrier, reading and observer that were judged."""
    lines: tuple[Line, ...]
    numbers: dict[str, Any]
    """The constants of the claim: rho, rho2, lambda_min, lambda_max, V2(0), F_d, F_m, the case."""
    traces: Traces
    """Of the run, or of the worst of many."""
    runs: tuple[int, ...] = ()
    """The runs that were judged, if there were many."""
    joints: tuple[str, ...] = ()
    """What the joints are called."""
    worst_run: int | None = None
    """The run whose inequality has the smallest margin (or fails), if there were many; the traces
    are its."""

    @property
    def verdict(self) -> str:
        """All in one word: "fails" if a line does, "holds" if none does and the inequality was
        checked, else "not applicable".
        """
        counted = [line for line in self.lines if line.counts]
        if any(line.verdict == FAILS for line in counted):
            return FAILS
        checked = any(line.verdict == HOLDS and "inequality" in line.name for line in counted)
        return HOLDS if checked else NOT_APPLICABLE

    @property
    def holds(self) -> bool:
        """Whether every claim that applies was checked and holds."""
        return self.verdict == HOLDS

    @property
    def is_of_own_claim(self) -> bool:
        """Whether what was checked is a claim that the law states of itself, and not the paper's
        theorem.
        """
        inequalities = [line.name for line in self.applicable if line.name.startswith("inequality")]
        return inequalities == [OWN_INEQUALITY]

    def __getitem__(self, name: str) -> Line:
        for line in self.lines:
            if isinstance(name, str) and line.name == name:
                return line
        raise KeyError(
            f"no line {checks.shown(name)}; there are"
            f" {', '.join(repr(line.name) for line in self.lines)}"
        )

    def __repr__(self) -> str:
        rows = [
            ("", "equation", "verdict", "margin", "value", "where the margin is smallest"),
            *self._rows(),
        ]
        notes = [f"  {'; '.join(names)}: {note}" for note, names in self._notes().items()]
        shown = [
            f"Certificate: {self.verdict}  ({self.subject})",
            *tables.as_text(rows),
            *(["notes", *notes] if notes else []),
        ]
        return "\n".join([*shown, *([self.omitted] if self.omitted else [])])

    def _repr_html_(self) -> str:
        return present("card", self)

    def table_html(self) -> str:
        """The lines that apply as an HTML table, those that fail in bold, and below it why the
        others do not apply.
        """
        heading = ("", "equation", "verdict", "margin", "value", "where", "checked", "note")
        rows = [
            (*row, line.statement, line.note)
            for line, row in zip(self.applicable, self._rows(), strict=True)
        ]
        failing = [i for i, line in enumerate(self.applicable) if line.verdict == FAILS]
        table = tables.as_html(heading, rows, failing)
        return f"{table}<p>{html.escape(self.omitted)}</p>" if self.omitted else table

    @property
    def applicable(self) -> tuple[Line, ...]:
        """The lines that say something of this run; `lines` has all."""
        return tuple(line for line in self.lines if line.applies)

    @property
    def omitted(self) -> str:
        """How many lines do not apply, and why, in one sentence; "" if all apply."""
        reasons: dict[str, list[str]] = {}
        for line in self.lines:
            if not line.applies:
                reasons.setdefault(_reason(line.note), []).append(line.name)
        count = sum(map(len, reasons.values()))
        if count == 0:
            return ""
        subject = (
            "1 line of the paper's theorem does not apply"
            if count == 1
            else f"{count} lines of the paper's theorem do not apply"
        )
        if len(reasons) == 1:
            return f"{subject}, because {next(iter(reasons))}."
        return (
            f"{subject}:"
            f" {'; '.join(f'{_named(names)}, because {reason}' for reason, names in reasons.items())}."
        )

    def _notes(self) -> dict[str, list[str]]:
        """Each note and the lines that it belongs to."""
        notes: dict[str, list[str]] = {}
        for line in self.applicable:
            if line.note:
                notes.setdefault(line.note, []).append(line.name)
        return notes

    @property
    def subject(self) -> str:
        """What was judged, in words."""
        return self.heading + (
            f"; {len(self.runs)} runs, worst {self.worst_run}" if self.runs else ""
        )

    def _rows(self) -> list[tuple[str, str, str, str, str, str]]:
        return [
            (
                line.name,
                line.equation,
                line.verdict,
                _number(line.margin, line.unit),
                _number(line.value, line.unit),
                line.where(),
            )
            for line in self.applicable
        ]

    def to_dict(self) -> dict[str, Any]:
        """Heading, verdict, constants and lines as plain numbers, strings and lists, for strict
        JSON (no NaN, no infinity).
        """
        return _for_json({
            "heading": self.heading,
            "verdict": self.verdict,
            "runs": list(self.runs),
            "worst_run": self.worst_run,
            "numbers": self.numbers,
            "lines": [dataclasses.asdict(line) for line in self.lines],
        })  # fmt: skip

    def plot(self, **options):
        """V2 under its envelope, the inequality's left side, and the errors under their bounds.
        Options as `plotting.certificate`.
        """
        return present("certificate figure", self, **options)


def _named(names: list[str]) -> str:
    """Lines by their names, or their number where there are many."""
    return ", ".join(names) if len(names) <= FEW else f"{len(names)} lines"


def _reason(note: str) -> str:
    """Why a line does not apply, from its note."""
    if note.startswith(SEEN_ONLY):
        return note.removeprefix(SEEN_ONLY).removesuffix(")")
    return note


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" + ("" if unit == "1" else f" {unit}")


def _for_json(value: Any) -> Any:
    """`value` with arrays as lists, NumPy numbers as Python's, and what is not finite as None."""
    if isinstance(value, dict):
        return {str(key): _for_json(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_for_json(x) for x in value]
    if isinstance(value, np.ndarray | np.generic):
        return _for_json(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
