"""The lines of a certificate about a claimed decay at every step: the differential inequality, the
envelope that follows by integration, and the bounds on xi, e2 and f_tilde inside it.

The claim with weights has the same lines as Theorem 2, with V_w in place of V2 (`claims`).
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from iblf_jax.certificates.claims import CASES
from iblf_jax.certificates.lines import (
    Line,
    Statement,
    check_margins,
    join_notes,
    not_applicable,
)
from iblf_jax.certificates.reconstruction import padded_index
from iblf_jax.certificates.run_summary import (
    THEOREM,
    WEIGHTED,
    RunSummary,
    Segment,
    weighted_lyapunov,
)
from iblf_jax.core import programs
from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation.scenario import Scenario

INEQUALITIES = {
    (THEOREM, 1): Statement("inequality, case 1", "(3.18)", "V2' + rho V2 <= 0", "1/s"),
    (THEOREM, 2): Statement("inequality, case 2", "(3.26)", "V2' + rho V2 - |f'|^2/2 <= 0", "1/s"),
    (WEIGHTED, 1): Statement(
        "weighted inequality, case 1", "(W.1)", "V_w' + rho V_w <= 0", "N m rad/s"
    ),
    (WEIGHTED, 2): Statement(
        "weighted inequality, case 2",
        "(W.1)",
        "V_w' + rho V_w - w_f |f'|^2/(2 b) <= 0",
        "N m rad/s",
    ),
}
ENVELOPES = {
    (THEOREM, 1): Statement("envelope, case 1", "(3.20)", "V2(t) <= V2(0) exp(-rho t)"),
    (THEOREM, 2): Statement("envelope, case 2", "(3.28)", "V2(t) <= V2(0) exp(-rho t) + rho2/rho"),
    (WEIGHTED, 1): Statement(
        "weighted envelope, case 1", "(W.3)", "V_w(t) <= V_w(0) exp(-rho t)", "N m rad"
    ),
    (WEIGHTED, 2): Statement(
        "weighted envelope, case 2", "(W.3)", "V_w(t) <= V_w(0) exp(-rho t) + rho2/rho", "N m rad"
    ),
}
XI_BOUND = {1: "(3.22)", 2: "(3.30)"}
BOUNDS = {1: "(3.23)", 2: "(3.31)"}
WEIGHTED_BOUNDS = {
    "xi, by V1": Statement(
        "weighted xi",
        "(W.3)",
        "w_i V1_i <= Vbar: |xi_i| <= sqrt(1 - exp(-Vbar/w_i)), or as the barrier says",
    ),
    "e2": Statement("weighted e2", "(W.3)", "|e2| <= sqrt(2 Vbar/lambda_min(M0))", "rad/s"),
    "f_tilde": Statement("weighted f_tilde", "(W.3)", "|f_tilde| <= sqrt(2 Vbar/w_f)", "N m"),
}
NO_BOUND = "the barrier states no bound on xi from V1"


def decay_lines(segment: Segment, kind: str) -> list[Line]:
    """The lines about a claim of a kind, THEOREM or WEIGHTED, at every step of one segment."""
    lines = [_inequality(segment, kind, case) for case in CASES]
    lines += [_envelope(segment, kind, case) for case in CASES]
    return lines + _bounds(segment, kind)


def check_steps(
    segment: Segment,
    statement: Statement,
    margins: np.ndarray,
    tolerances: np.ndarray | float,
    **fields: Any,
) -> Line:
    """`check_margins` at the steps of a segment."""
    return check_margins(
        statement, segment.t, segment.proof.excluded, margins, tolerances, **fields
    )


def left_side(segment: Segment, kind: str, case: int) -> np.ndarray:
    """The left side of the differential inequality at every step, (T,)."""
    proof, decay = segment.proof, segment.summary.decays[kind, case]
    rate = proof.dV
    if decay.w_f != 1.0:
        rate = rate + (decay.w_f - 1.0) * np.sum(proof.f_tilde * proof.df_tilde, axis=1)
    left = rate + decay.rho * weighted_lyapunov(proof, decay.w_f)
    if case == 2:
        left = left - decay.gain * np.sum(proof.df**2, axis=1)
    return left


def _inequality(segment: Segment, kind: str, case: int) -> Line:
    """The differential inequality, at every step."""
    summary, proof, statement = segment.summary, segment.proof, INEQUALITIES[kind, case]
    reason = summary.why_not(kind, case)
    if reason:
        return not_applicable(statement, reason)
    decay = summary.decays[kind, case]
    size = max(1.0, decay.w_f) * proof.dV_size + decay.rho * weighted_lyapunov(proof, decay.w_f)
    margins, note = -left_side(segment, kind, case), summary.exclusion_note
    return check_steps(segment, statement, margins, summary.eps * size, note=note)


def _envelope(segment: Segment, kind: str, case: int) -> Line:
    """The envelope of the Lyapunov function, at every step."""
    summary, statement = segment.summary, ENVELOPES[kind, case]
    reason = summary.why_not(kind, case)
    if reason:
        return not_applicable(statement, reason)
    bound, tolerance = segment.envelopes[kind, case]
    V = weighted_lyapunov(segment.proof, summary.decays[kind, case].w_f)
    return check_steps(segment, statement, bound - V, tolerance, note=summary.exclusion_note)


# --- the bounds on xi, e2 and f_tilde ------------------------------------------------------------


def _bounds(segment: Segment, kind: str) -> list[Line]:
    """The bounds on xi, e2 and f_tilde that follow from the envelope of the case that applies."""
    summary, proof = segment.summary, segment.proof
    case = summary.applicable_case(kind)
    statements, about = _bound_statements(summary), ""
    if kind == WEIGHTED:
        statements, about = WEIGHTED_BOUNDS, "V_w, "
    if case is None:
        reason = summary.why_not(kind, summary.case)
        return [not_applicable(statement, reason) for statement in statements.values()]
    envelope, w_f = segment.envelopes[kind, case], summary.decays[kind, case].w_f
    bounds = bounds_along(segment, envelope.bound, w_f)
    widened = bounds_along(segment, envelope.bound + envelope.tolerance, w_f)
    sizes = {
        "xi, by V1": np.abs(proof.xi),
        "xi": np.abs(proof.xi),
        "e2": np.linalg.norm(proof.e2, axis=1),
        "f_tilde": np.linalg.norm(proof.f_tilde, axis=1),
    }
    if summary.claims.bounds_velocities:
        sizes["xi2, by phi"] = np.abs(proof.full.xi2)
    note = join_notes(f"Vbar is the envelope of {about}case {case}", summary.exclusion_note)
    lines = []
    for name, statement in statements.items():
        reason = _why_no_bound(segment, name, bounds)
        if reason:
            lines.append(not_applicable(statement, reason))
            continue
        margins, tolerances = bounds[name] - sizes[name], widened[name] - bounds[name]
        lines.append(check_steps(segment, statement, margins, tolerances, note=note))
    return lines


def _bound_statements(summary: RunSummary) -> dict[str, Statement]:
    """The bounds of Theorem 2, or of (F.3), by name."""
    case = summary.theorem_case or summary.case
    by_barrier = "V1 <= Vbar: |xi_i| <= sqrt(1 - exp(-Vbar/w_i)), or as the barrier says"
    velocity = Statement("e2", BOUNDS[case], "|e2| <= sqrt(2 Vbar/lambda_min(M0))", "rad/s")
    if summary.claims.bounds_velocities:
        text = "phi <= Vbar: |xi2_i| as the velocity barrier says"
        velocity = Statement("xi2, by phi", "(F.3)", text)
    statements = (
        Statement("xi, by V1", XI_BOUND[case], by_barrier),
        Statement("xi", BOUNDS[case], "|xi_i| <= sqrt(2 Vbar/w_i)"),
        velocity,
        Statement("f_tilde", BOUNDS[case], "|f_tilde| <= sqrt(2 Vbar)", "N m"),
    )
    return {statement.name: statement for statement in statements}


def bounds_along(segment: Segment, V: np.ndarray, w_f: float = 1.0) -> dict[str, np.ndarray]:
    """The bounds on |xi| (by the barrier, and by (3.23)), |e2| and |f_tilde| where V_w <= V; (T, n)
    for xi, else (T,).
    """
    law = segment.summary.claims.law
    found: dict[str, np.ndarray] = {}
    if segment.summary.claims.bounds_velocities:
        xi2 = _along(segment, _xi2_bound, V, segment.sample.q, segment.sample.dq)
        found["e2"] = np.linalg.norm(xi2 * segment.proof.full.bound, axis=1)
        found["xi2, by phi"] = xi2
    else:
        found["e2"] = np.sqrt(2 * V / segment.summary.lambda_min)
    found["xi, by V1"] = _along(segment, xi_bound, V)
    found["xi"] = np.sqrt(2 * V[:, None] / np.asarray(law.weight))
    found["f_tilde"] = np.sqrt(2 * V / w_f)
    return found


def _why_no_bound(segment: Segment, name: str, bounds: dict[str, np.ndarray]) -> str:
    """Why a bound does not follow from the envelope, "" if it does.

    The bound on xi by V2 needs xi^2/2 <= V1 (Theorem 1), which holds where the barrier's own bound
    is smaller.
    """
    if name.startswith("xi") and not np.all(segment.proof.excluded):
        by_barrier, by_V2 = bounds["xi, by V1"], bounds["xi"]
        if np.all(np.isnan(by_barrier)):
            return NO_BOUND
        stronger = by_barrier <= by_V2 * (1 + 1e-9)
        if name == "xi" and not np.all(stronger | np.isnan(by_V2)):
            return "xi^2/2 <= V1 (Theorem 1) does not hold for this barrier"
    if name == "xi2, by phi" and np.all(np.isnan(bounds[name])):
        return "the velocity barrier states no bound on xi2 from phi"
    return ""


@programs.jit
def xi_bound(scenario: Scenario, t: jax.Array, V: jax.Array) -> jax.Array | None:
    """The barrier's own bound on |xi_i| where w_i V1_i <= V, (T, n), or None if it states none."""
    law: Any = unwrapped(scenario.controller)
    stated = law.barrier.xi_bound
    if stated is None:
        return None
    return jax.vmap(lambda t, V: stated(V / law.weight, scenario.context.tube(t)))(t, V)


def _along(segment: Segment, bound: Any, V: np.ndarray, *signals: np.ndarray) -> np.ndarray:
    """A bound along a segment, (T, n), computed in blocks of one size; NaN if none is stated."""
    index = padded_index(V.size)
    arguments = (segment.t, *signals, V.astype(segment.t.dtype))
    found = bound(segment.summary.run.scenario, *(x[index] for x in arguments))
    if found is None:
        return np.full(segment.sample.q.shape, np.nan)
    return np.asarray(found)[: V.size]


@programs.jit
def _xi2_bound(
    scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array, V: jax.Array
) -> jax.Array | None:
    """The velocity barrier's own bound on |xi2| where phi <= V, (T, n), or None if it states
    none.
    """
    law: Any = unwrapped(scenario.controller)
    stated = law.velocity_barrier.xi_bound
    if stated is None:
        return None

    def at(t, q, dq, V):
        _, inner = law.tubes(t, q, dq, scenario.context)
        return stated(V, inner)

    return jax.vmap(at)(t, q, dq, V)
