"""Claims V_w' <= -rho V_w (case 1, f' = 0) and V_w' <= -rho V_w + gain |f'|^2 (case 2) about the
torque f on a robot: the differential inequality at every step, the envelope that follows by
integration, and the bounds on xi, e2 and f_tilde inside it.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np

from iblf_jax.certificates.claims._base import Claim, check_steps, other_actuator
from iblf_jax.certificates.claims.own import own_claim, stated_methods
from iblf_jax.certificates.lines import Line, Statement, join_notes, not_applicable
from iblf_jax.certificates.reconstruction import padded_index
from iblf_jax.certificates.summary import (
    Segment,
    Summary,
    weighted_lyapunov,
)
from iblf_jax.certificates.terms import Point, TorquePoint, adaptive_law
from iblf_jax.control.barriers import Barrier
from iblf_jax.control.controllers import Backstepping, TrackingLaw
from iblf_jax.control.controllers._base import position_barrier
from iblf_jax.control.observers import AsPublished, Momentum
from iblf_jax.core import programs
from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation.scenario import Scenario

CASES = (1, 2)
NO_BOUND = "the barrier states no bound on xi from V1"


class Gains(NamedTuple):
    """The gains on which rho depends; (n,) each."""

    decay_rate: jax.Array
    """Of V1 of each joint along alpha [1/s]."""
    K2: jax.Array
    """`Backstepping.least_gain` [N m s/rad]."""
    kf: jax.Array


class TwoCases(Claim):
    """A claim with a case for f' = 0 and one for a bounded f'."""

    point: ClassVar[type[Point] | None] = TorquePoint
    inequalities: ClassVar[Mapping[int, Statement]]
    """By case."""
    envelopes: ClassVar[Mapping[int, Statement]]
    lyapunov: ClassVar[str] = ""
    """Which envelope a bound is of, in words before the case."""

    @abc.abstractmethod
    def why_no_rate(self, summary: Summary, case: int) -> str:
        """Why a case has no positive rate; "" if it has one."""

    @abc.abstractmethod
    def bound_statements(self, summary: Summary) -> dict[str, Statement]:
        """The bounds that follow from the envelope, by name."""

    def why_not_in_case(self, summary: Summary, case: int) -> str:
        """Why a case of the claim does not apply to a run; "" if it does."""
        reason = self.why_not_in_run(summary)
        if reason:
            return reason
        if case == 1 and case_of_run(summary) == 2:
            reached = f"{largest_f_rate(summary):.4g} N m/s"
            return f"case 1 is for f' = 0; here |f'| reaches {reached}, see case 2"
        return self.why_no_rate(summary, case) or summary.why_never

    def case_of(self, summary: Summary) -> int | None:
        """The stronger case that applies to a run, or None."""
        return next((case for case in CASES if not self.why_not_in_case(summary, case)), None)

    def exclusion_note(self, summary: Summary) -> str:
        """Which samples the claim excludes, and where it starts again, in words."""
        return join_notes(summary.exclusion_note(), summary.restart_note("f"))

    def left_side(self, segment: Segment, case: int) -> np.ndarray:
        """The left side of the differential inequality at every step, (T,)."""
        terms, decay = segment.terms, segment.summary.decay_bounds[self.key, case]
        rate = terms.dV
        if decay.w_f != 1.0:
            rate = rate + (decay.w_f - 1.0) * np.sum(terms.d_tilde * terms.dd_tilde, axis=1)
        left = rate + decay.rho * weighted_lyapunov(terms, decay.w_f)
        if case == 2:
            left = left - decay.gain * np.sum(terms.dd**2, axis=1)
        return left  # type: ignore[no-any-return]

    def decay_lines(self, segment: Segment) -> list[Line]:
        """The lines about the claimed decay at every step of one segment."""
        summary, terms, lines = segment.summary, segment.terms, []
        for case in CASES:
            statement, reason = self.inequalities[case], self.why_not_in_case(summary, case)
            if reason:
                lines.append(not_applicable(statement, reason))
                continue
            decay = summary.decay_bounds[self.key, case]
            V = weighted_lyapunov(terms, decay.w_f)
            size = max(1.0, decay.w_f) * terms.size + decay.rho * V
            margins, note = -self.left_side(segment, case), self.exclusion_note(summary)
            lines.append(check_steps(segment, statement, margins, summary.eps * size, note=note))
        lines += [self._envelope(segment, case) for case in CASES]
        return lines + self._bounds(segment)

    def _envelope(self, segment: Segment, case: int) -> Line:
        """The envelope of the Lyapunov function, at every step."""
        summary, statement = segment.summary, self.envelopes[case]
        reason = self.why_not_in_case(summary, case)
        if reason:
            return not_applicable(statement, reason)
        bound, tolerance = segment.envelopes[self.key, case]
        V = weighted_lyapunov(segment.terms, summary.decay_bounds[self.key, case].w_f)
        note = self.exclusion_note(summary)
        return check_steps(segment, statement, bound - V, tolerance, note=note)

    # --- the bounds on xi, e2 and f_tilde ---------------------------------------------------------

    def _bounds(self, segment: Segment) -> list[Line]:
        """The bounds that follow from the envelope of the case that applies."""
        summary = segment.summary
        case, statements = self.case_of(summary), self.bound_statements(summary)
        if case is None:
            reason = self.why_not_in_case(summary, case_of_run(summary))
            return [not_applicable(statement, reason) for statement in statements.values()]
        envelope, w_f = segment.envelopes[self.key, case], summary.decay_bounds[self.key, case].w_f
        bounds = self.bounds_along(segment, envelope.bound, w_f)
        widened = self.bounds_along(segment, envelope.bound + envelope.tolerance, w_f)
        sizes = self.sizes_along(segment)
        about = f"Vbar is the envelope of {self.lyapunov}case {case}"
        note = join_notes(about, self.exclusion_note(summary))
        lines = []
        for name, statement in statements.items():
            reason = self.why_no_bound(segment, name, bounds)
            if reason:
                lines.append(not_applicable(statement, reason))
                continue
            margins, tolerances = bounds[name] - sizes[name], widened[name] - bounds[name]
            lines.append(check_steps(segment, statement, margins, tolerances, note=note))
        return lines

    def sizes_along(self, segment: Segment) -> dict[str, np.ndarray]:
        """What the bounds are about, by name: (T, n) for xi, else (T,)."""
        terms = segment.terms
        return {
            "xi, by V1": np.abs(terms.xi[:, 0]),
            "xi": np.abs(terms.xi[:, 0]),
            "e2": np.linalg.norm(terms.e[:, 1], axis=1),
            "f_tilde": np.linalg.norm(terms.d_tilde, axis=1),
        }

    def bounds_along(
        self, segment: Segment, V: np.ndarray, w_f: float = 1.0
    ) -> dict[str, np.ndarray]:
        """The bounds on |xi| (by the barrier, and by (3.23)), |e2| and |f_tilde| where V_w <= V;
        (T, n) for xi, else (T,).
        """
        summary = segment.summary
        return {
            "e2": np.sqrt(2 * V / summary.reductions.lambda_min),
            "xi, by V1": xi_bound_along(segment, V),
            "xi": np.sqrt(2 * V[:, None] / np.asarray(position_barrier(summary.law)[1])),
            "f_tilde": np.sqrt(2 * V / w_f),
        }

    def why_no_bound(self, segment: Segment, name: str, bounds: dict[str, np.ndarray]) -> str:
        """Why a bound does not follow from the envelope, "" if it does.

        The bound on xi by V2 needs xi^2/2 <= V1 (Theorem 1), which holds where the barrier's own
        bound is smaller.
        """
        if not name.startswith("xi") or np.all(segment.terms.excluded):
            return ""
        by_barrier, by_V2 = bounds["xi, by V1"], bounds["xi"]
        if np.all(np.isnan(by_barrier)):
            return NO_BOUND
        stronger = by_barrier <= by_V2 * (1 + 1e-9)
        if name == "xi" and not np.all(stronger | np.isnan(by_V2)):
            return "xi^2/2 <= V1 (Theorem 1) does not hold for this barrier"
        return ""


def case_of_run(summary: Summary) -> int:
    """The case of a run: 1 if f' = 0, else 2."""
    return 1 if summary.reductions.steady else 2


