"""One number from many perturbed runs: the mean, the tail or the worst of their losses.

    mean    sum_b L_b / B
    cvar    mean of the worst (1 - level) share of the runs, at least one: the conditional value at
            risk (expected shortfall)
    worst   max_b L_b

All gains are evaluated with the same draws (common random numbers), so that differences between
losses are differences of the gains.

Source: R. T. Rockafellar, S. Uryasev, J. Risk 2 (2000) 21-41.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core import checks

KINDS = ("mean", "cvar", "worst")


class Risk(NamedTuple):
    """How losses of perturbed runs are combined; static."""

    kind: str = "mean"
    level: float = 0.9


def as_risk(risk: str | Risk) -> Risk:
    """A Risk from what the user gave, "mean", "cvar", "worst" or `cvar(level)`."""
    if isinstance(risk, Risk):
        checks.one_of("risk", risk.kind, KINDS)
        return cvar(risk.level) if risk.kind == "cvar" else risk
    checks.one_of("risk", risk, KINDS)
    return Risk(risk)


def cvar(level: float = 0.9) -> Risk:
    """The mean of the worst (1 - level) share of the runs.

    Args:
      level: in (0, 1); 0.9 for the worst tenth.

    Returns:
      A `risk` for `tune`.

    Raises:
      ValueError: a level outside (0, 1).

    Source: Rockafellar & Uryasev 2000.
    """
    if not 0.0 < checks.positive_number("cvar: level", level, "1") < 1.0:
        raise checks.fail("cvar: level", level, "a number between 0 and 1", "0.9, for example.")
    return Risk("cvar", float(level))


def worst_count(runs: int, share: float) -> int:
    """The number of the worst `share` of some runs, at least one."""
    return max(1, math.ceil(share * runs - 1e-9))


def worst_share(x: jax.Array, share: float) -> jax.Array:
    """The mean of the largest `share` of x, (B,), at least of one entry."""
    return jnp.mean(jax.lax.top_k(x, worst_count(x.shape[0], share))[0])


def combine(risk: Risk, losses: jax.Array) -> jax.Array:
    """The risk of B losses, ()."""
    if risk.kind == "mean":
        return jnp.mean(losses)
    if risk.kind == "cvar":
        return worst_share(losses, 1 - risk.level)
    return worst_share(losses, 0.0)
