"""One run as a certificate uses it: extremes over the whole run, the constants of its claims, and
the envelope of V along it.

A claim V' <= -rho V + g integrates to

    V(t) <= V(s) exp(-rho (t - s)) + rho2/rho   for t >= s,                (3.20), (3.28), (S.4)

from any instant s on, with rho2 = sup g along the run.  Where d jumps, and after instants that the
claim excludes, the envelope starts again at the next step.

A run is not the exact solution.  The envelope is therefore widened by the integrator's own error in
V (`reconstruction.terms_along`), which decays at the rate of the claim, and by rounding, so that V
can be followed down to the level of its noise.

`summarise` reads all steps, whatever the run recorded, twice: rho and rho2 are known after the
first pass only.  The steps of a short run are kept in between; those of a long one are
reconstructed again, so that memory stays bounded.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from iblf_jax.certificates.eigenvalues import Extremes, eigenvalues_over
from iblf_jax.certificates.reconstruction import (
    Steps,
    TimeGrid,
    check_status,
    is_valid,
    steps_of,
    time_grid,
)
from iblf_jax.certificates.terms import rounding
from iblf_jax.control.controllers import AdaptiveParameters, Saturated
from iblf_jax.core.pytree import layers, unwrapped
from iblf_jax.core.status import UNTRUSTED, describe
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.units import status_words

if TYPE_CHECKING:
    from iblf_jax.certificates.claims._base import Claim

KEPT_STEPS = 100_000
"""Largest number of steps that stay in memory between the two passes over a run."""
ENERGY_ROUNDING = 32.0
"""Rounding error of sqrt(2 V) in units of the last place, relative to the sizes of its terms."""


class DecayBound(NamedTuple):
    """The constants of a claimed decay, V_w' <= -rho V_w + gain |f'|^2; V_w is V for w_f = 1."""

    rho: float
    """[1/s]."""
    rho2: float
    """Largest further term along the run."""
    w_f: float = 1.0
    """Weight of |f_tilde|^2 in the Lyapunov function."""
    gain: float = 0.0
    """In case 2; case 1 has no f'."""


@dataclasses.dataclass(frozen=True)
class Summary:
    """Quantities of a whole run, and the claims about its scenario."""

    run: Rollout
    """Its arrays are on the host."""
    claims: tuple[Claim, ...]
    reductions: RunReductions
    """Over all steps."""
    duration: float
    """[s]."""

    @cached_property
    def law(self) -> Any:
        """The law without its wrappers (limits of the input)."""
        return unwrapped(self.run.scenario.controller)

    @cached_property
    def eps(self) -> float:
        """Relative error attributed to rounding."""
        return rounding(self.run.q.dtype)

    @cached_property
    def jumps(self) -> np.ndarray:
        """Times within the run at which the uncertain term jumps [s]."""
        jumps = np.sort(np.ravel(np.asarray(self.run.scenario.jump_times())))
        return jumps[(jumps > 0) & (jumps <= self.duration)]

    @cached_property
    def why_invalid(self) -> str:
        """Why nothing can be claimed about this run; "" if something can."""
        if is_valid(self.run):
            return ""
        words = status_words(self.run.scenario)
        return f"the run is not valid: {describe(int(self.run.status) & int(UNTRUSTED), words)}"

    @property
    def samples(self) -> int:
        """Number of samples, one for each step and one for the last instant."""
        return self.reductions.samples

    @property
    def excluded(self) -> int:
        """Number of samples that the claims exclude."""
        return self.reductions.excluded

    @cached_property
    def why_excluded(self) -> str:
        """What excludes samples from the claims, in words."""
        return why_excluded(self.run.scenario)

    @property
    def why_never(self) -> str:
        """Why the claims exclude every sample; "" if they do not."""
        return f"{self.why_excluded} all the time" if self.excluded == self.samples else ""

    def exclusion_note(self, of_alpha: str = "{}") -> str:
        """Which samples the claims exclude, in words, with what a virtual control adds to the
        reason {}; "" if none is.
        """
        if not self.excluded:
            return ""
        why = of_alpha.format(self.why_excluded)
        return f"{self.excluded} of {self.samples} samples are excluded: {why}"

    def restart_note(self, term: str) -> str:
        """Where the claims start again because the uncertain term jumps, in words; "" if it does
        not.
        """
        if not self.jumps.size:
            return ""
        times = ", ".join(f"{x:.4g}" for x in self.jumps)
        return f"{term} jumps at t = {times} s, and the claim starts again there"

    @cached_property
    def over_box(self) -> Extremes:
        """Extreme eigenvalues of M0 of a robot over the admissible box of positions."""
        reductions = self.reductions
        return eigenvalues_over(self.run.scenario.model, reductions.low, reductions.high)

    @cached_property
    def constants(self) -> dict[str, Any]:
        """Key of a claim -> its numbers for this run."""
        return {claim.key: claim.constants(self) for claim in self.claims}

    @cached_property
    def decay_bounds(self) -> dict[tuple[str, int], DecayBound]:
        """The constants of every claimed decay, by key of the claim and case."""
        return {
            (claim.key, case): decay
            for claim in self.claims
            for case, decay in claim.decay_bounds(self).items()
        }