def enters_verdict(summary: Summary, case: int) -> bool:
    """Whether a case enters the verdict: where f' = 0, case 1 decides."""
    return case == 1 or case_of_run(summary) == 2


def largest_f_rate(summary: Summary) -> float:
    """F_d, the largest |f'| [N m/s]; 0 in case 1."""
    if case_of_run(summary) == 1:
        return 0.0
    return float(summary.reductions.d_rate_largest)


@programs.jit
def _xi_bound(scenario: Scenario, t: jax.Array, V: jax.Array) -> jax.Array | None:
    """The barrier's own bound on |xi_i| where w_i V1_i <= V, (T, n), or None if it states none."""
    barrier, weight = position_barrier(unwrapped(scenario.controller))
    return jax.vmap(lambda t, V: barrier.xi_bound(V / weight, scenario.context.tube(t)))(t, V)


def xi_bound_along(segment: Segment, V: np.ndarray) -> np.ndarray:
    """The bound on |xi_i| along a segment, (T, n), computed in blocks of one size; NaN if the
    barrier states none.
    """
    index = padded_index(V.size)
    arguments = (segment.t[index], V.astype(segment.t.dtype)[index])
    stated = _xi_bound(segment.summary.run.scenario, *arguments)
    if stated is None:
        return np.full(segment.sample.q.shape, np.nan)
    return np.asarray(stated)[: V.size]


