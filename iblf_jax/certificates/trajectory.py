"""One run as the certificate sees it: the terms of the proof at every step, the constants of the
claim, and the envelope of V2.

    case 1:  V2(t) <= V2(s) exp(-rho (t - s)) for t >= s
      (3.20)
    case 2:  V2(t) <= V2(s) exp(-rho (t - s)) + rho2/rho,   rho2 = F_d^2/2, F_d = sup |f'| over the
      run                  (3.28)

The claim holds from any instant s on.  So where f jumps (Assumption 1 is broken there), and where
the guard or a torque limit was at work, the envelope starts anew at the next step.

A run is not the exact solution: the envelope is widened by the integrator's own error in V2
  (`proof_terms.along_run`), carried along at the
rate of the claim, and by rounding, so that V2 may be followed down to where it is only noise.

All steps are looked at, whatever the run recorded (`retrace`), twice: rho and F_d are known after
the first time only.  A run of few steps is kept in between; a long one is made again, so that
memory stays bounded.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.certificates import claims, weighted
from iblf_jax.certificates.eigenvalues import Extremes, eigenvalues_over
from iblf_jax.certificates.proof_terms import rounding
from iblf_jax.certificates.retrace import Stretch, believed, check_status, grid, stretches
from iblf_jax.core.status import UNTRUSTED, describe
from iblf_jax.engine.plan import CERTIFY_KEPT
from iblf_jax.simulation.scenario import Scenario

NOISE = 32.0
"""Units of the last place by which sqrt(2 V2) may be off, relative to the sizes of its terms."""


class Envelope(NamedTuple):
    """The bound on V2 along a stretch, (T,) each; NaN where nothing is claimed."""

    bound: np.ndarray
    """Right-hand side of (3.20) or (3.28)."""
    tolerance: np.ndarray
    """What rounding and the integrator add to it."""


class Anchor(NamedTuple):
    """Where an envelope comes from, at the last step of a stretch."""

    t: float
    """When it started [s]."""
    V: float
    noise: float
    carried: float
    """The integrator's error since then, carried to the step after."""


class Whole(NamedTuple):
    """What is known of a run as a whole."""

    run: Any
    """The Rollout, its arrays on the host."""
    eps: float
    """Relative error put down to rounding."""
    no_claim: str
    """Why Theorem 2 claims nothing about this loop; "" if it does."""
    no_run: str
    """Why nothing can be said about this run; "" if something can."""
    jumps: np.ndarray
    """Times within the run at which f jumps [s]."""
    case: int
    """1 if f' = 0, else 2."""
    rho: dict[tuple[int, str], float]
    """The rate, by case and by where lambda_max was taken ("run", "box") [1/s]."""
    F_m: float
    F_d: float
    lambda_min: float
    """Smallest eigenvalue of M0 along the run [kg m^2]."""
    lambda_max: float
    over_box: Extremes
    claim: claims.Claim | claims.FullClaim | None
    samples: int
    """Steps that were looked at, and the last instant."""
    left_out: int
    """Those of them at which the guard or a torque limit was at work."""
    V_ends: tuple[float, float]
    """V2 at the first and at the last."""
    slowest: float
    """Smallest eigenvalue of M0^-1 K2 along the run [1/s]."""
    weights: dict[int, weighted.Weights]
    """The numbers of the claim with weights, by case, for a loop that has one."""


class Trajectory(NamedTuple):
    """A stretch of a run with everything that the lines are made of."""

    whole: Whole
    t: np.ndarray
    sample: Any
    proof: Any
    recorded: np.ndarray
    envelope: dict[int, Envelope]
    weighted: dict[int, Envelope]
    """The envelopes of the claim with weights."""


def look(run: Any) -> tuple[Whole, Iterator[Trajectory]]:
    """What is known of one run, its arrays on the host, and its stretches one after the other."""
    seen: Iterable[Stretch] = (
        list(stretches(run)) if grid(run)[1] <= CERTIFY_KEPT else stretches(run)
    )
    whole = _whole(run, seen)
    return whole, _with_envelopes(whole, seen if isinstance(seen, list) else stretches(run))


