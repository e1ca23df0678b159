"""The lines of a certificate about Theorem 2 (and (F.1)-(F.3) for `controllers.FullState`).

They are the assumptions, the claimed decay (`decay_lines`) and the conclusions. For readings with a
gap in their proof, the dropped terms are measured beside the margin that the proof leaves for them.
The gain conditions and rates are in `rate_lines`.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from iblf_jax.certificates.decay_lines import (
    NO_BOUND,
    check_steps,
    decay_lines,
    left_side,
    xi_bound,
)
from iblf_jax.certificates.lines import (
    NOT_APPLICABLE,
    OBSERVED_ONLY,
    Line,
    Statement,
    check_margins,
    check_smallest,
    not_applicable,
    verdict_of,
)
from iblf_jax.certificates.run_summary import THEOREM, RunSummary, Segment
from iblf_jax.control.observers import Momentum
from iblf_jax.core.status import Status
from iblf_jax.simulation.signals import has

BOUNDED = Statement("f bounded", "Assumption 1", "|f| <= F_m", "N m")
RATE_BOUNDED = Statement("f' bounded", "Assumption 1", "|f'| <= F_d between jumps", "N m/s")
REFERENCE_INSIDE = Statement("reference inside", "Assumption 2", "k_lc < x_d < k_uc", "rad")
START_INSIDE = Statement("start inside", "Theorem 2", "k_lc(0) < q(0) < k_uc(0)", "rad")
ALPHA_INSIDE = Statement("alpha inside", "(F.1)", "v_l < alpha < v_u", "rad/s")
START_SPEED_INSIDE = Statement("start speed inside", "(F.1)", "v_l(0) < q'(0) < v_u(0)", "rad/s")
LIMITED = Statement(
    "inequality, limited torque",
    "(A.3)",
    "V2' + rho V2 - |f'|^2/2 - w s . lambda <= 0  (without |f'|^2/2 in case 1)",
    "1/s",
)
ASSUMPTIONS = (
    BOUNDED,
    RATE_BOUNDED,
    REFERENCE_INSIDE,
    START_INSIDE,
    ALPHA_INSIDE,
    START_SPEED_INSIDE,
)
"""The statements that a certificate shows before those of the gains."""


def segment_lines(segment: Segment) -> tuple[list[Line], dict[str, float]]:
    """The lines about every step of one segment, and the largest share that each dropped term has
    of its margin there.
    """
    bounds_velocities = segment.summary.claims.bounds_velocities
    lines = _assumptions(segment)
    if bounds_velocities:
        lines += [*_velocity_assumptions(segment), _barriers_inequality(segment)]
    lines += decay_lines(segment, THEOREM)
    if segment.proof.auxiliary:
        lines.append(_limited_inequality(segment))
    dropped, shares = _dropped_terms(segment)
    lines += [*dropped, _joints_inside(segment)]
    if bounds_velocities:
        lines.append(_velocities_inside(segment))
    return lines, shares


# --- the auxiliary state of a limited torque -----------------------------------------------------


def _limited_inequality(segment: Segment) -> Line:
    """The differential inequality with the auxiliary state, at every step, those with a limited
    torque included.
    """
    summary, proof = segment.summary, segment.proof
    case, terms = summary.case, segment.proof.auxiliary
    reason = summary.claims.why_no_theorem or summary.why_invalid
    if not reason and not summary.rho[case, "run"] > 0:
        reason = "the gain conditions are not met"
    if reason:
        return not_applicable(LIMITED, reason)
    margins = terms.growth - left_side(segment, THEOREM, case)
    size = proof.dV_size + summary.rho[case, "run"] * proof.V + np.abs(terms.growth)
    largest = float(np.max(np.abs(summary.run.auxiliary)))
    note = f"max |lambda| = {largest:.4g} rad/s; instants with a limited torque are included"
    return check_margins(LIMITED, segment.t, terms.excluded, margins, summary.eps * size, note=note)


# --- assumptions ---------------------------------------------------------------------------------


def _assumptions(segment: Segment) -> list[Line]:
    """Bounds of Assumption 1 along the run, and feasibility of the reference, Assumption 2."""
    summary, sample, proof = segment.summary, segment.sample, segment.proof
    df_norm = np.linalg.norm(proof.df, axis=1)
    if summary.case == 1:
        df_norm = 0.0 * df_norm
    jump_note = ""
    if summary.jumps.size:
        jump_note = f"Assumption 1 is broken by a jump of f: {summary.exclusion_note}"
    distance = np.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
    reference = check_smallest(REFERENCE_INSIDE, segment.t, distance)
    if not has(summary.run, "slack"):
        # A safety filter keeps its bounds for any reference, so its status does not show whether
        # the reference is inside them.
        reference = with_status(summary, reference, Status.INFEASIBLE_REFERENCE)
    lines = [
        finite(BOUNDED, segment.t, np.linalg.norm(proof.f, axis=1)),
        finite(RATE_BOUNDED, segment.t, df_norm, jump_note),
        reference,
    ]
    if segment.t[0] == 0:
        start = np.minimum(sample.q - sample.lower, sample.upper - sample.q)[:1]
        lines.append(check_smallest(START_INSIDE, segment.t, start))
    return lines


def finite(statement: Statement, t: np.ndarray, values: np.ndarray, note: str = "") -> Line:
    """The line of a quantity that must be finite at every step, with its largest value."""
    at = int(np.argmax(np.nan_to_num(values, nan=np.inf)))
    verdict = verdict_of(bool(np.all(np.isfinite(values))))
    return statement.line(verdict, value=float(values[at]), time=float(t[at]), note=note)


def _velocity_assumptions(segment: Segment) -> list[Line]:
    """The assumptions on the virtual velocity and on the velocity at the start."""
    sample = segment.sample
    alpha = check_smallest(ALPHA_INSIDE, segment.t, segment.proof.full.alpha_distance)
    lines = [with_status(segment.summary, alpha, Status.ALPHA_INFEASIBLE)]
    if segment.t[0] == 0:
        start = np.minimum(sample.dq - sample.dq_lower, sample.dq_upper - sample.dq)[:1]
        lines.append(check_smallest(START_SPEED_INSIDE, segment.t, start))
    return lines


def with_status(summary: RunSummary, line: Line, flag: Status) -> Line:
    """A line about something that the run's status reports, too: the verdict is that of the status,
    which covers every step of the run itself.
    """
    verdict = verdict_of(not int(summary.run.status) & int(flag))
    if verdict == line.verdict:
        return line
    return dataclasses.replace(
        line, verdict=verdict, note="the verdict is that of the run's own status"
    )


def _barriers_inequality(segment: Segment) -> Line:
    """The inequality of the two barriers, at every step, for any kf and c."""
    summary, proof = segment.summary, segment.proof
    text = "(V1 + phi)' + decay of V1 and phi - s2 . M0^-1 f_tilde + c |s2|^2 <= 0"
    statement = Statement("barriers", "(F.2)", text, "1/s")
    reason = summary.claims.why_no_theorem or summary.why_invalid
    if reason:
        return not_applicable(statement, reason)
    tolerance, note = summary.eps * proof.dV_size, summary.exclusion_note
    return check_steps(segment, statement, -proof.full.left, tolerance, note=note)


# --- the terms that the printed proof drops ------------------------------------------------------


def _dropped_terms(segment: Segment) -> tuple[list[Line], dict[str, float]]:
    """The sizes of the terms that the printed proof drops, compared with the margin that it leaves,
    and their largest share of it.
    """
    summary, proof, case = segment.summary, segment.proof, segment.summary.theorem_case
    by_law = Statement(
        "dropped term of the law",
        "(3.13)",
        "e2^T M0' e2/2 <= the margin that the proof leaves",
        "1/s",
    )
    by_observer = Statement(
        "dropped term of the observer",
        "(3.11)",
        "-f_tilde^T kf M0' q' <= the margin that the proof leaves",
        "1/s",
    )
    why_unclaimed = summary.claims.why_no_theorem or summary.why_invalid
    why_no_case = summary.why_not(THEOREM, case or summary.case)
    terms = (
        (by_law, proof.dropped_e2, _why_law_is_exact(summary)),
        (by_observer, proof.dropped_f, _why_observer_is_exact(summary)),
    )
    lines: list[Line] = []
    shares: dict[str, float] = {}
    for statement, term, why_exact in terms:
        reason = why_unclaimed or why_exact or why_no_case
        if reason or case is None:
            lines.append(not_applicable(statement, reason, counts=False))
            continue
        margin = proof.dropped_e2 + proof.dropped_f - left_side(segment, THEOREM, case)
        tolerance = summary.eps * proof.dV_size
        included = ~proof.excluded
        share = np.where(included, term / np.maximum(margin, tolerance), 0.0)
        shares[statement.name] = float(np.max(share))
        largest = float(np.max(np.abs(term[included]), initial=0.0))
        line = check_steps(
            segment, statement, margin - term, tolerance, value=largest, counts=False
        )
        lines.append(line)
    return lines, shares


def _why_law_is_exact(summary: RunSummary) -> str:
    """Why the proof drops no term of the law; "" if it drops one."""
    if summary.claims.bounds_velocities:
        return "the claim is exact: C0 q' is cancelled, and e2 weighed without M0"
    if summary.claims.law.reading == "corrected":
        return "the claim is exact: the law uses C0 alpha"
    return ""


def _why_observer_is_exact(summary: RunSummary) -> str:
    """Why the proof drops no term of the observer; "" if it drops one."""
    if isinstance(summary.run.scenario.observer, Momentum):
        return "the claim is exact: the observer has momentum form"
    return ""


# --- conclusions ---------------------------------------------------------------------------------


def _joints_inside(segment: Segment) -> Line:
    """Properties (I) and (II): every joint inside its bounds, at every step."""
    summary = segment.summary
    statement = Statement("joints inside", "(I), (II)", "|xi_i| < 1: -k_l < e1 < k_u")
    line = check_smallest(statement, segment.t, 1.0 - np.abs(segment.sample.xi))
    line = with_status(summary, line, Status.BOUND_VIOLATED)
    case = summary.theorem_case
    if case is None and summary.weights_replace_theorem:
        case = summary.weighted_case
    if case is None:
        return observed_only(line, summary.why_not(THEOREM, summary.case))
    scenario, first = summary.run.scenario, segment.proof.V[:1]
    if xi_bound(scenario, segment.t[:1], first) is None:
        return observed_only(line, NO_BOUND)
    return line


def _velocities_inside(segment: Segment) -> Line:
    """Every velocity inside its bounds, at every step."""
    summary, sample = segment.summary, segment.sample
    statement = Statement("velocities inside", "(F.3)", "v_l < q' < v_u", "rad/s")
    distance = np.minimum(sample.dq - sample.dq_lower, sample.dq_upper - sample.dq)
    line = check_smallest(statement, segment.t, distance)
    line = with_status(summary, line, Status.VELOCITY_VIOLATED)
    if summary.theorem_case is None:
        return observed_only(line, summary.why_not(THEOREM, summary.case))
    return line


def observed_only(line: Line, reason: str) -> Line:
    """A line that no claim covers."""
    return dataclasses.replace(line, verdict=NOT_APPLICABLE, note=f"{OBSERVED_ONLY}{reason})")
