"""The tangent barrier: it becomes the quadratic one as the bound goes away, but halves the gain
there.
"""

from __future__ import annotations

import math
from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers._base import GUARD, Barrier, check_guard, guarded_error, side_width
from iblf_jax.control.barriers._series import sinc
from iblf_jax.core.pytree import component, static
from iblf_jax.world.bounds import Tube


@component
class Tan(Barrier):
    """V1 = k^2/pi tan(theta),   theta = pi e1^2 / (2 k^2),   k = k_u if e1 > 0 else k_l.

        s = e1 / cos(theta)^2,   alpha = q_d' + e1 k'/k - k^2/(2 pi e1) (k1 + 2 k'/k) sin(2 theta)

    sin(2 theta)/e1 is removable at e1 = 0 and written as such.  At e2 = 0, V1' = -k1 V1.  For k ->
    infinity s -> e1 and the gain of alpha is k1/2.

    Args:
      guard: distance from the bound in xi at which the guard begins, a number in (0, 1) [1];
        0.001 if not given.

    Source: X. Yu, W. He, H. Li, J. Sun, IEEE Trans. Syst. Man Cybern. Syst. 51 (2021) 6994-7007.
    """

    guard: float = static(default=GUARD)
    uses_o: ClassVar[bool] = False
    value_unit: ClassVar[str] = "rad^2"
    ratio_jumps: ClassVar[bool] = False
    exact_decay: ClassVar[bool] = True
    slope_derivatives: ClassVar[int] = 4

    def check(self) -> None:
        """Raises ValueError for a guard outside (0, 1)."""
        check_guard("Tan", self.guard)

    def value(self, tube: Tube, q: jax.Array) -> jax.Array:
        """V1, (n,) [rad^2]."""
        e, beyond, k, _ = guarded_error(tube, q, self.guard)
        return (
            k**2 / math.pi * jnp.sin(0.5 * math.pi * (e / k) ** 2) / _cos_th(e / k)
            + e / _cos_th(e / k) ** 2 * beyond
        )

    def slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """s, (n,) [rad]."""
        e, _, k, _ = guarded_error(tube, q, self.guard)
        return e / _cos_th(e / k) ** 2

    def error_over_slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """cos(theta)^2, (n,) [1]."""
        e, _, k, _ = guarded_error(tube, q, self.guard)
        return _cos_th(e / k) ** 2

    def virtual_velocity(
        self, tube: Tube, q: jax.Array, k1: jax.Array, o: jax.Array | None
    ) -> jax.Array:
        """alpha, (n,) [rad/s]."""
        e, beyond, k, dk = guarded_error(tube, q, self.guard)
        # k^2/(2 pi e) sin 2th = e/2 sinc(2th)
        return (
            tube.dq_d
            + e * dk / k
            - 0.5 * e * (k1 + 2.0 * dk / k) * sinc(math.pi * (e / k) ** 2)
            - k1 * beyond
        )

    def decay_rate(self, k1: jax.Array) -> jax.Array:
        """k1: V1' = -k1 V1 at e2 = 0, (n,) [1/s]."""
        return k1

    def xi_bound(self, V: jax.Array, tube: Tube) -> jax.Array:
        """|xi| <= sqrt(2/pi arctan(pi V / k^2)), with the narrower side's k, (n,) [1]."""
        return jnp.sqrt(
            2.0 / math.pi * jnp.arctan(math.pi * V / jnp.minimum(tube.k_l, tube.k_u) ** 2)
        )

    def error_at(self, V: jax.Array, tube: Tube, above: jax.Array) -> jax.Array:
        """+-k sqrt(2/pi arctan(pi V / k^2)), (n,) [rad]."""
        k = side_width(tube, above)
        size = k * jnp.sqrt(2.0 / math.pi * jnp.arctan(math.pi * V / k**2))
        return jnp.where(above, size, -size)


def _cos_th(x: jax.Array) -> jax.Array:
    """cos(pi/2 x^2), written so that it is accurate near |x| = 1."""
    return jnp.sin(0.5 * math.pi * (1.0 - x) * (1.0 + x))
