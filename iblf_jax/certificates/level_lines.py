"""The lines of a certificate about a plant in strict-feedback form: assumptions, the inequality
(S.3) with the true d_tilde, the decay that follows from it, and the bounds inside it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from iblf_jax.certificates.auxiliary import covers_limit
from iblf_jax.certificates.decay_lines import check_steps
from iblf_jax.certificates.level_summary import LEVELS, LevelSummary, growth_along
from iblf_jax.certificates.lines import (
    Line,
    Statement,
    check_positive,
    check_smallest,
    join_notes,
    not_applicable,
    verdict_of,
)
from iblf_jax.certificates.run_summary import Segment
from iblf_jax.certificates.theorem_lines import (
    REFERENCE_INSIDE,
    finite,
    observed_only,
    with_status,
)
from iblf_jax.control.observers import NoObserver
from iblf_jax.core import checks
from iblf_jax.core.status import Status
from iblf_jax.core.units import Unit, of_component, per_second
from iblf_jax.world import plants
from iblf_jax.world.bounds import Tube
from iblf_jax.world.plants._base import Units

LEVEL_ROUNDING = 16.0
"""Error of V' in units of the last place, relative to the sizes of its terms, over that of Theorem
2; the largest that tests found is 1."""
INEQUALITY = Statement(
    "inequality, levels",
    "(S.3)",
    "V' <= -sum w_i decay_i - sum c_i w_i |s_i|^2 + T,  T = dV/dx . d_tilde + dV/dd_hat . d_hat'",
    "1/s",
)
SURFACE_INEQUALITY = Statement(
    "inequality, levels",
    "(S.3)",
    "V' <= -sum w_i decay_i - sum c_i w_i |s_i|^2 + sum w_i s_i . (d_tilde_i + G_i (beta_i -"
    " alpha_i))",
    "1/s",
)
EQUALITY = Statement("equality", "(S.3)", "both sides of (S.3) are equal", "1/s")
ESTIMATE = Statement("estimate", "(S.3)", "d_hat' = kappa d_tilde")
TERMS = Statement("observer terms", "(S.3)", "T along the run", "1/s")
AUXILIARY = Statement(
    "auxiliary state", "(A.3)", "(w_{r-1} s_{r-1})^T G_{r-1} lambda of the limited input", "1/s"
)
LAG = Statement("lag of the filters", "(S.3)", "sum w_i s_i . G_i (beta_i - alpha_i)", "1/s")
RHO = Statement("rho", "(S.4)", "rho = min_i decay rate of V_i > 0", "1/s")
ENVELOPE = Statement("envelope", "(S.4)", "V(t) <= V(0) exp(-rho t) + rho2/rho")
SMOOTH = Statement(
    "smooth",
    "(S.2)",
    "reference and slopes of the barriers have the derivatives that u contains",
)
ULTIMATE = "the lag of the filters does not vanish with d_tilde: only ultimate boundedness follows"
LIMIT_COVERED = (
    "with the term (w_{r-1} s_{r-1})^T G_{r-1} lambda of the auxiliary state (A.3) on the right"
)
NO_ESTIMATE = "the observer states no kappa; T uses the rate of its estimate along the run"


def _with_unit(line: Line, unit: Unit) -> Line:
    """A line with the unit of a level, or with that of the component that the line is about; with
    "1" for a line about components of several units.
    """
    if line.joint is not None:
        unit = of_component(unit, line.joint)
    if not isinstance(unit, str):
        unit = "1"
    return dataclasses.replace(line, unit=unit)


# --- the whole run --------------------------------------------------------------------------------


def run_lines(summary: LevelSummary) -> list[Line]:
    """The lines about constants of a run: smoothness, and the rate."""
    return [_smoothness(summary), _rate(summary)]


def _smoothness(summary: LevelSummary) -> Line:
    """Whether the data have the derivatives that the law takes."""
    law, context = summary.claims.law, summary.run.scenario.context
    if summary.claims.why_not:
        return not_applicable(SMOOTH, summary.claims.why_not)
    if law.filter is not None:
        return not_applicable(SMOOTH, "a law with filters forms no derivatives")
    spare = float(context.reference.continuous_derivatives) - law.order
    try:
        law.check_start(context)
    except ValueError as error:
        return SMOOTH.line(verdict_of(False), note=str(error))
    note = f"{law.order} derivatives of the reference are needed, and of the bounds of level 1"
    if summary.jumps.size:
        note = join_notes(note, summary.exclusion_note)
    if np.isinf(spare):
        return SMOOTH.line(verdict_of(True), note=note)
    return SMOOTH.line(verdict_of(True), margin=spare, note=note)


def _rate(summary: LevelSummary) -> Line:
    """The rate rho and the level that sets it."""
    rates = summary.claims.rates
    if summary.claims.why_not:
        return not_applicable(RHO, summary.claims.why_not)
    level, joint = np.unravel_index(np.argmin(rates), rates.shape)
    note = f"set by level {level + 1}"
    return check_positive(RHO, summary.rho, value=summary.rho, joint=int(joint), note=note)


# --- every step -----------------------------------------------------------------------------------


def segment_lines(segment: Segment) -> list[Line]:
    """The lines about every step of one segment."""
    lines = [*_assumptions(segment), *_inequalities(segment), _estimate(segment)]
    lines += [*_measured_terms(segment), _envelope(segment), *_bounds(segment)]
    return lines + _levels_inside(segment)


def left_side(claim: Any) -> np.ndarray:
    """The left less the right side of (S.3), which must not be positive, (T,)."""
    return claim.dV + claim.decay - growth_along(claim)  # type: ignore[no-any-return]


def level_units(summary: LevelSummary) -> tuple[Units, ...]:
    """The units of the levels of the model."""
    return plants.units_of(summary.run.scenario.model)[:-1]


def is_bounded(summary: LevelSummary, i: int) -> bool:
    """Whether level i + 1 has bounds."""
    return summary.run.scenario.context.bounds[i] is not None


def _assumptions(segment: Segment) -> list[Line]:
    """Bounded d_i, the reference and the start inside the bounds, and alpha_{i-1} inside those of
    level i.
    """
    summary, proof, sample = segment.summary, segment.proof, segment.sample
    units = level_units(summary)
    lines = []
    for i, unit in enumerate(units):
        statement = Statement(f"d_{i + 1} bounded", "(S.1)", f"|d_{i + 1}| is finite")
        line = finite(statement, segment.t, np.linalg.norm(proof.d[:, i], axis=1))
        lines.append(_with_unit(line, per_second(unit)))
    distance = np.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
    reference = check_smallest(REFERENCE_INSIDE, segment.t, distance)
    reference = with_status(summary, reference, Status.INFEASIBLE_REFERENCE)
    lines.append(_with_unit(reference, units[0]))
    for i, unit in enumerate(units):
        if not is_bounded(summary, i):
            continue
        if segment.t[0] == 0:
            text = f"lower(0) < x_{i + 1}(0) < upper(0)"
            statement = Statement(f"level {i + 1} starts inside", "(S.2)", text)
            line = check_smallest(statement, segment.t, proof.x_distance[:1, i])
            lines.append(_with_unit(line, unit))
        if i > 0 and proof.claim:
            text = f"lower < alpha_{i} < upper of level {i + 1}"
            statement = Statement(f"alpha_{i} inside", "(S.2)", text)
            line = check_smallest(statement, segment.t, proof.claim.alpha_distance[:, i])
            lines.append(_with_unit(line, unit))
    return lines


def _inequalities(segment: Segment) -> list[Line]:
    """(S.3) at every step, and its equality for barriers that decay exactly."""
    summary, proof = segment.summary, segment.proof
    law, reason, note = summary.claims.law, summary.why_not, summary.exclusion_note
    if reason:
        return [not_applicable(statement, reason) for statement in (INEQUALITY, EQUALITY)]
    statement = INEQUALITY
    if law.filter is not None:
        statement, note = SURFACE_INEQUALITY, join_notes(ULTIMATE, note)
    if covers_limit(summary.run.scenario):
        note = join_notes(LIMIT_COVERED, note)
    left = left_side(proof.claim)
    tolerance = LEVEL_ROUNDING * summary.eps * proof.claim.size
    inequality = check_steps(segment, statement, -left, tolerance, note=note)
    if not summary.claims.is_exact:
        why = "a barrier decays at least as fast as it states, not exactly"
        return [inequality, not_applicable(EQUALITY, why)]
    return [inequality, check_steps(segment, EQUALITY, -np.abs(left), tolerance)]


def _estimate(segment: Segment) -> Line:
    """The rate of the estimate that the observer claims."""
    summary, proof = segment.summary, segment.proof
    observer = summary.run.scenario.observer
    if isinstance(observer, NoObserver):
        return not_applicable(ESTIMATE, "there is no observer: d_hat = 0 and d_tilde = d")
    if observer.error_gain is None:
        kind = type(observer).__name__
        return not_applicable(ESTIMATE, f"{NO_ESTIMATE} ({kind})")
    if summary.why_invalid:
        return not_applicable(ESTIMATE, summary.why_invalid)
    statement = ESTIMATE
    if proof.estimate_error.ndim == 2:
        if summary.d_largest[0] > 0:
            why = "a torque observer of the robot needs q' = x_2, without d_1"
            return not_applicable(ESTIMATE, why)
        text = "f_hat' = kf f_tilde of the robot inside the plant"
        statement = Statement("estimate", "(S.3)", text, "N m/s")
    count = len(segment.t)
    error = np.abs(proof.estimate_error).reshape(count, -1)
    size = proof.estimate_size.reshape(count, -1)
    tolerance = LEVEL_ROUNDING * summary.eps * size
    line = check_steps(segment, statement, -error, tolerance)
    if line.joint is None:
        return line
    return dataclasses.replace(line, joint=line.joint % summary.run.n)


def _measured_terms(segment: Segment) -> list[Line]:
    """The largest disturbance terms, and the largest effect of the filters' lag."""
    summary, claim = segment.summary, segment.proof.claim
    if summary.why_not:
        return [not_applicable(TERMS, summary.why_not, counts=False)]
    lines = [_largest(segment, TERMS, claim.disturbance_terms)]
    if summary.claims.law.filter is not None:
        lines.append(_largest(segment, LAG, claim.lag))
    elif covers_limit(summary.run.scenario):
        lines.append(_largest(segment, AUXILIARY, claim.lag))
    return lines


