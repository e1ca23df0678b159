"""What a claim about a closed loop is: its terms at a state, the decay that follows from it, and
the lines of a certificate about it.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates.lines import (
    Line,
    Statement,
    check_margins,
    check_smallest,
    observed_only,
    verdict_of,
)
from iblf_jax.certificates.result import LevelLabel, LevelTraces, Traces
from iblf_jax.certificates.summary import DecayBound, Reduction, Segment, Summary
from iblf_jax.certificates.terms import Point, Terms
from iblf_jax.control.actuators import Ideal
from iblf_jax.control.barriers import Barrier
from iblf_jax.control.controllers import BarrierBackstepping
from iblf_jax.control.controllers._base import decay_of
from iblf_jax.control.decays._base import gain_at
from iblf_jax.core import checks
from iblf_jax.core.status import Status
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import has
from iblf_jax.world.bounds import Tube

REFERENCE_INSIDE = Statement("reference inside", "Assumption 2", "k_lc < x_d < k_uc", "rad")


C = TypeVar("C", Traces, LevelTraces)


class Claim(metaclass=abc.ABCMeta):
    """A claim about the loops of some laws.  Members have no fields: a scenario has several claims
    (`claims_of`), and their numbers belong to a `Summary`.
    """

    key: ClassVar[str]
    """Names the claim among those of a scenario."""
    point: ClassVar[type[Point] | None] = None
    """The points at which it has terms; None for one that reads those of other claims."""
    omits_f_tilde: ClassVar[bool] = False
    """Whether its V lacks |f_tilde|^2/2, which the V of a sample of a robot contains."""

    @abc.abstractmethod
    def why_not(self, scenario: Scenario) -> str:
        """Why it claims nothing about a scenario, in words; "" if it does."""

    def why_not_in_run(self, summary: Summary) -> str:
        """Why it does not apply to a run, in words; "" if it does."""
        return self.why_not(summary.run.scenario) or summary.why_invalid

    def with_terms_of_claim(self, point: Point, terms: Terms) -> Terms:
        """The terms at a state with those of this claim."""
        return terms

    def reductions(self, scenario: Scenario, terms: Terms) -> dict[str, Reduction]:
        """What a summary keeps of its quantities at some steps, by name."""
        return {}

    def constants(self, summary: Summary) -> Any:
        """Values that the claim computes once per run for its own methods."""
        return None

    def decay_bounds(self, summary: Summary) -> Mapping[int, DecayBound]:
        """Case -> constants of the decay that follows from the claim."""
        return {}

    def numbers(self, summary: Summary) -> dict[str, Any]:
        """What the claim adds to `Certificate.numbers`."""
        return {}

    def assumptions(self, segment: Segment) -> list[Line]:
        """The lines of its assumptions, before those of the gains."""
        return []

    def gain_lines(self, summary: Summary) -> list[Line]:
        """The lines about constants of the run."""
        return []

    def lines(self, segment: Segment) -> list[Line]:
        """The lines about every step of a segment."""
        return []

    def segment_data(self, segment: Segment) -> Any:
        """What `run_lines` needs of a segment."""
        return None

    def run_lines(
        self, summary: Summary, data: list[Any], lines: Mapping[str, Line]
    ) -> Iterable[Line]:
        """Further lines of the run; one with the name of an earlier line replaces it.

        Args:
          summary: of the run.
          data: the `segment_data` of each segment.
          lines: all lines so far by name.
        """
        return ()


class MainClaim(Claim):
    """A claim that the figure of a certificate shows; each scenario has exactly one."""

    in_words: ClassVar[str]
    """The claim in a sentence."""

    @abc.abstractmethod
    def disturbance_gain_term(self, segment: Segment) -> np.ndarray:
        """The term g that disturbances may add to the rate of V at every step, (T,)."""

    @abc.abstractmethod
    def why_no_settling(self, summary: Summary) -> str:
        """Why no settling time follows from the decays of the law in a run; "" if one does."""

    @abc.abstractmethod
    def traces(self, segment: Segment) -> Traces | LevelTraces:
        """The curves of the figure at the recorded samples of a segment; NaN where there is no
        claim.
        """

    @abc.abstractmethod
    def unclaimed_traces(self, run: Rollout) -> Traces | LevelTraces:
        """The curves of a run, its arrays on the host, of which nothing is claimed."""

    def labels(self, scenario: Scenario) -> tuple[LevelLabel, ...]:
        """The levels of the model, in words, of a claim about levels."""
        return ()


def centre_distance(tube: Tube) -> jax.Array:
    """Distance of the centre of a tube to its bounds, (n,)."""
    return jnp.minimum(tube.q_d - tube.lower, tube.upper - tube.q_d)


def level_dissipation(
    law: BarrierBackstepping, i: int, t: jax.Array, tube: Tube, x: jax.Array, slope: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """w_i decay_i and c_i w_i |s_i|^2 of level i + 1 of a law with barriers, () each, for the gain
    of the instant, which a decay makes a function of t and V_i; the first is 0 for a barrier that
    states no rate.
    """
    barrier, w = law.barriers[i], law.weights[i]
    gain = gain_at(decay_of(law, i), t, law.k[i], barrier, tube, x)
    stated, by_slope = barrier.decay_rate(gain), jnp.sum(law.c[i] * slope**2 / w)
    if stated is None:
        return jnp.zeros_like(t), by_slope
    return jnp.sum(w * stated * barrier.value(tube, x)), by_slope


def xi_bound(barrier: Barrier, weight: jax.Array, V: np.ndarray, tube: Tube) -> np.ndarray:
    """The barrier's own bound on |xi_i| where w_i V_i <= V, (T, n); NaN if it states none."""
    stated = barrier.xi_bound(V.astype(tube.lower.dtype)[:, None] / np.asarray(weight), tube)
    return np.full(tube.lower.shape, np.nan) if stated is None else np.asarray(stated)