class _Tally:
    """Extremes over the stretches of a run."""

    def __init__(self) -> None:
        self.low: Any = np.inf
        self.high: Any = -np.inf
        self.margin = self.lambda_min = np.inf
        self.F_m = self.F_d = self.lambda_max = -np.inf
        self.steady, self.samples, self.left_out = True, 0, 0
        self.V_ends = (np.nan, np.nan)
        self.slowest, self.half_square = np.inf, np.nan

    def add(self, stretch: Stretch) -> None:
        """Takes a stretch into account; what is no number stays none."""
        sample, proof = stretch.sample, stretch.proof
        self.low, self.high = (
            np.minimum(self.low, sample.lower.min(axis=0)),
            np.maximum(self.high, sample.upper.max(axis=0)),
        )
        self.margin = np.minimum(
            self.margin, np.minimum(sample.q - sample.lower, sample.upper - sample.q).min()
        )
        self.F_m = np.maximum(self.F_m, np.linalg.norm(proof.f, axis=1).max())
        self.F_d = np.maximum(self.F_d, np.linalg.norm(proof.df, axis=1).max())
        self.lambda_min = np.minimum(self.lambda_min, proof.lambda_min.min())
        self.lambda_max = np.maximum(self.lambda_max, proof.lambda_max.max())
        self.steady = self.steady and bool(proof.steady.all())
        self.slowest = np.minimum(self.slowest, proof.slowest.min())
        if self.samples == 0:
            self.half_square = 0.5 * np.sum(proof.f_tilde[0] ** 2)
        self.V_ends = (proof.V[0] if self.samples == 0 else self.V_ends[0], proof.V[-1])
        self.samples, self.left_out = (
            self.samples + stretch.t.size,
            self.left_out + int(proof.held.sum()),
        )


def _whole(run: Any, seen: Iterable[Stretch]) -> Whole:
    """The first look: extremes over all steps, and what follows from them."""
    tally = _Tally()
    for stretch in seen:
        tally.add(stretch)
    no_run = ""
    if believed(run):
        check_status(run, float(tally.margin))
    else:
        no_run = f"the run is not to be believed: {describe(int(run.status) & int(UNTRUSTED))}"
    no_claim = claims.why_no_claim(run.scenario)
    constants = None if no_claim else claims.claim(run.scenario)
    over_box = eigenvalues_over(run.scenario.model, tally.low, tally.high)
    case = 1 if tally.steady else 2
    rates = {}
    if constants is not None:
        for each in claims.CASES:
            for where, seen_there in (("run", tally), ("box", over_box)):
                rates[each, where] = float(
                    claims.rho(constants, seen_there.lambda_max, each, seen_there.lambda_min)
                )
    F_d = 0.0 if case == 1 else float(tally.F_d)
    return Whole(
        run=run,
        slowest=float(tally.slowest),
        weights=_weights(run, constants, tally, F_d),
        eps=rounding(run.q.dtype),
        no_claim=no_claim,
        no_run=no_run,
        jumps=_jumps(run.scenario, grid(run)[1] * float(run.dt)),
        case=case,
        rho=rates,
        F_m=float(tally.F_m),
        F_d=F_d,
        lambda_min=float(tally.lambda_min),
        lambda_max=float(tally.lambda_max),
        over_box=over_box,
        claim=constants,
        samples=tally.samples,
        left_out=tally.left_out,
        V_ends=(float(tally.V_ends[0]), float(tally.V_ends[1])),
    )


def _weights(run: Any, constants: Any, tally: _Tally, F_d: float) -> dict[int, weighted.Weights]:
    """The numbers of the claim with weights, by case; none for a loop that has no such claim."""
    if not isinstance(constants, claims.Claim) or not weighted.is_stated(run.scenario):
        return {}
    duration, half_square = grid(run)[1] * float(run.dt), float(tally.half_square)
    V_rest = float(tally.V_ends[0]) - half_square
    found = {}
    for case in claims.CASES:
        best = weighted.best(
            constants, float(tally.slowest), V_rest, half_square, F_d, duration, case
        )
        if best is not None:
            found[case] = best
    return found


def _with_envelopes(whole: Whole, seen: Iterable[Stretch]) -> Iterator[Trajectory]:
    """The second look: the stretches, with the envelopes that run through them."""
    anchors: dict[tuple[str, int], Anchor] = {}
    t, held = np.zeros(0), np.zeros(0, bool)
    for stretch in seen:
        starts = starts_of(
            np.append(t, stretch.t), np.append(held, stretch.proof.held), whole.jumps
        )[t.size :]
        t, held = stretch.t[-1:], stretch.proof.held[-1:]
        envelopes: dict[str, dict[int, Envelope]] = {"paper": {}, "weighted": {}}
        for (kind, case), (rate, rho2, w_f) in _claimed(whole).items():
            level = level_of(stretch, w_f)
            found = _envelope(whole, rate, rho2, stretch, level, starts, anchors.get((kind, case)))
            envelopes[kind][case], anchors[kind, case] = found
        yield Trajectory(
            whole,
            stretch.t,
            stretch.sample,
            stretch.proof,
            stretch.recorded,
            envelopes["paper"],
            envelopes["weighted"],
        )


