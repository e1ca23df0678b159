"""The lines of a certificate about Theorem 2 (and (F.1)-(F.3) for `controllers.FullState`).

`run_lines` has the gain conditions and rates, which are about a whole run. `segment_lines` has the
assumptions, the differential inequality, which is checked at every step, and what follows from it
by integration: the envelope of V2 and the bounds on xi, e2 and f_tilde. For readings with a gap in
their proof, the dropped terms are measured beside the margin that the proof leaves for them.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates import claims
from iblf_jax.certificates.claims import CASES, FullClaim
from iblf_jax.certificates.lines import (
    FAILS,
    NOT_APPLICABLE,
    OBSERVED_ONLY,
    Line,
    Statement,
    check_margins,
    check_positive,
    check_smallest,
    join_notes,
    not_applicable,
    verdict_of,
)
from iblf_jax.certificates.optional import optional_member
from iblf_jax.certificates.reconstruction import padded_index
from iblf_jax.certificates.run_summary import RunSummary, Segment
from iblf_jax.control.observers import Momentum
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import Status
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import has

RHO = {1: "(3.19)", 2: "(3.27)"}
INEQUALITY = {1: "(3.18)", 2: "(3.26)"}
ENVELOPE = {1: "(3.20)", 2: "(3.28)"}
XI_BOUND = {1: "(3.22)", 2: "(3.30)"}
BOUNDS = {1: "(3.23)", 2: "(3.31)"}
DECAY_STATEMENT = {1: "V2' + rho V2 <= 0", 2: "V2' + rho V2 - |f'|^2/2 <= 0"}
ENVELOPE_STATEMENT = {1: "V2(t) <= V2(0) exp(-rho t)", 2: "V2(t) <= V2(0) exp(-rho t) + rho2/rho"}
FURTHER_TERM = {1: "", 2: " - 1/2"}
"""Further term in the condition (F.3) on kf, by case."""

NO_BOUND = "the barrier states no bound on xi from V1"
NOT_NEEDED = (
    "the paper's own envelope of V2 is lost, stability is not: the claim with weights (W.1) does"
    " not need it"
)
CASE_1_COUNTS = "f' = 0 on this run, so case 1 decides"

BOUNDED = Statement("f bounded", "Assumption 1", "|f| <= F_m", "N m")
RATE_BOUNDED = Statement("f' bounded", "Assumption 1", "|f'| <= F_d between jumps", "N m/s")
REFERENCE_INSIDE = Statement("reference inside", "Assumption 2", "k_lc < x_d < k_uc", "rad")
START_INSIDE = Statement("start inside", "Theorem 2", "k_lc(0) < q(0) < k_uc(0)", "rad")
ALPHA_INSIDE = Statement("alpha inside", "(F.1)", "v_l < alpha < v_u", "rad/s")
START_SPEED_INSIDE = Statement("start speed inside", "(F.1)", "v_l(0) < q'(0) < v_u(0)", "rad/s")
ASSUMPTIONS = tuple(
    statement.name
    for statement in (
        BOUNDED,
        RATE_BOUNDED,
        REFERENCE_INSIDE,
        START_INSIDE,
        ALPHA_INSIDE,
        START_SPEED_INSIDE,
    )
)
"""Names of the lines that a certificate shows before those of the gains."""


def run_lines(summary: RunSummary) -> list[Line]:
    """The lines about constants of a run: gain conditions and rates."""
    lines = _full_gains(summary) if summary.claims.bounds_velocities else _gains(summary)
    for case in CASES:
        lines += [_rate(summary, case, domain) for domain in ("run", "box")]
    return lines


def segment_lines(segment: Segment) -> tuple[list[Line], dict[str, float]]:
    """The lines about every step of one segment, and the largest share that each dropped term has
    of its margin there.
    """
    bounds_velocities = segment.summary.claims.bounds_velocities
    lines = _assumptions(segment)
    if bounds_velocities:
        lines += [*_velocity_assumptions(segment), _barriers_inequality(segment)]
    lines += [_inequality(segment, case) for case in CASES]
    lines += [_envelope(segment, case) for case in CASES]
    lines += _bounds(segment)
    dropped, shares = _dropped_terms(segment)
    lines += [*dropped, _joints_inside(segment)]
    if bounds_velocities:
        lines.append(_velocities_inside(segment))
    return lines, shares


def exclusion_note(summary: RunSummary) -> str:
    """Which samples the claims exclude, and where they start again, in words."""
    excluded = ""
    if summary.excluded:
        why = "the guard or a torque limit was active"
        if summary.claims.bounds_velocities:
            why = "alpha was outside, or the guard or a torque limit active"
        excluded = f"{summary.excluded} of {summary.samples} samples are excluded: {why}"
    restarts = ""
    if summary.jumps.size:
        times = ", ".join(f"{x:.4g}" for x in summary.jumps)
        restarts = f"f jumps at t = {times} s, and the claim starts again there"
    return join_notes(excluded, restarts)


def _check_steps(
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


# --- assumptions ---------------------------------------------------------------------------------


def _assumptions(segment: Segment) -> list[Line]:
    """Bounds of Assumption 1 along the run, and feasibility of the reference, Assumption 2."""
    summary, sample, proof = segment.summary, segment.sample, segment.proof
    speed = np.linalg.norm(proof.df, axis=1)
    if summary.case == 1:
        speed = 0.0 * speed
    jumps = ""
    if summary.jumps.size:
        jumps = f"Assumption 1 is broken by a jump of f: {exclusion_note(summary)}"
    room = np.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
    reference = check_smallest(REFERENCE_INSIDE, segment.t, room)
    if not has(summary.run, "slack"):
        # The status of a safety filter says nothing about this: the filter keeps its bounds
        # wherever the reference is, but the theorem needs it inside.
        reference = _with_status(summary, reference, Status.INFEASIBLE_REFERENCE)
    lines = [
        _finite(BOUNDED, segment.t, np.linalg.norm(proof.f, axis=1)),
        _finite(RATE_BOUNDED, segment.t, speed, jumps),
        reference,
    ]
    if segment.t[0] == 0:
        start = np.minimum(sample.q - sample.lower, sample.upper - sample.q)[:1]
        lines.append(check_smallest(START_INSIDE, segment.t, start))
    return lines


def _finite(statement: Statement, t: np.ndarray, values: np.ndarray, note: str = "") -> Line:
    """The line of a quantity that must be finite at every step, with its largest value."""
    at = int(np.argmax(np.nan_to_num(values, nan=np.inf)))
    verdict = verdict_of(bool(np.all(np.isfinite(values))))
    return statement.line(verdict, value=float(values[at]), time=float(t[at]), note=note)


def _velocity_assumptions(segment: Segment) -> list[Line]:
    """The assumptions on the virtual velocity and on the velocity at the start."""
    sample = segment.sample
    alpha = check_smallest(ALPHA_INSIDE, segment.t, segment.proof.full.room)
    lines = [_with_status(segment.summary, alpha, Status.ALPHA_INFEASIBLE)]
    if segment.t[0] == 0:
        start = np.minimum(sample.dq - sample.dq_lower, sample.dq_upper - sample.dq)[:1]
        lines.append(check_smallest(START_SPEED_INSIDE, segment.t, start))
    return lines


def _with_status(summary: RunSummary, line: Line, flag: Status) -> Line:
    """A line about something that the run's status reports, too: the verdict is that of the status,
    which covers every step of the run itself.
    """
    verdict = verdict_of(not int(summary.run.status) & int(flag))
    if verdict == line.verdict:
        return line
    return dataclasses.replace(
        line, verdict=verdict, note="the verdict is that of the run's own status"
    )


# --- gains and rates -----------------------------------------------------------------------------


def _gains(summary: RunSummary) -> list[Line]:
    """The gain conditions (3.17) and (3.25)."""
    constants, case_1 = summary.claims.constants, summary.case == 1
    K2 = Statement("K2", "(3.17)", "lambda_min(K2 - I/2) > 0", "N m s/rad")
    kf_1 = Statement("kf, case 1", "(3.17)", "lambda_min(kf - I/2) > 0", "1/s")
    kf_2 = Statement("kf, case 2", "(3.25)", "lambda_min(kf - I) > 0", "1/s")
    if not isinstance(constants, claims.Claim):
        return [not_applicable(s, summary.claims.no_theorem) for s in (K2, kf_1, kf_2)]
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
            lines.append(not_applicable(statement, summary.claims.no_theorem))
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
    full = summary.claims.bounds_velocities
    name = f"rho, case {case}" + {"run": "", "box": ", over the box"}[domain]
    equation = RHO[case]
    text = (
        "rho = min(decay of V1, 2 (K2 - 1/2)/lambda_max(M0), 2 (kf -"
        f" {claims.LOWEST_KF[case]:g})) > 0"
    )
    if full:
        equation = "(F.3)"
        text = (
            "rho = min(decay of V1, decay of phi, 2 (kf"
            f"{FURTHER_TERM[case]} - 1/(4 c lambda_min(M0)^2))) > 0"
        )
    statement = Statement(name, equation, text, "1/s")
    reason = summary.claims.no_theorem
    if case == 1 and summary.case == 2:
        reason = summary.why_not_theorem(1)
    if reason:
        return not_applicable(statement, reason)
    source: Any = {"run": summary, "box": summary.over_box}[domain]
    least = ["the decay rate of V1", "K2 over lambda_max(M0)", "kf"]
    eigenvalue = f"lambda_max(M0) = {source.lambda_max:.4g} kg m^2"
    if full:
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


# --- the differential inequality and the envelope ------------------------------------------------


def left_side(segment: Segment, case: int) -> np.ndarray:
    """The left side of the differential inequality at every step, (T,) [1/s]."""
    proof = segment.proof
    left = proof.dV + segment.summary.rho[case, "run"] * proof.V
    if case == 2:
        left = left - 0.5 * np.sum(proof.df**2, axis=1)
    return left


def _inequality(segment: Segment, case: int) -> Line:
    """The differential inequality, at every step."""
    summary, proof = segment.summary, segment.proof
    statement = Statement(
        f"inequality, case {case}", INEQUALITY[case], DECAY_STATEMENT[case], "1/s"
    )
    reason = summary.why_not_theorem(case)
    if reason:
        return not_applicable(statement, reason)
    tolerance = summary.eps * (proof.terms + summary.rho[case, "run"] * proof.V)
    margins = -left_side(segment, case)
    return _check_steps(segment, statement, margins, tolerance, note=exclusion_note(summary))


def _barriers_inequality(segment: Segment) -> Line:
    """The inequality of the two barriers, at every step, for any kf and c."""
    summary, proof = segment.summary, segment.proof
    text = "(V1 + phi)' + decay of V1 and phi - s2 . M0^-1 f_tilde + c |s2|^2 <= 0"
    statement = Statement("barriers", "(F.2)", text, "1/s")
    reason = summary.claims.no_theorem or summary.invalid
    if reason:
        return not_applicable(statement, reason)
    tolerance, note = summary.eps * proof.terms, exclusion_note(summary)
    return _check_steps(segment, statement, -proof.full.left, tolerance, note=note)


def _envelope(segment: Segment, case: int) -> Line:
    """The envelope of V2, at every step."""
    statement = Statement(f"envelope, case {case}", ENVELOPE[case], ENVELOPE_STATEMENT[case])
    reason = segment.summary.why_not_theorem(case)
    if reason:
        return not_applicable(statement, reason)
    envelope, note = segment.envelope[case], exclusion_note(segment.summary)
    margins = envelope.bound - segment.proof.V
    return _check_steps(segment, statement, margins, envelope.tolerance, note=note)


# --- the bounds on xi, e2 and f_tilde ------------------------------------------------------------


@jax.jit
def _xi_bound(scenario: Scenario, t: jax.Array, V: jax.Array) -> jax.Array | None:
    """The barrier's own bound on |xi_i| where w_i V1_i <= V, (T, n), or None if it states none."""
    law: Any = unwrapped(scenario.controller)
    stated = optional_member(law.barrier, "xi_bound")
    if stated is None:
        return None
    return jax.vmap(lambda t, V: stated(V / law.weight, scenario.context.tube(t)))(t, V)


