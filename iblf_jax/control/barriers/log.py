"""The asymmetric time-varying logarithmic barrier, the comparison in the paper's figures."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers._base import (
    GUARD,
    Barrier,
    check_guard,
    guarded_error,
    side_width,
)
from iblf_jax.core import checks
from iblf_jax.core.pytree import component, static
from iblf_jax.world.bounds import Tube

MAX_P = 100
"""Largest exponent; with a larger one xi^(2p) is 0 in most of the tube."""


@component
class Log(Barrier):
    """V1 = 1/(2p) ln 1/(1 - xi^(2p)), with a whole exponent p >= 1.

        s = e1^(2p-1) / (k^(2p) - e1^(2p)),   alpha = q_d' - (k1 + kappa) e1

    The slope has a kink at e1 = 0 where k_u and k_l differ: second derivatives of a run leave out
    what the kink adds.

    Args:
      p: exponent, a whole number from 1 to 100; 1 if not given.
      guard: distance from the bound in xi at which the guard begins, a number in (0, 1) [1];
        0.001 if not given.

    Source: K. P. Tee, B. Ren, S. S. Ge, Automatica 47 (2011) 2511-2516.
    """

    p: int = static(default=1)
    guard: float = static(default=GUARD)

    @property
    def slope_derivatives(self) -> int:
        """Continuous derivatives of the slope at e1 = 0 in an asymmetric tube, 2p - 2."""
        return 2 * self.p - 2

    def check(self) -> None:
        """Raises ValueError unless p is a whole number from 1 to MAX_P and the guard in (0, 1)."""
        check_guard("Log", self.guard)
        checks.positive_integer("Log.p", self.p, most=MAX_P)

    def value(self, tube: Tube, q: jax.Array) -> jax.Array:
        """V1, (n,) [1]."""
        e, beyond, k, _ = guarded_error(tube, q, self.guard)
        return -jnp.log1p(-((e / k) ** (2 * self.p))) / (2 * self.p) + self._slope(e, k) * beyond

    def slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """s, (n,) [1/rad]."""
        e, _, k, _ = guarded_error(tube, q, self.guard)
        return self._slope(e, k)

    def _slope(self, e, k):
        # In xi, so that a large p does not underflow k^(2p).
        x = e / k
        return x ** (2 * self.p - 1) / (k * (1.0 - x ** (2 * self.p)))

    def error_over_slope(self, tube: Tube, q: jax.Array) -> jax.Array | None:
        """k^2 - e1^2 for p = 1, (n,) [rad^2]; None for p > 1, whose slope vanishes as e1^(2p -
        1).
        """
        e, _, k, _ = guarded_error(tube, q, self.guard)
        return k**2 - e**2 if self.p == 1 else None

    def decay_rate(self, k1: jax.Array) -> jax.Array:
        """2 p k1: V1' <= -k1 xi^(2p)/(1 - xi^(2p)) <= -2 p k1 V1 at e2 = 0, (n,) [1/s]."""
        return 2.0 * self.p * k1

    def xi_bound(self, V: jax.Array, tube: Tube) -> jax.Array:
        """|xi| <= (1 - exp(-2 p V))^(1/(2p)), (n,) [1]."""
        return jnp.broadcast_to(
            (-jnp.expm1(-2.0 * self.p * V)) ** (1.0 / (2 * self.p)), tube.q_d.shape
        )

    def error_at(self, V: jax.Array, tube: Tube, above: jax.Array) -> jax.Array:
        """+-k (1 - exp(-2 p V))^(1/(2p)), (n,) [rad]."""
        power = -jnp.expm1(-2.0 * self.p * V)
        xi = jnp.sqrt(power) if self.p == 1 else power ** (1.0 / (2 * self.p))
        size = side_width(tube, above) * xi
        return jnp.where(above, size, -size)