def _claimed(whole: Whole) -> dict[tuple[str, int], tuple[float, float, float]]:
    """Kind and case of every envelope -> its rate, its rho2 and the weight of f_tilde."""
    found = {}
    for case in claims.CASES if whole.claim is not None else ():
        found["paper", case] = (whole.rho[case, "run"], 0.0 if case == 1 else whole.F_d**2 / 2, 1.0)
    for case, weights in whole.weights.items():
        found["weighted", case] = (weights.rho, weights.rho2, weights.w_f)
    return found


def same_structure(one: Any, other: Any) -> bool:
    """Whether two pytrees have one structure."""
    structure: Any = jax.tree.structure(one)
    return bool(structure == jax.tree.structure(other))


def same_tree(one: Any, other: Any) -> bool:
    """Whether two pytrees have one structure and the same numbers."""
    return same_structure(one, other) and all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    )


def _jumps(scenario: Scenario, end: float) -> np.ndarray:
    times = np.sort(np.ravel(np.asarray(scenario.jump_times())))
    return times[(times > 0) & (times <= end)]


def starts_of(t: np.ndarray, held: np.ndarray, jumps: np.ndarray) -> np.ndarray:
    """At which samples the envelope starts anew, (T,) bool: the first, those after a jump, those
    after a held one.
    """
    fresh = np.searchsorted(jumps, t[1:], side="right") > np.searchsorted(
        jumps, t[:-1], side="right"
    )
    return np.concatenate([[True], fresh | held[:-1]])


class Level(NamedTuple):
    """V2, or V_w, along a stretch, (T,) each."""

    V: np.ndarray
    noise: np.ndarray
    """By how much sqrt(2 V) may be off by rounding."""
    defect: np.ndarray
    """The integrator's error in V over one step."""


def level_of(stretch: Any, w_f: float) -> Level:
    """V_w with the weight w_f of f_tilde, V2 for w_f = 1, along a `Stretch` or a `Trajectory`
    (whose integrator's errors are not known).
    """
    proof = stretch.proof
    V = proof.V if w_f == 1.0 else proof.V + (w_f - 1.0) * 0.5 * np.sum(proof.f_tilde**2, axis=1)
    noise = NOISE * float(np.finfo(proof.V.dtype).eps) * proof.V_terms * max(1.0, w_f) ** 0.5
    defect = getattr(stretch, "defect", np.zeros_like(V))
    if w_f != 1.0 and isinstance(stretch, Stretch):
        defect = defect + abs(w_f - 1.0) * stretch.defect_f
    return Level(V, noise, defect)


def _envelope(
    whole: Whole,
    rate: float,
    rho2: float,
    stretch: Stretch,
    level: Level,
    starts: np.ndarray,
    before: Anchor | None,
) -> tuple[Envelope, Anchor]:
    """The envelope of a level and its tolerance along a stretch; NaN at held steps, and everywhere
    if the rate is not positive.
    """
    t, V, noise = stretch.t, level.V, level.noise
    if before is None:
        before = Anchor(t[0], V[0], noise[0], 0.0)
    # Index of the step at which the envelope started, 0 for one before this stretch.
    first = np.maximum.accumulate(np.where(starts, np.arange(1, t.size + 1), 0))
    start_t, start_V, start_noise = (
        np.append(a, b)[first] for a, b in zip(before[:3], (t, V, noise), strict=True)
    )
    decay, sums, total = np.exp(-max(rate, 0.0) * float(whole.run.dt)), [], before.carried
    for fresh, error in zip(starts.tolist(), level.defect.tolist(), strict=True):
        sums.append(0.0 if fresh else total)
        total = decay * sums[-1] + error
    after = Anchor(start_t[-1], start_V[-1], start_noise[-1], total)
    if not rate > 0:
        nothing = np.full(t.size, np.nan)
        return Envelope(nothing, nothing), after
    bound = np.where(
        stretch.proof.held, np.nan, start_V * np.exp(-rate * (t - start_t)) + rho2 / rate
    )
    widened = np.sqrt(2 * (bound + np.asarray(sums))) + start_noise + noise
    return Envelope(bound, 0.5 * widened**2 - bound), after