def xi_bound_along(segment: Segment, V: np.ndarray) -> np.ndarray:
    """The barrier's bound on |xi_i| where w_i V1_i <= V, (T, n); NaN if it states none."""
    t, index = segment.t, padded_index(V.size)
    levels = jnp.asarray(V[index], t.dtype)
    found = _xi_bound(segment.summary.run.scenario, t[index], levels)
    if found is None:
        return np.full(segment.sample.q.shape, np.nan)
    return np.asarray(found)[: V.size]


@jax.jit
def _xi2_bound(
    scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array, V: jax.Array
) -> jax.Array | None:
    """The velocity barrier's own bound on |xi2| where phi <= V, (T, n), or None if it states
    none.
    """
    law: Any = unwrapped(scenario.controller)
    stated = optional_member(law.velocity_barrier, "xi_bound")
    if stated is None:
        return None

    def at(t, q, dq, V):
        _, inner = law.tubes(t, q, dq, scenario.context)
        return stated(V, inner)

    return jax.vmap(at)(t, q, dq, V)


def _xi2_bound_along(segment: Segment, V: np.ndarray) -> np.ndarray:
    """The velocity barrier's bound on |xi2| where phi <= V, (T, n); NaN if it states none."""
    t, sample, index = segment.t, segment.sample, padded_index(V.size)
    levels = jnp.asarray(V[index], t.dtype)
    scenario = segment.summary.run.scenario
    found = _xi2_bound(scenario, t[index], sample.q[index], sample.dq[index], levels)
    if found is None:
        return np.full(sample.q.shape, np.nan)
    return np.asarray(found)[: V.size]


