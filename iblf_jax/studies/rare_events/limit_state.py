"""The limit state: the margin of runs as a function of d independent standard normal numbers.

A run fails where its margin y(z) is not above 0, and its probability of failure is

    p = P(y(Z) <= 0),      Z ~ N(0, I_d),

over the draws that can be run.  The margin of a draw that cannot be run is NaN; the algorithms
exclude these draws, so p is a probability given that a draw can be run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

LimitState = Callable[[np.ndarray], np.ndarray]
"""Points z, (k, d) -> margins (k,); NaN for points that cannot be run."""

MIN_PROBABILITY = 1e-300
"""Probability below which none is reported."""
NO_RUN = "No draw could be run, so nothing is known about the probability."


class Level(NamedTuple):
    """One conditional level, or all samples of a method without levels."""

    threshold: float
    """The margin that defines the next level; 0 in the last one if failures were reached."""
    probability: float
    """Estimated probability that the margin is not above the threshold, given the level before."""
    margins: np.ndarray
    """Of the samples, (N,)."""
    coefficient_of_variation: float
    """Of the probability."""
    acceptance: float
    """Share of the candidates of the Markov chains that were accepted; 1 for independent
    samples."""


def converge(levels: Sequence[Level]) -> bool:
    """Whether the second half of the thresholds differs by less than 1 %, of at least 4."""
    half, last = len(levels) // 2, levels[-1].threshold
    return half >= 2 and levels[half].threshold - last < 0.01 * last


def stagnate(levels: Sequence[Level]) -> bool:
    """Whether the thresholds of levels no longer come nearer to 0: they converge to another margin,
    or no sample is below the last one.
    """
    last = levels[-1]
    return converge(levels) or (last.threshold > 0 and last.probability == 1)


class Samples(NamedTuple):
    """Samples with their margins and weights."""

    z: np.ndarray
    """(k, d)."""
    margins: np.ndarray
    """(k,)."""
    weights: np.ndarray
    """Proportional to what each counts, (k,)."""

    @staticmethod
    def none(dimension: int) -> Samples:
        """No sample."""
        return Samples(np.zeros((0, dimension)), np.zeros(0), np.zeros(0))


class Estimate(NamedTuple):
    """The probability of failure, by one of the methods."""

    probability: float
    """The estimate; an upper bound at the confidence of the interval if no failure was found."""
    low: float
    high: float
    coefficient_of_variation: float
    """Infinite if no failure was found."""
    levels: tuple[Level, ...]
    failures: Samples
    """The samples that failed."""
    nearby: Samples
    """Samples with which a changed limit state is assessed: those of the last level of subset
    simulation, or the failures."""
    nearby_probability: float
    """Estimated probability of the set that they are samples of."""
    estimator: str
    """"subset", "importance" or "monte_carlo"."""
    effective_samples: float
    """Number of equally weighted independent failures with the same information."""
    notes: tuple[str, ...] = ()
    """What limits the estimate, in sentences."""

    @property
    def is_upper_bound(self) -> bool:
        """Whether no sample failed."""
        return not len(self.failures.margins)


def log_normal_interval(
    probability: float, variation: float, confidence: float
) -> tuple[float, float]:
    """The interval of an estimate whose logarithm is normal, from its coefficient of variation.

    p exp(+-Phi^-1((1 + confidence) / 2) sqrt(log(1 + variation^2)))
    """
    from scipy.special import ndtri

    width = ndtri(0.5 + confidence / 2) * np.sqrt(np.log1p(variation**2))
    return float(probability * np.exp(-width)), float(min(1.0, probability * np.exp(width)))


def binomial_interval(count: float, runs: float, confidence: float) -> tuple[float, float]:
    """The Clopper-Pearson interval; `count` and `runs` need not be whole."""
    from scipy.special import betaincinv

    tail = 0.5 * (1 - confidence)
    low, high = 0.0, 1.0
    if count > 0:
        low = float(betaincinv(count, runs - count + 1, tail))
    if count < runs:
        high = float(betaincinv(count + 1, runs - count, 1 - tail))
    return low, high


def upper_bound(runs: float, confidence: float) -> float:
    """The largest probability with which no event in so many independent runs is plausible.

    1 - (1 - confidence)^(1 / runs)
    """
    return float(-np.expm1(np.log1p(-confidence) / max(runs, 1.0)))
