"""Theorem 2: the backstepping law with an observer whose error obeys f_tilde' = f' - kf f_tilde.

    V2' <= -rho V2 + 1/2 |f'|^2
    rho = min( decay rate of V1,  2 lambda_min(K2 - I/2) / lambda_max(M0),  r_f )

    case 1, f' = 0:       needs K2 > 1/2, kf > 1/2,  r_f = 2 lambda_min(kf - I/2)    (3.17), (3.19)
    case 2, |f'| <= F_d:  needs K2 > 1/2, kf > 1,    r_f = 2 lambda_min(kf - I)      (3.25), (3.27)

    case 1:  V2(t) <= V2(s) exp(-rho (t - s))              for t >= s                         (3.20)
    case 2:  V2(t) <= V2(s) exp(-rho (t - s)) + rho2/rho,  rho2 = F_d^2/2, F_d = sup |f'|     (3.28)

Every barrier that states how fast its V1 decays along alpha (`decay_rate`) has the claim, because
the law cancels the barrier's slope against e2: 2 k1 for the integral barrier, 2 p k1 for the
logarithmic one, and so on.  kf is diagonal, so lambda_min is the smallest entry.  With a
`gain_matrix` K, K K2 takes the place of K2, and lambda_min is that of its symmetric part.

The printed proof drops two terms of V2', whose sizes are measured beside the margin that the proof
leaves for them:

    law with C0 q':            + 1/2 e2^T M0' e2       dropped in (3.13); zero with C0 alpha, by
                                                       skew symmetry
    observer (3.11), printed:  - f_tilde^T kf M0' q'   since f_tilde' = f' - kf f_tilde - kf M0' q'

A law that takes the shift of an auxiliary state is also checked while its torque is limited, with
w s . lambda on the right side (A.3).
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates.claims._base import (
    MainClaim,
    at_recorded,
    check_steps,
    other_actuator,
    reference_inside,
    stays_inside,
    unclaimed,
)
from iblf_jax.certificates.claims.own import OWN
from iblf_jax.certificates.claims.two_cases import (
    CASES,
    NO_BOUND,
    Gains,
    TwoCases,
    case_of_run,
    enters_verdict,
    gains_of,
    largest_f_rate,
    why_no_theorem,
    xi_bound_along,
)
from iblf_jax.certificates.claims.weighted import WEIGHTED
from iblf_jax.certificates.lines import (
    FAILS,
    Line,
    Role,
    Statement,
    check_margins,
    check_positive,
    check_smallest,
    finite,
    join_notes,
    not_applicable,
)
from iblf_jax.certificates.result import Traces
from iblf_jax.certificates.summary import DecayBound, Reduction, Segment, Summary, largest_norm
from iblf_jax.certificates.terms import (
    TORQUE,
    Point,
    Terms,
    TorquePoint,
    adaptive_law,
    covers_limit,
    relative_gap,
)
from iblf_jax.control.controllers import Backstepping
from iblf_jax.control.controllers._base import decay_of
from iblf_jax.control.decays._base import energy_gain, gain_at
from iblf_jax.control.observers import AsPublished, Momentum
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import Status
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import has, margin_of
from iblf_jax.world.bounds import NARROWEST
from iblf_jax.world.robots import Robot, mass_matrix_rate

LOWEST_KF = {1: 0.5, 2: 1.0}
"""Lower bound of kf: (3.17) in case 1, (3.25) in case 2."""
LOWEST_K2 = 0.5
CONDITION = {1: "(3.17)", 2: "(3.25)"}
"""Gain condition of each case."""
RHO = {1: "(3.19)", 2: "(3.27)"}
XI_BOUND = {1: "(3.22)", 2: "(3.30)"}
BOUNDS = {1: "(3.23)", 2: "(3.31)"}
DOMAINS = ("run", "box")
"""Where the eigenvalues of M0 are taken: along the run, or over the admissible box of positions."""
NOT_NEEDED = (
    "the paper's own envelope of V2 is lost, stability is not: the claim with weights (W.1) does"
    " not need it"
)
CASE_1_DECIDES = "f' = 0 on this run, so case 1 decides"
BOUNDED = Statement("f bounded", "Assumption 1", "|f| <= F_m", "N m")
RATE_BOUNDED = Statement("f' bounded", "Assumption 1", "|f'| <= F_d between jumps", "N m/s")
START_INSIDE = Statement("start inside", "Theorem 2", "k_lc(0) < q(0) < k_uc(0)", "rad")
LIMITED = Statement(
    "inequality, limited torque",
    "(A.3)",
    "V2' + rho V2 - |f'|^2/2 - w s . lambda <= 0  (without |f'|^2/2 in case 1)",
    "1/s",
    Role.INEQUALITY,
)
DROPPED_BY_LAW = Statement(
    "dropped term of the law",
    "(3.13)",
    "e2^T M0' e2/2 <= the margin that the proof leaves",
    "1/s",
)
DROPPED_BY_OBSERVER = Statement(
    "dropped term of the observer",
    "(3.11)",
    "-f_tilde^T kf M0' q' <= the margin that the proof leaves",
    "1/s",
)


class TorqueTerms(NamedTuple):
    """The terms of Theorem 2 besides those of `Terms`, at one instant."""

    M0: jax.Array
    """(n, n) [kg m^2]."""
    dropped_e2: jax.Array
    """1/2 e2^T M0' e2 for the law as printed, else 0, () [1/s]."""
    dropped_f: jax.Array
    """-f_tilde^T kf M0' q' for the observer as printed, else 0, () [1/s]."""
    steady: jax.Array
    """Whether f' = 0 exactly, () bool: the plant equals the model at this time, and the other
    torque in f is constant."""
    auxiliary: Any = ()
    """`AuxiliaryTerms` of a law that takes the shift of the limit around it."""
    dissipation: Any = ()
    """sum w V1 rate(k1(t, V1)) + e2^T K2 e2 + 2 k2(t, W) W of a `Backstepping` law with decays, ()
    [1/s]."""


