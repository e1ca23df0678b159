"""No barrier: plain backstepping, the limit of the barriers as the bounds go away."""

from __future__ import annotations

import math
from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers._base import Barrier
from iblf_jax.core.pytree import component
from iblf_jax.world.bounds import Tube


@component
class Quadratic(Barrier):
    """V1 = 1/2 e1^2,   s = e1,   alpha = q_d' - k1 e1.

    It knows of no bound, so it keeps none: the unconstrained yardstick.  At e2 = 0, V1' = -2 k1 V1.
    Source: M. Krstic, I. Kanellakopoulos, P. Kokotovic, Nonlinear and Adaptive Control Design,
      1995.
    """

    guard = -math.inf
    uses_o: ClassVar[bool] = False
    value_unit: ClassVar[str] = "rad^2"
    ratio_jumps: ClassVar[bool] = False
    exact_decay: ClassVar[bool] = True

    def value(self, tube: Tube, q: jax.Array) -> jax.Array:
        """V1, (n,) [rad^2]."""
        return 0.5 * (q - tube.q_d) ** 2

    def slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """s, (n,) [rad]."""
        return q - tube.q_d

    def error_over_slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """1, (n,) [1]."""
        return jnp.ones_like(q)

    def virtual_velocity(
        self, tube: Tube, q: jax.Array, k1: jax.Array, o: jax.Array | None
    ) -> jax.Array:
        """alpha, (n,) [rad/s]."""
        return tube.dq_d - k1 * (q - tube.q_d)

    def decay_rate(self, k1: jax.Array) -> jax.Array:
        """2 k1: V1' = -2 k1 V1 at e2 = 0, (n,) [1/s]."""
        return 2.0 * k1

    def error_at(self, V: jax.Array, tube: Tube, above: jax.Array) -> jax.Array:
        """+-sqrt(2 V), (n,) [rad]."""
        size = jnp.broadcast_to(jnp.sqrt(2.0 * V), tube.q_d.shape)
        return jnp.where(above, size, -size)