# --- the loops of Theorem 2 -----------------------------------------------------------------------


def gains_of(scenario: Scenario) -> Gains:
    """The gains on which rho depends; only for a scenario for which `why_no_theorem` is empty."""
    law: Any = unwrapped(scenario.controller)
    kf = scenario.observer.kf
    return Gains(law.barrier.decay_rate(law.k1), law.least_gain, kf)


def why_no_theorem(scenario: Scenario) -> str:
    """Why Theorem 2 claims nothing about a scenario, in words; "" if it does."""
    law: TrackingLaw = unwrapped(scenario.controller)
    if not isinstance(law, Backstepping):
        about = f"Theorem 2 is about the backstepping law (3.14); {type(law).__name__}"
        return f"{about} has no claim of this kind{_why_no_own_claim(scenario)}"
    if adaptive_law(scenario) is not None:
        return "Theorem 2 is about a constant model, and AdaptiveParameters changes it"
    return why_no_decay(law.barrier, law.k1) or why_not_in_loop(scenario)


def why_no_decay(barrier: Barrier, gain: jax.Array) -> str:
    """Why the V of a barrier has no known decay, in words; "" if it has."""
    if barrier.decay_rate(gain) is None:
        return f"the barrier {type(barrier).__name__} states no decay rate of its V1"
    return ""


def why_not_in_loop(scenario: Scenario) -> str:
    """Why the observer and the actuator of a scenario have no claim of this kind; "" if they
    have.
    """
    observer, actuator = scenario.observer, other_actuator(scenario)
    if not isinstance(observer, AsPublished | Momentum):
        needs = "Theorem 2 needs the observer (3.11), printed or in momentum form"
        return f"{needs}; {type(observer).__name__} has no claim of this kind"
    if actuator:
        about = "Theorem 2 is about a torque that acts as it is commanded"
        return f"{about}; {actuator} has no claim of this kind"
    return ""


def _why_no_own_claim(scenario: Scenario) -> str:
    """Why a law states no claim about itself, as the end of a sentence; "" if it states one."""
    if own_claim(scenario) is not None:
        return ""
    inner, outer = unwrapped(scenario.controller), scenario.controller
    if stated_methods(inner):
        wrapper = type(outer).__name__
        return f"; the claim that it states of itself does not cover the {wrapper} that wraps it"
    return ", and states none of its own (controllers.LyapunovLaw)"