class AuxiliaryTerms(NamedTuple):
    """The terms of (A.3) at one instant."""

    power: jax.Array
    """w s . lambda, ()."""
    excluded: jax.Array
    """Whether the guard at the bound is active, or alpha outside its bounds, () bool."""


class Theorem(TwoCases, MainClaim):
    """Theorem 2."""

    key: ClassVar[str] = "theorem"
    in_words: ClassVar[str] = "the paper's theorem"
    inequalities: ClassVar[Mapping[int, Statement]] = {
        case: Statement(f"inequality, case {case}", equation, text, "1/s", Role.INEQUALITY)
        for case, equation, text in (
            (1, "(3.18)", "V2' + rho V2 <= 0"),
            (2, "(3.26)", "V2' + rho V2 - |f'|^2/2 <= 0"),
        )
    }
    envelopes: ClassVar[Mapping[int, Statement]] = {
        1: Statement("envelope, case 1", "(3.20)", "V2(t) <= V2(0) exp(-rho t)"),
        2: Statement("envelope, case 2", "(3.28)", "V2(t) <= V2(0) exp(-rho t) + rho2/rho"),
    }
    conditions: ClassVar[Mapping[int, str]] = CONDITION
    """Gain condition of each case."""
    least: ClassVar[tuple[str, ...]] = ("the decay rate of V1", "K2 over lambda_max(M0)", "kf")
    """The terms of which rho is the least, in words."""

    # --- whether it applies -----------------------------------------------------------------------

    def why_not(self, scenario: Scenario) -> str:
        """Why Theorem 2 claims nothing about a scenario, in words; "" if it does."""
        return why_no_theorem(scenario)

    def why_no_rate(self, summary: Summary, case: int) -> str:
        """Why a case has no positive rate; "" if it has one."""
        if not summary.decay_bounds[self.key, case].rho > 0:
            return f"the gain conditions {self.conditions[case]} are not met"
        return ""

    # --- the terms --------------------------------------------------------------------------------

    def with_terms_of_claim(self, point: Point, terms: Terms) -> Terms:
        """The terms at a state with those of this claim."""
        assert isinstance(point, TorquePoint)
        scenario = point.scenario
        plant_is_model = _are_equal(scenario.plant.at(point.t), scenario.model)
        by_law, by_observer = _dropped_terms(point, terms)
        entry = TorqueTerms(
            M0=point.M0,
            dropped_e2=by_law,
            dropped_f=by_observer,
            steady=plant_is_model & jnp.all(point.rates["external"] == 0.0),
        )
        size, sqrt_V_size = self.term_sizes(point, terms)
        excluded = terms.excluded
        law, outer = point.law, scenario.controller
        if self.has_law(law):
            if law is not outer and adaptive_law(scenario) is None:
                # A wrapper around the law changed its torque.
                excluded |= point.differs_from_command(law, ())
            if isinstance(law, Backstepping):
                entry = entry._replace(dissipation=_dissipation_of_backstepping(point, terms.e[1]))
        if covers_limit(scenario):
            # The terms of (A.3), with w s of the barrier on e1.
            sample = point.sample
            is_excluded = jnp.any(sample.guard_active)
            if has(sample, "dq_lower"):
                margin = margin_of(sample, 2, sample.alpha - sample.auxiliary)
                is_excluded |= jnp.any(margin <= NARROWEST)
            product = jnp.sum(point.now["s"] * sample.auxiliary)
            entry = entry._replace(auxiliary=AuxiliaryTerms(product, is_excluded))
        return terms._replace(
            size=size,
            sqrt_V_size=sqrt_V_size,
            excluded=excluded,
            claims=terms.claims | {TORQUE: entry},
        )

    def has_law(self, law: object) -> bool:
        """Whether it is about a law of this class."""
        return isinstance(law, Backstepping)

    def term_sizes(self, point: TorquePoint, terms: Terms) -> tuple[jax.Array, jax.Array]:
        """`Terms.size` and `Terms.sqrt_V_size`."""
        law = point.law
        guard = -1.0 if law.barrier is None else law.barrier.guard
        K2 = law.full_gain if isinstance(law, Backstepping) else law.K2
        return SignalSizes(point, K2, guard).of_V2(terms, law.weight)

    # --- the constants ----------------------------------------------------------------------------

    def rho_terms(self, summary: Summary, case: int, domain: str) -> np.ndarray:
        """The terms of which rho is the least, (3,) [1/s], with the eigenvalues of M0 of a
        domain.
        """
        source = eigenvalues_in(summary, domain)
        gains = gains_of(summary.run.scenario)
        return np.asarray(rho_terms(gains, source.lambda_max, case))

    def reductions(self, scenario: Scenario, terms: Terms) -> dict[str, Reduction]:
        """Extreme eigenvalues of M0 [kg m^2] and of M0^-1 K2 [1/s], sup |f'| and whether f' = 0 at
        every step.
        """
        torque, law = terms.claims[TORQUE], unwrapped(scenario.controller)
        M0 = np.asarray(torque.M0)
        eigenvalues, mu = _eigenvalues(M0), np.nan
        if isinstance(law, Backstepping):
            gain = np.asarray(law.full_gain)
            if gain.ndim == 1:
                gain = np.diag(gain)
            values, vectors = np.linalg.eigh(0.5 * (gain + gain.T))
            inverse_root = vectors / np.sqrt(np.where(values > 0.0, values, np.nan))
            mu = (1.0 / _eigenvalues(inverse_root.T @ M0 @ inverse_root)[:, -1]).min()
        half_square = 0.5 * np.sum(terms.d_tilde[0] ** 2)
        return {
            "d_rate_largest": Reduction(np.maximum, largest_norm(terms.dd)),
            "steady": Reduction(operator.and_, bool(torque.steady.all())),
            "lambda_min": Reduction(np.minimum, eigenvalues[:, 0].min()),
            "lambda_max": Reduction(np.maximum, eigenvalues[:, -1].max()),
            "mu": Reduction(np.minimum, mu),
            "half_square_start": Reduction(lambda first, _: first, half_square),
        }

    def constants(self, summary: Summary) -> dict[tuple[int, str], np.ndarray]:
        """The terms of rho by case and domain; none where the claim does not apply."""
        if self.why_not(summary.run.scenario):
            return {}
        return {
            (case, domain): self.rho_terms(summary, case, domain)
            for case in CASES
            for domain in DOMAINS
        }

    def decay_bounds(self, summary: Summary) -> dict[int, DecayBound]:
        """Case -> constants of the decay."""
        rho2 = {1: 0.0, 2: largest_f_rate(summary) ** 2 / 2}
        return {
            case: DecayBound(float(np.min(terms)), rho2[case], 1.0, 0.5)
            for (case, domain), terms in summary.constants[self.key].items()
            if domain == "run"
        }

    def numbers(self, summary: Summary) -> dict[str, Any]:
        """The constants of the claim."""
        reductions, over_box = summary.reductions, summary.over_box
        F_d = largest_f_rate(summary)
        rho = {
            f"rho_{domain}_case_{case}": float(np.min(terms))
            for (case, domain), terms in summary.constants[self.key].items()
        }
        return {
            **rho,
            "case": case_of_run(summary),
            "F_m": float(reductions.d_largest),
            "F_d": F_d,
            "rho2": F_d**2 / 2,
            "V2_start": float(reductions.V_start),
            "V2_end": float(reductions.V_end),
            "lambda_min_run": float(reductions.lambda_min),
            "lambda_max_run": float(reductions.lambda_max),
            "lambda_min_box": over_box.lambda_min,
            "lambda_max_box": over_box.lambda_max,
            "lambda_searched": over_box.searched,
            "q_of_lambda_max_box": over_box.q_max,
            "jump_times": summary.jumps,
            "lambda_min_K2_over_M0_run": float(reductions.mu),
        }

    # --- for the settling time --------------------------------------------------------------------

    def disturbance_gain_term(self, segment: Segment) -> np.ndarray:
        """The term e2 . f_tilde + 1/2 e2^T M0' e2 (printed) at every step, (T,)."""
        terms = segment.terms
        by_f_tilde = np.sum(terms.e[:, 1] * terms.d_tilde, axis=1)
        return by_f_tilde + terms.claims[TORQUE].dropped_e2  # type: ignore[no-any-return]

    def why_no_settling(self, summary: Summary) -> str:
        """Why no settling time follows; "" if one does."""
        actuator = other_actuator(summary.run.scenario)
        if actuator:
            return f"(D.2) is about a torque that acts as it is commanded, not about {actuator}"
        return summary.why_never or summary.why_invalid

    # --- assumptions ------------------------------------------------------------------------------

    def assumptions(self, segment: Segment) -> list[Line]:
        """Bounds of Assumption 1 along the run, and feasibility of the reference, Assumption 2."""
        summary, terms = segment.summary, segment.terms
        df_norm = np.linalg.norm(terms.dd, axis=1)
        if case_of_run(summary) == 1:
            df_norm = 0.0 * df_norm
        jump_note = ""
        if summary.jumps.size:
            note = self.exclusion_note(summary)
            jump_note = f"Assumption 1 is broken by a jump of f: {note}"
        lines = [
            finite(BOUNDED, segment.t, np.linalg.norm(terms.d, axis=1)),
            finite(RATE_BOUNDED, segment.t, df_norm, jump_note),
            reference_inside(segment),
        ]
        if segment.t[0] == 0:
            lines.append(check_smallest(START_INSIDE, segment.t, terms.distance[:1, 0]))
        return lines

    # --- gains and rates --------------------------------------------------------------------------

    def gain_lines(self, summary: Summary) -> list[Line]:
        """The gain conditions, and the rates along the run and over the admissible box."""
        lines = self.gain_conditions(summary)
        for case in CASES:
            lines += [self._rate(summary, case, domain) for domain in DOMAINS]
        return lines

    def gain_conditions(self, summary: Summary) -> list[Line]:
        """The gain conditions (3.17) and (3.25)."""
        K2 = Statement("K2", "(3.17)", "lambda_min(K2 - I/2) > 0", "N m s/rad")
        kf_1 = Statement("kf, case 1", "(3.17)", "lambda_min(kf - I/2) > 0", "1/s")
        kf_2 = Statement("kf, case 2", "(3.25)", "lambda_min(kf - I) > 0", "1/s")
        reason = self.why_not(summary.run.scenario)
        if reason:
            return [not_applicable(statement, reason) for statement in (K2, kf_1, kf_2)]
        gains = gains_of(summary.run.scenario)
        conditions = (
            (K2, gains.K2 - LOWEST_K2, True),
            (kf_1, gains.kf - LOWEST_KF[1], True),
            (kf_2, gains.kf - LOWEST_KF[2], enters_verdict(summary, 2)),
        )
        lines = []
        for statement, above_lowest, enters in conditions:
            margins = np.asarray(above_lowest)
            joint: int | None = int(margins.argmin())
            if statement is K2 and summary.law.gain_matrix is not None:
                joint = None  # an eigenvalue of a full matrix belongs to all joints
            line = check_positive(
                statement,
                float(margins.min()),
                joint=joint,
                enters_verdict=enters,
                note="" if enters else CASE_1_DECIDES,
            )
            lines.append(_unless_replaced(summary, line))
        return lines

    def rate_statement(self, name: str, case: int) -> Statement:
        """The statement of the rate of a case."""
        text = (
            f"rho = min(decay of V1, 2 (K2 - 1/2)/lambda_max(M0), 2 (kf - {LOWEST_KF[case]:g})) > 0"
        )
        return Statement(name, RHO[case], text, "1/s")

    def eigenvalue_note(self, source: Any) -> str:
        """The eigenvalue of M0 on which rho depends, in words."""
        return f"lambda_max(M0) = {source.lambda_max:.4g} kg m^2"

    def _rate(self, summary: Summary, case: int, domain: str) -> Line:
        """The rate rho of one case, with the eigenvalues of M0 of a domain."""
        name, searched = f"rho, case {case}", ""
        if domain == "box":
            name, searched = f"{name}, over the box", f" ({summary.over_box.searched})"
        statement = self.rate_statement(name, case)
        reason = self.why_not(summary.run.scenario)
        if case == 1 and case_of_run(summary) == 2:
            reason = self.why_not_in_case(summary, 1)
        if reason:
            return not_applicable(statement, reason)
        terms = summary.constants[self.key][case, domain]
        rho = float(np.min(terms))
        eigenvalue = self.eigenvalue_note(eigenvalues_in(summary, domain))
        line = check_positive(
            statement,
            rho,
            value=rho,
            note=f"{eigenvalue}{searched}; set by {self.least[np.argmin(terms)]}",
            enters_verdict=enters_verdict(summary, case),
        )
        return _unless_replaced(summary, line)

    # --- every step -------------------------------------------------------------------------------

    def lines(self, segment: Segment) -> list[Line]:
        """The lines about every step of one segment."""
        lines = self.decay_lines(segment)
        if segment.terms.claims[TORQUE].auxiliary:
            lines.append(self._limited_inequality(segment))
        lines += self._dropped_lines(segment)
        # Properties (I) and (II): every joint inside its bounds.
        summary = segment.summary
        statement = Statement("joints inside", "(I), (II)", "|xi_i| < 1: -k_l < e1 < k_u")
        case, why_unclaimed = self.case_of(summary), ""
        if case is None and WEIGHTED.replaces_theorem(summary):
            case = WEIGHTED.case_of(summary)
        if case is None:
            why_unclaimed = self.why_not_in_case(summary, case_of_run(summary))
        elif np.all(np.isnan(xi_bound_along(segment, segment.terms.V))):
            why_unclaimed = NO_BOUND
        margins, flag = 1.0 - np.abs(segment.sample.xi), Status.BOUND_VIOLATED
        return [*lines, stays_inside(segment, statement, margins, flag, why_unclaimed)]

    def bound_statements(self, summary: Summary) -> dict[str, Statement]:
        """The bounds that follow from the envelope, by name."""
        case = self.case_of(summary) or case_of_run(summary)
        by_barrier = "V1 <= Vbar: |xi_i| <= sqrt(1 - exp(-Vbar/w_i)), or as the barrier says"
        statements = (
            Statement("xi, by V1", XI_BOUND[case], by_barrier),
            Statement("xi", BOUNDS[case], "|xi_i| <= sqrt(2 Vbar/w_i)"),
            self.velocity_bound(case),
            Statement("f_tilde", BOUNDS[case], "|f_tilde| <= sqrt(2 Vbar)", "N m"),
        )
        return {statement.name: statement for statement in statements}

    def velocity_bound(self, case: int) -> Statement:
        """The bound on the error of the velocity."""
        return Statement("e2", BOUNDS[case], "|e2| <= sqrt(2 Vbar/lambda_min(M0))", "rad/s")

    def _limited_inequality(self, segment: Segment) -> Line:
        """The differential inequality with the auxiliary state, at every step, those with a limited
        torque included.
        """
        summary, terms = segment.summary, segment.terms
        case, auxiliary = case_of_run(summary), terms.claims[TORQUE].auxiliary
        reason = self.why_not_in_run(summary)
        if not reason and not summary.decay_bounds[self.key, case].rho > 0:
            reason = "the gain conditions are not met"
        if reason:
            return not_applicable(LIMITED, reason)
        margins = auxiliary.power - self.left_side(segment, case)
        rho = summary.decay_bounds[self.key, case].rho
        size = terms.size + rho * terms.V + np.abs(auxiliary.power)
        largest = float(np.max(np.abs(summary.run.auxiliary)))
        note = f"max |lambda| = {largest:.4g} rad/s; instants with a limited torque are included"
        tolerances = summary.eps * size
        return check_margins(LIMITED, segment.t, auxiliary.excluded, margins, tolerances, note=note)

    # --- the terms that the printed proof drops ---------------------------------------------------

    def why_law_is_exact(self, summary: Summary) -> str:
        """Why the proof drops no term of the law; "" if it drops one."""
        if summary.law.variant == "corrected":
            return "the claim is exact: the law uses C0 alpha"
        return ""

    def _dropped_parts(self, segment: Segment) -> list[tuple[Statement, np.ndarray, str]]:
        """The dropped terms, their sizes, and why a proof drops none."""
        torque, summary = segment.terms.claims[TORQUE], segment.summary
        of_observer = ""
        if isinstance(summary.run.scenario.observer, Momentum):
            of_observer = "the claim is exact: the observer has momentum form"
        return [
            (DROPPED_BY_LAW, torque.dropped_e2, self.why_law_is_exact(summary)),
            (DROPPED_BY_OBSERVER, torque.dropped_f, of_observer),
        ]

    def _margin_of_proof(self, segment: Segment, case: int) -> np.ndarray:
        """The margin that the proof leaves for the dropped terms, (T,)."""
        torque = segment.terms.claims[TORQUE]
        dropped = torque.dropped_e2 + torque.dropped_f
        return dropped - self.left_side(segment, case)  # type: ignore[no-any-return]

    def _dropped_lines(self, segment: Segment) -> list[Line]:
        """The sizes of the terms that the printed proof drops, compared with the margin that it
        leaves.
        """
        summary, terms = segment.summary, segment.terms
        case = self.case_of(summary)
        why_unclaimed = self.why_not_in_run(summary)
        why_no_case = self.why_not_in_case(summary, case or case_of_run(summary))
        lines: list[Line] = []
        for statement, term, why_exact in self._dropped_parts(segment):
            reason = why_unclaimed or why_exact or why_no_case
            if reason or case is None:
                lines.append(not_applicable(statement, reason, enters_verdict=False))
                continue
            margin = self._margin_of_proof(segment, case)
            largest = float(np.max(np.abs(term[~terms.excluded]), initial=0.0))
            tolerance = summary.eps * terms.size
            line = check_steps(
                segment,
                statement,
                margin - term,
                tolerance,
                value=largest,
                enters_verdict=False,
            )
            lines.append(line)
        return lines

    def segment_data(self, segment: Segment) -> dict[str, float]:
        """The largest share that each dropped term has of its margin."""
        summary, terms = segment.summary, segment.terms
        case = self.case_of(summary)
        if case is None:
            return {}
        shares = {}
        for statement, term, why_exact in self._dropped_parts(segment):
            if why_exact:
                continue
            margin, tolerance = self._margin_of_proof(segment, case), summary.eps * terms.size
            share = np.where(~terms.excluded, term / np.maximum(margin, tolerance), 0.0)
            shares[statement.name] = float(np.max(share))
        return shares

    def run_lines(
        self, summary: Summary, data: list[Any], lines: Mapping[str, Line]
    ) -> Iterable[Line]:
        """The lines about dropped terms, with the largest share that they have of their margins."""
        for name in dict.fromkeys(name for shares in data for name in shares):
            share = max(0.0, *(shares.get(name, 0.0) for shares in data))
            note = f"at most {100 * share:.3g} % of that margin at one instant"
            yield dataclasses.replace(lines[name], note=note)

    # --- inside the bounds, curves ----------------------------------------------------------------

    def traces(self, segment: Segment) -> Traces:
        """The curves of the figure.  For a law that has only a claim about itself, V and the left
        side are those of that claim.
        """
        summary, sample, terms = segment.summary, segment.sample, segment.terms
        case, torque = self.case_of(summary), terms.claims[TORQUE]
        traces = _unclaimed_traces(segment.t, terms.V, sample.xi, terms.e[:, 1], terms.d_tilde)
        dropped = torque.dropped_e2 + torque.dropped_f
        traces = traces._replace(dropped=dropped, excluded=terms.excluded)
        if case is not None:
            envelope = segment.envelopes[self.key, case].bound
            bounds = self.bounds_along(segment, envelope)
            traces = traces._replace(
                envelope=envelope,
                left=self.left_side(segment, case),
                xi_bound=bounds["xi, by V1"],
                e2_bound=bounds["e2"],
                f_tilde_bound=bounds["f_tilde"],
            )
        elif OWN.applies(summary):
            traces = OWN.on_traces(segment, traces)._replace(dropped=np.zeros_like(dropped))
        return at_recorded(segment, traces)  # type: ignore[no-any-return]

    def unclaimed_traces(self, run: Rollout) -> Traces:
        """The curves of a run of which nothing is claimed."""
        f_tilde = run.disturbance - run.disturbance_estimate
        return _unclaimed_traces(run.t, run.V, run.xi, run.e2, f_tilde)


