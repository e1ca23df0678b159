"""The decay with a constant gain."""

from __future__ import annotations

from typing import ClassVar

import jax

from iblf_jax.control.decays._base import Decay
from iblf_jax.core.pytree import component


@component
class Exponential(Decay):
    """k(t, V) = k:   z' = -k z, z = sqrt(2V).

    z(t) = z(0) exp(-k t): the error tends to 0 and does not reach it.  A law for
    which no decay is given has this one.  Name it for a level of a law whose other levels have
    another decay.

    Source: M. Krstic, I. Kanellakopoulos, P. Kokotovic, Nonlinear and Adaptive Control Design,
      1995.
    """

    constant: ClassVar[bool] = True

    def effective_gain(self, t: jax.Array, k: jax.Array, V: jax.Array) -> jax.Array:
        """k, (n,) [1/s]."""
        return k
