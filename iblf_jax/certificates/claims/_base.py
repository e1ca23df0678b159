"""What a claim about a closed loop is: its terms at a state, the decay that follows from it, and
the lines of a certificate about it.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import numpy as np

from iblf_jax.certificates.lines import Line, Statement, check_margins, verdict_of
from iblf_jax.certificates.result import LevelLabel, LevelTraces, Traces
from iblf_jax.certificates.summary import Decay, Segment, Summary
from iblf_jax.certificates.terms import Point, Terms
from iblf_jax.core.status import Status
from iblf_jax.simulation.scenario import Scenario


class Claim(metaclass=abc.ABCMeta):
    """A claim about the loops of some laws.  Members have no fields: a scenario has several claims
    (`claims_of`), and their numbers belong to a `Summary`.
    """

    key: ClassVar[str]
    """Names the claim among those of a scenario."""
    equation: ClassVar[str]
    """Number of its inequality."""
    about_torque: ClassVar[bool] = False
    """Whether it is about a robot and the torque f."""

    @abc.abstractmethod
    def why_not(self, scenario: Scenario) -> str:
        """Why it claims nothing about a scenario, in words; "" if it does."""

    def why_not_in_run(self, summary: Summary) -> str:
        """Why it does not apply to a run, in words; "" if it does."""
        return self.why_not(summary.run.scenario) or summary.why_invalid

    def added(self, point: Point, terms: Terms) -> Terms:
        """The terms at a state with those of this claim."""
        return terms

    def constants(self, summary: Summary) -> Any:
        """The numbers of the claim for a run, which `Summary.constants` keeps."""
        return None

    def decays(self, summary: Summary) -> Mapping[int, Decay]:
        """Case -> constants of the decay that follows from the claim."""
        return {}

    def numbers(self, summary: Summary) -> dict[str, Any]:
        """The constants of the claim, for `Certificate.numbers`."""
        return {}

    def assumptions(self, segment: Segment) -> list[Line]:
        """The lines of its assumptions, before those of the gains."""
        return []

    def gains(self, summary: Summary) -> list[Line]:
        """The lines about constants of the run."""
        return []

    def lines(self, segment: Segment) -> list[Line]:
        """The lines about every step of a segment."""
        return []

    def gathered(self, segment: Segment) -> Any:
        """What `conclusions` needs of a segment."""
        return None

    def conclusions(
        self, summary: Summary, gathered: list[Any], lines: Mapping[str, Line]
    ) -> Iterable[Line]:
        """Further lines of the run, or changed ones of the same names.

        Args:
          summary: of the run.
          gathered: what `gathered` returned for each segment.
          lines: all lines so far by name.
        """
        return ()


class ShownClaim(Claim):
    """A claim that the figure of a certificate shows; each scenario has exactly one."""

    in_words: ClassVar[str]
    """The claim in a sentence."""

    @abc.abstractmethod
    def traces(self, segment: Segment) -> Traces | LevelTraces:
        """The curves of the figure at the recorded samples of a segment; NaN where there is no
        claim.
        """

    @abc.abstractmethod
    def unclaimed_traces(self, run: Any) -> Traces | LevelTraces:
        """The curves of a run, its arrays on the host, of which nothing is claimed."""

    def labels(self, scenario: Scenario) -> tuple[LevelLabel, ...]:
        """The levels of the model, in words, of a claim about levels."""
        return ()


def check_steps(
    segment: Segment,
    statement: Statement,
    margins: np.ndarray,
    tolerances: np.ndarray | float,
    **fields: Any,
) -> Line:
    """`check_margins` at the steps of a segment."""
    return check_margins(
        statement, segment.t, segment.terms.excluded, margins, tolerances, **fields
    )


def with_status(summary: Summary, line: Line, flag: Status) -> Line:
    """A line about something that the run's status reports, too: the verdict is that of the status,
    which covers every step of the run itself.
    """
    verdict = verdict_of(not int(summary.run.status) & int(flag))
    if verdict == line.verdict:
        return line
    return dataclasses.replace(
        line, verdict=verdict, note="the verdict is that of the run's own status"
    )
