"""The claim with weights, for every positive K2 and kf of the corrected law of Theorem 2 with a
momentum observer:

    V_w = sum_i w_i V1_i + 1/2 e2^T M0 e2 + (w_f/2) |f_tilde|^2,   w_f > 0 [rad/(N m)]
    V_w' <= -rho V_w + (w_f/(2 b)) |f'|^2                                                      (W.1)
    rho = min( decay rate of V1,  2 (1 - a) mu,  2 min_i(kf_i - b/2 - 1/(4 a K2_i w_f)) ),
    mu = lambda_min(M0^-1 K2)                                                                  (W.2)

for any 0 < a < 1 and, where f' = 0 (case 1), b = 0.  It follows from
e2_i f_tilde_i <= a K2_i e2_i^2 + f_tilde_i^2/(4 a K2_i) and
f_tilde . f' <= (b/2) |f_tilde|^2 + |f'|^2/(2 b), and integrates to

    V_w(t) <= V_w(0) exp(-rho t) + rho2/rho,   rho2 = w_f F_d^2/(2 b),   w_i V1_i <= V_w.      (W.3)

The paper has w_i = w_f = 1 and a = 1/(2 K2), hence its conditions K2 > 1/2 and kf > 1/2: below them
its envelope is lost, but stability is not.  Here a, b and w_f are free, and `best_constants`
chooses those with the smallest mean of (W.3) over a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from iblf_jax.certificates.claims.two_cases import (
    CASES,
    Gains,
    TwoCases,
    enters_verdict,
    gains_of,
    largest_f_rate,
    why_no_theorem,
)
from iblf_jax.certificates.lines import Line, Role, Statement, check_positive, not_applicable
from iblf_jax.certificates.summary import DecayBound, Segment, Summary
from iblf_jax.control.controllers import Backstepping
from iblf_jax.control.observers import Momentum
from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation.scenario import Scenario

GRID = np.linspace(0.02, 0.98, 97)
"""Fractions of the largest rate, and of the largest b for a rate, that `best_constants` tries."""
RATE = {
    1: "rho = min(decay of V1, 2 (1 - a) lambda_min(M0^-1 K2), 2 (kf - 1/(4 a K2 w_f))) > 0",
    2: "rho = min(decay of V1, 2 (1 - a) lambda_min(M0^-1 K2), 2 (kf - b/2 - 1/(4 a K2 w_f))) > 0",
}


class Weighted(TwoCases):
    """The claim with weights."""

    key: ClassVar[str] = "weighted"
    inequalities: ClassVar[Mapping[int, Statement]] = {
        case: Statement(
            f"weighted inequality, case {case}",
            "(W.1)",
            f"V_w' + rho V_w{term} <= 0",
            "N m rad/s",
            Role.WEIGHTED_INEQUALITY,
        )
        for case, term in {1: "", 2: " - w_f |f'|^2/(2 b)"}.items()
    }
    envelopes: ClassVar[Mapping[int, Statement]] = {
        case: Statement(
            f"weighted envelope, case {case}",
            "(W.3)",
            f"V_w(t) <= V_w(0) exp(-rho t){term}",
            "N m rad",
            Role.WEIGHTED,
        )
        for case, term in {1: "", 2: " + rho2/rho"}.items()
    }
    bounds: ClassVar[Mapping[str, Statement]] = {
        "xi, by V1": Statement(
            "weighted xi",
            "(W.3)",
            "w_i V1_i <= Vbar: |xi_i| <= sqrt(1 - exp(-Vbar/w_i)), or as the barrier says",
            role=Role.WEIGHTED,
        ),
        "e2": Statement(
            "weighted e2",
            "(W.3)",
            "|e2| <= sqrt(2 Vbar/lambda_min(M0))",
            "rad/s",
            Role.WEIGHTED,
        ),
        "f_tilde": Statement(
            "weighted f_tilde",
            "(W.3)",
            "|f_tilde| <= sqrt(2 Vbar/w_f)",
            "N m",
            Role.WEIGHTED,
        ),
    }
    lyapunov: ClassVar[str] = "V_w, "

    def why_not(self, scenario: Scenario) -> str:
        """Why the claim with weights does not apply; "" if it does."""
        law = unwrapped(scenario.controller)
        is_corrected = isinstance(law, Backstepping) and law.variant == "corrected"
        has_momentum = isinstance(scenario.observer, Momentum)
        if not is_corrected or not has_momentum or why_no_theorem(scenario):
            return "the claim with weights is about the corrected law with a momentum observer"
        return ""

    def why_no_rate(self, summary: Summary, case: int) -> str:
        """Why a case has no positive rate; "" if it has one."""
        if case not in summary.constants[self.key]:
            return "the numbers of the run are not finite"
        return ""

    def replaces_theorem(self, summary: Summary) -> bool:
        """Whether it replaces the paper's own claim: the barriers have weights other than 1."""
        weight = summary.law.weight
        others = weight is not None and bool(np.any(np.asarray(weight) != 1.0))
        return others and self.case_of(summary) is not None

    def constants(self, summary: Summary) -> dict[int, WeightedConstants]:
        """The numbers of the claim by case."""
        reductions, F_d = summary.reductions, largest_f_rate(summary)
        half_square = float(reductions.half_square_start)
        V_rest = float(reductions.V_start) - half_square
        gains, mu = gains_of(summary.run.scenario), float(reductions.mu)
        found = {}
        for case in CASES:
            best = best_constants(gains, mu, V_rest, half_square, F_d, summary.duration, case)
            if best is not None:
                found[case] = best
        return found

    def decay_bounds(self, summary: Summary) -> dict[int, DecayBound]:
        """Case -> constants of the decay."""
        found = {}
        for case, chosen in summary.constants[self.key].items():
            gain = chosen.w_f / (2.0 * chosen.b) if case == 2 else 0.0
            found[case] = DecayBound(chosen.rho, chosen.rho2, chosen.w_f, gain)
        return found

    def numbers(self, summary: Summary) -> dict[str, Any]:
        """The constants of the claim."""
        return {
            f"{name}_weighted_case_{case}": value
            for case, chosen in summary.constants[self.key].items()
            for name, value in chosen._asdict().items()
        }

    def bound_statements(self, summary: Summary) -> dict[str, Statement]:
        """The bounds that follow from the envelope, by name."""
        return dict(self.bounds)

    def lines(self, segment: Segment) -> list[Line]:
        """The rates, and the lines about every step of one segment."""
        rates = [self._rate(segment.summary, case) for case in CASES]
        return [*rates, *self.decay_lines(segment)]

    def _rate(self, summary: Summary, case: int) -> Line:
        """The rate of one case, with the chosen numbers."""
        name = f"weighted rho, case {case}"
        statement = Statement(name, "(W.2)", RATE[case], "1/s", Role.WEIGHTED)
        reason = self.why_not_in_case(summary, case)
        if reason:
            return not_applicable(statement, reason)
        gains, mu = gains_of(summary.run.scenario), float(summary.reductions.mu)
        chosen = summary.constants[self.key][case]
        limits = (np.min(gains.decay_rate), 2.0 * mu, 2.0 * np.min(gains.kf))
        least = ("the decay rate of V1", "K2 over M0", "kf")[int(np.argmin(limits))]
        numbers = f"a = {chosen.a:.4g}, w_f = {chosen.w_f:.4g} rad/(N m)"
        if case == 2:
            numbers += f", b = {chosen.b:.4g} 1/s"
        note = (
            f"chosen for the smallest mean of the envelope: {numbers}; lambda_min(M0^-1 K2) ="
            f" {mu:.4g} 1/s; limited by {least}"
        )
        terms = rate_terms(gains, mu, chosen.a, chosen.b, chosen.w_f)
        return check_positive(
            statement,
            float(np.min(terms)),
            value=chosen.rho,
            note=note,
            enters_verdict=enters_verdict(summary, case),
        )


