"""Crude Monte-Carlo simulation: the share of independent draws that fail."""

from __future__ import annotations

import numpy as np

from iblf_jax.studies.rare_events.limit_state import (
    NO_RUN,
    Estimate,
    Level,
    LimitState,
    Samples,
    binomial_interval,
    upper_bound,
)


def crude_monte_carlo(
    limit_state: LimitState, dimension: int, *, runs: int, seed: int, confidence: float
) -> Estimate:
    """The share of failures among independent draws, with the Clopper-Pearson interval.

        p = (number of draws with y <= 0) / (number of draws that can be run)

    Args:
      limit_state: margins of points.
      dimension: d.
      runs: number of draws.
      seed: of the draws.
      confidence: of the interval.
    """
    z = np.random.default_rng([seed, 0]).standard_normal((runs, dimension))
    return estimate_of_draws(z, limit_state(z), confidence)


def estimate_of_draws(z: np.ndarray, margins: np.ndarray, confidence: float) -> Estimate:
    """The estimate from independent draws, (N, d), and their margins, (N,)."""
    can_run = ~np.isnan(margins)
    z, margins = z[can_run], margins[can_run]
    runs = len(margins)
    failed = margins <= 0
    count = int(np.sum(failed))
    notes: tuple[str, ...] = ()
    if not runs:
        notes = (NO_RUN,)
    if not count:
        bound = upper_bound(runs, confidence) if runs else 1.0
        level = Level(0.0, 0.0, margins, np.inf, 1.0)
        nothing = Samples.none(z.shape[1])
        return Estimate(
            bound, 0.0, bound, np.inf, (level,), nothing, nothing, 1.0, "monte_carlo", 0.0, notes
        )
    p = count / runs
    variation = float(np.sqrt((1 - p) / count))
    low, high = binomial_interval(count, runs, confidence)
    level = Level(0.0, p, margins, variation, 1.0)
    failures = Samples(z[failed], margins[failed], np.ones(count))
    return Estimate(
        probability=p,
        low=low,
        high=high,
        coefficient_of_variation=variation,
        levels=(level,),
        failures=failures,
        nearby=failures,
        nearby_probability=p,
        estimator="monte_carlo",
        effective_samples=float(count),
        notes=notes,
    )
