"""Subset simulation: a rare failure as a sequence of conditional events that are not rare.

With thresholds b_1 > b_2 > ... > b_L = 0 of the margin y,

    P(y <= 0) = P(y <= b_1) P(y <= b_2 | y <= b_1) ... P(y <= 0 | y <= b_{L-1}).

Each b_l is the quantile of the margins of level l at which a share p0 of the samples lies below; if
the largest margin is an atom of more than 1 - p0 (that of a start that all runs share), it is the
largest margin below the atom.  The samples up to b_l are the first states of Markov chains, which
generate the samples of the next level, distributed as N(0, I) restricted to y <= b_l.  A chain
proposes in each component

    z'_j = sqrt(1 - s_j^2) z_j + s_j w_j,      w_j ~ N(0, 1),

which leaves N(0, I) unchanged, and rejects a candidate with y(z') > b_l.  The steps s_j are
proportional to the standard deviations of the first states and adapted so that 44 % of the
candidates are accepted.  All chains of a level advance together, in one batch of runs.

The coefficient of variation of the conditional probability of a level with N samples is

    delta^2 = (1 - p) / (p N) (1 + gamma),

where gamma accounts for correlated samples.  The chains of a level are correlated where their first
states have one ancestor; samples with a common ancestor one level before are one cluster, and

    1 + gamma = sum over clusters c of S_c^2 / (N p (1 - p)),      S_c = sum in c of (I - p),

with I = 1 where y <= b.  If no two chains had a common ancestor, this would be equation (29) of Au
and Beck without its assumption of stationary covariances.  The estimates of different levels are
correlated as well, because the samples below the threshold of one level are the first states of
the next.  With clusters c of samples of both levels that have one ancestor, of the generation
before the earlier level,

    delta^2 = sum_l delta_l^2 + 2 sum_{l < m} max(0, sum_c S_lc S_mc / (N_l p_l N_m p_m)).

Source: S. K. Au, J. L. Beck, Probabilistic Engineering Mechanics 16 (2001) 263-277; the chains: I.
  Papaioannou, W. Betz, K. Zwirglmaier, D. Straub, ibid. 41 (2015) 89-103.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iblf_jax.studies.rare_events.crude import estimate_of_draws
from iblf_jax.studies.rare_events.limit_state import (
    MIN_PROBABILITY,
    Estimate,
    Level,
    LimitState,
    Samples,
    converge,
    log_normal_interval,
    upper_bound,
)

FIRST_SCALE = 0.6
"""Step of the chains in units of the standard deviation of their first states, at the start."""
FEWEST_CHAINS = 10
"""Smallest number of samples below an atom of the margin from which a level is generated."""
LONGEST_CHAIN = 100
"""Largest number of states of a chain, of which each is a batch of runs."""
TARGET_ACCEPTANCE = 0.44
"""Share of accepted candidates for which the steps are adapted (Papaioannou et al., section 3)."""
NO_FAILURE = (
    "No sample failed, so the estimate is an upper bound, for the failures that the levels lead to,"
    " and no estimate of the size of the probability."
)
STALLED = (
    "Fewer than {chains} samples of the last level have a margin below {margin:.4g}, which all"
    " others have: no level nearer to failure was generated."
)
CONVERGED = (
    "The margins approach {margin:.4g} and not 0: the last {count} of {levels} levels came nearer"
    " to failure by less than 1 %. No failure was reached. If the distributions are bounded, the"
    " probability may be 0: ij.falsify searches for a draw that fails, and ij.prove for a proof"
    " that none does."
)
OUT_OF_LEVELS = (
    "The limit of {levels} levels was reached before a share {share:g} of the samples failed."
)


class Population(NamedTuple):
    """The samples of a level."""

    z: np.ndarray
    """(N, d)."""
    margins: np.ndarray
    """(N,)."""
    chain: np.ndarray
    """Number of the chain of each sample, (N,)."""
    parent: np.ndarray
    """Number of the chain of the level before in which the first state of the sample's chain
    was, (N,)."""
    acceptance: float
    """Share of the candidates that were accepted."""


def subset_simulation(
    limit_state: LimitState,
    dimension: int,
    *,
    runs: int,
    share: float,
    levels: int,
    seed: int,
    confidence: float,
) -> Estimate:
    """The probability of failure by subset simulation.

    Args:
      limit_state: margins of points.
      dimension: d.
      runs: samples of a level; share * runs chains of 1 / share states.
      share: conditional probability p0 of the levels before the last.
      levels: largest number of levels.
      seed: of the draws and chains.
      confidence: of the interval.
    """
    z = np.random.default_rng([seed, 0]).standard_normal((runs, dimension))
    margins = limit_state(z)
    can_run = ~np.isnan(margins)
    number = np.arange(int(np.sum(can_run)))
    samples = Population(z[can_run], margins[can_run], number, number, 1.0)
    if np.sum(samples.margins <= 0) >= share * len(number):
        return estimate_of_draws(z, margins, confidence)
    scale = FIRST_SCALE
    found: list[Level] = []
    history: list[tuple[Population, float]] = []
    notes: list[str] = []
    while True:
        threshold = next_threshold(samples.margins, share)
        inside = samples.margins <= threshold
        found.append(_level(samples, threshold))
        history.append((samples, threshold))
        if threshold <= 0:
            break
        if np.all(inside):
            notes.append(STALLED.format(chains=FEWEST_CHAINS, margin=threshold))
            break
        if len(found) == levels:
            notes.append(OUT_OF_LEVELS.format(levels=levels, share=share))
            break
        rng = np.random.default_rng([seed, len(found)])
        samples, scale = _next_level(limit_state, samples, threshold, share, scale, rng)
    return _estimate(found, history, confidence, notes)


def next_threshold(margins: np.ndarray, share: float) -> float:
    """The quantile of the margins below which a share of them lies, at least 0.

    If all margins are up to it, it is the largest of those that are smaller, if there are enough.
    """
    count = max(1, round(share * len(margins)))
    ordered = np.sort(margins)
    quantile = 0.5 * (ordered[count - 1] + ordered[min(count, len(ordered) - 1)])
    if not np.isfinite(quantile):
        quantile = ordered[count - 1]
    below = ordered[ordered < ordered[-1]]
    if quantile == ordered[-1] and len(below) >= FEWEST_CHAINS:
        quantile = below[-1]
    return float(max(quantile, 0.0))


def _level(samples: Population, threshold: float) -> Level:
    p = float(np.mean(samples.margins <= threshold))
    deviations = relative_deviations(samples, threshold)
    variation = float(np.sqrt(_sum_of_squares(np.bincount(samples.parent, deviations))))
    return Level(threshold, p, samples.margins, variation, samples.acceptance)


def _next_level(
    limit_state: LimitState,
    samples: Population,
    threshold: float,
    share: float,
    scale: float,
    rng: np.random.Generator,
) -> tuple[Population, float]:
    """The samples of the next level and the scale of the last step."""
    inside = np.flatnonzero(samples.margins <= threshold)
    chains = min(len(inside), max(1, round(share * len(samples.margins))))
    first = np.sort(rng.permutation(inside)[:chains])
    states = [samples.z[first]]
    margins = [samples.margins[first]]
    spread = np.std(states[0], axis=0)
    acceptance = 0.0
    states_of_chain = min(round(len(samples.margins) / chains), LONGEST_CHAIN)
    steps = max(1, states_of_chain - 1)
    for step in range(1, steps + 1):
        size = np.minimum(scale * spread, 1.0)
        noise = rng.standard_normal(states[-1].shape)
        candidates = np.sqrt(1 - size**2) * states[-1] + size * noise
        found = limit_state(candidates)
        accepted = found <= threshold  # False for NaN
        states.append(np.where(accepted[:, None], candidates, states[-1]))
        margins.append(np.where(accepted, found, margins[-1]))
        rate = float(np.mean(accepted))
        acceptance += rate / steps
        scale = float(scale * np.exp((rate - TARGET_ACCEPTANCE) / np.sqrt(step)))
    chain = np.tile(np.arange(chains), len(states))
    population = Population(
        z=np.concatenate(states),
        margins=np.concatenate(margins),
        chain=chain,
        parent=np.tile(samples.chain[first], len(states)),
        acceptance=acceptance,
    )
    return population, scale


def _estimate(
    levels: list[Level],
    history: list[tuple[Population, float]],
    confidence: float,
    notes: list[str],
) -> Estimate:
    """The product of the conditional probabilities, its interval, and the failures."""
    last, _ = history[-1]
    failed = last.margins <= 0
    before = float(np.prod([level.probability for level in levels[:-1]]))
    nearby = Samples(last.z, last.margins, np.ones(len(last.margins)))
    if not np.any(failed):
        # The upper end of the interval of the probability of the last level, times the bound of
        # independent samples, one for each parent.
        reached = before
        if before < 1:
            _, reached = log_normal_interval(before, variation_of(history[:-1]), confidence)
        reached *= upper_bound(len(np.unique(last.parent)), confidence)
        if converge(levels):
            count = len(levels) - len(levels) // 2
            margin = levels[-1].threshold
            notes = [CONVERGED.format(margin=margin, count=count, levels=len(levels)), *notes]
        return Estimate(
            probability=reached,
            low=0.0,
            high=reached,
            coefficient_of_variation=np.inf,
            levels=tuple(levels),
            failures=Samples.none(last.z.shape[1]),
            nearby=nearby,
            nearby_probability=before,
            estimator="subset",
            effective_samples=0.0,
            notes=(NO_FAILURE, *notes),
        )
    levels = [*levels[:-1], _level(last, 0.0)]
    history = [*history[:-1], (last, 0.0)]
    p = max(before * float(np.mean(failed)), MIN_PROBABILITY)
    variation = variation_of(history)
    low, high = log_normal_interval(p, variation, confidence)
    count = int(np.sum(failed))
    return Estimate(
        probability=p,
        low=low,
        high=high,
        coefficient_of_variation=variation,
        levels=tuple(levels),
        failures=Samples(last.z[failed], last.margins[failed], np.ones(count)),
        nearby=nearby,
        nearby_probability=before,
        estimator="subset",
        effective_samples=1 / max(variation, 1e-8) ** 2,
        notes=tuple(notes),
    )


def variation_of(history: list[tuple[Population, float]]) -> float:
    """The coefficient of variation of the product of the conditional probabilities.

    Args:
      history: samples and threshold of each level.
    """
    total = 0.0
    for number, (samples, threshold) in enumerate(history):
        deviations = relative_deviations(samples, threshold)
        total += _sum_of_squares(np.bincount(samples.parent, deviations))
        ancestor = samples.parent
        for earlier, its_threshold in reversed(history[:number]):
            parent_of_chain = np.zeros(np.max(earlier.chain) + 1, int)
            parent_of_chain[earlier.chain] = earlier.parent
            ancestor = parent_of_chain[ancestor]
            its_deviations = relative_deviations(earlier, its_threshold)
            count = max(np.max(ancestor), np.max(earlier.parent)) + 1
            of_earlier = np.bincount(earlier.parent, its_deviations, count)
            of_later = np.bincount(ancestor, deviations, count)
            total += 2 * max(0.0, float(of_earlier @ of_later))
    return float(np.sqrt(total))


def relative_deviations(samples: Population, threshold: float) -> np.ndarray:
    """(I / p - 1) / N of each sample, whose sum over other samples would be the relative error of
    p.
    """
    inside = samples.margins <= threshold
    return (inside / np.mean(inside) - 1) / len(inside)


def _sum_of_squares(x: np.ndarray) -> float:
    return float(np.sum(x**2))
