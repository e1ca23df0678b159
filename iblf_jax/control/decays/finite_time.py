"""Settling in finite time, by a power of the error below 1."""

from __future__ import annotations

import jax

from iblf_jax.control.decays._base import SIZE, Decay, power
from iblf_jax.core.pytree import Leaf, component, leaf


@component
class FiniteTime(Decay):
    """k(t, V) = k + k_a (2V + delta^2)^((a-1)/2):   z' = -k z - k_a z (z^2 + delta^2)^((a-1)/2).

    With z = sqrt(2V).  For delta = 0 it is z' = -k z - k_a z^a, which is 0 after

        T = ln(1 + k z(0)^(1-a)/k_a) / (k (1 - a)).

    Its gain at z = 0 is infinite.  With delta > 0 the gain there is k + k_a delta^(a-1), and the
    claim is |z| <= delta, from the time on that is T with k_a 2^((a-1)/2) in the place of k_a at
    the latest, because z^2 + delta^2 <= 2 z^2 outside.  Inside, z decays exponentially.  For a = 1
    the decay is exponential with k + k_a.

    Args:
      k_a: additional gain at 2V + delta^2 = 1 in the unit of V, () or (n,) [1/s], > 0.
      a: power of the error, () or (n,) [1], > 0; settling in finite time needs a < 1; 0.5 if not
        given.
      delta: size of z below which the power is smoothed, () or (n,) [rad], > 0, in the unit of z =
        sqrt(2V) of the level; 0.01 if not given.

    Source: S. P. Bhat, D. S. Bernstein, SIAM J. Control and Optimization 38 (2000) 751-766;
      smoothed as stated here.
    """

    k_a: Leaf = leaf("1/s", sign="positive")
    a: Leaf = leaf("1", sign="positive", default=0.5)
    delta: Leaf = leaf(SIZE, sign="positive", default=0.01)

    def effective_gain(self, t: jax.Array, k: jax.Array, V: jax.Array) -> jax.Array:
        """k(t, V), (n,) [1/s]."""
        return k + self.k_a * power(2.0 * V + self.delta**2, 0.5 * (self.a - 1.0))

    def band(self) -> jax.Array:
        """The V of |z| = delta, (n,)."""
        return 0.5 * self.delta**2
