"""The claim about `controllers.BarrierBackstepping` of order 2 on a robot, with a gain c of the
slope of the last barrier, where the error of the estimate acts: c meets the torque that the
observer has not found.

V1 = sum w_1 V_1 and phi = sum w_2 V_2 are the barriers on positions and velocities.  With
V2 = V1 + phi + 1/2 |f_tilde|^2, s2 = w_2 s_2 the slope of phi, c for c_2/w_2 and
lambda = lambda_min(M0),

    (V1 + phi)' <= -(decay of V1) - (decay of phi) + s2 . M0^-1 f_tilde - c |s2|^2,            (F.2)
    s2 . M0^-1 f_tilde <= c |s2|^2 + |f_tilde|^2/(4 c lambda^2),
    V2' <= -rho V2 (+ 1/2 |f'|^2),                                                             (F.3)
    rho = min(decay rate of V1, that of phi, 2 (lambda_min(kf) (- 1/2) - 1/(4 c lambda^2)));

terms in brackets apply for f' != 0 (case 2).  (F.3) bounds the effect of the estimation error in
advance, where (S.3) has it as it is along the run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates.claims._base import (
    centre_distance,
    check_steps,
    level_dissipation,
    stays_inside,
    with_status,
    xi_bound,
)
from iblf_jax.certificates.claims.own import own_claim
from iblf_jax.certificates.claims.theorem import (
    CASE_1_DECIDES,
    SignalSizes,
    Theorem,
    eigenvalues_in,
)
from iblf_jax.certificates.claims.two_cases import (
    CASES,
    case_of_run,
    enters_verdict,
    why_no_decay,
    why_not_in_loop,
)
from iblf_jax.certificates.lines import (
    Line,
    Statement,
    check_positive,
    check_smallest,
    join_notes,
    not_applicable,
)
from iblf_jax.certificates.summary import Segment, Summary
from iblf_jax.certificates.terms import (
    Point,
    Terms,
    TorquePoint,
    adaptive_law,
    inner_context,
    relative_gap,
)
from iblf_jax.control.controllers import BarrierBackstepping, TrackingLaw
from iblf_jax.control.controllers._levels import Level
from iblf_jax.core import checks
from iblf_jax.core.linalg import solve_spd
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import Status
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world.bounds import NARROWEST, Tube

LOWEST = {1: 0.0, 2: 0.5}
"""Lower bound of kf - 1/(4 c lambda_min(M0)^2), by case."""
FURTHER_TERM = {1: "", 2: " - 1/2"}
"""Further term in the condition on kf, by case."""
ALPHA_INSIDE = Statement("alpha inside", "(F.1)", "v_l < alpha < v_u", "rad/s")
START_SPEED_INSIDE = Statement("start speed inside", "(F.1)", "v_l(0) < q'(0) < v_u(0)", "rad/s")


class MatchedTerms(NamedTuple):
    """The terms of (F.2) at one instant."""

    left: jax.Array
    """(V1 + phi)' + decay rates times V1 and phi - s2 . M0^-1 f_tilde + c |s2|^2, () [1/s]."""
    tube: Tube
    """Of the velocities."""
    side: jax.Array
    """K of each joint's side, (n,) [rad/s]."""
    alpha_distance: jax.Array
    """Distance of alpha to the velocity bounds, (n,) [rad/s]."""
    disturbance_gain: jax.Array
    """s2 . M0^-1 f_tilde - c |s2|^2, () [1/s]."""


