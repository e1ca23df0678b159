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
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.certificates import claims
from iblf_jax.certificates.claims import CASES, Claims, WeightedConstants
from iblf_jax.certificates.eigenvalues import Extremes, eigenvalues_over
from iblf_jax.certificates.lines import join_notes
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
THEOREM, WEIGHTED = "theorem", "weighted"
"""Kinds of a claimed decay: that of Theorem 2 (and F.3), and the claim with weights."""


@dataclasses.dataclass(frozen=True)
class RunSummary:
    """Quantities of a whole run, and which claims apply to it."""

    run: Any
    """The Rollout, its arrays on the host."""
    claims: Claims
    """The claims about its scenario."""
    why_invalid: str
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
    """Number of samples, one for each step and one for the last instant."""
    excluded: int
    """Number of samples at which the guard or a torque limit was active."""
    V_ends: tuple[float, float]
    """V2 at the first and at the last sample."""
    mu: float
    """Smallest eigenvalue of M0^-1 K2 along the run [1/s]."""
    weighted_constants: dict[int, WeightedConstants]
    """The numbers of the claim with weights, by case, for a loop that has one."""

    def why_not(self, kind: str, case: int) -> str:
        """Why the claim of a case does not apply to this run; "" if it does.

        Args:
          kind: THEOREM or WEIGHTED.
          case: 1 or 2.
        """
        unclaimed = self.claims.why_no_theorem
        if kind == WEIGHTED:
            unclaimed = self.claims.why_no_weights
        unclaimed = unclaimed or self.why_invalid
        if unclaimed:
            return unclaimed
        if case == 1 and self.case == 2:
            return f"case 1 is for f' = 0; here |f'| reaches {self.F_d:.4g} N m/s, see case 2"
        if kind == WEIGHTED and case not in self.weighted_constants:
            return "the numbers of the run are not finite"
        if kind == THEOREM and not self.rho[case, "run"] > 0:
            condition = CONDITION[case]
            if self.claims.bounds_velocities:
                condition = "(F.3)"
            return f"the gain conditions {condition} are not met"
        if self.excluded == self.samples:
            return f"{self.why_excluded} all the time"
        return ""

    def applicable_case(self, kind: str) -> int | None:
        """The stronger case of a claim that applies to the run, or None."""
        return next((case for case in CASES if not self.why_not(kind, case)), None)

    @property
    def theorem_case(self) -> int | None:
        """The stronger case of Theorem 2 that applies to the run, or None."""
        return self.applicable_case(THEOREM)

    @property
    def weighted_case(self) -> int | None:
        """The stronger case of the claim with weights that applies to the run, or None."""
        return self.applicable_case(WEIGHTED)

    @property
    def weights_replace_theorem(self) -> bool:
        """Whether the claim with weights replaces the paper's own: the barriers have weights other
        than 1.
        """
        return self.claims.other_weights and self.weighted_case is not None

    @property
    def decays(self) -> dict[tuple[str, int], Decay]:
        """The constants of every claimed decay, by kind and case."""
        found = {}
        if self.claims.constants is not None:
            rho2 = {1: 0.0, 2: self.F_d**2 / 2}
            for case in CASES:
                found[THEOREM, case] = Decay(self.rho[case, "run"], rho2[case], 1.0, 0.5)
        for case, chosen in self.weighted_constants.items():
            gain = 0.0
            if case == 2:
                gain = chosen.w_f / (2.0 * chosen.b)
            found[WEIGHTED, case] = Decay(chosen.rho, chosen.rho2, chosen.w_f, gain)
        return found

    @property
    def why_excluded(self) -> str:
        """What excludes samples from the claims, in words."""
        return claims.why_excluded(self.run.scenario)

    @property
    def exclusion_note(self) -> str:
        """Which samples the claims exclude, and where they start again, in words."""
        excluded = ""
        if self.excluded:
            why = self.why_excluded
            if self.claims.bounds_velocities:
                why = f"alpha was outside, or {why}"
            excluded = f"{self.excluded} of {self.samples} samples are excluded: {why}"
        restarts = ""
        if self.jumps.size:
            times = ", ".join(f"{x:.4g}" for x in self.jumps)
            restarts = f"f jumps at t = {times} s, and the claim starts again there"
        return join_notes(excluded, restarts)


