"""The claim about a plant in strict-feedback form under `controllers.BarrierBackstepping`, whose
Lyapunov function V = sum w_i V_i depends on the time, on the state x of the model and on the
estimate d_hat, through the errors and through the virtual controls.  With d_tilde = d - d_hat,

    V' <= -sum w_i decay_i - sum c_i w_i |s_i|^2 + T
    T  = dV/dx . d_tilde + dV/dd_hat . d_hat'                                                 (S.3)

for any observer, because the law replaces x' by the flow of the model with the estimate and holds
the estimate.  dV/dx contains w_i s_i in level i, and dV_i/dalpha_{i-1} times the derivatives of
alpha_{i-1} in the levels below it.  When alpha_{i-1} varies at fixed x_i and t, both the error and
the tube of level i change; the derivative includes both.  An observer with
d_tilde' = d' - kappa d_tilde has d_hat' = kappa d_tilde (`Observer.error_gain`), which is checked
by itself.  Without an observer d_hat = 0 and d_tilde = d.  A torque observer gives f_hat, and the
law holds f_hat constant, not d_hat = M0^-1 f_hat.  T then contains dV/df_hat . f_hat', with
f_hat' = kf f_tilde.

For barriers that decay exactly (`Barrier.exact_decay`), (S.3) is an equality.

With filters, beta_i takes the place of alpha_i in the errors and its rate is known exactly, so that
T = sum w_i s_i . d_tilde_i + sum w_i s_i . G_i (beta_i - alpha_i).  The last sum is the effect of
the filters' lag; it does not vanish with d_tilde, and only ultimate boundedness follows.

The auxiliary state lambda of a limited input (`controllers.Saturated`) moves the centre of the last
tube to alpha_{r-1} + lambda.  The claim then includes the instants at which the input is limited,
and T has the term (w_{r-1} s_{r-1})^T G_{r-1} lambda of (A.3), which is of the form of the lag.

(S.3) integrates to

    V' <= -rho V + g,   rho = min_i decay rate of V_i,   g = T - sum c_i w_i |s_i|^2
    V(t) <= V(s) exp(-rho (t - s)) + rho2/rho,   rho2 = sup max(g, 0) along the run           (S.4)

with the lag of filters in T for a law that has them.  T vanishes where d_tilde does, and V then
decays at the rate rho.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from iblf_jax.certificates.claims._base import (
    MainClaim,
    at_recorded,
    centre_distance,
    check_steps,
    level_dissipation,
    other_actuator,
    reference_inside,
    stays_inside,
    unclaimed,
    xi_bound,
)
from iblf_jax.certificates.claims.own import OWN
from iblf_jax.certificates.lines import (
    Line,
    Role,
    Statement,
    check_positive,
    check_smallest,
    finite,
    join_notes,
    measured,
    not_applicable,
    verdict_of,
)
from iblf_jax.certificates.result import LevelLabel, LevelTraces
from iblf_jax.certificates.summary import DecayBound, Reduction, Segment, Summary
from iblf_jax.certificates.terms import (
    ESTIMATED,
    Arguments,
    ChainPoint,
    Point,
    Terms,
    adaptive_law,
    covers_limit,
    inner_context,
    inner_state,
    relative_gap,
)
from iblf_jax.control.barriers import Barrier
from iblf_jax.control.controllers import BarrierBackstepping, TrackingLaw
from iblf_jax.control.controllers._base import decay_of
from iblf_jax.control.controllers._levels import Level
from iblf_jax.control.decays._base import gain_at
from iblf_jax.control.observers import NoObserver
from iblf_jax.core import checks
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import Status
from iblf_jax.core.units import Unit, as_text, of_component, per_second
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants
from iblf_jax.world.bounds import NARROWEST, Tube
from iblf_jax.world.plants._base import Units

LEVEL_ROUNDING = 16.0
"""Error of V' in units of the last place, relative to the sizes of its terms, over that of Theorem
2; the largest that tests found is 1."""
INEQUALITY = Statement(
    "inequality, levels",
    "(S.3)",
    "V' <= -sum w_i decay_i - sum c_i w_i |s_i|^2 + T,  T = dV/dx . d_tilde + dV/dd_hat . d_hat'",
    "1/s",
    Role.INEQUALITY,
)
SURFACE_INEQUALITY = Statement(
    "inequality, levels",
    "(S.3)",
    "V' <= -sum w_i decay_i - sum c_i w_i |s_i|^2 + sum w_i s_i . (d_tilde_i + G_i (beta_i -"
    " alpha_i))",
    "1/s",
    Role.INEQUALITY,
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


class LevelTerms(NamedTuple):
    """The terms of (S.3) besides those of `Terms`, () each unless noted."""

    dissipation: jax.Array
    """sum w_i decay_i, where decay_i is at least the barrier's stated rate times V_i, for the gain
    k_i(t, V_i) of the instant."""
    by_slopes: jax.Array
    """sum c_i w_i |s_i|^2."""
    disturbance_terms: jax.Array
    """T, without the lag of filters."""
    lag: jax.Array
    """sum w_i s_i . G_i (c_i - alpha_i), c_i the centre of the tube of level i + 1, of a law with
    filters or with an auxiliary state, else 0."""
    alpha_distance: jax.Array
    """Distance of alpha_{i-1} to the bounds of level i, (r, n); infinite without bounds."""
    k_l: jax.Array
    """Lower side of the tubes, (r, n), in the units of the levels."""
    k_u: jax.Array

    @property
    def disturbance_gain(self) -> jax.Array:
        """The term g = T - sum c_i w_i |s_i|^2 with the lag of filters in T, ()."""
        return self.disturbance_terms + self.lag - self.by_slopes


class EstimateTerms(NamedTuple):
    """The terms of the rate of the estimate, of the shape of the estimate."""

    error: jax.Array
    """d_hat' - kappa d_tilde, (r, n), or f_hat' - kf f_tilde, (n,), of an observer that states
    kappa, else 0."""
    size: jax.Array
    """Sum of the absolute values of its terms."""


class Levels(MainClaim):
    """(S.3) and the bounds that follow from it."""

    key: ClassVar[str] = "levels"
    point: ClassVar[type[Point] | None] = ChainPoint
    in_words: ClassVar[str] = "the claim (S.3)"
    omits_f_tilde: ClassVar[bool] = True

    def why_not(self, scenario: Scenario) -> str:
        """Why (S.3) claims nothing about a scenario, in words; "" if it does."""
        law: TrackingLaw = unwrapped(scenario.controller)
        if not isinstance(law, BarrierBackstepping):
            about = f"(S.3) is about BarrierBackstepping; {type(law).__name__} has no claim of this"
            return f"{about} kind"
        if law.addition:
            return f"(S.3) is about (S.2), and the law has {law.addition}"
        if adaptive_law(scenario) is not None:
            return "(S.3) is about a constant model, and AdaptiveParameters changes it"
        for i, (barrier, k) in enumerate(zip(law.barriers, law.k, strict=True)):
            if barrier.decay_rate(k) is None:
                kind = type(barrier).__name__
                return f"the barrier {kind} of level {i + 1} states no decay rate of its V"
        if scenario.loop.observer.completes:
            kind = type(scenario.observer).__name__
            about = "(S.3) is about a measured state, and the law receives levels that"
            return f"{about} {kind} estimates"
        actuator = other_actuator(scenario)
        if actuator:
            about = "(S.3) is about an input that acts as it is commanded"
            return f"{about}; {actuator} has no claim of this kind"
        return ""

    def why_not_in_run(self, summary: Summary) -> str:
        """Why (S.3) does not apply to a run; "" if it does."""
        reason = super().why_not_in_run(summary)
        if not reason and summary.why_never:
            return f"{summary.why_never}, or alpha was outside the bounds"
        return reason

    def why_no_settling(self, summary: Summary) -> str:
        """Why no settling time follows; "" if one does."""
        return self.why_not_in_run(summary)

    def exclusion_note(self, summary: Summary) -> str:
        """Which samples the claim excludes, and where it starts again, in words."""
        excluded = summary.exclusion_note("{}, or alpha was outside the bounds")
        return join_notes(excluded, summary.restart_note("d"))

    # --- the terms --------------------------------------------------------------------------------

    def with_terms_of_claim(self, point: Point, terms: Terms) -> Terms:
        """The terms at a state with those of this claim, and with those of the estimate."""
        assert isinstance(point, ChainPoint)
        entries = terms.claims | {ESTIMATED: _estimate_terms(point)}
        terms = terms._replace(claims=entries)
        if not isinstance(point.law, BarrierBackstepping):
            return terms
        terms = _with_claim_terms(point, terms)
        # e_i has no tube where alpha_{i-1} is outside the bounds of level i.
        distance = terms.claims[self.key].alpha_distance
        return terms._replace(excluded=terms.excluded | jnp.any(distance <= NARROWEST))

    # --- the constants ----------------------------------------------------------------------------

    def reductions(self, scenario: Scenario, terms: Terms) -> dict[str, Reduction]:
        """The constant rho2, the largest g of (S.3), at least 0."""
        gain = np.zeros(1)
        if self.key in terms.claims:
            gain = np.where(terms.excluded, 0.0, terms.claims[self.key].disturbance_gain)
        return {"rho2": Reduction(np.maximum, np.maximum(0.0, gain.max()))}

    def constants(self, summary: Summary) -> np.ndarray:
        """Decay rate of V_i of each level and component, (r, n) [1/s]; empty where (S.3) does not
        apply.
        """
        scenario, law = summary.run.scenario, summary.law
        if self.why_not(scenario):
            return np.zeros((0, scenario.n))
        rows = zip(law.barriers, law.k, strict=True)
        return np.stack([np.broadcast_to(barrier.decay_rate(k), scenario.n) for barrier, k in rows])

    def decay_bounds(self, summary: Summary) -> dict[int, DecayBound]:
        """The constants of (S.4), as case 2; none where (S.3) does not apply."""
        rates = summary.constants[self.key]
        if not rates.size:
            return {}
        return {2: DecayBound(float(np.min(rates)), float(summary.reductions.rho2))}

    def rho(self, summary: Summary) -> float:
        """The rate of (S.4) [1/s]; NaN where (S.3) does not apply."""
        decay = summary.decay_bounds.get((self.key, 2))
        return np.nan if decay is None else decay.rho

    def numbers(self, summary: Summary) -> dict[str, Any]:
        """The constants of the claim."""
        reductions = summary.reductions
        return {
            "rho": self.rho(summary),
            "rho2": float(reductions.rho2),
            "V_start": float(reductions.V_start),
            "V_end": float(reductions.V_end),
            "d_largest": reductions.d_largest,
            "d_tilde_largest": reductions.d_tilde_largest,
            "jump_times": summary.jumps,
        }

    # --- the whole run ----------------------------------------------------------------------------

    def gain_lines(self, summary: Summary) -> list[Line]:
        """The lines about constants of a run: smoothness, and the rate."""
        return [self._smoothness(summary), self._rate(summary)]

    def _smoothness(self, summary: Summary) -> Line:
        """Whether the data have the derivatives that the law takes."""
        law, scenario = summary.law, summary.run.scenario
        context, reason = scenario.context, self.why_not(scenario)
        if reason:
            return not_applicable(SMOOTH, reason)
        if law.filter is not None:
            return not_applicable(SMOOTH, "a law with filters forms no derivatives")
        spare = float(context.reference.continuous_derivatives) - law.order
        try:
            law.check_start(context)
        except ValueError as error:
            return SMOOTH.line(verdict_of(False), note=str(error))
        note = f"{law.order} derivatives of the reference are needed, and of the bounds of level 1"
        if summary.jumps.size:
            note = join_notes(note, self.exclusion_note(summary))
        if np.isinf(spare):
            return SMOOTH.line(verdict_of(True), note=note)
        return SMOOTH.line(verdict_of(True), margin=spare, note=note)

    def _rate(self, summary: Summary) -> Line:
        """The rate rho and the level that sets it."""
        rates, rho = summary.constants[self.key], self.rho(summary)
        reason = self.why_not(summary.run.scenario)
        if reason:
            return not_applicable(RHO, reason)
        level, joint = np.unravel_index(np.argmin(rates), rates.shape)
        note = f"set by level {level + 1}"
        return check_positive(RHO, rho, value=rho, joint=int(joint), note=note)

    # --- every step -------------------------------------------------------------------------------

    def lines(self, segment: Segment) -> list[Line]:
        """The lines about every step of one segment."""
        lines = [*self._starts(segment), *self._inequalities(segment), _estimate(segment)]
        lines += [*self._measured_terms(segment), self._envelope(segment), *self._bounds(segment)]
        return lines + self._levels_inside(segment)

    def _starts(self, segment: Segment) -> list[Line]:
        """Bounded d_i, the reference and the start inside the bounds, and alpha_{i-1} inside those
        of level i.
        """
        summary, terms = segment.summary, segment.terms
        units = level_units(summary)
        lines = []
        for i, unit in enumerate(units):
            statement = Statement(f"d_{i + 1} bounded", "(S.1)", f"|d_{i + 1}| is finite")
            line = finite(statement, segment.t, np.linalg.norm(terms.d[:, i], axis=1))
            lines.append(_with_unit(line, per_second(unit)))
        lines.append(_with_unit(reference_inside(segment), units[0]))
        for i, unit in enumerate(units):
            if not is_bounded(summary, i):
                continue
            if segment.t[0] == 0:
                text = f"lower(0) < x_{i + 1}(0) < upper(0)"
                statement = Statement(f"level {i + 1} starts inside", "(S.2)", text)
                line = check_smallest(statement, segment.t, terms.distance[:1, i])
                lines.append(_with_unit(line, unit))
            if i > 0 and self.key in terms.claims:
                text = f"lower < alpha_{i} < upper of level {i + 1}"
                statement = Statement(f"alpha_{i} inside", "(S.2)", text)
                line = check_smallest(
                    statement, segment.t, terms.claims[self.key].alpha_distance[:, i]
                )
                lines.append(_with_unit(line, unit))
        return lines

    def disturbance_gain_term(self, segment: Segment) -> np.ndarray:
        """The term g of (S.4) at every step, (T,)."""
        return segment.terms.claims[self.key].disturbance_gain  # type: ignore[no-any-return]

    def left_side(self, segment: Segment) -> np.ndarray:
        """The left less the right side of (S.3), which must not be positive, (T,)."""
        dissipation = segment.terms.claims[self.key].dissipation
        left = segment.terms.dV + dissipation - self.disturbance_gain_term(segment)
        return left  # type: ignore[no-any-return]

    def _inequalities(self, segment: Segment) -> list[Line]:
        """(S.3) at every step, and its equality for barriers that decay exactly."""
        summary, law = segment.summary, segment.summary.law
        reason, note = self.why_not_in_run(summary), self.exclusion_note(summary)
        if reason:
            return [not_applicable(statement, reason) for statement in (INEQUALITY, EQUALITY)]
        statement = INEQUALITY
        if law.filter is not None:
            statement, note = SURFACE_INEQUALITY, join_notes(ULTIMATE, note)
        if covers_limit(summary.run.scenario):
            note = join_notes(LIMIT_COVERED, note)
        left = self.left_side(segment)
        tolerance = LEVEL_ROUNDING * summary.eps * segment.terms.size
        inequality = check_steps(segment, statement, -left, tolerance, note=note)
        if not all(barrier.exact_decay for barrier in law.barriers):
            why = "a barrier decays at least as fast as it states, not exactly"
            return [inequality, not_applicable(EQUALITY, why)]
        return [inequality, check_steps(segment, EQUALITY, -np.abs(left), tolerance)]

    def _measured_terms(self, segment: Segment) -> list[Line]:
        """The largest disturbance terms, and the largest effect of the filters' lag."""
        summary, reason = segment.summary, self.why_not_in_run(segment.summary)
        if reason:
            return [not_applicable(TERMS, reason, enters_verdict=False)]
        claim = segment.terms.claims[self.key]
        lines = [_largest(segment, TERMS, claim.disturbance_terms)]
        if summary.law.filter is not None:
            lines.append(_largest(segment, LAG, claim.lag))
        elif covers_limit(summary.run.scenario):
            lines.append(_largest(segment, AUXILIARY, claim.lag))
        return lines

    def _envelope(self, segment: Segment) -> Line:
        """The envelope of V, at every step."""
        summary = segment.summary
        reason = self.why_not_in_run(summary)
        if reason:
            return not_applicable(ENVELOPE, reason)
        bound, tolerance = segment.envelopes[self.key, 2]
        decay = summary.decay_bounds[self.key, 2]
        note = f"rho2/rho = {decay.rho2 / decay.rho:.4g}"
        if summary.law.filter is not None:
            note = join_notes(note, ULTIMATE)
        note = join_notes(note, self.exclusion_note(summary))
        return check_steps(segment, ENVELOPE, bound - segment.terms.V, tolerance, note=note)

    def _bounds(self, segment: Segment) -> list[Line]:
        """The bounds on the error of each level that follow from V <= Vbar."""
        summary, terms = segment.summary, segment.terms
        why_not = self.why_not_in_run(summary)
        lines = []
        widened: Any = ()
        bounds: Any = ()
        if not why_not:
            envelope, tolerance = segment.envelopes[self.key, 2]
            bounds = self.error_bounds(segment, envelope)
            widened = self.error_bounds(segment, envelope + tolerance)
        for i, unit in enumerate(level_units(summary)):
            statement = Statement(
                f"xi, level {i + 1}",
                "(S.4)",
                f"w_{i + 1} V_{i + 1} <= Vbar: |xi| as the barrier of the level says",
            )
            if not is_bounded(summary, i):
                text = f"|e_{i + 1}| <= sqrt(2 Vbar/w_{i + 1})"
                statement = Statement(f"e, level {i + 1}", "(S.4)", text)
            if why_not:
                lines.append(not_applicable(statement, why_not))
                continue
            if np.all(np.isnan(bounds[:, i]) | terms.excluded[:, None]):
                lines.append(not_applicable(statement, _no_bound(summary, i)))
                continue
            error = np.abs(errors(segment)[:, i])
            margins, tolerances = bounds[:, i] - error, widened[:, i] - bounds[:, i]
            line = check_steps(segment, statement, margins, tolerances, note="Vbar is the envelope")
            if not is_bounded(summary, i):
                line = _with_unit(line, unit)
            lines.append(line)
        return lines

    def error_bounds(self, segment: Segment, V: np.ndarray) -> np.ndarray:
        """The bounds on `errors` where the sum of w_i V_i is at most V, (T, r, n); NaN where the
        barrier of a level states none.
        """
        summary, claim = segment.summary, segment.terms.claims[self.key]
        law = summary.law
        zero = np.zeros_like(claim.k_l[:, 0])
        rows = []
        for i, barrier in enumerate(law.barriers):
            if not is_bounded(summary, i):
                rows.append(np.sqrt(2.0 * (V[:, None] / np.asarray(law.weights[i]))) + zero)
                continue
            k_l, k_u = claim.k_l[:, i], claim.k_u[:, i]
            tube = Tube(zero, zero, -k_l, k_u, zero, zero)
            rows.append(xi_bound(barrier, law.weights[i], V, tube))
        return np.stack(rows, axis=1)

    def _levels_inside(self, segment: Segment) -> list[Line]:
        """Every level inside its bounds, at every step."""
        summary = segment.summary
        flags = {0: Status.BOUND_VIOLATED, 1: Status.VELOCITY_VIOLATED}
        lines, units = [], level_units(summary)
        for i, unit in enumerate(units):
            if not is_bounded(summary, i):
                continue
            text = f"lower < x_{i + 1} < upper"
            statement = Statement(f"level {i + 1} inside", "(S.4)", text)
            reason = self.why_not_in_run(summary)
            if not reason and self._states_no_bound(segment, i):
                reason = _no_bound(summary, i)
            if not reason and i == len(units) - 1 and covers_limit(summary.run.scenario):
                reason = "the claim is about x_r - lambda"
            distance, flag = segment.terms.distance[:, i], flags.get(i)
            line = stays_inside(segment, statement, distance, flag, reason)
            lines.append(_with_unit(line, unit))
        return lines

    def _states_no_bound(self, segment: Segment, i: int) -> bool:
        """Whether the barrier of a level with bounds gives no bound on its error."""
        return bool(np.all(np.isnan(self.error_bounds(segment, np.zeros_like(segment.t))[:, i])))

    # --- curves -----------------------------------------------------------------------------------

    def traces(self, segment: Segment) -> LevelTraces:
        """The curves of the figure.  For a law that has only a claim about itself, V and the left
        side are those of that claim.
        """
        summary, terms = segment.summary, segment.terms
        unknown = np.full(terms.d.shape, np.nan)
        traces = unclaimed(
            LevelTraces,
            segment.t,
            V=terms.V,
            error=errors(segment) if self.key in terms.claims else unknown,
            error_bound=unknown,
            d_tilde=np.linalg.norm(terms.d_tilde, axis=2),
            excluded=terms.excluded,
        )
        if not self.why_not_in_run(summary):
            envelope, claim = segment.envelopes[self.key, 2].bound, terms.claims[self.key]
            traces = traces._replace(
                envelope=envelope,
                left=self.left_side(segment),
                disturbance_terms=claim.disturbance_terms + claim.lag,
                error_bound=self.error_bounds(segment, envelope),
            )
        elif OWN.applies(summary):
            traces = OWN.on_traces(segment, traces)
        return at_recorded(segment, traces)  # type: ignore[no-any-return]

    def unclaimed_traces(self, run: Rollout) -> LevelTraces:
        """The curves of a run of which nothing is claimed."""
        unknown = np.full((*run.t.shape, plants.order_of(run.scenario.model), run.n), np.nan)
        error = unknown.copy()
        error[:, 0] = run.xi
        return unclaimed(  # type: ignore[no-any-return]
            LevelTraces,
            run.t,
            V=run.V,
            error=error,
            error_bound=unknown,
            d_tilde=unknown[:, :, 0],
        )

    def labels(self, scenario: Scenario) -> tuple[LevelLabel, ...]:
        """The levels of the model, in words."""
        plant = plants.as_plant(scenario.model)
        *units, _ = plants.units_of(plant)
        named = zip(plants.level_names(plant), units, strict=True)
        return tuple(
            LevelLabel(name, as_text(unit), scenario.context.bounds[i] is not None)
            for i, (name, unit) in enumerate(named)
        )


