"""Importance sampling around design points.

Samples come from a mixture of standard normal distributions around the K design points,

    q(z) = sum_k alpha_k N(z; z_k, I),      p = E_q[w 1(y <= 0)],      w = N(z; 0, I) / q(z),

with weights alpha_k proportional to Phi(-|z_k|), but at least `LEAST_SHARE` / K.  The estimate is
unbiased whatever the points are.  How good it is follows from the weights of the failures: the
effective number of samples is (sum w)^2 / sum w^2.  The shape k of a generalised Pareto
distribution that is fitted to the largest weights shows whether their variance exists: for
k > 1/2 it does not.
An estimate with few effective samples, one dominating weight or k above 1/2 is flagged as
degenerate; a failure region that bends towards the origin has such weights.

If none of N samples fails, q(failure) is at most b = 1 - (1 - confidence)^(1 / N) at the
confidence.  This is no bound of p: a set of probability p has at least Phi(Phi^-1(p) - |z_k|) under
N(z_k, I), which a half space behind the origin attains, so

    p <= min_k Phi(Phi^-1(b / alpha_k) + |z_k|).

Source: O. Ditlevsen, H. O. Madsen, Structural Reliability Methods, chapter 9; A. B. Owen, Y. Zhou,
  J. American Statistical Association 95 (2000) 135-143 (mixtures); A. Vehtari et al., J. Machine
  Learning Research 25 (2024), 72 (the shape k); the fit: J. Zhang, M. A. Stephens, Technometrics 51
  (2009) 316-325.
"""

from __future__ import annotations

import numpy as np

from iblf_jax.studies.rare_events.limit_state import (
    MIN_PROBABILITY,
    NO_RUN,
    Estimate,
    Level,
    LimitState,
    Samples,
    log_normal_interval,
    upper_bound,
)

LEAST_SHARE = 0.1
"""Share of the samples that is distributed evenly over the design points."""
FEW_SAMPLES = 50.0
"""Effective number of failures below which the estimate is flagged."""
LARGE_WEIGHT = 0.1
"""Share of a single sample of the sum of the weights above which the estimate is flagged."""
LARGE_SHAPE = 0.5
"""Shape of the tail of the weights above which the estimate is flagged."""
FEWEST_IN_TAIL = 5
"""Smallest number of weights to which a tail is fitted."""
DEGENERATE = (
    "The weights are degenerate: {effective:.1f} effective failures, {largest:.0%} of the weight"
    " in one sample, shape of the tail {shape:.2f}. The interval is not reliable; take more runs"
    " or estimator='subset'."
)
NONE_FAILED = (
    "No sample around the design points failed, so the estimate is an upper bound, and a large one"
    " where they are far from the origin."
)


