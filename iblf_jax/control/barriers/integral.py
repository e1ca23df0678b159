"""The asymmetric time-varying integral barrier of Zhang & Yan 2024."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers._base import (
    GUARD,
    Barrier,
    check_guard,
    guarded_error,
    side_width,
)
from iblf_jax.core.pytree import component, static
from iblf_jax.world.bounds import Tube


@component
class Integral(Barrier):
    """V1 = int_0^xi 2 s / (1 - s^2) ds = -ln(1 - xi^2).                        (2.6), (3.1)

        s = dV1/de1 = 2 e1 / (k^2 - e1^2),   alpha = q_d' - (k1 + kappa) e1    (3.15), (3.5)

    It is twice the logarithmic barrier with p = 1, identically.  Theorem 1: xi^2/2 <= V1 <= xi^2/(1
    - xi^2).

    The slope has a kink at e1 = 0 where k_u and k_l differ: second derivatives of a run leave out
    what the kink adds.

    Args:
      guard: distance from the bound in xi at which the guard begins, a number in (0, 1) [1];
        0.001 if not given.

    Source: T. Zhang, P. Yan, AIMS Mathematics 9(1) (2024) 319-339.
    """

    guard: float = static(default=GUARD)
    slope_derivatives: ClassVar[int] = 0

    def check(self) -> None:
        """Raises ValueError for a guard outside (0, 1)."""
        check_guard("Integral", self.guard)

    def value(self, tube: Tube, q: jax.Array) -> jax.Array:
        """V1, (n,) [1]."""
        e, beyond, k, _ = guarded_error(tube, q, self.guard)
        return -jnp.log1p(-((e / k) ** 2)) + 2.0 * e / (k**2 - e**2) * beyond

    def slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """Con = 2 e1 / (k^2 - e1^2), (n,) [1/rad].    (3.15)"""
        e, _, k, _ = guarded_error(tube, q, self.guard)
        return 2.0 * e / (k**2 - e**2)

    def error_over_slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """(k^2 - e1^2)/2, (n,) [rad^2]."""
        e, _, k, _ = guarded_error(tube, q, self.guard)
        return 0.5 * (k**2 - e**2)

    def decay_rate(self, k1: jax.Array) -> jax.Array:
        """2 k1: V1' <= -2 k1 xi^2/(1 - xi^2) <= -2 k1 V1 at e2 = 0, (n,) [1/s].    (3.9), (3.19)"""
        return 2.0 * k1

    def xi_bound(self, V: jax.Array, tube: Tube) -> jax.Array:
        """|xi| <= sqrt(1 - exp(-V)), (n,) [1].    (3.22)"""
        return jnp.broadcast_to(jnp.sqrt(-jnp.expm1(-V)), tube.q_d.shape)

    def error_at(self, V: jax.Array, tube: Tube, above: jax.Array) -> jax.Array:
        """+-k sqrt(1 - exp(-V)), (n,) [rad]."""
        size = side_width(tube, above) * jnp.sqrt(-jnp.expm1(-V))
        return jnp.where(above, size, -size)
