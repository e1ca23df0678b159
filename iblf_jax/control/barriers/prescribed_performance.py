"""Prescribed performance: the error inside its funnel is mapped onto the whole line, and the mapped
error is driven to zero.
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
    side_width,
    xi_bound_from_errors,
)
from iblf_jax.control.barriers._series import log_remainder
from iblf_jax.core.pytree import component, static
from iblf_jax.world.bounds import Tube


@component
class PrescribedPerformance(Barrier):
    """V1 = 1/2 eps^2,   eps = 1/2 ln[ (k_l + e1) k_u / ((k_u - e1) k_l) ].

        s = eps eps_e,   alpha = q_d' - (k1 eps + eps_t) / eps_e

    eps_e = 1/2 (1/(k_l + e1) + 1/(k_u - e1)), and eps_t is the rate of eps at fixed e1.  At e2 = 0,
    V1' = -k1 eps^2. Its bounds are usually a `bounds.Funnel`, r(t) = (r0 - rinf) exp(-l t) + rinf;
    any bounds do.  For k -> infinity s -> 0 and the gain of alpha is k1.

    Args:
      guard: distance from the bound in xi at which the guard begins, a number in (0, 1) [1];
        0.001 if not given.

    Source: C. P. Bechlioulis, G. A. Rovithakis, IEEE Trans. Automatic Control 53 (2008) 2090-2099.
    """

    guard: float = static(default=GUARD)
    uses_o: ClassVar[bool] = False
    ratio_jumps: ClassVar[bool] = False
    exact_decay: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError for a guard outside (0, 1)."""
        check_guard("PrescribedPerformance", self.guard)

    def value(self, tube: Tube, q: jax.Array) -> jax.Array:
        """V1, (n,) [1]."""
        e, beyond, _, _ = guarded_error(tube, q, self.guard)
        eps = _eps(e, tube)
        return 0.5 * eps**2 + eps * _eps_e(e, tube) * beyond

    def slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """s, (n,) [1/rad]."""
        e, _, _, _ = guarded_error(tube, q, self.guard)
        return _eps(e, tube) * _eps_e(e, tube)

    def error_over_slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """e1/(eps eps_e), (n,) [rad^2]: eps/e1 = 1/2 (h(-e1/k_l)/k_l + h(e1/k_u)/k_u), h(u) = -ln(1
        - u)/u.
        """
        e, _, _, _ = guarded_error(tube, q, self.guard)
        a, b = -e / tube.k_l, e / tube.k_u
        rest = log_remainder(jnp.stack([a, b]))
        eps_over_e = 0.5 * ((1.0 + a * rest[0]) / tube.k_l + (1.0 + b * rest[1]) / tube.k_u)
        return 1.0 / (eps_over_e * _eps_e(e, tube))

    def virtual_velocity(
        self, tube: Tube, q: jax.Array, k1: jax.Array, o: jax.Array | None
    ) -> jax.Array:
        """alpha, (n,) [rad/s]."""
        e, beyond, _, _ = guarded_error(tube, q, self.guard)
        k_l, k_u = tube.k_l, tube.k_u
        # eps_t / eps_e with the poles of both cancelled
        drift = -e * (tube.dk_l * (k_u - e) / k_l + tube.dk_u * (k_l + e) / k_u) / (k_l + k_u)
        return tube.dq_d - k1 * (_eps(e, tube) / _eps_e(e, tube) + beyond) - drift

    def decay_rate(self, k1: jax.Array) -> jax.Array:
        """2 k1: V1' = -k1 eps^2 at e2 = 0, (n,) [1/s]."""
        return 2.0 * k1

    def xi_bound(self, V: jax.Array, tube: Tube) -> jax.Array:
        """The larger |xi| on the two sides at which |eps| = sqrt(2V), which is that of the side
        with the narrower bound, (n,) [1].
        """
        return xi_bound_from_errors(self, V, tube)

    def error_at(self, V: jax.Array, tube: Tube, above: jax.Array) -> jax.Array:
        """+-k (1 - E) / (1 + E k / k_other), E = exp(-2 sqrt(2V)), (n,) [rad]."""
        k = side_width(tube, above)
        ratio = k / side_width(tube, ~above)
        size = 2.0 * jnp.sqrt(2.0 * V)
        error = k * -jnp.expm1(-size) / (1.0 + ratio * jnp.exp(-size))
        return jnp.where(above, error, -error)


def _eps(e: jax.Array, tube: Tube) -> jax.Array:
    return 0.5 * (jnp.log1p(e / tube.k_l) - jnp.log1p(-e / tube.k_u))


def _eps_e(e: jax.Array, tube: Tube) -> jax.Array:
    return 0.5 * (1.0 / (tube.k_l + e) + 1.0 / (tube.k_u - e))