def importance_sampling(
    limit_state: LimitState,
    points: np.ndarray,
    *,
    runs: int,
    seed: int,
    confidence: float,
    runnable: float = 1.0,
) -> Estimate:
    """The probability of failure by samples around design points.

    Args:
      limit_state: margins of points.
      points: design points, (K, d).
      runs: number of samples, at least 2.
      seed: of the samples.
      confidence: of the interval.
      runnable: probability that a draw can be run, by which the estimate is divided.  If it is 0,
        the estimate is the upper bound 1.
    """
    from scipy.special import ndtr

    rng = np.random.default_rng([seed, 1])
    radius = np.linalg.norm(points, axis=1)
    share = ndtr(-radius)
    share = (1 - LEAST_SHARE) * share / np.sum(share) + LEAST_SHARE / len(points)
    index = rng.choice(len(points), size=runs, p=share)
    z = points[index] + rng.standard_normal((runs, points.shape[1]))
    margins = limit_state(z)
    weights = np.exp(-log_mixture_ratio(z, points, share))
    failed = margins <= 0  # False for NaN
    can_run = ~np.isnan(margins)
    if runnable == 0:
        return _upper_bound(1.0, NO_RUN, margins[can_run], z.shape[1])
    if not np.any(failed):
        bound = bound_without_failures(radius, share, runs, confidence) / runnable
        return _upper_bound(min(1.0, bound), NONE_FAILED, margins[can_run], z.shape[1])
    weights = weights / runnable
    contributions = np.where(failed, weights, 0.0)
    p = float(np.mean(contributions))
    samples = Samples(z[failed], margins[failed], weights[failed])
    effective = float(np.sum(contributions)) ** 2 / float(np.sum(contributions**2))
    largest = float(np.max(contributions) / np.sum(contributions))
    variation = float(np.std(contributions, ddof=1)) / (p * np.sqrt(runs))
    low, high = log_normal_interval(p, variation, confidence)
    notes: tuple[str, ...] = ()
    shape = tail_shape(samples.weights)
    # The comparison is negated because the fit of a tail may be NaN.
    if effective < FEW_SAMPLES or largest > LARGE_WEIGHT or not shape <= LARGE_SHAPE:
        notes = (DEGENERATE.format(effective=effective, largest=largest, shape=shape),)
    return Estimate(
        probability=min(max(p, MIN_PROBABILITY), 1.0),
        low=low,
        high=high,
        coefficient_of_variation=variation,
        levels=(Level(0.0, p, margins[can_run], variation, 1.0),),
        failures=samples,
        nearby=samples,
        nearby_probability=p,
        estimator="importance",
        effective_samples=effective,
        notes=notes,
    )


def _upper_bound(bound: float, note: str, margins: np.ndarray, dimension: int) -> Estimate:
    """The estimate without a failure among samples with these margins."""
    none = Samples.none(dimension)
    return Estimate(
        probability=bound,
        low=0.0,
        high=bound,
        coefficient_of_variation=np.inf,
        levels=(Level(0.0, 0.0, margins, np.inf, 1.0),),
        failures=none,
        nearby=none,
        nearby_probability=1.0,
        estimator="importance",
        effective_samples=0.0,
        notes=(note,),
    )


def bound_without_failures(
    radius: np.ndarray, share: np.ndarray, runs: int, confidence: float
) -> float:
    """The largest probability of failure with which no failure among the samples is plausible.

    Args:
      radius: distances of the design points from the origin, (K,).
      share: their shares of the samples, (K,).
      runs: number of samples.
      confidence: of the bound.
    """
    from scipy.special import ndtr, ndtri

    within_each = np.minimum(1.0, upper_bound(runs, confidence) / share)
    return float(np.min(ndtr(ndtri(within_each) + radius)))


def log_mixture_ratio(z: np.ndarray, points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """log(q(z) / N(z; 0, I)) of each sample, (N,)."""
    from scipy.special import logsumexp

    exponents = z @ points.T - 0.5 * np.sum(points * points, axis=1)
    return np.asarray(logsumexp(exponents + np.log(share), axis=1))


def tail_shape(weights: np.ndarray) -> float:
    """Shape k of the generalised Pareto distribution of the largest weights; infinite for fewer
    than FEWEST_IN_TAIL of them, -infinite if they are all equal.
    """
    count = int(min(0.2 * len(weights), 3 * np.sqrt(len(weights))))
    if count < FEWEST_IN_TAIL:
        return np.inf
    ordered = np.sort(weights)
    excess = ordered[-count:] - ordered[-count - 1]
    if not np.any(excess > 0):
        return -np.inf
    # The estimator of Zhang and Stephens, from the ordered sample.
    x = excess[excess > 0]
    n = len(x)
    grid = 30 + int(np.sqrt(n))
    quartile = x[int(0.25 * n + 0.5) - 1] if n > 2 else x[0]
    theta = 1 / x[-1] + (1 - np.sqrt(grid / (np.arange(grid) + 0.5))) / (3 * quartile)
    shapes = np.mean(np.log1p(-theta[:, None] * x), axis=1)
    likelihood = n * (np.log(-theta / shapes) - shapes - 1)
    posterior = np.exp(likelihood - np.max(likelihood))
    mean = np.sum(theta * posterior) / np.sum(posterior)
    return float(np.mean(np.log1p(-mean * x)))