class Decay(NamedTuple):
    """The constants of a claimed decay, V_w' <= -rho V_w + gain |f'|^2; V_w is V2 for w_f = 1."""

    rho: float
    """[1/s]."""
    rho2: float
    """gain F_d^2."""
    w_f: float
    """Weight of |f_tilde|^2 in the Lyapunov function."""
    gain: float
    """In case 2; case 1 has no f'."""


class Envelope(NamedTuple):
    """The bound on V_w along a segment, (T,) each; NaN where nothing is claimed."""

    bound: np.ndarray
    """Right-hand side of (3.20) or (3.28)."""
    tolerance: np.ndarray
    """Error of the bound by rounding and by the integrator."""


class Segment(NamedTuple):
    """Consecutive steps of a run, and the envelopes along them."""

    summary: Any
    """Of the whole run, a `RunSummary` or a `LevelSummary`."""
    t: np.ndarray
    sample: Any
    proof: Any
    recorded: np.ndarray
    envelopes: dict[tuple[str, int], Envelope]
    """By kind and case."""


def summarise(run: Any) -> tuple[RunSummary, Iterator[Segment]]:
    """The summary of one run, its arrays on the host, and its segments in order."""
    return in_two_passes(run, _summary)


def in_two_passes(
    run: Any, summary_of: Callable[[Any, TimeGrid, Iterable[Steps]], Any]
) -> tuple[Any, Iterator[Segment]]:
    """The summary of one run that a function makes from all its steps, and its segments in
    order.
    """
    grid = time_grid(run)
    if grid.last <= KEPT_STEPS:
        kept = list(steps_of(run, grid))
        summary = summary_of(run, grid, kept)
        return summary, _segments(summary, kept)
    summary = summary_of(run, grid, steps_of(run, grid))
    return summary, _segments(summary, steps_of(run, grid))


# --- first pass: extremes over all steps ---------------------------------------------------------


class _Extrema:
    """Running extrema over the steps of a run. NaN propagates."""

    def __init__(self) -> None:
        self.low: Any = np.inf
        self.high: Any = -np.inf
        self.bound_distance = np.inf
        self.F_m = -np.inf
        self.F_d = -np.inf
        self.lambda_min = np.inf
        self.lambda_max = -np.inf
        self.mu = np.inf
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
        distance = np.minimum(sample.q - sample.lower, sample.upper - sample.q).min()
        self.bound_distance = np.minimum(self.bound_distance, distance)
        self.F_m = np.maximum(self.F_m, np.linalg.norm(proof.f, axis=1).max())
        self.F_d = np.maximum(self.F_d, np.linalg.norm(proof.df, axis=1).max())
        self.lambda_min = np.minimum(self.lambda_min, proof.lambda_min.min())
        self.lambda_max = np.maximum(self.lambda_max, proof.lambda_max.max())
        self.mu = np.minimum(self.mu, proof.mu.min())
        self.steady = self.steady and bool(proof.steady.all())
        self.samples += steps.t.size
        self.excluded += int(proof.excluded.sum())


def _summary(run: Any, grid: TimeGrid, all_steps: Iterable[Steps]) -> RunSummary:
    """Extremes over all steps, and the constants that follow from them."""
    extrema = _Extrema()
    for steps in all_steps:
        extrema.add(steps)
    why_invalid = ""
    if is_valid(run):
        check_status(run, float(extrema.bound_distance))
    else:
        why_invalid = f"the run is not valid: {describe(int(run.status) & int(UNTRUSTED))}"
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
        why_invalid=why_invalid,
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
        mu=float(extrema.mu),
        weighted_constants=_weighted_constants(claimed, extrema, F_d, grid.duration),
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