LEVELS = Levels()


def _with_unit(line: Line, unit: Unit) -> Line:
    """A line with the unit of a level, or with that of the component that the line is about; with
    "1" for a line about components of several units.
    """
    if line.joint is not None:
        unit = of_component(unit, line.joint)
    if not isinstance(unit, str):
        unit = "1"
    return dataclasses.replace(line, unit=unit)


def level_units(summary: Summary) -> tuple[Units, ...]:
    """The units of the levels of the model."""
    return plants.units_of(summary.run.scenario.model)[:-1]


def is_bounded(summary: Summary, i: int) -> bool:
    """Whether level i + 1 has bounds."""
    return summary.run.scenario.context.bounds[i] is not None


def errors(segment: Segment) -> np.ndarray:
    """The relative errors xi of levels with bounds, and the errors e of the others, (T, r, n)."""
    summary, terms = segment.summary, segment.terms
    bounded = [is_bounded(summary, i) for i in range(terms.e.shape[1])]
    return np.where(np.reshape(bounded, (-1, 1)), terms.xi, terms.e)


def _largest(segment: Segment, statement: Statement, values: np.ndarray) -> Line:
    """A measured term with its largest value."""
    included = np.where(segment.terms.excluded, -np.inf, values)
    at = int(np.argmax(included))
    note = "measured; a part of the right side of (S.3)"
    return measured(statement, note, value=float(included[at]), time=float(segment.t[at]))