def unclaimed(kind: type, t: jax.Array | np.ndarray, **known: Any) -> Any:
    """The curves of samples of which nothing is claimed, with those that are known."""
    unknown = dict.fromkeys(kind._fields, np.full(t.shape, np.nan))  # type: ignore[attr-defined]
    return kind(**unknown | {"t": t, "excluded": np.ones(t.shape, bool)} | known)


def at_recorded(segment: Segment, traces: C) -> C:
    """The curves at the recorded samples of a segment; the left side without excluded ones."""
    left = np.where(segment.terms.excluded, np.nan, traces.left)
    return type(traces)(*(x[segment.recorded] for x in traces._replace(left=left)))


def other_actuator(scenario: Scenario) -> str:
    """The actuator of a scenario, in words; "" for one that acts as it is commanded."""
    if isinstance(scenario.actuator, Ideal):
        return ""
    return checks.with_article(type(scenario.actuator).__name__)


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


def reference_inside(segment: Segment) -> Line:
    """Whether the reference is inside the bounds, Assumption 2."""
    summary, sample = segment.summary, segment.sample
    distance = np.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
    line = check_smallest(REFERENCE_INSIDE, segment.t, distance)
    if has(summary.run, "slack"):
        # A safety filter keeps its bounds for any reference, so its status does not show whether
        # the reference is inside them.
        return line
    return with_status(summary, line, Status.INFEASIBLE_REFERENCE)


def stays_inside(
    segment: Segment, statement: Statement, margins: np.ndarray, flag: Status | None, why_not: str
) -> Line:
    """The line of a level that stays inside its bounds; `flag` is the status that reports it, too,
    and `why_not` is why no claim covers it, "" if one does.
    """
    line = check_smallest(statement, segment.t, margins)
    if flag is not None:
        line = with_status(segment.summary, line, flag)
    return observed_only(line, why_not) if why_not else line


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
