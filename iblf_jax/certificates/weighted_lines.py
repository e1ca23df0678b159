"""The lines of a certificate about the claim with weights (`weighted`), stretch by stretch as those
of Theorem 2 (`lines`).
"""

from __future__ import annotations

import numpy as np

from iblf_jax.certificates import claims, weighted
from iblf_jax.certificates.lines import (
    NO_BOUND,
    Description,
    excluded,
    judged,
    positive,
    weighted_case,
    why_not_weighted,
    xi_bound_along,
)
from iblf_jax.certificates.result import NOT_APPLICABLE, Line
from iblf_jax.certificates.trajectory import Trajectory, Whole, level_of

LEFT = {1: "V_w' + rho V_w <= 0", 2: "V_w' + rho V_w - w_f |f'|^2/(2 b) <= 0"}
ENVELOPED = {1: "V_w(t) <= V_w(0) exp(-rho t)", 2: "V_w(t) <= V_w(0) exp(-rho t) + rho2/rho"}
RATE = {
    1: "rho = min(decay of V1, 2 (1 - a) lambda_min(M0^-1 K2), 2 (kf - 1/(4 a K2 w_f))) > 0",
    2: "rho = min(decay of V1, 2 (1 - a) lambda_min(M0^-1 K2), 2 (kf - b/2 - 1/(4 a K2 w_f))) > 0",
}


def rates(whole: Whole) -> list[Line]:
    """The rates of both cases, with the numbers that were chosen."""
    if not weighted.is_stated(whole.run.scenario):
        return []
    lines = []
    for case in claims.CASES:
        description: Description = {
            "name": f"weighted rho, case {case}",
            "equation": "(W.2)",
            "statement": RATE[case],
            "unit": "1/s",
        }
        reason = why_not_weighted(whole, case)
        if reason or not isinstance(whole.claim, claims.Claim):
            lines.append(Line(verdict=NOT_APPLICABLE, note=reason, **description))
            continue
        found = whole.weights[case]
        limits = (np.min(whole.claim.decay), 2.0 * whole.slowest, 2.0 * np.min(whole.claim.kf))
        least = ("the decay rate of V1", "K2 over M0", "kf")[int(np.argmin(limits))]
        chosen = f"a = {found.a:.4g}, w_f = {found.w_f:.4g} rad/(N m)" + (
            f", b = {found.b:.4g} 1/s" if case == 2 else ""
        )
        note = (
            f"chosen for the smallest mean of the envelope: {chosen}; lambda_min(M0^-1 K2) ="
            f" {whole.slowest:.4g} 1/s; limited by {least}"
        )
        margin = float(
            np.min(weighted.rate_terms(whole.claim, whole.slowest, found.a, found.b, found.w_f))
        )
        counts = not (case == 2 and whole.case == 1)
        lines.append(positive(description, margin, value=found.rho, note=note, counts=counts))
    return lines


def of_stretch(trajectory: Trajectory) -> list[Line]:
    """The lines that are about instants, for one stretch."""
    if not weighted.is_stated(trajectory.whole.run.scenario):
        return []
    lines = [_inequality(trajectory, case) for case in claims.CASES]
    return [*lines, *(_envelope(trajectory, case) for case in claims.CASES), *_bounds(trajectory)]


def _inequality(trajectory: Trajectory, case: int) -> Line:
    """The differential inequality (W.1), at every step."""
    whole, proof = trajectory.whole, trajectory.proof
    description: Description = {
        "name": f"weighted inequality, case {case}",
        "equation": "(W.1)",
        "statement": LEFT[case],
        "unit": "N m rad/s",
    }
    reason = why_not_weighted(whole, case)
    if reason:
        return Line(verdict=NOT_APPLICABLE, note=reason, **description)
    found = whole.weights[case]
    V = level_of(trajectory, found.w_f).V
    left = rate_of(trajectory, found.w_f) + found.rho * V
    if case == 2:
        left = left - found.w_f / (2.0 * found.b) * np.sum(proof.df**2, axis=1)
    tolerance = whole.eps * (max(1.0, found.w_f) * proof.terms + found.rho * V)
    return judged(trajectory, -left, tolerance, {**description, "note": excluded(whole)})


def rate_of(trajectory: Trajectory, w_f: float) -> np.ndarray:
    """V_w' at every step, exact, (T,)."""
    proof = trajectory.proof
    return np.asarray(proof.dV + (w_f - 1.0) * np.sum(proof.f_tilde * proof.df_tilde, axis=1))


def _envelope(trajectory: Trajectory, case: int) -> Line:
    """The envelope of V_w, at every step."""
    whole = trajectory.whole
    description: Description = {
        "name": f"weighted envelope, case {case}",
        "equation": "(W.3)",
        "statement": ENVELOPED[case],
        "unit": "N m rad",
    }
    reason = why_not_weighted(whole, case)
    if reason:
        return Line(verdict=NOT_APPLICABLE, note=reason, **description)
    upper, V = trajectory.weighted[case], level_of(trajectory, whole.weights[case].w_f).V
    return judged(
        trajectory, upper.bound - V, upper.tolerance, {**description, "note": excluded(whole)}
    )


def _bounds(trajectory: Trajectory) -> list[Line]:
    """The bounds on xi, e2 and f_tilde that follow from the envelope of V_w."""
    whole, proof = trajectory.whole, trajectory.proof
    descriptions: list[Description] = [
        {
            "name": "weighted xi",
            "statement": (
                "w_i V1_i <= Vbar: |xi_i| <= sqrt(1 - exp(-Vbar/w_i)), or as the barrier says"
            ),
        },
        {
            "name": "weighted e2",
            "statement": "|e2| <= sqrt(2 Vbar/lambda_min(M0))",
            "unit": "rad/s",
        },
        {"name": "weighted f_tilde", "statement": "|f_tilde| <= sqrt(2 Vbar/w_f)", "unit": "N m"},
    ]
    case = weighted_case(whole)
    if case is None:
        reason = why_not_weighted(whole, whole.case)
        return [
            Line(equation="(W.3)", verdict=NOT_APPLICABLE, note=reason, **description)
            for description in descriptions
        ]
    upper, w_f = trajectory.weighted[case], whole.weights[case].w_f
    sizes = (
        np.abs(proof.xi),
        np.linalg.norm(proof.e2, axis=1),
        np.linalg.norm(proof.f_tilde, axis=1),
    )
    tight, wide = (
        _limits(trajectory, V, w_f) for V in (upper.bound, upper.bound + upper.tolerance)
    )
    note = "; ".join(x for x in (f"Vbar is the envelope of V_w, case {case}", excluded(whole)) if x)
    lines = []
    for description, size, low, high in zip(descriptions, sizes, tight, wide, strict=True):
        if np.all(np.isnan(low)) and not np.all(proof.held):
            lines.append(
                Line(equation="(W.3)", verdict=NOT_APPLICABLE, note=NO_BOUND, **description)
            )
            continue
        lines.append(
            judged(
                trajectory,
                low - size,
                high - low,
                {**description, "equation": "(W.3)", "note": note},
            )
        )
    return lines


def _limits(
    trajectory: Trajectory, V: np.ndarray, w_f: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The bounds on |xi| (T, n), |e2| and |f_tilde| (T,) where V_w <= V."""
    by_e2 = np.sqrt(2.0 * V / trajectory.whole.lambda_min)
    return xi_bound_along(trajectory, V), by_e2, np.sqrt(2.0 * V / w_f)