def why_excluded(scenario: Scenario) -> str:
    """What excludes instants from the claims about the law inside its wrappers, in words."""
    changing = []
    for law in layers(scenario.controller)[:-1]:
        if law.has_auxiliary:
            changing.append(f"the auxiliary state of {type(law).__name__}")
        elif not isinstance(law, Saturated | AdaptiveParameters):
            changing.append(type(law).__name__)
    reason = "the guard or a limit of the input was active"
    if not changing:
        return reason
    inner = type(unwrapped(scenario.controller)).__name__
    return f"{reason}, or {' or '.join(changing)} changed the input of {inner}"


class Envelope(NamedTuple):
    """The bound on V along a segment, (T,) each; NaN where nothing is claimed."""

    bound: np.ndarray
    tolerance: np.ndarray
    """Error of the bound by rounding and by the integrator."""


class Segment(NamedTuple):
    """Consecutive steps of a run, and the envelopes along them."""

    summary: Summary
    t: np.ndarray
    sample: Any
    terms: Any
    """`Terms` of NumPy arrays at each step."""
    recorded: np.ndarray
    envelopes: dict[tuple[str, int], Envelope]
    """By key of the claim and case."""


def summarise(run: Rollout, claims: Sequence[Claim]) -> tuple[Summary, Iterator[Segment]]:
    """The summary of one run, its arrays on the host, and its segments in order."""
    grid, claims = time_grid(run), tuple(claims)
    if grid.last <= KEPT_STEPS:
        kept = list(steps_of(run, grid, claims))
        summary = _summary(run, grid, claims, kept)
        return summary, _segments(summary, kept)
    summary = _summary(run, grid, claims, steps_of(run, grid, claims))
    return summary, _segments(summary, steps_of(run, grid, claims))


# --- first pass: extremes over all steps ---------------------------------------------------------


class Reduction(NamedTuple):
    """A quantity of some steps, and how it is combined with that of the steps before."""

    combine: Callable[[Any, Any], Any]
    value: Any


class RunReductions(SimpleNamespace):
    """Extrema, sums, and first and last values over the steps of a run, by name, those of its
    claims (`Claim.reductions`) included.  NaN propagates.

    low, high                    bounds on positions over the run, (n,) [rad]
    bound_distance               smallest distance to a bound, () [rad]
    d_largest, d_tilde_largest   sup of the norms: of a torque, (), or of each level, (r,)
    V_start, V_end               V at the first and at the last step
    """

    samples: int = 0
    excluded: int = 0

    def add(self, steps: Steps, scenario: Scenario, claims: Sequence[Claim]) -> None:
        """Updates the reductions with some steps."""
        sample, terms = steps.sample, steps.terms
        reductions = {
            "low": Reduction(np.minimum, sample.lower.min(axis=0)),
            "high": Reduction(np.maximum, sample.upper.max(axis=0)),
            "bound_distance": Reduction(np.minimum, terms.distance[:, 0].min()),
            "d_largest": Reduction(np.maximum, largest_norm(terms.d)),
            "d_tilde_largest": Reduction(np.maximum, largest_norm(terms.d_tilde)),
            "samples": Reduction(operator.add, steps.t.size),
            "excluded": Reduction(operator.add, int(terms.excluded.sum())),
            "V_start": Reduction(lambda first, _: first, terms.V[0]),
            "V_end": Reduction(lambda _, last: last, terms.V[-1]),
        }
        for claim in claims:
            reductions |= claim.reductions(scenario, terms)
        so_far = vars(self)
        for name, (combine, value) in reductions.items():
            so_far[name] = combine(so_far[name], value) if name in so_far else value


def largest_norm(values: np.ndarray) -> np.ndarray:
    """Largest norm over time: of a torque, (), or of each level, (r,)."""
    return np.linalg.norm(values, axis=-1).max(axis=0)  # type: ignore[no-any-return]