def _largest(segment: Segment, statement: Statement, values: np.ndarray) -> Line:
    """A measured term with its largest value."""
    included = np.where(segment.proof.excluded, -np.inf, values)
    at = int(np.argmax(included))
    line = not_applicable(statement, "measured; a part of the right side of (S.3)", counts=False)
    return dataclasses.replace(line, value=float(included[at]), time=float(segment.t[at]))


def _envelope(segment: Segment) -> Line:
    """The envelope of V, at every step."""
    summary = segment.summary
    if summary.why_not:
        return not_applicable(ENVELOPE, summary.why_not)
    bound, tolerance = segment.envelopes[LEVELS]
    note = f"rho2/rho = {summary.rho2 / summary.rho:.4g}"
    if summary.claims.law.filter is not None:
        note = join_notes(note, ULTIMATE)
    note = join_notes(note, summary.exclusion_note)
    return check_steps(segment, ENVELOPE, bound - segment.proof.V, tolerance, note=note)


# --- the bounds on the errors ---------------------------------------------------------------------


def _bounds(segment: Segment) -> list[Line]:
    """The bounds on the error of each level that follow from V <= Vbar."""
    summary, proof = segment.summary, segment.proof
    lines = []
    widened: Any = ()
    bounds: Any = ()
    if not summary.why_not:
        envelope, tolerance = segment.envelopes[LEVELS]
        bounds = error_bounds(segment, envelope)
        widened = error_bounds(segment, envelope + tolerance)
    for i, unit in enumerate(level_units(summary)):
        statement = Statement(
            f"xi, level {i + 1}",
            "(S.4)",
            f"w_{i + 1} V_{i + 1} <= Vbar: |xi| as the barrier of the level says",
        )
        if not is_bounded(summary, i):
            text = f"|e_{i + 1}| <= sqrt(2 Vbar/w_{i + 1})"
            statement = Statement(f"e, level {i + 1}", "(S.4)", text)
        if summary.why_not:
            lines.append(not_applicable(statement, summary.why_not))
            continue
        if np.all(np.isnan(bounds[:, i]) | proof.excluded[:, None]):
            lines.append(not_applicable(statement, _no_bound(summary, i)))
            continue
        error = np.abs(errors(segment)[:, i])
        margins, tolerances = bounds[:, i] - error, widened[:, i] - bounds[:, i]
        line = check_steps(segment, statement, margins, tolerances, note="Vbar is the envelope")
        if not is_bounded(summary, i):
            line = _with_unit(line, unit)
        lines.append(line)
    return lines


