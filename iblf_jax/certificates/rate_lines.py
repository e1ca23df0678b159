"""The lines of a certificate about constants of a run: gain conditions and rates, of Theorem 2
(and (F.3) for `controllers.FullState`), and of the claim with weights.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from iblf_jax.certificates import claims
from iblf_jax.certificates.claims import CASES, FullClaim
from iblf_jax.certificates.lines import (
    FAILS,
    Line,
    Statement,
    check_positive,
    join_notes,
    not_applicable,
)
from iblf_jax.certificates.run_summary import THEOREM, WEIGHTED, RunSummary

RHO = {1: "(3.19)", 2: "(3.27)"}
FURTHER_TERM = {1: "", 2: " - 1/2"}
"""Further term in the condition (F.3) on kf, by case."""
NOT_NEEDED = (
    "the paper's own envelope of V2 is lost, stability is not: the claim with weights (W.1) does"
    " not need it"
)
CASE_1_COUNTS = "f' = 0 on this run, so case 1 decides"
WEIGHTED_RATE = {
    1: "rho = min(decay of V1, 2 (1 - a) lambda_min(M0^-1 K2), 2 (kf - 1/(4 a K2 w_f))) > 0",
    2: "rho = min(decay of V1, 2 (1 - a) lambda_min(M0^-1 K2), 2 (kf - b/2 - 1/(4 a K2 w_f))) > 0",
}


def rate_lines(summary: RunSummary) -> list[Line]:
    """The gain conditions of Theorem 2, and its rates."""
    lines = _full_gains(summary) if summary.claims.bounds_velocities else _gains(summary)
    for case in CASES:
        lines += [_rate(summary, case, domain) for domain in ("run", "box")]
    return lines


def weighted_rate_lines(summary: RunSummary) -> list[Line]:
    """The rates of the claim with weights; no lines for a loop without the claim."""
    if summary.claims.why_no_weights:
        return []
    return [_weighted_rate(summary, case) for case in CASES]


def _gains(summary: RunSummary) -> list[Line]:
    """The gain conditions (3.17) and (3.25)."""
    constants, case_1 = summary.claims.constants, summary.case == 1
    K2 = Statement("K2", "(3.17)", "lambda_min(K2 - I/2) > 0", "N m s/rad")
    kf_1 = Statement("kf, case 1", "(3.17)", "lambda_min(kf - I/2) > 0", "1/s")
    kf_2 = Statement("kf, case 2", "(3.25)", "lambda_min(kf - I) > 0", "1/s")
    if not isinstance(constants, claims.Claim):
        return [not_applicable(s, summary.claims.why_no_theorem) for s in (K2, kf_1, kf_2)]
    conditions = (
        (K2, constants.K2 - claims.LOWEST_K2, True),
        (kf_1, constants.kf - claims.LOWEST_KF[1], True),
        (kf_2, constants.kf - claims.LOWEST_KF[2], not case_1),
    )
    lines = []
    for statement, above_lowest, counts in conditions:
        margins = np.asarray(above_lowest)
        line = check_positive(
            statement,
            float(margins.min()),
            joint=int(margins.argmin()),
            counts=counts,
            note="" if counts else CASE_1_COUNTS,
        )
        lines.append(_unless_replaced(summary, line))
    return lines


def _full_gains(summary: RunSummary) -> list[Line]:
    """The condition of (F.3) on kf and c, in both cases."""
    constants, lambda_min = summary.claims.constants, summary.lambda_min
    lines = []
    for case in CASES:
        text = f"lambda_min(kf){FURTHER_TERM[case]} - 1/(4 c lambda_min(M0)^2) > 0"
        statement = Statement(f"kf and c, case {case}", "(F.3)", text, "1/s")
        if not isinstance(constants, FullClaim):
            lines.append(not_applicable(statement, summary.claims.why_no_theorem))
            continue
        margin = 0.5 * float(summary.rho_terms[case, "run"][2])
        needed = np.asarray(constants.kf).min() - claims.LOWEST_FULL[case]
        note = f"lambda_min(M0) = {lambda_min:.4g} kg m^2 along the run"
        if margin <= 0 < needed:
            note += f": c > {0.25 / (needed * lambda_min**2):.4g} would do"
        counts = not (case == 2 and summary.case == 1)
        if not counts:
            note = CASE_1_COUNTS
        lines.append(check_positive(statement, margin, counts=counts, note=note))
    return lines


def _rate(summary: RunSummary, case: int, domain: str) -> Line:
    """The rate rho of one case, with the eigenvalues of M0 along the run or over the admissible
    box.
    """
    bounds_velocities = summary.claims.bounds_velocities
    name = f"rho, case {case}" + {"run": "", "box": ", over the box"}[domain]
    equation = RHO[case]
    text = (
        "rho = min(decay of V1, 2 (K2 - 1/2)/lambda_max(M0), 2 (kf -"
        f" {claims.LOWEST_KF[case]:g})) > 0"
    )
    if bounds_velocities:
        equation = "(F.3)"
        text = (
            "rho = min(decay of V1, decay of phi, 2 (kf"
            f"{FURTHER_TERM[case]} - 1/(4 c lambda_min(M0)^2))) > 0"
        )
    statement = Statement(name, equation, text, "1/s")
    reason = summary.claims.why_no_theorem
    if case == 1 and summary.case == 2:
        reason = summary.why_not(THEOREM, 1)
    if reason:
        return not_applicable(statement, reason)
    source: Any = {"run": summary, "box": summary.over_box}[domain]
    least = ["the decay rate of V1", "K2 over lambda_max(M0)", "kf"]
    eigenvalue = f"lambda_max(M0) = {source.lambda_max:.4g} kg m^2"
    if bounds_velocities:
        least = ["the decay rate of V1", "the decay rate of phi", "kf and c"]
        eigenvalue = f"lambda_min(M0) = {source.lambda_min:.4g} kg m^2"
    searched = {"run": "", "box": f" ({summary.over_box.searched})"}[domain]
    line = check_positive(
        statement,
        summary.rho[case, domain],
        value=summary.rho[case, domain],
        note=f"{eigenvalue}{searched}; set by {least[np.argmin(summary.rho_terms[case, domain])]}",
        counts=not (case == 2 and summary.case == 1),
    )
    return _unless_replaced(summary, line)


def _unless_replaced(summary: RunSummary, line: Line) -> Line:
    """A line that only the paper's own envelope needs. Where the claim with weights replaces that
    envelope, the line does not decide the verdict.
    """
    if line.verdict != FAILS or summary.weighted_case is None:
        return line
    counts = line.counts and not summary.weights_replace_theorem
    return dataclasses.replace(line, counts=counts, note=join_notes(NOT_NEEDED, line.note))


def _weighted_rate(summary: RunSummary, case: int) -> Line:
    """The rate of one case, with the chosen numbers."""
    statement = Statement(f"weighted rho, case {case}", "(W.2)", WEIGHTED_RATE[case], "1/s")
    constants, reason = summary.claims.constants, summary.why_not(WEIGHTED, case)
    if reason or not isinstance(constants, claims.Claim):
        return not_applicable(statement, reason)
    chosen, mu = summary.weighted_constants[case], summary.mu
    limits = (np.min(constants.decay), 2.0 * mu, 2.0 * np.min(constants.kf))
    least = ("the decay rate of V1", "K2 over M0", "kf")[int(np.argmin(limits))]
    numbers = f"a = {chosen.a:.4g}, w_f = {chosen.w_f:.4g} rad/(N m)"
    if case == 2:
        numbers += f", b = {chosen.b:.4g} 1/s"
    note = (
        f"chosen for the smallest mean of the envelope: {numbers}; lambda_min(M0^-1 K2) ="
        f" {mu:.4g} 1/s; limited by {least}"
    )
    terms = claims.weighted_rate_terms(constants, mu, chosen.a, chosen.b, chosen.w_f)
    counts = not (case == 2 and summary.case == 1)
    margin = float(np.min(terms))
    return check_positive(statement, margin, value=chosen.rho, note=note, counts=counts)
