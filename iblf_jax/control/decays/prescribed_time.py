"""Settling at a time that the user chooses, by a gain that grows towards it."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.decays._base import Decay
from iblf_jax.core.pytree import Leaf, component, leaf


@component
class PrescribedTime(Decay):
    """k(t, V) = k + gain/h(T - t),   h(s) = s for s >= 2 gain/cap,   h(s) = gain/cap for s <= 0.

    With z = sqrt(2V), z' = -k z - gain z/(T - t) gives z(t) = z(0) exp(-k t) ((T - t)/T)^gain,
    which is 0 at T.  The gain would be infinite there; h bounds it by `cap`, reached at T, with
    four continuous derivatives:

        h(s) = c (1 + u^5 (14 - 28 u + 20 u^2 - 5 u^3)),   u = clip(s/(2c), 0, 1),   c = gain/cap

    for s <= 2c.  What is claimed at T is not 0 but z(T) <= z(0) exp(-k T) (2c/T)^gain for 2c <= T;
    afterwards the decay is exponential with k + cap.  For T -> infinity it is exponential with k.

    Args:
      T: time of settling, () or (n,) [s], > 0.
      gain: order of the zero of z at T, () or (n,) [1], > 0; u is bounded without the cap if it is
        larger than the order of the plant; 4 if not given.
      cap: largest additional gain, () or (n,) [1/s], > 0; 50 if not given.

    Source: Y. Song, Y. Wang, J. Holloway, M. Krstic, Automatica 83 (2017) 243-251; bounded by `cap`
      as stated here.
    """

    T: Leaf = leaf("s", sign="positive")
    gain: Leaf = leaf("1", sign="positive", default=4.0)
    cap: Leaf = leaf("1/s", sign="positive", default=50.0)
    smooth_derivatives: ClassVar[int] = 4

    def effective_gain(self, t: jax.Array, k: jax.Array, V: jax.Array) -> jax.Array:
        """k(t, V), (n,) [1/s]."""
        shortest = self.gain / self.cap
        rest = self.T - t
        u = jnp.clip(0.5 * rest / shortest, 0.0, 1.0)
        ramp = u**5 * (14.0 + u * (-28.0 + u * (20.0 - 5.0 * u)))
        remaining = jnp.where(u < 1.0, shortest * (1.0 + ramp), rest)
        return k + self.gain / remaining

    def deadline(self) -> jax.Array:
        """T, (n,) [s]."""
        return self.T
