"""The lines of a certificate about the claims beyond Theorem 2 (`claims`): the claim with weights,
and the claim that a law states about itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from iblf_jax.certificates import claims
from iblf_jax.certificates.claims import CASES
from iblf_jax.certificates.lines import (
    OWN_INEQUALITY,
    Line,
    Statement,
    check_margins,
    check_positive,
    join_notes,
    not_applicable,
)
from iblf_jax.certificates.optional import optional_member
from iblf_jax.certificates.proof_terms import GENERAL_TERMS
from iblf_jax.certificates.run_summary import (
    ALWAYS_EXCLUDED,
    RunSummary,
    Segment,
    weighted_lyapunov,
)
from iblf_jax.certificates.theorem_lines import NO_BOUND, exclusion_note, xi_bound_along
from iblf_jax.control.actuators import Ideal
from iblf_jax.core import checks

WEIGHTED_LEFT = {1: "V_w' + rho V_w <= 0", 2: "V_w' + rho V_w - w_f |f'|^2/(2 b) <= 0"}
WEIGHTED_ENVELOPE = {
    1: "V_w(t) <= V_w(0) exp(-rho t)",
    2: "V_w(t) <= V_w(0) exp(-rho t) + rho2/rho",
}
WEIGHTED_RATE = {
    1: "rho = min(decay of V1, 2 (1 - a) lambda_min(M0^-1 K2), 2 (kf - 1/(4 a K2 w_f))) > 0",
    2: "rho = min(decay of V1, 2 (1 - a) lambda_min(M0^-1 K2), 2 (kf - b/2 - 1/(4 a K2 w_f))) > 0",
}
WEIGHTED_BOUNDS = (
    Statement(
        "weighted xi",
        "(W.3)",
        "w_i V1_i <= Vbar: |xi_i| <= sqrt(1 - exp(-Vbar/w_i)), or as the barrier says",
    ),
    Statement("weighted e2", "(W.3)", "|e2| <= sqrt(2 Vbar/lambda_min(M0))", "rad/s"),
    Statement("weighted f_tilde", "(W.3)", "|f_tilde| <= sqrt(2 Vbar/w_f)", "N m"),
)
OWN_ROUNDING = 8.0
"""Relative errors of the derivatives of a law's own V, in those of their terms."""


# --- the claim with weights ----------------------------------------------------------------------


def weighted_run_lines(summary: RunSummary) -> list[Line]:
    """The rates of both cases, with the chosen numbers; no lines for a loop without the claim."""
    if not summary.claims.has_weights:
        return []
    return [_weighted_rate(summary, case) for case in CASES]


def weighted_segment_lines(segment: Segment) -> list[Line]:
    """The lines about every step of one segment; none for a loop without the claim."""
    if not segment.summary.claims.has_weights:
        return []
    lines = [_weighted_inequality(segment, case) for case in CASES]
    lines += [_weighted_envelope(segment, case) for case in CASES]
    return lines + _weighted_bounds(segment)


def _weighted_rate(summary: RunSummary, case: int) -> Line:
    """The rate of one case, with the chosen numbers."""
    statement = Statement(f"weighted rho, case {case}", "(W.2)", WEIGHTED_RATE[case], "1/s")
    constants, reason = summary.claims.constants, summary.why_not_weighted(case)
    if reason or not isinstance(constants, claims.Claim):
        return not_applicable(statement, reason)
    chosen, slowest = summary.weights[case], summary.slowest
    limits = (np.min(constants.decay), 2.0 * slowest, 2.0 * np.min(constants.kf))
    least = ("the decay rate of V1", "K2 over M0", "kf")[int(np.argmin(limits))]
    numbers = f"a = {chosen.a:.4g}, w_f = {chosen.w_f:.4g} rad/(N m)"
    if case == 2:
        numbers += f", b = {chosen.b:.4g} 1/s"
    note = (
        f"chosen for the smallest mean of the envelope: {numbers}; lambda_min(M0^-1 K2) ="
        f" {slowest:.4g} 1/s; limited by {least}"
    )
    terms = claims.weighted_rate_terms(constants, slowest, chosen.a, chosen.b, chosen.w_f)
    counts = not (case == 2 and summary.case == 1)
    margin = float(np.min(terms))
    return check_positive(statement, margin, value=chosen.rho, note=note, counts=counts)


def _weighted_inequality(segment: Segment, case: int) -> Line:
    """The differential inequality (W.1), at every step."""
    summary, proof = segment.summary, segment.proof
    statement = Statement(
        f"weighted inequality, case {case}", "(W.1)", WEIGHTED_LEFT[case], "N m rad/s"
    )
    reason = summary.why_not_weighted(case)
    if reason:
        return not_applicable(statement, reason)
    chosen = summary.weights[case]
    V = weighted_lyapunov(proof, chosen.w_f)
    left = _weighted_lyapunov_rate(proof, chosen.w_f) + chosen.rho * V
    if case == 2:
        left = left - chosen.w_f / (2.0 * chosen.b) * np.sum(proof.df**2, axis=1)
    tolerance = summary.eps * (max(1.0, chosen.w_f) * proof.terms + chosen.rho * V)
    note = exclusion_note(summary)
    return check_margins(statement, segment.t, proof.excluded, -left, tolerance, note=note)


