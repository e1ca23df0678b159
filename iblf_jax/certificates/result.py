"""The result of `certify`: a `Certificate`, which is a list of `Line`s, and the traces that its
figure shows.
"""

from __future__ import annotations

import dataclasses
import html
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.certificates.lines import (
    FAILS,
    HOLDS,
    NOT_APPLICABLE,
    OBSERVED_ONLY,
    Line,
    Role,
)
from iblf_jax.core import checks, tables
from iblf_jax.core.presentation import Content, Result, present

MAX_LISTED = 3
"""Lines that do not apply are listed by name up to this number."""


class Traces(NamedTuple):
    """The curves of `Certificate.plot`: arrays over the T recorded samples of one run; NaN where
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
    excluded: np.ndarray
    """bool: the guard or a torque limit was active; nothing is claimed there."""


class LevelTraces(NamedTuple):
    """The curves of `Certificate.plot` for a plant in strict-feedback form, at the T recorded
    samples of one run; NaN where nothing is claimed.
    """

    t: np.ndarray
    V: np.ndarray
    """sum w_i V_i."""
    envelope: np.ndarray
    """Right-hand side of (S.4)."""
    left: np.ndarray
    """The left less the right side of (S.3) [1/s]."""
    disturbance_terms: np.ndarray
    """T of (S.3), with the lag of filters [1/s]."""
    error: np.ndarray
    """The error xi_i of levels with bounds, e_i of the others, (T, r, n)."""
    error_bound: np.ndarray
    """Bounds on |error| by the envelope, (T, r, n)."""
    d_tilde: np.ndarray
    """|d_tilde_i|, (T, r)."""
    excluded: np.ndarray
    """bool: the claim excludes this sample."""


class LevelLabel(NamedTuple):
    """A level of a plant in words."""

    name: str
    unit: str
    """Of the errors; the units of the components if they differ."""
    is_bounded: bool


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Certificate(Result):
    """Theorem 2, or (S.3), inequality by inequality, for one run or for many.  `holds`, `lines`,
    `cert["inequality, case 2"]`, `plot()`.
    """

    heading: str
    """Law, barrier, variant and observer of the certificate."""
    lines: tuple[Line, ...]
    numbers: dict[str, Any]
    """Constants of the claim by name.  Theorem 2 and (F.3): rho_{run,box}_case_{1,2}, case, F_m,
    F_d, rho2, V2_start, V2_end, lambda_{min,max}_{run,box}.  (S.3): rho, rho2, V_start, V_end,
    d_largest, d_tilde_largest.  All: samples, samples_left_out."""
    traces: Traces | LevelTraces
    """Of the run, or of the worst of many."""
    runs: tuple[int, ...] = ()
    """The runs that were checked, if there were many."""
    joints: tuple[str, ...] = ()
    """Names of the joints."""
    worst_run: int | None = None
    """The run whose inequality has the smallest margin (or fails), if there were many; the traces
    are those of this run."""
    claim: str = "the paper's theorem"
    """The claim that the lines are about, besides one that the law states about itself."""
    levels: tuple[LevelLabel, ...] = ()
    """The levels of a plant in strict-feedback form, of which `traces` are `LevelTraces` then."""
    inaccurate: int = 0
    """The number of checked runs with the flag INACCURATE."""

    @property
    def verdict(self) -> str:
        """The overall verdict: "fails" if a line fails, "holds" if none fails and the inequality
        was checked, else "not applicable".
        """
        deciding = [line for line in self.lines if line.enters_verdict]
        if any(line.verdict == FAILS for line in deciding):
            return FAILS
        checked = any(line.verdict == HOLDS and line.is_inequality for line in deciding)
        return HOLDS if checked else NOT_APPLICABLE

    @property
    def headline(self) -> str:
        """The verdict; if it is "fails", the lines that fail, and the claim with weights if it
        holds; if it is "not applicable", the reason of most of the lines that do not apply.
        """
        if self.verdict == NOT_APPLICABLE and (reasons := self._reasons()):
            return f"{self.verdict}, because {max(reasons, key=lambda one: len(reasons[one]))}"
        if self.verdict != FAILS:
            return self.verdict
        failing = [f'"{x.name}"' for x in self.lines if x.enters_verdict and x.verdict == FAILS]
        verdicts = {x.verdict for x in self.lines if x.has_weights and x.enters_verdict}
        if HOLDS in verdicts and FAILS not in verdicts:
            return f"{self.claim} fails in {_listed(failing)}; the claim with weights holds"
        return f"fails in {_listed(failing)}"

    @property
    def holds(self) -> bool:
        """Whether every claim that applies was checked and holds."""
        return self.verdict == HOLDS

    @property
    def is_of_own_claim(self) -> bool:
        """Whether the checked inequality is one that the law states about itself, and not that of
        the paper's theorem.
        """
        roles = [x.role for x in self.applicable if x.is_inequality and not x.has_weights]
        return roles == [Role.OWN_INEQUALITY]

    def __getitem__(self, name: str) -> Line:
        for line in self.lines:
            if isinstance(name, str) and line.name == name:
                return line
        raise KeyError(
            f"no line {checks.shown(name)}; there are"
            f" {', '.join(repr(line.name) for line in self.lines)}"
        )

    def _content(self) -> Content:
        heading = ("", "equation", "verdict", "margin", "value", "where the margin is smallest")
        shown: list[str | tables.Table] = [f"Certificate: {self.headline}  ({self.subject})"]
        if self.inaccurate:
            shown.append(self.accuracy_note)
        shown.append(tables.Table(heading, self._rows()))
        notes: dict[str, list[str]] = {}
        for line in self.applicable:
            if line.note:
                notes.setdefault(line.note, []).append(line.name)
        if notes:
            shown.append("notes")
            shown += [f"  {'; '.join(names)}: {note}" for note, names in notes.items()]
        if self.verdict == NOT_APPLICABLE:
            shown.append(self.omitted)
        return shown

    def table_html(self) -> str:
        """The lines that apply as an HTML table, those that fail in bold; below it why nothing was
        decided, where nothing was.
        """
        heading = ("", "equation", "verdict", "margin", "value", "where", "checked", "note")
        rows = [
            (*row, line.statement, line.note)
            for line, row in zip(self.applicable, self._rows(), strict=True)
        ]
        failing = [i for i, line in enumerate(self.applicable) if line.verdict == FAILS]
        table = tables.as_html(heading, rows, failing)
        if self.inaccurate:
            table = f"<p>{html.escape(self.accuracy_note)}</p>{table}"
        if self.verdict != NOT_APPLICABLE:
            return table
        return f"{table}<p>{html.escape(self.omitted)}</p>"

    @property
    def accuracy_note(self) -> str:
        """How many of the checked runs have the flag INACCURATE, in words; "" if none has."""
        if not self.inaccurate:
            return ""
        runs = "The run is"
        if self.runs:
            runs = f"{self.inaccurate} of {len(self.runs)} runs are"
        return (
            f"{runs} flagged INACCURATE, so the numbers of this certificate are not reliable:"
            " simulate with a smaller dt."
        )

    @property
    def applicable(self) -> tuple[Line, ...]:
        """The lines that are informative about this run; `lines` has all."""
        return tuple(line for line in self.lines if line.applies)

    def _reasons(self) -> dict[str, list[str]]:
        """Reason -> the lines that do not apply for it."""
        reasons: dict[str, list[str]] = {}
        for line in self.lines:
            if line.applies:
                continue
            reason = line.note
            if reason.startswith(OBSERVED_ONLY):
                reason = reason.removeprefix(OBSERVED_ONLY).removesuffix(")")
            reasons.setdefault(reason, []).append(line.name)
        return reasons

    @property
    def omitted(self) -> str:
        """How many lines do not apply, and why, in one sentence; "" if all apply."""
        reasons = self._reasons()
        count = sum(map(len, reasons.values()))
        if count == 0:
            return ""
        subject = f"{count} lines of {self.claim} do not apply"
        if count == 1:
            subject = f"1 line of {self.claim} does not apply"
        if len(reasons) == 1:
            return f"{subject}, because {next(iter(reasons))}."
        parts = [f"{_listed(names)}, because {reason}" for reason, names in reasons.items()]
        return f"{subject}: {'; '.join(parts)}."

    @property
    def subject(self) -> str:
        """What the certificate is about, in words."""
        if not self.runs:
            return self.heading
        return f"{self.heading}; {len(self.runs)} runs, worst {self.worst_run}"

    def _rows(self) -> list[tuple[str, str, str, str, str, str]]:
        return [
            (
                line.name,
                line.equation,
                line.verdict,
                _number(line.margin, line.unit),
                _number(line.value, line.unit),
                line.where(self.joints),
            )
            for line in self.applicable
        ]

    def to_dict(self) -> dict[str, Any]:
        """Heading, verdict, constants and lines as plain numbers, strings and lists, for strict
        JSON (no NaN, no infinity).
        """
        return tables.for_json({
            "heading": self.heading,
            "verdict": self.verdict,
            "runs": list(self.runs),
            "worst_run": self.worst_run,
            "inaccurate_runs": self.inaccurate,
            "numbers": self.numbers,
            "lines": [dataclasses.asdict(line) for line in self.lines],
        })  # fmt: skip

    def plot(self, **options):
        """V2 under its envelope, the inequality's left side, and the errors under their bounds.
        Options as `plotting.certificate`.
        """
        return present("certificate figure", self, **options)


def _listed(names: list[str]) -> str:
    """The names of lines, or their number where there are many."""
    return ", ".join(names) if len(names) <= MAX_LISTED else f"{len(names)} lines"


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return ""
    if unit == "1":
        return f"{value:.4g}"
    return f"{value:.4g} {unit}"
