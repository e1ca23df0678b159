"""The contract of a decay: the gain with which a level of a law is driven to zero.

The virtual velocity of a barrier is linear in its gain, and its claim V' <= -rate(k) V holds at
every instant for the gain of that instant.  A gain k(t, V) in the place of the constant k therefore
gives

    V' <= -rate(k(t, V)) V,

with equality for `TransformedError`, `PrescribedPerformance`, `Quadratic` (rate 2k) and `Tan` (rate
k).  In z = sqrt(2V), which is the size of the mapped error for the first three, this is
z' = -k(t, V) z.
For `Integral` (rate 2k) and `Log` (rate 2pk) it is an inequality: z decays at least as fast.

**Contract.**  k(t, V) >= k.  All claims that a law and a certificate state for the constant gain
then remain true, and the decay adds its own: a time after which V is inside a band.

V is the value of the barrier without the weight of the law.  `controllers.Backstepping` and
`DynamicSurface` have no barrier in their second step; there V is the energy W = 1/2 e2^T M0 e2, the
gain k is 0, and the torque -M0 k(t, W) e2 adds -2 k(t, W) W to W'.
"""

from __future__ import annotations

import abc
import math
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.core.families import Part
from iblf_jax.core.units import PlantUnit

if TYPE_CHECKING:
    from iblf_jax.control.barriers import Barrier
    from iblf_jax.world.bounds import Tube

SIZE = PlantUnit("rad", "z")
"""Unit of z = sqrt(2V)."""


class Decay(Part):
    """The contract of a decay.  All arrays are (n,), one number a joint, and joints do not mix."""

    constant: ClassVar[bool] = False
    """Whether the gain is k at all times, so that a law does not compute V for it."""
    smooth_derivatives: ClassVar[float] = math.inf
    """The number of continuous derivatives that the gain has as a function of t and V."""

    @abc.abstractmethod
    def effective_gain(self, t: jax.Array, k: jax.Array, V: jax.Array) -> jax.Array:
        """The gain k(t, V) >= k, (n,) [1/s].

        Args:
          t: time, () [s].
          k: constant gain of the level, (n,) [1/s], >= 0.
          V: value of the barrier, (n,), in its unit, >= 0.
        """

    def band(self) -> jax.Array | None:
        """The V below which nothing more is claimed, (n,)."""
        return None

    def deadline(self) -> jax.Array | None:
        """Time from which z <= z(0) exp(-k T) (2c/T)^gain holds, as `PrescribedTime` states, (n,)
        [s]; None without.
        """
        return None


def gain_at(
    decay: Decay, t: jax.Array, k: jax.Array, barrier: Barrier, tube: Tube, x: jax.Array
) -> Any:
    """The gain of one level of a law, (n,) [1/s]; k itself for a constant decay.

    Args:
      decay: of the level.
      t: time, () [s].
      k: constant gain of the level, (n,) [1/s].
      barrier, tube: of the level.
      x: state of the level, (n,).
    """
    if decay.constant:
        return k
    return decay.effective_gain(t, k, barrier.value(tube, x))


def energy_gain(decay: Decay, t: jax.Array, W: jax.Array, like: jax.Array) -> jax.Array:
    """The gain of an energy W, () [1/s], which all joints share: the mean of those of the joints.

    Args:
      decay: of the second step.
      t: time, () [s].
      W: energy 1/2 e2^T M0 e2, () [N m rad].
      like: an array of the shape (n,).
    """
    zero = jnp.zeros_like(like)
    return jnp.mean(decay.effective_gain(t, zero, zero + W))


def power(base: jax.Array, exponent: jax.Array) -> jax.Array:
    """base^exponent for a positive base, with derivatives of every order."""
    return jnp.exp(exponent * jnp.log(base))
