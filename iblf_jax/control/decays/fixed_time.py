"""Settling in a time that does not depend on the start, by two powers of the error."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.control.decays._base import SIZE, Decay
from iblf_jax.core.pytree import Leaf, component, leaf


@component
class FixedTime(Decay):
    """k(t, V) = k + k_a (2V + delta^2)^((a-1)/2) + k_b (2V + delta^2)^((b-1)/2),   a < 1 < b.

    With z = sqrt(2V) and delta = 0 it is z' = -k z - k_a z^a - k_b z^b.  The term of b dominates
    far from 0, that of a near 0.  |z| <= delta holds from

        T = 2^((1-a)/2)/(k_a (1 - a)) + 1/(k_b (b - 1))

    on at the latest, for every start: the first term is the time from |z| = 1 with k_a 2^((a-1)/2)
    z^a alone, the second that from infinity to |z| = 1 with k_b z^b alone.

    Args:
      k_a: additional gain by the power a at 2V + delta^2 = 1 in the unit of V, () or (n,) [1/s], >
        0.
      k_b: additional gain by the power b there, () or (n,) [1/s], > 0.
      a: lower power of the error, () or (n,) [1], > 0; settling needs a < 1; 0.5 if not given.
      b: upper power of the error, () or (n,) [1], > 0; a time for every start needs b > 1; 1.5 if
        not given.
      delta: size of z below which the powers are smoothed, () or (n,) [rad], > 0, in the unit of z
        = sqrt(2V) of the level; 0.01 if not given.

    Source: A. Polyakov, IEEE Trans. Automatic Control 57 (2012) 2106-2110; smoothed as stated here.
    """

    k_a: Leaf = leaf("1/s", sign="positive")
    k_b: Leaf = leaf("1/s", sign="positive")
    a: Leaf = leaf("1", sign="positive", default=0.5)
    b: Leaf = leaf("1", sign="positive", default=1.5)
    delta: Leaf = leaf(SIZE, sign="positive", default=0.01)

    def effective_gain(self, t: jax.Array, k: jax.Array, V: jax.Array) -> jax.Array:
        """k(t, V), (n,) [1/s]."""
        log_size = 0.5 * jnp.log(2.0 * V + self.delta**2)  # one logarithm for both powers
        near_zero = self.k_a * jnp.exp((self.a - 1.0) * log_size)
        far_from_zero = self.k_b * jnp.exp((self.b - 1.0) * log_size)
        return k + near_zero + far_from_zero

    def band(self) -> jax.Array:
        """The V of |z| = delta, (n,)."""
        return 0.5 * self.delta**2
