"""One run of a plant in strict-feedback form as a certificate uses it: which claims apply, and the
constants of the decay that follows from (S.3).

    V' <= -rho V + g,   rho = min_i decay rate of V_i,   g = T - sum c_i w_i |s_i|^2
    V(t) <= V(s) exp(-rho (t - s)) + rho2/rho,   rho2 = sup max(g, 0) along the run           (S.4)

T is that of (S.3), with the lag of filters for a law that has them.  It vanishes where d_tilde
does, and V then decays at the rate rho.  The envelope starts again where d jumps, and after
instants that the claim excludes (`run_summary`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.certificates.claims import adaptive_law, own_claim, why_excluded
from iblf_jax.certificates.lines import join_notes
from iblf_jax.certificates.proof_terms import DECAY_ROUNDING
from iblf_jax.certificates.reconstruction import Steps, TimeGrid, check_status, is_valid
from iblf_jax.certificates.run_summary import Decay
from iblf_jax.control.actuators import Ideal
from iblf_jax.control.controllers import BarrierBackstepping
from iblf_jax.core import checks
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import UNTRUSTED, describe
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.units import status_words
from iblf_jax.world import plants

LEVELS = ("levels", 0)
"""Key of the envelope (S.4) among those of a segment."""


class LevelClaims(NamedTuple):
    """The claims about one scenario with a law that receives the levels of the plant."""

    law: Any
    """The law without its wrappers (limits of the input)."""
    why_not: str
    """Why (S.3) does not apply; "" if it does."""
    is_exact: bool
    """Whether (S.3) is an equality: every barrier decays exactly."""
    rates: np.ndarray
    """Decay rate of V_i of each level and component, (r, n) [1/s]; empty where (S.3) does not
    apply."""
    own: Any
    """The law that states a claim about itself, or None."""


@dataclasses.dataclass(frozen=True)
class LevelSummary:
    """Quantities of a whole run, and which claims apply to it."""

    run: Any
    """The Rollout, its arrays on the host."""
    claims: LevelClaims
    why_invalid: str
    """Why nothing can be claimed about this run; "" if something can."""
    eps: float
    """Relative error attributed to rounding."""
    jumps: np.ndarray
    """Times within the run at which d jumps [s]."""
    rho2: float
    """Of (S.4)."""
    d_largest: np.ndarray
    """sup |d_i| of each level, (r,)."""
    d_tilde_largest: np.ndarray
    """sup |d_tilde_i| of each level, (r,)."""
    samples: int
    """Number of samples, one for each step and one for the last instant."""
    excluded: int
    """Number of samples that the claim excludes."""
    V_ends: tuple[float, float]
    """V at the first and at the last sample."""

    @property
    def why_not(self) -> str:
        """Why (S.3) does not apply to this run; "" if it does."""
        reason = self.claims.why_not or self.why_invalid
        if not reason and self.excluded == self.samples:
            return f"{self.why_excluded} all the time, or alpha was outside the bounds"
        return reason

    @property
    def rho(self) -> float:
        """The rate of (S.4) [1/s]; NaN where (S.3) does not apply."""
        if self.claims.why_not:
            return np.nan
        return float(np.min(self.claims.rates))

    @property
    def decays(self) -> dict[tuple[str, int], Decay]:
        """The constants of (S.4); none where (S.3) does not apply."""
        if self.claims.why_not:
            return {}
        return {LEVELS: Decay(self.rho, self.rho2, 1.0, 0.0)}

    @property
    def why_excluded(self) -> str:
        """What excludes samples besides alpha outside the bounds, in words."""
        return why_excluded(self.run.scenario)

    @property
    def exclusion_note(self) -> str:
        """Which samples the claim excludes, and where it starts again, in words."""
        excluded = ""
        if self.excluded:
            excluded = (
                f"{self.excluded} of {self.samples} samples are excluded: {self.why_excluded}, or"
                " alpha was outside the bounds"
            )
        restarts = ""
        if self.jumps.size:
            times = ", ".join(f"{x:.4g}" for x in self.jumps)
            restarts = f"d jumps at t = {times} s, and the claim starts again there"
        return join_notes(excluded, restarts)


def level_claims_of(scenario: Scenario) -> LevelClaims:
    """The claims about a scenario with a law that receives the levels of the plant.

    Raises:
      ValueError: a law that states half of a claim about itself.
    """
    law = unwrapped(scenario.controller)
    why_not = why_no_level_claim(scenario)
    rates, is_exact = np.zeros((0, scenario.n)), False
    if not why_not:
        stated = [
            np.broadcast_to(barrier.decay_rate(k), scenario.n)
            for barrier, k in zip(law.barriers, law.k, strict=True)
        ]
        rates = np.stack(stated)
        is_exact = all(barrier.exact_decay for barrier in law.barriers)
    return LevelClaims(law, why_not, is_exact, rates, own_claim(scenario))


def why_no_level_claim(scenario: Scenario) -> str:
    """Why (S.3) claims nothing about a scenario, in words; "" if it does."""
    law: Any = unwrapped(scenario.controller)
    if not isinstance(law, BarrierBackstepping):
        about = f"(S.3) is about BarrierBackstepping; {type(law).__name__} has no claim of this"
        return f"{about} kind"
    if adaptive_law(scenario) is not None:
        return "(S.3) is about a constant model, and AdaptiveParameters changes it"
    for i, (barrier, k) in enumerate(zip(law.barriers, law.k, strict=True)):
        if barrier.decay_rate(k) is None:
            kind = type(barrier).__name__
            return f"the barrier {kind} of level {i + 1} states no decay rate of its V"
    if scenario.loop.observer.completes:
        kind = type(scenario.observer).__name__
        return f"(S.3) is about a measured state, and the law receives levels that {kind} estimates"
    if not isinstance(scenario.actuator, Ideal):
        actuator = checks.with_article(type(scenario.actuator).__name__)
        about = "(S.3) is about an input that acts as it is commanded"
        return f"{about}; {actuator} has no claim of this kind"
    return ""


class _Extrema:
    """Running extrema over the steps of a run.  NaN propagates."""

    def __init__(self, order: int) -> None:
        self.bound_distance = np.inf
        self.rho2 = 0.0
        self.d = np.zeros(order)
        self.d_tilde = np.zeros(order)
        self.samples = 0
        self.excluded = 0
        self.V_start = np.nan
        self.V_end = np.nan

    def add(self, steps: Steps) -> None:
        """Updates the extrema with some steps."""
        proof, sample = steps.proof, steps.sample
        if self.samples == 0:
            self.V_start = proof.V[0]
        self.V_end = proof.V[-1]
        distance = np.minimum(sample.q - sample.lower, sample.upper - sample.q).min()
        self.bound_distance = np.minimum(self.bound_distance, distance)
        self.d = np.maximum(self.d, np.linalg.norm(proof.d, axis=2).max(axis=0))
        self.d_tilde = np.maximum(self.d_tilde, np.linalg.norm(proof.d_tilde, axis=2).max(axis=0))
        self.samples += steps.t.size
        self.excluded += int(proof.excluded.sum())
        if proof.claim:
            growth = np.where(proof.excluded, 0.0, growth_along(proof.claim))
            self.rho2 = np.maximum(self.rho2, growth.max())


def growth_along(claim: Any) -> np.ndarray:
    """The term g = T - sum c_i w_i |s_i|^2 with the lag of filters in T, (T,)."""
    return claim.disturbance_terms + claim.lag - claim.by_slopes  # type: ignore[no-any-return]


def level_summary(run: Any, grid: TimeGrid, all_steps: Iterable[Steps]) -> LevelSummary:
    """Extremes over all steps, and the constants that follow from them."""
    scenario = run.scenario
    extrema = _Extrema(plants.order_of(scenario.model))
    for steps in all_steps:
        extrema.add(steps)
    why_invalid = ""
    if is_valid(run):
        check_status(run, float(extrema.bound_distance))
    else:
        flags = describe(int(run.status) & int(UNTRUSTED), status_words(scenario))
        why_invalid = f"the run is not valid: {flags}"
    jumps = np.sort(np.ravel(np.asarray(scenario.jump_times())))
    return LevelSummary(
        run=run,
        claims=level_claims_of(scenario),
        why_invalid=why_invalid,
        eps=DECAY_ROUNDING * float(np.finfo(run.q.dtype).eps),
        jumps=jumps[(jumps > 0) & (jumps <= grid.duration)],
        rho2=float(extrema.rho2),
        d_largest=extrema.d,
        d_tilde_largest=extrema.d_tilde,
        samples=extrema.samples,
        excluded=extrema.excluded,
        V_ends=(float(extrema.V_start), float(extrema.V_end)),
    )