class Matched(Theorem):
    """(F.3): the estimation error acts where the law has the gain c."""

    key: ClassVar[str] = "matched"
    conditions: ClassVar[Mapping[int, str]] = {1: "(F.3)", 2: "(F.3)"}
    least: ClassVar[tuple[str, ...]] = (
        "the decay rate of V1",
        "the decay rate of phi",
        "kf and c",
    )

    def why_not(self, scenario: Scenario) -> str:
        """Why (F.3) claims nothing about a scenario, in words; "" if it does."""
        law: TrackingLaw = unwrapped(scenario.controller)
        if not isinstance(law, BarrierBackstepping) or law.order != 2 or law.filter is not None:
            return "(F.3) is about BarrierBackstepping of order 2 with exact derivatives"
        if law.addition:
            return f"(F.3) is about (F.1), and the law has {law.addition}"
        if scenario.loop.model.uncertain_levels:
            return "(F.3) is about the torque on a robot"
        if not (checks.is_concrete(law.c) and np.all(np.asarray(law.c)[-1] > 0)):
            return "(F.3) needs c > 0 on the last level"
        if own_claim(scenario) is not None:
            return "the law states a claim of its own"
        if adaptive_law(scenario) is not None:
            return "(F.3) is about a constant model, and AdaptiveParameters changes it"
        pairs = zip(law.barriers, law.k, strict=True)
        reasons = (why_no_decay(barrier, k) for barrier, k in pairs)
        return next(filter(None, reasons), "") or why_not_in_loop(scenario)

    def exclusion_note(self, summary: Summary) -> str:
        """Which samples the claim excludes, and where it starts again, in words."""
        excluded = summary.exclusion_note("alpha was outside, or {}")
        return join_notes(excluded, summary.restart_note("f"))

    # --- the terms --------------------------------------------------------------------------------

    def has_law(self, law: object) -> bool:
        """Whether it is about a law of this class."""
        return isinstance(law, BarrierBackstepping)

    def with_terms_of_claim(self, point: Point, terms: Terms) -> Terms:
        """The terms at a state with those of this claim."""
        terms = super().with_terms_of_claim(point, terms)
        assert isinstance(point, TorquePoint)
        law, x, t = point.law, point.x, point.t
        levels, tubes = _levels(point)
        barriers_rate = terms.dV - terms.d_tilde @ terms.dd_tilde
        dissipation = by_slopes = jnp.zeros_like(t)
        for i, (level, tube) in enumerate(zip(levels, tubes, strict=True)):
            of_level, by_slope = level_dissipation(law, i, t, tube, x[i], level.slope)
            dissipation, by_slopes = dissipation + of_level, by_slopes + by_slope
        disturbance_gain = levels[1].slope @ solve_spd(point.M0, terms.d_tilde) - by_slopes
        inner = tubes[1]
        distance = centre_distance(inner)
        entry = MatchedTerms(
            left=barriers_rate + dissipation - disturbance_gain,
            tube=inner,
            side=jnp.where(x[1] > inner.q_d, inner.k_u, inner.k_l),
            alpha_distance=distance,
            disturbance_gain=disturbance_gain,
        )
        return terms._replace(
            xi=jnp.stack([terms.xi[0], inner.xi(x[1])]),
            # e2 has no tube where alpha is outside the velocity bounds.
            excluded=terms.excluded | jnp.any(distance <= NARROWEST),
            claims=terms.claims | {self.key: entry},
        )

    def term_sizes(self, point: TorquePoint, terms: Terms) -> tuple[jax.Array, jax.Array]:
        """`Terms.size` and `Terms.sqrt_V_size`, with the terms of phi'."""
        law, dq = point.law, point.x[1]
        sizes = SignalSizes(point, law.k[1], law.barriers[0].guard)
        size, sqrt_V_size = sizes.of_V2(terms, law.weights[0])
        levels, (_, inner) = _levels(point)
        unit = jnp.eye(dq.size, dtype=dq.dtype)
        inverse = jnp.stack([solve_spd(point.M0, row) for row in unit])
        acceleration = sizes.acceleration + jnp.sum(jnp.abs(inverse) * sizes.torque, axis=1)
        s2, gap = jnp.abs(levels[1].slope), relative_gap(inner.xi(dq), law.barriers[1].guard)
        by_slope = jnp.sum(law.c[1] / law.weights[1] * s2**2)
        return size + ((s2 / gap) @ acceleration + by_slope), sqrt_V_size

    # --- gains and rates --------------------------------------------------------------------------

    def rho_terms(self, summary: Summary, case: int, domain: str) -> np.ndarray:
        """The terms of which rho is the least, (3,) [1/s], with the eigenvalues of M0 of a
        domain.
        """
        law: Any = summary.law
        lambda_min = eigenvalues_in(summary, domain).lambda_min
        pairs = zip(law.barriers, law.k, strict=True)
        by_barriers = [np.min(barrier.decay_rate(k)) for barrier, k in pairs]
        coupling = 0.25 / (np.min(law.c[1] / law.weights[1]) * lambda_min**2)
        kf = np.min(summary.run.scenario.observer.kf)
        return np.array([*by_barriers, 2.0 * (kf - LOWEST[case] - coupling)])

    def gain_conditions(self, summary: Summary) -> list[Line]:
        """The condition of (F.3) on kf and c, in both cases."""
        scenario, lambda_min = summary.run.scenario, float(summary.reductions.lambda_min)
        reason = self.why_not(scenario)
        lines = []
        for case in CASES:
            text = f"lambda_min(kf){FURTHER_TERM[case]} - 1/(4 c lambda_min(M0)^2) > 0"
            statement = Statement(f"kf and c, case {case}", "(F.3)", text, "1/s")
            if reason:
                lines.append(not_applicable(statement, reason))
                continue
            margin = 0.5 * float(summary.constants[self.key][case, "run"][2])
            needed = np.asarray(scenario.observer.kf).min() - LOWEST[case]
            note = f"lambda_min(M0) = {lambda_min:.4g} kg m^2 along the run"
            if margin <= 0 < needed:
                note += f": c > {0.25 / (needed * lambda_min**2):.4g} would do"
            enters = enters_verdict(summary, case)
            if not enters:
                note = CASE_1_DECIDES
            lines.append(check_positive(statement, margin, enters_verdict=enters, note=note))
        return lines

    def rate_statement(self, name: str, case: int) -> Statement:
        """The statement of the rate of a case."""
        text = (
            "rho = min(decay of V1, decay of phi, 2 (kf"
            f"{FURTHER_TERM[case]} - 1/(4 c lambda_min(M0)^2))) > 0"
        )
        return Statement(name, "(F.3)", text, "1/s")

    def eigenvalue_note(self, source: Any) -> str:
        """The eigenvalue of M0 on which rho depends, in words."""
        return f"lambda_min(M0) = {source.lambda_min:.4g} kg m^2"

    # --- every step -------------------------------------------------------------------------------

    def disturbance_gain_term(self, segment: Segment) -> np.ndarray:
        """The term s2 . M0^-1 f_tilde - c |s2|^2 of (F.2) at every step, (T,)."""
        return segment.terms.claims[self.key].disturbance_gain  # type: ignore[no-any-return]

    def assumptions(self, segment: Segment) -> list[Line]:
        """Those of Theorem 2, and those on the virtual velocity and on the velocity at the
        start.
        """
        entry, summary = segment.terms.claims[self.key], segment.summary
        alpha = check_smallest(ALPHA_INSIDE, segment.t, entry.alpha_distance)
        lines = super().assumptions(segment)
        lines.append(with_status(summary, alpha, Status.ALPHA_INFEASIBLE))
        if segment.t[0] == 0:
            start = segment.terms.distance[:1, 1]
            lines.append(check_smallest(START_SPEED_INSIDE, segment.t, start))
        return lines

    def lines(self, segment: Segment) -> list[Line]:
        """The lines about every step of one segment."""
        summary, terms = segment.summary, segment.terms
        # The inequality of the two barriers, for any kf and c.
        text = "(V1 + phi)' + decay of V1 and phi - s2 . M0^-1 f_tilde + c |s2|^2 <= 0"
        statement = Statement("barriers", "(F.2)", text, "1/s")
        reason = self.why_not_in_run(summary)
        barriers = not_applicable(statement, reason)
        if not reason:
            left, note = terms.claims[self.key].left, self.exclusion_note(summary)
            barriers = check_steps(segment, statement, -left, summary.eps * terms.size, note=note)
        statement = Statement("velocities inside", "(F.3)", "v_l < q' < v_u", "rad/s")
        reason = ""
        if self.case_of(summary) is None:
            reason = self.why_not_in_case(summary, case_of_run(summary))
        distance, flag = terms.distance[:, 1], Status.VELOCITY_VIOLATED
        velocities = stays_inside(segment, statement, distance, flag, reason)
        return [barriers, *super().lines(segment), velocities]

    def why_law_is_exact(self, summary: Summary) -> str:
        """Why the proof drops no term of the law."""
        return "the claim is exact: C0 q' is cancelled, and e2 weighed without M0"

    def velocity_bound(self, case: int) -> Statement:
        """The bound on the error of the velocity."""
        text = "phi <= Vbar: |xi2_i| as the velocity barrier says"
        return Statement("xi2, by phi", "(F.3)", text)

    def sizes_along(self, segment: Segment) -> dict[str, np.ndarray]:
        """What the bounds are about, by name."""
        return super().sizes_along(segment) | {"xi2, by phi": np.abs(segment.terms.xi[:, 1])}

    def bounds_along(
        self, segment: Segment, V: np.ndarray, w_f: float = 1.0
    ) -> dict[str, np.ndarray]:
        """The bounds by name, with those on xi2 and e2 from phi."""
        law, entry = segment.summary.law, segment.terms.claims[self.key]
        xi2 = xi_bound(law.barriers[1], law.weights[1], V, entry.tube)
        e2 = np.linalg.norm(xi2 * entry.side, axis=1)
        return super().bounds_along(segment, V, w_f) | {"e2": e2, "xi2, by phi": xi2}

    def why_no_bound(self, segment: Segment, name: str, bounds: dict[str, np.ndarray]) -> str:
        """Why a bound does not follow from the envelope, "" if it does."""
        reason = super().why_no_bound(segment, name, bounds)
        if not reason and name == "xi2, by phi" and np.all(np.isnan(bounds[name])):
            return "the velocity barrier states no bound on xi2 from phi"
        return reason


MATCHED = Matched()


def _levels(point: TorquePoint) -> tuple[list[Level], list[Tube]]:
    """What each level of the law computes, and its tube."""
    context = inner_context(point.scenario, point.state.controller)
    f_hat = point.now["disturbance_estimate"]
    return point.law.levels(point.t, point.x, f_hat, context, ())  # type: ignore[no-any-return]
