"""One run as a certificate uses it: constants over the whole run, and the envelope of V2 along it.

    case 1:  V2(t) <= V2(s) exp(-rho (t - s))              for t >= s                         (3.20)
    case 2:  V2(t) <= V2(s) exp(-rho (t - s)) + rho2/rho,  rho2 = F_d^2/2, F_d = sup |f'|     (3.28)

The claim holds from any instant s on. Where f jumps, which Assumption 1 excludes, and where the
guard or a torque limit was active, the envelope starts again at the next step.

A run is not the exact solution. The envelope is therefore widened by the integrator's own error in
V2 (`reconstruction.proof_along`), which decays at the rate of the claim, and by rounding, so that
V2 can be followed down to the level of its noise.

`summarise` reads all steps, whatever the run recorded, twice: rho and F_d are known after the first
pass only. The steps of a short run are kept in between; those of a long one are reconstructed
again, so that memory stays bounded.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.certificates import claims
from iblf_jax.certificates.claims import CASES, Claims, Weights
from iblf_jax.certificates.eigenvalues import Extremes, eigenvalues_over
from iblf_jax.certificates.proof_terms import rounding
from iblf_jax.certificates.reconstruction import (
    Steps,
    TimeGrid,
    check_status,
    is_valid,
    steps_of,
    time_grid,
)
from iblf_jax.core.status import UNTRUSTED, describe

KEPT_STEPS = 100_000
"""Largest number of steps that stay in memory between the two passes over a run."""
ENERGY_ROUNDING = 32.0
"""Rounding error of sqrt(2 V2) in units of the last place, relative to the sizes of its terms."""
CONDITION = {1: "(3.17)", 2: "(3.25)"}
"""Gain condition of each case."""
ALWAYS_EXCLUDED = "the guard or a torque limit was active all the time"


@dataclasses.dataclass(frozen=True)
class RunSummary:
    """Quantities of a whole run, and which claims apply to it."""

    run: Any
    """The Rollout, its arrays on the host."""
    claims: Claims
    """The claims about its scenario."""
    invalid: str
    """Why nothing can be claimed about this run; "" if something can."""
    eps: float
    """Relative error attributed to rounding."""
    jumps: np.ndarray
    """Times within the run at which f jumps [s]."""
    case: int
    """1 if f' = 0, else 2."""
    rho: dict[tuple[int, str], float]
    """The rate, by case and by the domain of the eigenvalues of M0 ("run", "box") [1/s]."""
    rho_terms: dict[tuple[int, str], np.ndarray]
    """The three terms of which each rate is the least, (3,) [1/s]."""
    F_m: float
    """sup |f| [N m]."""
    F_d: float
    """sup |f'| [N m/s]."""
    lambda_min: float
    """Smallest eigenvalue of M0 along the run [kg m^2]."""
    lambda_max: float
    """Largest eigenvalue of M0 along the run [kg m^2]."""
    over_box: Extremes
    samples: int
    """Number of steps, and the last instant."""
    excluded: int
    """Those of them at which the guard or a torque limit was active."""
    V_ends: tuple[float, float]
    """V2 at the first and at the last."""
    slowest: float
    """Smallest eigenvalue of M0^-1 K2 along the run [1/s]."""
    weights: dict[int, Weights]
    """The numbers of the claim with weights, by case, for a loop that has one."""

    def why_not_theorem(self, case: int) -> str:
        """Why the claim of a case of Theorem 2 does not apply to this run; "" if it does."""
        if self.claims.no_theorem or self.invalid:
            return self.claims.no_theorem or self.invalid
        if case == 1 and self.case == 2:
            return self._why_case_2()
        if not self.rho[case, "run"] > 0:
            if self.claims.bounds_velocities:
                return "the gain conditions (F.3) are not met"
            return f"the gain conditions {CONDITION[case]} are not met"
        return self._why_excluded()

    def why_not_weighted(self, case: int) -> str:
        """Why the claim with weights of a case does not apply to this run; "" if it does."""
        if not self.claims.has_weights:
            return "the claim with weights is about the corrected law with a momentum observer"
        if self.invalid:
            return self.invalid
        if case == 1 and self.case == 2:
            return self._why_case_2()
        if case not in self.weights:
            return "the numbers of the run are not finite"
        return self._why_excluded()

    def _why_case_2(self) -> str:
        return f"case 1 is for f' = 0; here |f'| reaches {self.F_d:.4g} N m/s, see case 2"

    def _why_excluded(self) -> str:
        return ALWAYS_EXCLUDED if self.excluded == self.samples else ""

    @property
    def theorem_case(self) -> int | None:
        """The stronger case of Theorem 2 that applies to the run, or None."""
        return next((case for case in CASES if not self.why_not_theorem(case)), None)

    @property
    def weighted_case(self) -> int | None:
        """The stronger case of the claim with weights that applies to the run, or None."""
        return next((case for case in CASES if not self.why_not_weighted(case)), None)

    @property
    def weights_replace_theorem(self) -> bool:
        """Whether the claim with weights replaces the paper's own: the barriers have weights other
        than 1.
        """
        return self.claims.other_weights and self.weighted_case is not None