def bounds_along(segment: Segment, V: np.ndarray) -> dict[str, np.ndarray]:
    """The bounds on |xi| (by the barrier, and by (3.23)), |e2| and |f_tilde| where V2 <= V; (T, n)
    for xi, else (T,).
    """
    law = segment.summary.claims.law
    found: dict[str, np.ndarray] = {}
    if segment.summary.claims.bounds_velocities:
        xi2 = _xi2_bound_along(segment, V)
        found["e2"] = np.linalg.norm(xi2 * segment.proof.full.bound, axis=1)
        found["xi2, by phi"] = xi2
    else:
        found["e2"] = np.sqrt(2 * V / segment.summary.lambda_min)
    found["xi, by V1"] = xi_bound_along(segment, V)
    found["xi"] = np.sqrt(2 * V[:, None] / np.asarray(law.weight))
    found["f_tilde"] = np.sqrt(2 * V)
    return found


def _bound_statements(summary: RunSummary) -> list[Statement]:
    """The bounds that follow from the envelope of the case that applies."""
    case = summary.theorem_case or summary.case
    by_barrier = "V1 <= Vbar: |xi_i| <= sqrt(1 - exp(-Vbar/w_i)), or as the barrier says"
    velocity = Statement("e2", BOUNDS[case], "|e2| <= sqrt(2 Vbar/lambda_min(M0))", "rad/s")
    if summary.claims.bounds_velocities:
        text = "phi <= Vbar: |xi2_i| as the velocity barrier says"
        velocity = Statement("xi2, by phi", "(F.3)", text)
    return [
        Statement("xi, by V1", XI_BOUND[case], by_barrier),
        Statement("xi", BOUNDS[case], "|xi_i| <= sqrt(2 Vbar/w_i)"),
        velocity,
        Statement("f_tilde", BOUNDS[case], "|f_tilde| <= sqrt(2 Vbar)", "N m"),
    ]