WEIGHTED = Weighted()


class WeightedConstants(NamedTuple):
    """The free numbers of the claim with weights, and the resulting rates."""

    a: float
    """[1]."""
    b: float
    """[1/s]; 0 in case 1."""
    w_f: float
    """[rad/(N m)]."""
    rho: float
    """[1/s]."""
    rho2: float
    """[N m rad/s]."""


def rate_terms(gains: Gains, mu: float, a: float, b: float, w_f: float) -> np.ndarray:
    """The three terms of which rho is the least, (3,) [1/s].
    (W.2)

    Args:
      gains: gains and decay rates.
      mu: smallest lambda_min(M0^-1 K2) over the run, () [1/s].
      a, b, w_f: as in the docstring of this module.
    """
    decay, K2, kf = (np.asarray(x, float) for x in gains)
    by_K2 = 2.0 * (1.0 - a) * mu
    by_kf = 2.0 * np.min(kf - b / 2.0 - 0.25 / (a * K2 * w_f))
    return np.array([np.min(decay), by_K2, by_kf])


def best_constants(
    gains: Gains,
    mu: float,
    V_rest: float,
    half_square: float,
    F_d: float,
    duration: float,
    case: int,
) -> WeightedConstants | None:
    """The constants with the smallest mean of the envelope (W.3) over a run; None if the numbers of
    the run are not finite.

    For each rho and b of a grid it takes the largest a that (W.2) allows, then the smallest w_f.

    Args:
      gains: gains and decay rates.
      mu: smallest lambda_min(M0^-1 K2) over the run, () [1/s].
      V_rest: V_w(0) without f_tilde, () [N m rad].
      half_square: |f_tilde(0)|^2 / 2, () [(N m)^2].
      F_d: sup |f'|, () [N m/s].
      duration: of the run [s].
      case: 1 for f' = 0, 2 for bounded f'.
    """
    decay, K2, kf = (np.asarray(x, float) for x in gains)
    rho_limit = min(float(np.min(decay)), 2.0 * mu, 2.0 * float(np.min(kf)))
    if not (np.all(np.isfinite([rho_limit, V_rest, half_square, F_d])) and rho_limit > 0):
        return None
    # Axes: rates rho, then fractions of the largest b.
    rho = rho_limit * GRID[:, None]
    a = 1.0 - rho / (2.0 * mu)
    fractions = np.zeros((1, 1))
    if case == 2:
        fractions = GRID[None, :]
    b = 2.0 * (np.min(kf) - rho / 2.0) * fractions
    kf_margin = kf - (b + rho)[..., None] / 2.0
    w_f = np.max(0.25 / (a[..., None] * K2 * kf_margin), axis=-1)
    rho2 = np.zeros_like(w_f)
    if case == 2:
        rho2 = w_f * F_d**2 / (2.0 * b)
    mean_decay = -np.expm1(-rho * duration) / (rho * duration)
    mean = (V_rest + w_f * half_square) * mean_decay + rho2 / rho
    row, column = np.unravel_index(np.argmin(mean), mean.shape)
    return WeightedConstants(
        a=float(a[row, 0]),
        b=float(b[row, column]),
        w_f=float(w_f[row, column]),
        rho=float(rho[row, 0]),
        rho2=float(rho2[row, column]),
    )