def _weighted_constants(
    claimed: Claims, extrema: _Extrema, F_d: float, duration: float
) -> dict[int, WeightedConstants]:
    """The numbers of the claim with weights, by case; none for a loop that has no such claim."""
    if not isinstance(claimed.constants, claims.Claim) or claimed.why_no_weights:
        return {}
    half_square = float(extrema.half_square_start)
    V_rest = float(extrema.V_start) - half_square
    found = {}
    for case in CASES:
        best = claims.best_constants(
            claimed.constants, float(extrema.mu), V_rest, half_square, F_d, duration, case
        )
        if best is not None:
            found[case] = best
    return found


# --- second pass: envelopes ----------------------------------------------------------------------


class _Anchor(NamedTuple):
    """Start of an envelope, passed from one segment to the next."""

    t: float
    """[s]."""
    V: float
    noise: float
    carried: float
    """Error of the integrator since then, at the first step of the next segment."""


def _segments(summary: Any, all_steps: Iterable[Steps]) -> Iterator[Segment]:
    """The segments, with the envelopes that run through them."""
    decays = summary.decays
    anchors: dict[tuple[str, int], _Anchor] = {}
    # The last step of the segment before decides whether an envelope starts again.
    last_t, last_excluded = np.zeros(0), np.zeros(0, bool)
    for steps in all_steps:
        t, excluded = steps.t, steps.proof.excluded
        starts = restarts(np.append(last_t, t), np.append(last_excluded, excluded), summary.jumps)
        starts = starts[last_t.size :]
        last_t, last_excluded = t[-1:], excluded[-1:]
        envelopes = {}
        for key, decay in decays.items():
            envelopes[key], anchors[key] = _envelope(
                float(summary.run.dt), decay, steps, starts, anchors.get(key)
            )
        yield Segment(summary, t, steps.sample, steps.proof, steps.recorded, envelopes)


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


def _envelope(
    dt: float, claimed: Decay, steps: Steps, starts: np.ndarray, anchor: _Anchor | None
) -> tuple[Envelope, _Anchor]:
    """The envelope along some steps and its tolerance; NaN at excluded steps, and everywhere if the
    rate is not positive.
    """
    t, proof, rho, w_f = steps.t, steps.proof, claimed.rho, claimed.w_f
    V = weighted_lyapunov(proof, w_f)
    eps = float(np.finfo(proof.V.dtype).eps)
    # The rounding error of sqrt(2 V), and the error of the integrator in V over one step.
    noise = ENERGY_ROUNDING * eps * proof.sqrt_V_size * max(1.0, w_f) ** 0.5
    defects = steps.defect + abs(w_f - 1.0) * steps.defect_f
    if anchor is None:
        anchor = _Anchor(t[0], V[0], noise[0], 0.0)
    # Index of the step at which the envelope started, plus 1; 0 for one before these steps.
    start = np.maximum.accumulate(np.where(starts, np.arange(1, t.size + 1), 0))
    start_t = np.append(anchor.t, t)[start]
    start_V = np.append(anchor.V, V)[start]
    start_noise = np.append(anchor.noise, noise)[start]
    # The integrator's errors accumulate and decay at the claimed rate.
    decay = np.exp(-max(rho, 0.0) * dt)
    errors, carried = [], anchor.carried
    for restart, defect in zip(starts.tolist(), defects.tolist(), strict=True):
        errors.append(0.0 if restart else carried)
        carried = decay * errors[-1] + defect
    after = _Anchor(start_t[-1], start_V[-1], start_noise[-1], carried)
    if not rho > 0:
        unclaimed = np.full(t.size, np.nan)
        return Envelope(unclaimed, unclaimed), after
    bound = start_V * np.exp(-rho * (t - start_t)) + claimed.rho2 / rho
    bound = np.where(proof.excluded, np.nan, bound)
    widened = np.sqrt(2 * (bound + np.asarray(errors))) + start_noise + noise
    return Envelope(bound, 0.5 * widened**2 - bound), after