class Envelope(NamedTuple):
    """The bound on V2 along a segment, (T,) each; NaN where nothing is claimed."""

    bound: np.ndarray
    """Right-hand side of (3.20) or (3.28)."""
    tolerance: np.ndarray
    """Error of the bound by rounding and by the integrator."""


class Segment(NamedTuple):
    """Consecutive steps of a run, and the envelopes along them."""

    summary: RunSummary
    """Of the whole run."""
    t: np.ndarray
    sample: Any
    proof: Any
    recorded: np.ndarray
    envelope: dict[int, Envelope]
    """Envelope of V2, by case."""
    weighted_envelope: dict[int, Envelope]
    """Envelope of V_w, by case."""


def summarise(run: Any) -> tuple[RunSummary, Iterator[Segment]]:
    """The summary of one run, its arrays on the host, and its segments in order."""
    grid = time_grid(run)
    if grid.last <= KEPT_STEPS:
        kept = list(steps_of(run, grid))
        summary = _summary(run, grid, kept)
        return summary, _segments(summary, kept)
    summary = _summary(run, grid, steps_of(run, grid))
    return summary, _segments(summary, steps_of(run, grid))


# --- first pass: extremes over all steps ---------------------------------------------------------


class _Extrema:
    """Running extrema over the steps of a run. NaN propagates."""

    def __init__(self) -> None:
        self.low: Any = np.inf
        self.high: Any = -np.inf
        self.margin = np.inf
        self.F_m = -np.inf
        self.F_d = -np.inf
        self.lambda_min = np.inf
        self.lambda_max = -np.inf
        self.slowest = np.inf
        self.steady = True
        self.samples = 0
        self.excluded = 0
        self.V_start = np.nan
        self.V_end = np.nan
        self.half_square_start = np.nan

    def add(self, steps: Steps) -> None:
        """Updates the extrema with some steps."""
        sample, proof = steps.sample, steps.proof
        if self.samples == 0:
            self.V_start = proof.V[0]
            self.half_square_start = 0.5 * np.sum(proof.f_tilde[0] ** 2)
        self.V_end = proof.V[-1]
        self.low = np.minimum(self.low, sample.lower.min(axis=0))
        self.high = np.maximum(self.high, sample.upper.max(axis=0))
        margin = np.minimum(sample.q - sample.lower, sample.upper - sample.q).min()
        self.margin = np.minimum(self.margin, margin)
        self.F_m = np.maximum(self.F_m, np.linalg.norm(proof.f, axis=1).max())
        self.F_d = np.maximum(self.F_d, np.linalg.norm(proof.df, axis=1).max())
        self.lambda_min = np.minimum(self.lambda_min, proof.lambda_min.min())
        self.lambda_max = np.maximum(self.lambda_max, proof.lambda_max.max())
        self.slowest = np.minimum(self.slowest, proof.slowest.min())
        self.steady = self.steady and bool(proof.steady.all())
        self.samples += steps.t.size
        self.excluded += int(proof.excluded.sum())


