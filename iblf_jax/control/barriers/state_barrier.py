"""The integral barrier on the state itself: the bound acts on the position, not on the error.

With the bounds' centre c(t) and half-width kc(t), p = q - c and p_d = q_d - c, so that
e1 = p - p_d and |p| < kc.  The barrier weighs the error by how near the *position* is to its bound,

    V1 = int_0^e1 s kc^2 / (kc^2 - (s + p_d)^2) ds,

so it needs no feasibility of the error's own bounds (k_l, k_u), only |p_d| < kc.  Its partial
derivatives are

    dV1/dp = kc^2 e1 / (kc^2 - p^2),   dV1/dp_d = -e1 rho,
    dV1/dkc = (2 V1 - p dV1/dp - p_d dV1/dp_d) / kc,
    rho = kc / (2 e1) ln[ (kc + p)(kc - p_d) / ((kc - p)(kc + p_d)) ],

the last because V1 = kc^2 K(p/kc, p_d/kc).  Hence, with w = V1/e1^2 and g = (kc^2 - p^2)/kc^2, the
virtual velocity that gives V1' = -k1 kc^2 e1^2 / (kc^2 - p^2) at e2 = 0, for a time-varying centre
and half-width, is

    alpha = c' + g rho (p_d' - p_d kc'/kc) - k1 e1 + p kc'/kc - 2 e1 w g kc'/kc
          = q_d' - k1 e1 - (1 - g rho) (p_d' - p_d kc'/kc) + e1 (1 - 2 g w) kc'/kc.

K is the relative entropy KL(P || Q) of two coins P = (1 + p_d/kc)/2 and Q = (1 + p/kc)/2, and kc^2
e1^2 / (kc^2 - p^2) is kc^2 times their chi-square distance.  KL <= ln(1 + chi^2) <= chi^2 for any
two distributions, so V1' <= -k1 V1; and k1 is the best such constant (reference at the bound).  In
the code, kc + p = k_l + e1 and kc - p = k_u - e1: no differences of nearly equal numbers.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers._base import GUARD, Barrier, check_guard, guarded_error
from iblf_jax.control.barriers._series import log_remainder
from iblf_jax.core.pytree import component, static
from iblf_jax.world.bounds import Tube

BISECTIONS = 60


class _Parts(NamedTuple):
    kc: jax.Array
    g: jax.Array
    """1 - (p/kc)^2 [1]."""
    w: jax.Array
    """V1 / e1^2 [1]."""
    rho: jax.Array
    """-dV1/dp_d / e1 [1]."""


def _parts(e: jax.Array, k_l: jax.Array, k_u: jax.Array) -> _Parts:
    kc = 0.5 * (k_l + k_u)
    a, b = e / k_l, e / k_u
    h_l, h_u = log_remainder(jnp.stack([-a, b]))
    w = 0.5 * kc * (h_l / k_l + h_u / k_u)
    rho = 0.5 * kc * ((1.0 - a * h_l) / k_l + (1.0 + b * h_u) / k_u)
    return _Parts(kc, (k_l + e) * (k_u - e) / kc**2, w, rho)


@component
class StateBarrier(Barrier):
    """V1 = int_0^e1 s kc^2 / (kc^2 - (s + p_d)^2) ds,   p_d = q_d - c,   bounds c(t) -+ kc(t).

        s = kc^2 e1 / (kc^2 - p^2),   p = q - c
        alpha = q_d' - k1 e1 - (1 - g rho) (p_d' - p_d kc'/kc) + e1 (1 - 2 g V1/e1^2) kc'/kc

    (symbols and derivation at the head of this module).  At e2 = 0, V1' = -k1 kc^2 e1^2 / (kc^2 -
    p^2) <= -k1 V1.  For kc -> infinity it is unconstrained backstepping.

    Args:
      guard: distance from the bound in xi at which the guard begins, a number in (0, 1) [1];
        0.001 if not given.

    Source: K. P. Tee, S. S. Ge, 51st IEEE CDC (2012) 3239-3244 (constant kc); the compensation of
      kc'(t) is derived here.
    """

    guard: float = static(default=GUARD)
    uses_o: ClassVar[bool] = False
    value_unit: ClassVar[str] = "rad^2"
    ratio_jumps: ClassVar[bool] = False

    def check(self) -> None:
        """Raises ValueError for a guard outside (0, 1)."""
        check_guard("StateBarrier", self.guard)

    def value(self, tube: Tube, q: jax.Array) -> jax.Array:
        """V1, (n,) [rad^2]."""
        e, beyond, _, _ = guarded_error(tube, q, self.guard)
        parts = _parts(e, tube.k_l, tube.k_u)
        return e**2 * parts.w + e / parts.g * beyond

    def slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """s, (n,) [rad]."""
        e, _, _, _ = guarded_error(tube, q, self.guard)
        return e / _parts(e, tube.k_l, tube.k_u).g

    def error_over_slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """(kc^2 - p^2)/kc^2, (n,) [1]."""
        e, _, _, _ = guarded_error(tube, q, self.guard)
        return _parts(e, tube.k_l, tube.k_u).g

    def virtual_velocity(
        self, tube: Tube, q: jax.Array, k1: jax.Array, o: jax.Array | None
    ) -> jax.Array:
        """alpha, (n,) [rad/s]."""
        e, beyond, _, _ = guarded_error(tube, q, self.guard)
        kc, g, w, rho = _parts(e, tube.k_l, tube.k_u)
        p_d, dp_d = 0.5 * (tube.k_l - tube.k_u), 0.5 * (tube.dk_l - tube.dk_u)
        growth = 0.5 * (tube.dk_l + tube.dk_u) / kc
        bound_rate = (1.0 - g * rho) * (dp_d - p_d * growth) - e * (1.0 - 2.0 * g * w) * growth
        return tube.dq_d - k1 * (e + beyond) - bound_rate

    def decay_rate(self, k1: jax.Array) -> jax.Array:
        """k1: V1' <= -k1 V1 at e2 = 0 (head of this module), (n,) [1/s]."""
        return k1

    def xi_bound(self, V: jax.Array, tube: Tube) -> jax.Array:
        """The larger |xi| on the two sides at which V1 = V, (n,) [1], by bisection."""
        V = jnp.broadcast_to(V, tube.q_d.shape)

        def reached(k_l, k_u):
            def halve(_, ends):
                low, high = ends
                middle = 0.5 * (low + high)
                e = middle * k_u
                under = e**2 * _parts(e, k_l, k_u).w <= V
                return jnp.where(under, middle, low), jnp.where(under, high, middle)

            return jax.lax.fori_loop(0, BISECTIONS, halve, (jnp.zeros_like(V), jnp.ones_like(V)))[1]

        # The lower side is the upper side of the mirrored tube.
        return jnp.maximum(reached(tube.k_l, tube.k_u), reached(tube.k_u, tube.k_l))