def _no_bound(summary: Summary, i: int) -> str:
    """Why the barrier of a level gives no bound on its error."""
    kind = type(summary.law.barriers[i]).__name__
    return f"the barrier {checks.shown(kind)} of level {i + 1} states no bound on xi from V"


def _estimate(segment: Segment) -> Line:
    """The rate of the estimate that the observer claims."""
    summary, terms = segment.summary, segment.terms.claims[ESTIMATED]
    observer = summary.run.scenario.observer
    if isinstance(observer, NoObserver):
        return not_applicable(ESTIMATE, "there is no observer: d_hat = 0 and d_tilde = d")
    if observer.error_gain is None:
        kind = type(observer).__name__
        return not_applicable(ESTIMATE, f"{NO_ESTIMATE} ({kind})")
    if summary.why_invalid:
        return not_applicable(ESTIMATE, summary.why_invalid)
    statement = ESTIMATE
    if terms.error.ndim == 2:
        if summary.reductions.d_largest[0] > 0:
            why = "a torque observer of the robot needs q' = x_2, without d_1"
            return not_applicable(ESTIMATE, why)
        text = "f_hat' = kf f_tilde of the robot inside the plant"
        statement = Statement("estimate", "(S.3)", text, "N m/s")
    count = len(segment.t)
    error = np.abs(terms.error).reshape(count, -1)
    size = terms.size.reshape(count, -1)
    tolerance = LEVEL_ROUNDING * summary.eps * size
    line = check_steps(segment, statement, -error, tolerance)
    if line.joint is None:
        return line
    return dataclasses.replace(line, joint=line.joint % summary.run.n)