def _bounds(segment: Segment) -> list[Line]:
    """The bounds on xi, e2 and f_tilde that follow from the envelope of the case that applies."""
    summary, proof = segment.summary, segment.proof
    statements, case = _bound_statements(summary), summary.theorem_case
    if case is None:
        reason = summary.why_not_theorem(summary.case)
        return [not_applicable(statement, reason) for statement in statements]
    envelope = segment.envelope[case]
    bounds = bounds_along(segment, envelope.bound)
    widened = bounds_along(segment, envelope.bound + envelope.tolerance)
    sizes = {
        "xi, by V1": np.abs(proof.xi),
        "xi": np.abs(proof.xi),
        "e2": np.linalg.norm(proof.e2, axis=1),
        "f_tilde": np.linalg.norm(proof.f_tilde, axis=1),
    }
    if summary.claims.bounds_velocities:
        sizes["xi2, by phi"] = np.abs(proof.full.xi2)
    note = join_notes(f"Vbar is the envelope of case {case}", exclusion_note(summary))
    lines = []
    for statement in statements:
        name = statement.name
        reason = _why_no_bound(segment, name, bounds)
        if reason:
            lines.append(not_applicable(statement, reason))
            continue
        margins, tolerances = bounds[name] - sizes[name], widened[name] - bounds[name]
        lines.append(_check_steps(segment, statement, margins, tolerances, note=note))
    return lines