def errors(segment: Segment) -> np.ndarray:
    """The relative errors xi of levels with bounds, and the errors e of the others, (T, r, n)."""
    summary, claim = segment.summary, segment.proof.claim
    bounded = [is_bounded(summary, i) for i in range(claim.e.shape[1])]
    return np.where(np.reshape(bounded, (-1, 1)), claim.xi, claim.e)


def error_bounds(segment: Segment, V: np.ndarray) -> np.ndarray:
    """The bounds on `errors` where the sum of w_i V_i is at most V, (T, r, n); NaN where the
    barrier of a level states none.
    """
    summary, claim = segment.summary, segment.proof.claim
    law = summary.claims.law
    zero = np.zeros_like(claim.e[:, 0])
    rows = []
    for i, barrier in enumerate(law.barriers):
        level = V[:, None] / np.asarray(law.weights[i])
        if not is_bounded(summary, i):
            rows.append(np.sqrt(2.0 * level) + zero)
            continue
        k_l, k_u = claim.k_l[:, i], claim.k_u[:, i]
        tube = Tube(zero, zero, -k_l, k_u, zero, zero)
        stated = barrier.xi_bound(level, tube)
        if stated is None:
            stated = np.full_like(zero, np.nan)
        rows.append(np.asarray(stated))
    return np.stack(rows, axis=1)