# --- the terms at a state -------------------------------------------------------------------------


def _with_claim_terms(point: ChainPoint, terms: Terms) -> Terms:
    """The terms at a state with V = sum w_i V_i and those of (S.3).

    V' is exact: dV/d(t, x, d_hat, state of the law), by forward-mode differentiation, times the
    rates of these along the vector field of the whole loop.
    """
    scenario, law = point.scenario, point.law
    at, tangent = point.arguments
    d_tilde, sizes = point.d_tilde, point.sizes
    flat, unflattened = ravel_pytree(at)

    def value(flat: jax.Array) -> tuple[jax.Array, Any]:
        given = unflattened(flat)
        context = inner_context(scenario, given.law_state)
        own_state = inner_state(scenario, given.law_state)
        levels, tubes = law.levels(*given[:3], context, own_state)
        values = [
            jnp.sum(w * barrier.value(tube, x))
            for w, barrier, tube, x in zip(law.weights, law.barriers, tubes, given.x, strict=True)
        ]
        V = jnp.sum(jnp.stack(values))
        return V, (V, levels, tubes)

    flat_slopes, (V, levels, tubes) = jax.jacfwd(value, has_aux=True)(flat)
    slopes = unflattened(flat_slopes)
    products = jax.tree.map(lambda slope, rate: jnp.sum(slope * rate), slopes, tangent)
    disturbance_terms = jnp.sum(slopes.x * d_tilde)
    disturbance_terms += jnp.sum(slopes.estimate * tangent.estimate)
    dissipation, by_slopes, size, square = (jnp.zeros_like(at.t) for _ in range(4))
    rows = []
    for i, (level, tube, barrier) in enumerate(zip(levels, tubes, law.barriers, strict=True)):
        w, x = law.weights[i], at.x[i]
        of_level, by_slope = level_dissipation(law, i, at.t, tube, x, level.slope)
        dissipation, by_slopes = dissipation + of_level, by_slopes + by_slope
        xi, distance = jnp.zeros_like(x), jnp.full_like(x, jnp.inf)
        if scenario.context.bounds[i] is not None:
            xi, distance = tube.xi(x), centre_distance(tube)
        gap = relative_gap(xi, barrier.guard)
        gain = gain_at(decay_of(law, i), at.t, law.k[i], barrier, tube, x)
        size += jnp.sum(jnp.abs(level.slope) / gap * (jnp.abs(tube.dq_d) + gain * jnp.abs(x)))
        error_size = jnp.abs(x) + jnp.abs(tube.q_d)
        square += jnp.sum(w * (error_size / gap) ** 2 / _ratio_at_centre(barrier, tube))
        rows.append((x - tube.q_d, xi, gap, distance, tube.k_l, tube.k_u))
    e, xi, gap, distance, k_l, k_u = map(jnp.stack, zip(*rows, strict=True))
    size += jnp.sum(jnp.abs(slopes.x) / gap * sizes)
    size += sum(jnp.abs(product) for product in jax.tree.leaves(products))
    size += dissipation + by_slopes
    entry = LevelTerms(
        dissipation=dissipation,
        by_slopes=by_slopes,
        disturbance_terms=disturbance_terms,
        lag=_lag(scenario, at, levels, tubes),
        alpha_distance=distance,
        k_l=k_l,
        k_u=k_u,
    )
    return terms._replace(
        V=V,
        dV=jnp.sum(jnp.stack(jax.tree.leaves(products))),
        e=e,
        xi=xi,
        size=size,
        sqrt_V_size=jnp.sqrt(square),
        claims=terms.claims | {LEVELS.key: entry},
    )