THEOREM = Theorem()


def _eigenvalues(matrices: np.ndarray) -> np.ndarray:
    """Eigenvalues of symmetric matrices, ascending, (T, n); NaN where a matrix is not finite, for
    which NumPy would raise.
    """
    finite = np.all(np.isfinite(matrices), axis=(1, 2), keepdims=True)
    unit = np.eye(matrices.shape[-1])
    return np.where(finite[..., 0], np.linalg.eigvalsh(np.where(finite, matrices, unit)), np.nan)


def eigenvalues_in(summary: Summary, domain: str) -> Any:
    """What has the extreme eigenvalues of M0 of a domain as `lambda_min` and `lambda_max`."""
    return {"run": summary.reductions, "box": summary.over_box}[domain]


def rho_terms(gains: Gains, lambda_max: jax.typing.ArrayLike, case: int) -> jax.Array:
    """The three terms of which rho is the least, (3,) [1/s].
    (3.19), (3.27)

    Args:
      gains: gains and decay rates.
      lambda_max: largest eigenvalue of M0, () [kg m^2].
      case: 1 for f' = 0, 2 for bounded f'.
    """
    return jnp.stack([
        jnp.min(gains.decay_rate),
        2.0 * jnp.min(gains.K2 - LOWEST_K2) / lambda_max,
        2.0 * jnp.min(gains.kf - LOWEST_KF[case]),
    ])  # fmt: skip


