"""The factor at which a law has a given effort, looked for among all factors of a range.

The effort need not grow with the factor, and trials may fail, so nothing is concluded from a few of
them:

1. A grid of factors is run in one batch: 2^(i / 16) from 1/4 to 4, and 2^(i / 4) beyond, to 1/32
   and 32.
2. Between two valid neighbours that have the target between them there is a crossing.  Further
   batches refine it until the factor is known to 1e-6; it is rejected if the effort jumps over the
   target there.  The places where a crossing may hide are refined, too: next to failed trials, and
   around an effort that turns back just before the target.
3. Of all crossings the one nearest to 1, by |ln factor|, is chosen.

A trial is valid if its run did not fail and is accurate.  Where the law's own run, or the one that
sets the target, is flagged inaccurate itself, inaccurate trials count as well, and the result says
so.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core.status import FAILED, WORDS, Status, describe, has_flag
from iblf_jax.core.tables import for_json

FINE_POINTS = 16
"""Grid points an octave (a factor of two) for factors from 1/4 to 4."""
FINE_OCTAVES = 2
COARSE_POINTS = 4
"""Grid points an octave beyond, to 1/32 and 32."""
MAX_OCTAVES = 5
BRACKET_WIDTH = 1e-6
"""Width of a bracket, in powers of two, from which a straight line gives the crossing."""
MAX_REFINEMENTS = 9
"""Largest number of refinement batches; a bracket takes three or four."""
HIDDEN_REFINEMENTS = 2
"""Refinement batches that also refine the intervals where a crossing may hide."""
JUMP_TOLERANCE = 1e-3
"""Relative distance to the target within which a neighbour of a crossing must be; else the effort
jumps there."""

MAX_NAMED = 4
"""Crossings, and groups of failed trials, that the text names."""

NO_EFFORT = FAILED & ~(
    Status.VELOCITY_VIOLATED | Status.REGION_VIOLATED | Status.STATE_BOUND_VIOLATED
)
"""Flags of runs whose effort is not to be compared; constraints that a law does not know of are no
obstacle."""


INFLUENCE = 0.05
"""Least change of the effort from half to twice the gains, relative to the target, with which a
factor says something about a law [1]."""


class Trials(NamedTuple):
    """The results of a batch of factors, (N,) each."""

    effort: np.ndarray
    """RMS torque above gravity [N m]."""
    status: np.ndarray
    mode: np.ndarray
    """Fastest mode [1/s]."""
    error: np.ndarray
    """Estimated error relative to the tube [1]."""


@dataclasses.dataclass(frozen=True, eq=False)
class EffortSearch:
    """All trials of the search for the factor at which the effort of a law is the target."""

    target: float
    """[N m]."""
    factors: np.ndarray
    """Of all trials, growing, (N,)."""
    efforts: np.ndarray
    """[N m], (N,), of failed trials too."""
    status: np.ndarray
    """Flags of `Status` of each trial, (N,)."""
    crossings: tuple[float, ...]
    """All factors found at which the effort is the target, the nearest to 1 first."""
    accepts_inaccurate: bool
    """Whether trials flagged INACCURATE count as valid, as the runs at the gains given are."""
    smaller_dt: float | None = None
    """A step [s] for the failed trials that may hide a better factor, where nothing but the step is
    to blame; None without such."""
    unit: str = "N m"
    """Of the efforts."""
    texts: Mapping[Status, str] = dataclasses.field(default_factory=lambda: WORDS)
    """Of each status flag."""

    @property
    def factor(self) -> float:
        """The crossing nearest to 1 by |ln factor|; NaN where there is none."""
        return next(iter(self.crossings), math.nan)

    @property
    def valid(self) -> np.ndarray:
        """Which trials are valid, (N,) bool."""
        return is_valid(self.efforts, self.status, self.accepts_inaccurate)

    @property
    def nearest(self) -> tuple[float, float]:
        """Factor and effort [N m] of the valid trial whose effort is nearest to the target; NaN
        where no trial is valid.
        """
        if not np.any(self.valid):
            return math.nan, math.nan
        away = np.where(self.valid, np.abs(self.efforts - self.target), np.inf)
        i = int(np.argmin(away))
        return float(self.factors[i]), float(self.efforts[i])

    @property
    def failed(self) -> dict[float, str]:
        """Factor -> why its run is not valid, in words."""
        why = invalid_flags(self.accepts_inaccurate)
        bad = zip(self.factors[~self.valid], self.status[~self.valid], strict=True)
        return {float(factor): describe(int(status) & why, self.texts) for factor, status in bad}

    @property
    def influence(self) -> float:
        """How much the effort depends on the gains near the factor: (largest - smallest) / target
        over the valid trials from half to twice the factor [1]; NaN without a factor.
        """
        near = self.valid & (self.factors >= self.factor / 2) & (self.factors <= 2 * self.factor)
        if not np.any(near):
            return math.nan
        return float(np.ptp(self.efforts[near]) / self.target)

    def remark(self) -> str:
        """Why the factor is missing, or says little about the law, in one line; "" if neither."""
        if not self.crossings and self.smaller_dt is not None:
            return (
                f"{self._nothing_found()}; failed trials may be valid with dt={self.smaller_dt:g}"
            )
        if not self.crossings:
            return self._nothing_found()
        if self.influence < INFLUENCE:
            return (
                f"half and twice the gains change the effort by {100 * self.influence:.2g} % only,"
                " so that it says nothing about the law"
            )
        words = []
        if len(self.crossings) > 1:
            words.append(f"the nearest to 1 of {len(self.crossings)} factors with this effort")
        if self.smaller_dt is not None:
            words.append(f"with dt={self.smaller_dt:g} failed trials nearer to 1 may be valid")
        return "; ".join(words)

    def in_words(self) -> str:
        """What was searched, what failed and what was found, in one line."""
        count, low, high = len(self.factors), self.factors[0], self.factors[-1]
        searched = f"{count} factors from {low:.3g} to {high:.3g} were run"
        return "; ".join([self._found(), searched, *self._failures()])

    def _found(self) -> str:
        if not self.crossings:
            return self._nothing_found()
        crossings = _few([f"{x:.4g}" for x in self.crossings])
        text = f"the effort is {self.target:.4g} {self.unit} at {crossings}"
        if len(self.crossings) > 1:
            text += f", of which {self.factor:.4g} is the nearest to 1"
        if self.accepts_inaccurate:
            text += " (inaccurate runs count, as those at the gains given are inaccurate)"
        return text

    def _nothing_found(self) -> str:
        efforts = self.efforts[self.valid]
        if not efforts.size:
            target = f"{self.target:.4g} {self.unit}"
            return f"none of them is valid, so no effort can be compared with {target}"
        if efforts.max() < self.target:
            side = "stays below"
        elif efforts.min() > self.target:
            side = "stays above"
        else:
            side = "does not pass through"
        factor, effort = self.nearest
        tried = f"{efforts.min():.4g} to {efforts.max():.4g}"
        where = f"its effort {side} {self.target:.4g} {self.unit} ({tried})"
        return f"{where}; the nearest of them has {effort:.4g} {self.unit}, at {factor:.4g}"

    def _failures(self) -> list[str]:
        """Each group of neighbouring trials that failed for one reason."""
        if not self.failed:
            return []
        nearest = sorted(
            self.failed_groups(), key=lambda group: min(abs(math.log(x)) for x in group[0])
        )
        groups = []
        for factors, status in nearest:
            where = f"at {factors[0]:.4g}"
            if len(factors) > 1:
                where = f"{len(factors)} from {factors[0]:.4g} to {factors[-1]:.4g}"
            groups.append(f"{where} ({_reasons(status, self.texts)})")
        words = [f"{len(self.failed)} of them fail: {_few(groups)}"]
        if self.smaller_dt is not None:
            words.append(
                f"nearest to 1 only the time step is to blame: with dt={self.smaller_dt:g} these"
                " trials may be valid"
            )
        return words

    def failed_groups(self) -> list[tuple[list[float], list[int]]]:
        """Neighbouring trials that failed, from the smallest factor on: their factors, and the
        flags for which they count as failed.
        """
        why = invalid_flags(self.accepts_inaccurate)
        trials = zip(self.valid, self.factors.tolist(), self.status.tolist(), strict=True)
        groups = []
        for counts, neighbours in itertools.groupby(trials, key=lambda trial: trial[0]):
            if not counts:
                _, factors, status = zip(*neighbours, strict=True)
                groups.append((list(factors), [flags & why for flags in status]))
        return groups

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain numbers and strings for strict JSON."""
        factor, effort = self.nearest
        trials = {"factor": self.factors, "effort": self.efforts, "status": self.status}
        return for_json({
            "target": self.target,
            "factor": self.factor,
            "crossings": self.crossings,
            "searched": [self.factors[0], self.factors[-1]],
            "accepts_inaccurate": self.accepts_inaccurate,
            "nearest": {"factor": factor, "effort": effort},
            "trials": trials,
            "failed": [{"factor": factor, "why": why} for factor, why in self.failed.items()],
            "smaller_dt": self.smaller_dt,
        })  # fmt: skip