def _lag(
    scenario: Scenario, at: Arguments, levels: Sequence[Level], tubes: Sequence[Tube]
) -> jax.Array:
    """Sum of w_i s_i . G_i (c_i - alpha_i), c_i the centre of the tube of level i + 1, (); 0 for a
    law without filters and without an auxiliary state.
    """
    law: TrackingLaw = unwrapped(scenario.controller)
    total = jnp.zeros_like(at.t)
    if law.filter is None and not covers_limit(scenario):
        return total
    plant = plants.as_plant(scenario.model)
    for i, (level, above) in enumerate(zip(levels[:-1], tubes[1:], strict=True)):
        effect = plants.transposed_gain(plant, i + 1, at.t, at.x, level.slope)
        total += jnp.sum(effect * (above.q_d - level.alpha))
    return total


def _ratio_at_centre(barrier: Barrier, tube: Tube) -> jax.Array:
    """e/s at e = 0, (n,); that of k^2/2 for a barrier without one."""
    stated = barrier.error_over_slope(tube, tube.q_d)
    if stated is None:
        return 0.5 * jnp.minimum(tube.k_l, tube.k_u) ** 2
    return stated  # type: ignore[no-any-return]


def _estimate_terms(point: ChainPoint) -> EstimateTerms:
    """The error of d_hat' = kappa d_tilde and the size of its terms; 0 without a stated kappa."""
    scenario, (at, tangent) = point.scenario, point.arguments
    error, sizes = point.d_tilde, point.sizes
    zero = jnp.zeros_like(at.estimate)
    kappa = scenario.observer.error_gain
    if kappa is None:
        return EstimateTerms(zero, zero)
    x = at.x
    if at.estimate.ndim == 1:
        # A torque observer: f_tilde = M0 d_tilde_2.
        M0 = checks.given(scenario.loop.model.robot).mass_matrix(x[0])
        error, sizes, x = M0 @ error[1], jnp.abs(M0) @ sizes[1], jnp.abs(M0) @ jnp.abs(x[1])
    elif jnp.ndim(kappa) == 1:
        kappa = kappa[:, None]
    size = jnp.abs(tangent.estimate) + kappa * (sizes + jnp.abs(error) + jnp.abs(at.estimate))
    return EstimateTerms(tangent.estimate - kappa * error, size + kappa**2 * jnp.abs(x))