def _unless_replaced(summary: Summary, line: Line) -> Line:
    """A line that only the paper's own envelope needs.  Where the claim with weights replaces that
    envelope, the line does not decide the verdict.
    """
    if line.verdict != FAILS or WEIGHTED.case_of(summary) is None:
        return line
    enters = line.enters_verdict and not WEIGHTED.replaces_theorem(summary)
    return dataclasses.replace(line, enters_verdict=enters, note=join_notes(NOT_NEEDED, line.note))


def _unclaimed_traces(
    t: jax.Array | np.ndarray, V: jax.Array, xi: jax.Array, e2: jax.Array, f_tilde: jax.Array
) -> Traces:
    """The curves of samples of which nothing is claimed."""
    return unclaimed(  # type: ignore[no-any-return]
        Traces,
        t,
        V=V,
        xi=xi,
        xi_bound=np.full(xi.shape, np.nan),
        e2=np.linalg.norm(e2, axis=1),
        f_tilde=np.linalg.norm(f_tilde, axis=1),
    )


# --- the terms at a state -------------------------------------------------------------------------


def _are_equal(one: Robot, other: Robot) -> jax.Array:
    """Whether two robots are equal, leaf by leaf, () bool."""
    structure: Any = jax.tree.structure(one)
    if structure != jax.tree.structure(other):
        return jnp.zeros((), bool)
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return jnp.all(jnp.stack([jnp.ones((), bool), *(jnp.all(a == b) for a, b in pairs)]))