def invalid_flags(accepts_inaccurate: bool) -> int:
    """The flags of runs that have no valid effort."""
    if accepts_inaccurate:
        return int(NO_EFFORT)
    return int(NO_EFFORT | Status.INACCURATE)


def is_valid(efforts: np.ndarray, status: np.ndarray, inaccurate: bool) -> np.ndarray:
    """Which trials are valid, (N,) bool.

    Args:
      efforts, status: of the trials, (N,).
      inaccurate: whether trials flagged INACCURATE are valid.
    """
    bad = invalid_flags(inaccurate)
    return np.isfinite(efforts) & (status & bad == 0)


def grid() -> np.ndarray:
    """Exponents, to base 2, of the factors that are tried first, in increasing order; 0 is one of
    them.
    """
    fine = np.arange(-FINE_POINTS * FINE_OCTAVES, FINE_POINTS * FINE_OCTAVES + 1) / FINE_POINTS
    outer = (
        np.arange(COARSE_POINTS * FINE_OCTAVES + 1, COARSE_POINTS * MAX_OCTAVES + 1) / COARSE_POINTS
    )
    return np.concatenate([-outer[::-1], fine, outer])


def search(
    run: Callable[[np.ndarray], Trials],
    target: float,
    needed_dt: Callable[[Trials], float | None] = lambda trials: None,
    inaccurate: bool = False,
    unit: str = "N m",
    texts: Mapping[Status, str] = WORDS,
) -> EffortSearch:
    """Finds the factors at which the effort is the target.

    Args:
      run: factors (N,) -> their trials; called with at most as many factors as the grid has.
      target: the effort to reach [N m].
      needed_dt: trials with too large a time step -> one that is small enough [s].
      inaccurate: whether trials flagged INACCURATE are valid.
      unit: of the efforts.
      texts: of each status flag.
    """
    powers = grid()
    trials = run(2.0**powers)
    powers, trials, crossings = _refined(run, target, powers, trials, inaccurate)
    ordered = tuple(2.0**power for power in sorted(crossings, key=abs))
    valid = is_valid(trials.effort, trials.status, inaccurate)
    hidden = _hidden(powers, trials, valid, crossings)
    dt = None
    if np.any(hidden):
        dt = needed_dt(Trials(*(x[hidden] for x in trials)))
    return EffortSearch(
        target, 2.0**powers, trials.effort, trials.status, ordered, inaccurate, dt, unit, texts
    )