def _summary(
    run: Rollout, grid: TimeGrid, claims: tuple[Claim, ...], all_steps: Iterable[Steps]
) -> Summary:
    """Extremes over all steps, and the constants that follow from them."""
    reductions = RunReductions()
    for steps in all_steps:
        reductions.add(steps, run.scenario, claims)
    if is_valid(run):
        check_status(run, float(reductions.bound_distance))
    return Summary(run, claims, reductions, grid.duration)


# --- second pass: envelopes ----------------------------------------------------------------------


class _Anchor(NamedTuple):
    """Start of an envelope, passed from one segment to the next."""

    t: float
    """[s]."""
    V: float
    noise: float
    carried: float
    """Error of the integrator since then, at the first step of the next segment."""


def _segments(summary: Summary, all_steps: Iterable[Steps]) -> Iterator[Segment]:
    """The segments, with the envelopes that run through them."""
    anchors: dict[tuple[str, int], _Anchor] = {}
    # The last step of the segment before decides whether an envelope starts again.
    last_t, last_excluded = np.zeros(0), np.zeros(0, bool)
    for steps in all_steps:
        t, excluded = steps.t, steps.terms.excluded
        starts = restarts(np.append(last_t, t), np.append(last_excluded, excluded), summary.jumps)
        starts = starts[last_t.size :]
        last_t, last_excluded = t[-1:], excluded[-1:]
        envelopes = {}
        for key, bound in summary.decay_bounds.items():
            envelopes[key], anchors[key] = _envelope(
                float(summary.run.dt), bound, steps, starts, anchors.get(key)
            )
        yield Segment(summary, t, steps.sample, steps.terms, steps.recorded, envelopes)


def restarts(t: np.ndarray, excluded: np.ndarray, jumps: np.ndarray) -> np.ndarray:
    """The samples at which the envelope starts, (T,) bool: the first, those after a jump, and those
    after an excluded one.
    """
    jumps_until = np.searchsorted(jumps, t, side="right")
    after_jump = jumps_until[1:] > jumps_until[:-1]
    return np.concatenate([[True], after_jump | excluded[:-1]])


def weighted_lyapunov(terms: Any, w_f: float) -> np.ndarray:
    """V_w with the weight w_f of f_tilde, (T,); V2 for w_f = 1."""
    if w_f == 1.0:
        return terms.V
    return terms.V + (w_f - 1.0) * 0.5 * np.sum(terms.d_tilde**2, axis=1)


def _envelope(
    dt: float, claimed: DecayBound, steps: Steps, starts: np.ndarray, anchor: _Anchor | None
) -> tuple[Envelope, _Anchor]:
    """The envelope along some steps and its tolerance; NaN at excluded steps, and everywhere if the
    rate is not positive.
    """
    t, terms, rho, w_f = steps.t, steps.terms, claimed.rho, claimed.w_f
    V = weighted_lyapunov(terms, w_f)
    eps = float(np.finfo(terms.V.dtype).eps)
    # The rounding error of sqrt(2 V), and the error of the integrator in V over one step.
    noise = ENERGY_ROUNDING * eps * terms.sqrt_V_size * max(1.0, w_f) ** 0.5
    defects = steps.defect + abs(w_f - 1.0) * steps.defect_f
    if anchor is None:
        anchor = _Anchor(t[0], V[0], noise[0], 0.0)
    # Index of the step at which the envelope started, plus 1; 0 for one before these steps.
    start = np.maximum.accumulate(np.where(starts, np.arange(1, t.size + 1), 0))
    start_t = np.append(anchor.t, t)[start]
    start_V = np.append(anchor.V, V)[start]
    start_noise = np.append(anchor.noise, noise)[start]
    # The integrator's errors accumulate and decay at the claimed rate.
    shrinking = np.exp(-max(rho, 0.0) * dt)
    errors, carried = [], anchor.carried
    for restart, defect in zip(starts.tolist(), defects.tolist(), strict=True):
        error = 0.0 if restart else carried
        errors.append(error)
        carried = shrinking * error + defect
    after = _Anchor(start_t[-1], start_V[-1], start_noise[-1], carried)
    if not rho > 0:
        unclaimed = np.full(t.size, np.nan)
        return Envelope(unclaimed, unclaimed), after
    bound = start_V * np.exp(-rho * (t - start_t)) + claimed.rho2 / rho
    bound = np.where(terms.excluded, np.nan, bound)
    widened = np.sqrt(2 * (bound + np.asarray(errors))) + start_noise + noise
    return Envelope(bound, 0.5 * widened**2 - bound), after