def _summary(run: Any, grid: TimeGrid, all_steps: Iterable[Steps]) -> RunSummary:
    """Extremes over all steps, and the constants that follow from them."""
    extrema = _Extrema()
    for steps in all_steps:
        extrema.add(steps)
    invalid = ""
    if is_valid(run):
        check_status(run, float(extrema.margin))
    else:
        invalid = f"the run is not valid: {describe(int(run.status) & int(UNTRUSTED))}"
    scenario = run.scenario
    claimed = claims.claims_of(scenario)
    over_box = eigenvalues_over(scenario.model, extrema.low, extrema.high)
    case, F_d = 2, float(extrema.F_d)
    if extrema.steady:
        case, F_d = 1, 0.0
    rho_terms = _rho_terms(claimed, extrema, over_box)
    jumps = np.sort(np.ravel(np.asarray(scenario.jump_times())))
    return RunSummary(
        run=run,
        claims=claimed,
        invalid=invalid,
        eps=rounding(run.q.dtype),
        jumps=jumps[(jumps > 0) & (jumps <= grid.duration)],
        case=case,
        rho={key: float(np.min(terms)) for key, terms in rho_terms.items()},
        rho_terms=rho_terms,
        F_m=float(extrema.F_m),
        F_d=F_d,
        lambda_min=float(extrema.lambda_min),
        lambda_max=float(extrema.lambda_max),
        over_box=over_box,
        samples=extrema.samples,
        excluded=extrema.excluded,
        V_ends=(float(extrema.V_start), float(extrema.V_end)),
        slowest=float(extrema.slowest),
        weights=_weights(claimed, extrema, F_d, grid.duration),
    )


def _rho_terms(
    claimed: Claims, extrema: _Extrema, over_box: Extremes
) -> dict[tuple[int, str], np.ndarray]:
    """The terms of rho by case, with the eigenvalues along the run and over the box."""
    constants = claimed.constants
    if constants is None:
        return {}
    found = {}
    for case in CASES:
        for domain, source in (("run", extrema), ("box", over_box)):
            terms = claims.rho_terms(constants, source.lambda_max, case, source.lambda_min)
            found[case, domain] = np.asarray(terms)
    return found


def _weights(claimed: Claims, extrema: _Extrema, F_d: float, duration: float) -> dict[int, Weights]:
    """The numbers of the claim with weights, by case; none for a loop that has no such claim."""
    if not isinstance(claimed.constants, claims.Claim) or not claimed.has_weights:
        return {}
    half_square = float(extrema.half_square_start)
    V_rest = float(extrema.V_start) - half_square
    slowest = float(extrema.slowest)
    found = {}
    for case in CASES:
        best = claims.best_weights(
            claimed.constants, slowest, V_rest, half_square, F_d, duration, case
        )
        if best is not None:
            found[case] = best
    return found


# --- second pass: envelopes ----------------------------------------------------------------------


class _ClaimedDecay(NamedTuple):
    """The constants of one envelope."""

    rho: float
    """[1/s]."""
    rho2: float
    w_f: float
    """Weight of |f_tilde|^2 in the Lyapunov function."""


class _Anchor(NamedTuple):
    """Start of an envelope, passed from one segment to the next."""

    t: float
    """[s]."""
    V: float
    noise: float
    carried: float
    """Error of the integrator since then, at the first step of the next segment."""


class _Level(NamedTuple):
    """V2, or V_w, along some steps, (T,) each."""

    V: np.ndarray
    noise: np.ndarray
    """Rounding error of sqrt(2 V)."""
    defect: np.ndarray
    """Error of the integrator in V over one step."""


def _segments(summary: RunSummary, all_steps: Iterable[Steps]) -> Iterator[Segment]:
    """The segments, with the envelopes that run through them."""
    decays = _claimed_decays(summary)
    anchors: dict[tuple[str, int], _Anchor] = {}
    # The last step of the segment before decides whether an envelope starts again.
    last_t, last_excluded = np.zeros(0), np.zeros(0, bool)
    for steps in all_steps:
        t, excluded = steps.t, steps.proof.excluded
        starts = restarts(np.append(last_t, t), np.append(last_excluded, excluded), summary.jumps)
        starts = starts[last_t.size :]
        last_t, last_excluded = t[-1:], excluded[-1:]
        found: dict[str, dict[int, Envelope]] = {"theorem": {}, "weighted": {}}
        for (kind, case), decay in decays.items():
            anchor = anchors.get((kind, case))
            envelope, anchor = _envelope(float(summary.run.dt), decay, steps, starts, anchor)
            found[kind][case], anchors[kind, case] = envelope, anchor
        yield Segment(
            summary,
            t,
            steps.sample,
            steps.proof,
            steps.recorded,
            found["theorem"],
            found["weighted"],
        )