def _hidden(
    powers: np.ndarray, trials: Trials, valid: np.ndarray, crossings: Sequence[float]
) -> np.ndarray:
    """The trials that failed only because of their time step and may hide a crossing nearer to 1,
    (N,) bool.

    Beyond the stability limit of the time step the other flags carry no information.  Where no
    crossing was found, the trials are those nearest to 1 on each side.
    """
    unstable = has_flag(trials.status, Status.STEP_TOO_LARGE)
    inaccurate = has_flag(trials.status, Status.INACCURATE)
    only_inaccurate = inaccurate & ~has_flag(trials.status, NO_EFFORT)
    blamed = ~valid & (unstable | only_inaccurate)
    if crossings:
        return blamed & (np.abs(powers) < min(map(abs, crossings)))
    nearest = np.zeros_like(blamed)
    for side in (powers <= 0, powers >= 0):
        own = np.flatnonzero(blamed & side)
        if len(own):
            nearest[own[np.argmin(np.abs(powers[own]))]] = True
    return nearest


def _refined(
    run: Callable[[np.ndarray], Trials],
    target: float,
    powers: np.ndarray,
    trials: Trials,
    inaccurate: bool,
) -> tuple[np.ndarray, Trials, list[float]]:
    """The trials with those of the refinement, in increasing order, and the exponents of the
    crossings.
    """
    for count in range(MAX_REFINEMENTS):
        excess = _excess(trials, target, inaccurate)
        places = _open_brackets(powers, excess)
        if count < HIDDEN_REFINEMENTS:
            places += _hiding_places(powers, excess)
        if not places:
            break
        # Exponents inside the intervals nearest to the factor 1, equally many in each.
        most = len(grid())
        places = sorted(places, key=lambda i: min(abs(powers[i]), abs(powers[i + 1])))[:most]
        each = max(1, most // len(places))
        share = np.arange(1, each + 1) / (each + 1)
        further = np.concatenate([powers[i] + share * (powers[i + 1] - powers[i]) for i in places])
        new = run(2.0**further)
        order = np.argsort(np.concatenate([powers, further]), kind="stable")
        powers = np.concatenate([powers, further])[order]
        trials = Trials(*(np.concatenate(pair)[order] for pair in zip(trials, new, strict=True)))
    return powers, trials, _crossings(powers, _excess(trials, target, inaccurate), target)


def _excess(trials: Trials, target: float, inaccurate: bool) -> np.ndarray:
    """Effort less target, NaN where a trial is not valid, (N,)."""
    valid = is_valid(trials.effort, trials.status, inaccurate)
    return np.where(valid, trials.effort - target, np.nan)


def _open_brackets(powers: np.ndarray, excess: np.ndarray) -> list[int]:
    """The intervals that contain a crossing and are wider than `BRACKET_WIDTH`, by the index of
    their lower end.
    """
    opposite = excess[:-1] * excess[1:] < 0.0
    return np.flatnonzero(opposite & (np.diff(powers) > BRACKET_WIDTH)).tolist()


def _hiding_places(powers: np.ndarray, excess: np.ndarray) -> list[int]:
    """The intervals in which a crossing may hide: next to failed trials, and where the effort turns
    back before the target.
    """
    finite = np.isfinite(excess)
    found = set(np.flatnonzero(finite[:-1] != finite[1:]).tolist())
    for i in range(1, len(powers) - 1):
        before, here, after = excess[i - 1 : i + 2]
        is_nearest = abs(here) <= min(abs(before), abs(after))
        same_side = min(before * here, here * after) > 0.0
        if is_nearest and same_side:
            found |= {i - 1, i}
    valid = np.flatnonzero(finite).tolist()
    for a, b in itertools.pairwise(valid):
        if b > a + 1 and excess[a] * excess[b] < 0.0:
            found |= set(range(a, b))  # the crossing is somewhere among failed trials
    brackets = set(_open_brackets(powers, excess))
    return sorted(found - brackets)


def _crossings(powers: np.ndarray, excess: np.ndarray, target: float) -> list[float]:
    """The exponents at which the excess is zero, by linear interpolation between neighbours of
    opposite sign.
    """
    found = powers[excess == 0.0].tolist()
    for i in np.flatnonzero(excess[:-1] * excess[1:] < 0.0).tolist():
        a, b = excess[i], excess[i + 1]
        if min(abs(a), abs(b)) > JUMP_TOLERANCE * abs(target):
            continue  # a jump
        found.append(float(powers[i] - a * (powers[i + 1] - powers[i]) / (b - a)))
    return _distinct(found)


def _distinct(powers: list[float]) -> list[float]:
    """Without crossings that differ by rounding only."""
    kept: list[float] = []
    for power in sorted(powers, key=abs):
        if all(abs(power - other) > 10.0 * BRACKET_WIDTH for other in kept):
            kept.append(power)
    return kept


def _few(words: Sequence[str]) -> str:
    """The first few of some words, and how many more there are."""
    text = ", ".join(words[:MAX_NAMED])
    if len(words) > MAX_NAMED:
        text += f" and {len(words) - MAX_NAMED} more"
    return text


def _reasons(status: Sequence[int], texts: Mapping[Status, str]) -> str:
    """Why some trials failed, each reason with the number of trials if not all of them failed for
    it.
    """
    words = []
    for flag, text in texts.items():
        count = sum(bool(x & flag) for x in status)
        if count == len(status):
            words.append(text)
        elif count:
            words.append(f"{text} (in {count} of them)")
    return "; ".join(words) or "the effort is not finite"