def _no_bound(summary: LevelSummary, i: int) -> str:
    """Why the barrier of a level gives no bound on its error."""
    kind = type(summary.claims.law.barriers[i]).__name__
    return f"the barrier {checks.shown(kind)} of level {i + 1} states no bound on xi from V"


def _levels_inside(segment: Segment) -> list[Line]:
    """Every level inside its bounds, at every step."""
    summary = segment.summary
    flags = {0: Status.BOUND_VIOLATED, 1: Status.VELOCITY_VIOLATED}
    lines = []
    last = len(level_units(summary)) - 1
    for i, unit in enumerate(level_units(summary)):
        if not is_bounded(summary, i):
            continue
        text = f"lower < x_{i + 1} < upper"
        statement = Statement(f"level {i + 1} inside", "(S.4)", text)
        line = check_smallest(statement, segment.t, segment.proof.x_distance[:, i])
        line = _with_unit(line, unit)
        if i in flags:
            line = with_status(summary, line, flags[i])
        reason = summary.why_not
        if not reason and _states_no_bound(segment, i):
            reason = _no_bound(summary, i)
        if not reason and i == last and covers_limit(summary.run.scenario):
            reason = "the claim is about x_r - lambda"
        if reason:
            line = observed_only(line, reason)
        lines.append(line)
    return lines


def _states_no_bound(segment: Segment, i: int) -> bool:
    """Whether the barrier of a level with bounds gives no bound on its error."""
    return bool(np.all(np.isnan(error_bounds(segment, np.zeros_like(segment.t))[:, i])))