def _why_no_bound(segment: Segment, name: str, bounds: dict[str, np.ndarray]) -> str:
    """Why a bound does not follow from the envelope, "" if it does.

    The bound on xi by V2 needs xi^2/2 <= V1 (Theorem 1), which holds where the barrier's own bound
    is the stronger one.
    """
    if name.startswith("xi") and not np.all(segment.proof.excluded):
        by_barrier, by_V2 = bounds["xi, by V1"], bounds["xi"]
        if np.all(np.isnan(by_barrier)):
            return NO_BOUND
        stronger = by_barrier <= by_V2 * (1 + 1e-9)
        if name == "xi" and not np.all(stronger | np.isnan(by_V2)):
            return "xi^2/2 <= V1 (Theorem 1) is not so for this barrier"
    if name == "xi2, by phi" and np.all(np.isnan(bounds[name])):
        return "the velocity barrier states no bound on xi2 from phi"
    return ""


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
    unclaimed = summary.claims.no_theorem or summary.invalid
    why_no_case = summary.why_not_theorem(case or summary.case)
    terms = (
        (by_law, proof.dropped_e2, _why_law_is_exact(summary)),
        (by_observer, proof.dropped_f, _why_observer_is_exact(summary)),
    )
    lines: list[Line] = []
    shares: dict[str, float] = {}
    for statement, term, exact in terms:
        reason = unclaimed or exact or why_no_case
        if reason or case is None:
            lines.append(not_applicable(statement, reason, counts=False))
            continue
        margin = proof.dropped_e2 + proof.dropped_f - left_side(segment, case)
        tolerance = summary.eps * proof.terms
        included = ~proof.excluded
        share = np.where(included, term / np.maximum(margin, tolerance), 0.0)
        shares[statement.name] = float(np.max(share))
        largest = float(np.max(np.abs(term[included]), initial=0.0))
        line = _check_steps(
            segment, statement, margin - term, tolerance, value=largest, counts=False
        )
        lines.append(line)
    return lines, shares


def _why_law_is_exact(summary: RunSummary) -> str:
    """Why the proof drops no term of the law; "" if it drops one."""
    if summary.claims.bounds_velocities:
        return "the claim is exact: C0 q' is cancelled, and e2 weighed without M0"
    if optional_member(summary.claims.law, "reading") == "corrected":
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
    line = _with_status(summary, line, Status.BOUND_VIOLATED)
    case = summary.theorem_case
    if case is None and summary.weights_replace_theorem:
        case = summary.weighted_case
    if case is None:
        return _observed_only(line, summary.why_not_theorem(summary.case))
    scenario, first = summary.run.scenario, segment.proof.V[:1]
    if _xi_bound(scenario, segment.t[:1], first) is None:
        return _observed_only(line, NO_BOUND)
    return line


def _velocities_inside(segment: Segment) -> Line:
    """Every velocity inside its bounds, at every step."""
    summary, sample = segment.summary, segment.sample
    statement = Statement("velocities inside", "(F.3)", "v_l < q' < v_u", "rad/s")
    room = np.minimum(sample.dq - sample.dq_lower, sample.dq_upper - sample.dq)
    line = check_smallest(statement, segment.t, room)
    line = _with_status(summary, line, Status.VELOCITY_VIOLATED)
    if summary.theorem_case is None:
        return _observed_only(line, summary.why_not_theorem(summary.case))
    return line


def _observed_only(line: Line, reason: str) -> Line:
    """A line that no claim covers."""
    return dataclasses.replace(line, verdict=NOT_APPLICABLE, note=f"{OBSERVED_ONLY}{reason})")