def _claimed_decays(summary: RunSummary) -> dict[tuple[str, int], _ClaimedDecay]:
    """The constants of every envelope, by kind and case."""
    found = {}
    if summary.claims.constants is not None:
        rho2 = {1: 0.0, 2: summary.F_d**2 / 2}
        for case in CASES:
            found["theorem", case] = _ClaimedDecay(summary.rho[case, "run"], rho2[case], 1.0)
    for case, weights in summary.weights.items():
        found["weighted", case] = _ClaimedDecay(weights.rho, weights.rho2, weights.w_f)
    return found


def restarts(t: np.ndarray, excluded: np.ndarray, jumps: np.ndarray) -> np.ndarray:
    """The samples at which the envelope starts, (T,) bool: the first, those after a jump, and those
    after an excluded one.
    """
    jumps_until = np.searchsorted(jumps, t, side="right")
    after_jump = jumps_until[1:] > jumps_until[:-1]
    return np.concatenate([[True], after_jump | excluded[:-1]])


def weighted_lyapunov(proof: Any, w_f: float) -> np.ndarray:
    """V_w with the weight w_f of f_tilde, (T,); V2 for w_f = 1."""
    if w_f == 1.0:
        return proof.V
    return proof.V + (w_f - 1.0) * 0.5 * np.sum(proof.f_tilde**2, axis=1)


def _level(steps: Steps, w_f: float) -> _Level:
    """V_w along some steps, with its errors."""
    proof = steps.proof
    eps = float(np.finfo(proof.V.dtype).eps)
    noise = ENERGY_ROUNDING * eps * proof.V_terms * max(1.0, w_f) ** 0.5
    defect = steps.defect
    if w_f != 1.0:
        defect = defect + abs(w_f - 1.0) * steps.defect_f
    return _Level(weighted_lyapunov(proof, w_f), noise, defect)


def _envelope(
    dt: float, claimed: _ClaimedDecay, steps: Steps, starts: np.ndarray, anchor: _Anchor | None
) -> tuple[Envelope, _Anchor]:
    """The envelope along some steps and its tolerance; NaN at excluded steps, and everywhere if the
    rate is not positive.
    """
    t, level, rho = steps.t, _level(steps, claimed.w_f), claimed.rho
    if anchor is None:
        anchor = _Anchor(t[0], level.V[0], level.noise[0], 0.0)
    # Index of the step at which the envelope started, plus 1; 0 for one before these steps.
    start = np.maximum.accumulate(np.where(starts, np.arange(1, t.size + 1), 0))
    start_t = np.append(anchor.t, t)[start]
    start_V = np.append(anchor.V, level.V)[start]
    start_noise = np.append(anchor.noise, level.noise)[start]
    # The integrator's errors accumulate and decay at the claimed rate.
    decay = np.exp(-max(rho, 0.0) * dt)
    errors, carried = [], anchor.carried
    for restart, defect in zip(starts.tolist(), level.defect.tolist(), strict=True):
        errors.append(0.0 if restart else carried)
        carried = decay * errors[-1] + defect
    after = _Anchor(start_t[-1], start_V[-1], start_noise[-1], carried)
    if not rho > 0:
        unclaimed = np.full(t.size, np.nan)
        return Envelope(unclaimed, unclaimed), after
    bound = start_V * np.exp(-rho * (t - start_t)) + claimed.rho2 / rho
    bound = np.where(steps.proof.excluded, np.nan, bound)
    widened = np.sqrt(2 * (bound + np.asarray(errors))) + start_noise + level.noise
    return Envelope(bound, 0.5 * widened**2 - bound), after
