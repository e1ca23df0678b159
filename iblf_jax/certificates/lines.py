"""Lines of a certificate: one inequality, its margin on a run, and the verdict.

A line states what was checked, by what margin it holds (positive: holds), where and when the margin
is smallest, and the verdict. "Not applicable" is a verdict of its own: no claim was made, so none
was broken. `check_positive` and `check_margins` make lines from numbers.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

HOLDS, FAILS, NOT_APPLICABLE = "holds", "fails", "not applicable"
OBSERVED_ONLY = "no claim, only observed ("
"""Beginning of the note of a line that holds on the run although no theorem claims it."""


class Role(enum.StrEnum):
    """What a line is for the verdict of a certificate."""

    INEQUALITY = "inequality"
    """The differential inequality of a claim, from which the rest follows."""
    OWN_INEQUALITY = "own inequality"
    """That of the claim that the law states about itself."""
    WEIGHTED_INEQUALITY = "weighted inequality"
    """That of the claim with weights."""
    WEIGHTED = "weighted"
    """Any other line of the claim with weights."""
    OTHER = "other"
    """An assumption, a gain condition, or what follows from the inequality."""


INEQUALITIES = frozenset({Role.INEQUALITY, Role.OWN_INEQUALITY, Role.WEIGHTED_INEQUALITY})


@dataclasses.dataclass(frozen=True)
class Line:
    """One inequality of the theorem and its verdict."""

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
    """The reason of "not applicable", or a remark."""
    enters_verdict: bool = True
    """Whether the verdict enters `Certificate.verdict`; that of a mere measurement does not."""
    first_broken: float | None = None
    """The first instant at which the inequality is broken [s]; None if there is none."""
    role: Role = Role.OTHER

    @property
    def has_weights(self) -> bool:
        """Whether it belongs to the claim with weights."""
        return self.role in (Role.WEIGHTED_INEQUALITY, Role.WEIGHTED)

    @property
    def is_inequality(self) -> bool:
        """Whether it is the differential inequality of a claim, from which the rest follows."""
        return self.role in INEQUALITIES

    @property
    def applies(self) -> bool:
        """Whether the line is informative about this run: it has a verdict, or a measured number
        beside the claims.
        """
        return self.verdict != NOT_APPLICABLE or (
            self.value is not None and not self.enters_verdict
        )

    def where(self, joints: Sequence[str] = ()) -> str:
        """Run, joint and time of the smallest margin, and when the line was first broken, in
        words; `joints` are the names of the joints, "joint 0", "joint 1", ... if not given.
        """
        if self.margin is None and self.value is None:
            return ""
        joint: str | None = None
        if self.joint is not None:
            joint = joints[self.joint] if joints else f"joint {self.joint}"
        parts = (
            ("run {}", self.run),
            ("{}", joint),
            ("t = {:.4g} s", self.time),
            ("first broken at t = {:.4g} s", self.first_broken),
        )
        return ", ".join(text.format(value) for text, value in parts if value is not None)


class Statement(NamedTuple):
    """The fields of a line that do not depend on the run."""

    name: str
    equation: str
    text: str
    unit: str = "1"
    role: Role = Role.OTHER

    def line(self, verdict: str, **fields: Any) -> Line:
        """The line with this verdict."""
        return Line(
            self.name,
            self.equation,
            self.text,
            verdict,
            unit=self.unit,
            role=self.role,
            **fields,
        )


def verdict_of(holds: bool) -> str:
    """The verdict of a claim that applies."""
    return HOLDS if holds else FAILS


def not_applicable(statement: Statement, reason: str, **fields: Any) -> Line:
    """The line of a statement that is not claimed about this run, with further fields."""
    return statement.line(NOT_APPLICABLE, note=reason, **fields)


def measured(statement: Statement, note: str, **fields: Any) -> Line:
    """The line of a number that is measured beside the claims."""
    return not_applicable(statement, note, enters_verdict=False, **fields)


def check_positive(statement: Statement, margin: float, **fields: Any) -> Line:
    """The line of a statement whose margin must be positive."""
    return statement.line(verdict_of(margin > 0), margin=margin, **fields)


def check_smallest(statement: Statement, t: np.ndarray, margins: np.ndarray) -> Line:
    """The line of a statement whose margins at every step, (T, n), must be positive.

    A NaN counts as the smallest margin.
    """
    smallest = np.argmin(np.nan_to_num(margins, nan=-np.inf))
    row, joint = np.unravel_index(smallest, margins.shape)
    margin = float(margins[row, joint])
    return check_positive(statement, margin, joint=int(joint), time=float(t[row]))


def check_margins(
    statement: Statement,
    t: np.ndarray,
    excluded: np.ndarray,
    margins: np.ndarray,
    tolerances: np.ndarray | float,
    **fields: Any,
) -> Line:
    """The line of a statement about every step.

    Args:
      statement: the inequality.
      t: time of each step, (T,) [s].
      excluded: steps that the claims exclude, (T,) bool.
      margins: at every step, (T,) or (T, n); they must not be below minus the tolerances. NaN where
        nothing is claimed.
      tolerances: of the margins.
      fields: further fields of the line.
    """
    if np.all(excluded):
        return statement.line(HOLDS, margin=np.inf, **fields)
    margins = np.asarray(margins, float)
    tolerances = np.broadcast_to(np.asarray(tolerances, float), margins.shape)
    per_joint = margins.ndim == 2
    if per_joint:
        excluded = np.broadcast_to(excluded[:, None], margins.shape)
    broken = ~excluded & ~(margins >= -tolerances)
    # The smallest margin, among the broken ones if there are any.
    candidates = broken if np.any(broken) else ~excluded
    compared = np.where(candidates, np.nan_to_num(margins, nan=-np.inf), np.inf)
    place = np.unravel_index(np.argmin(compared), margins.shape)
    broken_rows = np.flatnonzero(broken.reshape(margins.shape[0], -1).any(axis=1))
    if broken_rows.size:
        fields["first_broken"] = float(t[broken_rows[0]])
    if per_joint:
        fields["joint"] = int(place[1])
    return statement.line(
        verdict_of(not broken_rows.size),
        margin=float(margins[place]),
        tolerance=float(tolerances[place]),
        time=float(t[place[0]]),
        **fields,
    )


def finite(statement: Statement, t: np.ndarray, values: np.ndarray, note: str = "") -> Line:
    """The line of a quantity that must be finite at every step, with its largest value."""
    at = int(np.argmax(np.nan_to_num(values, nan=np.inf)))
    verdict = verdict_of(bool(np.all(np.isfinite(values))))
    return statement.line(verdict, value=float(values[at]), time=float(t[at]), note=note)


def observed_only(line: Line, reason: str) -> Line:
    """A line that no claim covers."""
    return dataclasses.replace(line, verdict=NOT_APPLICABLE, note=f"{OBSERVED_ONLY}{reason})")


def join_notes(*notes: str) -> str:
    """Several notes in one, without the empty ones."""
    return "; ".join(note for note in notes if note)


# --- one line from several of the same name ------------------------------------------------------


def rank(line: Line, ranks: dict[str, float]) -> tuple[float, float]:
    """Sort key of lines, the worst first: the rank of the verdict, then the margin; where there is
    no margin, the largest value.
    """
    if line.margin is not None:
        return ranks[line.verdict], line.margin
    return ranks[line.verdict], np.inf if line.value is None else -line.value


WITHIN_RUN = {FAILS: 0.0, NOT_APPLICABLE: 1.0, HOLDS: 2.0}
"""Ranks of verdicts among the segments of a run: one without a claim hides one that holds."""
OVER_RUNS = {FAILS: 0.0, HOLDS: 1.0, NOT_APPLICABLE: 2.0}
"""Ranks of verdicts among runs: one without a claim does not hide one that holds."""


def over_segments(same: list[Line]) -> Line:
    """One line from those of the segments of a run: the worst, with the largest value and the first
    instant at which one is broken.
    """
    worst = min(same, key=lambda line: rank(line, WITHIN_RUN))
    values = [line.value for line in same if line.value is not None]
    broken = [line.first_broken for line in same if line.first_broken is not None]
    worst = dataclasses.replace(worst, first_broken=min(broken, default=None))
    if worst.value is None:
        return worst
    return dataclasses.replace(worst, value=max(values))


def merged(checked: list[Line]) -> dict[str, Line]:
    """One line per name from those of all segments of a run."""
    by_name: dict[str, list[Line]] = {}
    for line in checked:
        by_name.setdefault(line.name, []).append(line)
    return {name: over_segments(same) for name, same in by_name.items()}


def over_runs(same: list[Line], invalid_runs: list[int]) -> Line:
    """One line from those of many runs: the worst, with the number of runs in which it fails or is
    not claimed.

    A line that was not checked in an invalid run does not hold in all runs.
    """
    worst = min(same, key=lambda line: rank(line, OVER_RUNS))
    if worst.verdict == HOLDS:
        unchecked = [
            line for line in same if line.run in invalid_runs and line.verdict == NOT_APPLICABLE
        ]
        worst = next(iter(unchecked), worst)
    failed = sum(line.verdict == FAILS for line in same)
    absent = sum(line.verdict == NOT_APPLICABLE for line in same)
    notes = [worst.note]
    if 0 < absent < len(same):
        notes.insert(0, f"not applicable in {absent} of {len(same)} runs")
    if failed:
        notes.insert(0, f"fails in {failed} of {len(same)} runs")
    return dataclasses.replace(worst, note=join_notes(*notes))