def _dropped_terms(point: TorquePoint, terms: Terms) -> tuple[jax.Array, jax.Array]:
    """The two terms that the printed proof drops; zero for a law or an observer without them."""
    scenario, state, e2 = point.scenario, point.state, terms.e[1]
    dM0 = mass_matrix_rate(scenario.model, state.q, state.dq)
    by_law = by_observer = jnp.zeros_like(e2[0])
    if isinstance(point.law, Backstepping) and point.law.variant == "printed":
        by_law = 0.5 * (e2 @ (dM0 @ e2))
    if isinstance(scenario.observer, AsPublished):
        by_observer = -terms.d_tilde @ (scenario.observer.kf * (dM0 @ state.dq))
    return by_law, by_observer


def _dissipation_of_backstepping(point: TorquePoint, e2: jax.Array) -> Any:
    """Dissipation of sum w V1 + 1/2 e2^T M0 e2 with the gains of this instant, (); `()` for a law
    without decays or a barrier without a rate.
    """
    law, t, q = point.law, point.t, point.state.q
    if not law.decays:
        return ()
    tube = point.scenario.context.tube(t)
    stated = law.barrier.decay_rate(gain_at(decay_of(law, 0), t, law.k1, law.barrier, tube, q))
    if stated is None:
        return ()
    dissipation = jnp.sum(law.weight * stated * law.barrier.value(tube, q)) + e2 @ law.feedback(e2)
    W = 0.5 * e2 @ (point.M0 @ e2)
    second = decay_of(law, 1)
    if second.constant:
        return dissipation
    return dissipation + 2.0 * energy_gain(second, t, W, e2) * W