def _weighted_lyapunov_rate(proof: Any, w_f: float) -> np.ndarray:
    """V_w' at every step, exact, (T,)."""
    return np.asarray(proof.dV + (w_f - 1.0) * np.sum(proof.f_tilde * proof.df_tilde, axis=1))


def _weighted_envelope(segment: Segment, case: int) -> Line:
    """The envelope of V_w, at every step."""
    summary, proof = segment.summary, segment.proof
    statement = Statement(
        f"weighted envelope, case {case}", "(W.3)", WEIGHTED_ENVELOPE[case], "N m rad"
    )
    reason = summary.why_not_weighted(case)
    if reason:
        return not_applicable(statement, reason)
    envelope = segment.weighted_envelope[case]
    margins = envelope.bound - weighted_lyapunov(proof, summary.weights[case].w_f)
    tolerance, note = envelope.tolerance, exclusion_note(summary)
    return check_margins(statement, segment.t, proof.excluded, margins, tolerance, note=note)


def _weighted_bounds(segment: Segment) -> list[Line]:
    """The bounds on xi, e2 and f_tilde that follow from the envelope of V_w."""
    summary, proof, case = segment.summary, segment.proof, segment.summary.weighted_case
    if case is None:
        reason = summary.why_not_weighted(summary.case)
        return [not_applicable(statement, reason) for statement in WEIGHTED_BOUNDS]
    envelope, w_f = segment.weighted_envelope[case], summary.weights[case].w_f
    sizes = (
        np.abs(proof.xi),
        np.linalg.norm(proof.e2, axis=1),
        np.linalg.norm(proof.f_tilde, axis=1),
    )
    bounds = _bounds_where(segment, envelope.bound, w_f)
    widened = _bounds_where(segment, envelope.bound + envelope.tolerance, w_f)
    note = join_notes(f"Vbar is the envelope of V_w, case {case}", exclusion_note(summary))
    lines = []
    for statement, size, bound, wider in zip(WEIGHTED_BOUNDS, sizes, bounds, widened, strict=True):
        if np.all(np.isnan(bound)) and not np.all(proof.excluded):
            lines.append(not_applicable(statement, NO_BOUND))
            continue
        line = check_margins(
            statement, segment.t, proof.excluded, bound - size, wider - bound, note=note
        )
        lines.append(line)
    return lines


def _bounds_where(
    segment: Segment, V: np.ndarray, w_f: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The bounds on |xi| (T, n), |e2| and |f_tilde| (T,) where V_w <= V."""
    e2 = np.sqrt(2.0 * V / segment.summary.lambda_min)
    return xi_bound_along(segment, V), e2, np.sqrt(2.0 * V / w_f)


# --- the claim of a law about itself -------------------------------------------------------------


def why_not_own(summary: RunSummary) -> str:
    """Why the law's claim about itself does not apply to a run; "" if it does."""
    actuator = summary.run.scenario.actuator
    if not isinstance(actuator, Ideal):
        about = "the law's own claim is about a torque that acts as it is commanded"
        return f"{about}, not about {checks.with_article(type(actuator).__name__)}"
    if summary.excluded == summary.samples:
        return ALWAYS_EXCLUDED
    return summary.invalid


def own_left_side(proof: Any) -> np.ndarray:
    """V' + W - T, which must not be positive, (T,)."""
    return proof.own.dV + proof.own.decay - proof.own.terms


def own_segment_lines(segment: Segment) -> list[Line]:
    """The lines of the law's claim about itself for one segment; none for a law without one."""
    summary, proof, law = segment.summary, segment.proof, segment.summary.claims.own
    if law is None:
        return []
    own = proof.own
    states_terms = optional_member(law, "disturbance_terms") is not None
    right_side = "what the law states" if states_terms else GENERAL_TERMS
    decay = "W >= 0: the decay that the law states"
    inequality = f"V' <= -W + T,  T: {right_side}"
    # Near 0, V and W are differences of numbers as large as their largest values.
    checked = (
        (Statement("own V", "own", "V >= 0", "1"), own.V, np.max(np.abs(own.V))),
        (Statement("own decay", "own", decay, "1/s"), own.decay, np.max(np.abs(own.decay))),
        (Statement(OWN_INEQUALITY, "own", inequality, "1/s"), -own_left_side(proof), own.size),
    )
    reason = why_not_own(summary)
    if reason:
        return [not_applicable(statement, reason) for statement, _, _ in checked]
    note = ""
    if summary.excluded:
        note = (
            f"{summary.excluded} of {summary.samples} samples are excluded: the guard or a torque"
            " limit was active"
        )
    return [
        check_margins(
            statement,
            segment.t,
            proof.excluded,
            margins,
            OWN_ROUNDING * summary.eps * sizes,
            note=note,
        )
        for statement, margins, sizes in checked
    ]
