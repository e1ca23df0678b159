"""The nonlinear mapping (uniform barrier): the error over its distances to both walls, driven to
zero.
"""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers._base import (
    GUARD,
    Barrier,
    check_guard,
    guarded_error,
    xi_bound_from_errors,
)
from iblf_jax.core.pytree import component, static
from iblf_jax.world.bounds import Tube


@component
class TransformedError(Barrier):
    """V1 = 1/2 z^2,   z = e1 k_l k_u / ((k_l + e1)(k_u - e1)).

        s = z z_e,   alpha = q_d' - (k1 z + z_t) / z_e
        z_e = k_l k_u (k_l k_u + e1^2) / ((k_l + e1)(k_u - e1))^2

    z_t is the rate of z at fixed e1.  At e2 = 0, V1' = -k1 z^2.  For k -> infinity z -> e1:
    unconstrained backstepping, without a change of law ("uniform": one law with and without
    bounds).

    Args:
      guard: distance from the bound in xi at which the guard begins, a number in (0, 1) [1];
        0.001 if not given.

    Source: K. Zhao, Y. Song, IEEE Trans. Automatic Control 64 (2019) 1265-1272.
    """

    guard: float = static(default=GUARD)
    uses_o: ClassVar[bool] = False
    value_unit: ClassVar[str] = "rad^2"
    ratio_jumps: ClassVar[bool] = False
    exact_decay: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError for a guard outside (0, 1)."""
        check_guard("TransformedError", self.guard)

    def value(self, tube: Tube, q: jax.Array) -> jax.Array:
        """V1, (n,) [rad^2]."""
        e, beyond, _, _ = guarded_error(tube, q, self.guard)
        z, z_e = _mapped(e, tube)
        return 0.5 * z**2 + z * z_e * beyond

    def slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """s, (n,) [rad]."""
        e, _, _, _ = guarded_error(tube, q, self.guard)
        z, z_e = _mapped(e, tube)
        return z * z_e

    def error_over_slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """((k_l + e1)(k_u - e1))^3 / ((k_l k_u)^2 (k_l k_u + e1^2)), (n,) [1]."""
        e, _, _, _ = guarded_error(tube, q, self.guard)
        a, b = e / tube.k_l, e / tube.k_u
        return ((1.0 + a) * (1.0 - b)) ** 3 / (1.0 + a * b)

    def virtual_velocity(
        self, tube: Tube, q: jax.Array, k1: jax.Array, o: jax.Array | None
    ) -> jax.Array:
        """alpha, (n,) [rad/s]."""
        e, beyond, _, _ = guarded_error(tube, q, self.guard)
        k_l, k_u = tube.k_l, tube.k_u
        # z / z_e and z_t / z_e with their poles cancelled; in e/k, so that wide bounds do not
        # overflow
        a, b = e / k_l, e / k_u
        scale = 1.0 + a * b
        error = e * (1.0 + a) * (1.0 - b) / scale
        drift = (a**2 * (1.0 - b) * tube.dk_l - b**2 * (1.0 + a) * tube.dk_u) / scale
        return tube.dq_d - k1 * (error + beyond) - drift

    def decay_rate(self, k1: jax.Array) -> jax.Array:
        """2 k1: V1' = -k1 z^2 at e2 = 0, (n,) [1/s]."""
        return 2.0 * k1

    def xi_bound(self, V: jax.Array, tube: Tube) -> jax.Array:
        """The larger |xi| on the two sides at which |z| = sqrt(2V), (n,) [1]."""
        return xi_bound_from_errors(self, V, tube)

    def error_at(self, V: jax.Array, tube: Tube, above: jax.Array) -> jax.Array:
        """The root e of z(e) = +-sqrt(2V) inside the bounds, (n,) [rad]."""
        z = jnp.where(above, jnp.sqrt(2.0 * V), -jnp.sqrt(2.0 * V))
        # z e^2 + b e - z k_l k_u = 0
        product = tube.k_l * tube.k_u
        b = product - z * (tube.k_u - tube.k_l)
        root = jnp.sqrt(b**2 + 4.0 * z**2 * product)
        return 2.0 * z * product / (b + root)


def _mapped(e: jax.Array, tube: Tube) -> tuple[jax.Array, jax.Array]:
    """The mapped error z [rad] and z_e [1], in e/k so that wide bounds do not overflow."""
    a, b = e / tube.k_l, e / tube.k_u
    room = (1.0 + a) * (1.0 - b)
    return e / room, (1.0 + a * b) / room**2