class SignalSizes:
    """Sums of the absolute values of the terms of signals: rounding is relative to them.

    Args:
      point: of the loop.
      K2: gain of the velocity error, (n,) or (n, n), or None.
      guard: of the barrier on e1.
    """

    def __init__(self, point: TorquePoint, K2: jax.Array | None, guard: float) -> None:
        now, rates = point.now, point.rates
        self.point = point
        K2 = jnp.zeros_like(point.state.q) if K2 is None else K2
        self.K2 = jnp.diag(K2) if K2.ndim == 1 else jnp.abs(K2)
        self.gap = relative_gap(now["xi"], guard)
        self.e2 = jnp.abs(point.state.dq) + jnp.abs(now["alpha"]) + jnp.abs(now["dq_d"])
        self.acceleration = jnp.abs(now["ddq"]) + jnp.abs(rates["alpha"])
        self.torque = (
            jnp.abs(point.M0) @ self.acceleration
            + jnp.abs(now["tau"])
            + jnp.abs(now["disturbance_estimate"])
            + self.K2 @ self.e2
            + jnp.abs(now["s"]) / self.gap
        )

    def of_V2(self, terms: Terms, weight: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        """`Terms.size` and `Terms.sqrt_V_size`; `weight` is that of V1, (n,), or None for 1."""
        point, e2, torque, gap = self.point, self.e2, self.torque, self.gap
        scenario, state, now, rates = point.scenario, point.state, point.now, point.rates
        M0 = jnp.abs(point.M0)
        kf = scenario.observer.kf
        kf = jnp.zeros_like(state.q) if kf is None else kf
        torque_rate = (
            M0 @ jnp.abs(rates["ddq"])
            + jnp.abs(rates["tau"])
            + jnp.abs(rates["disturbance_estimate"])
            + self.K2 @ self.acceleration
            + kf * torque
            + (jnp.abs(rates["s"]) + jnp.abs(now["s"]) * e2) / gap
        )
        size = (
            e2 @ (jnp.abs(now["s"]) / gap + torque)
            + (jnp.abs(terms.d_tilde) + jnp.abs(terms.dd)) @ torque_rate
            + torque @ jnp.abs(terms.dd_tilde)
        )
        tube = scenario.context.tube(point.t)
        width = jnp.minimum(tube.k_l, tube.k_u)
        weight = jnp.ones_like(width) if weight is None else weight
        of_V1 = jnp.sum(weight * (jnp.abs(state.q) / (width * gap)) ** 2)
        return size, jnp.sqrt(of_V1 + e2 @ (M0 @ e2) + torque @ torque)
