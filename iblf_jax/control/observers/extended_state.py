"""A linear extended-state observer on the momentum p = M0 q'.

    p' = tau + C0^T q' - G0 + f,   since (M0 q')' = M0 q" + M0' q' and M0' = C0 + C0^T

so a copy of p, corrected by what is measured, estimates f as an additional constant state.  C0^T q'
= M0' q' - C0 q'.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.observers._base import RobotObserver
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.robots import Robot, energy_gradient, momentum


class ExtendedStateValues(NamedTuple):
    """State of `ExtendedState`."""

    p_hat: jax.Array
    """Estimate of the momentum M0 q', (n,) [N m s]."""
    f_hat: jax.Array
    """Estimate of f, (n,) [N m]."""


@component
class ExtendedState(RobotObserver):
    """p_hat' = tau + C0^T q' - G0 + f_hat + l1 (p - p_hat),   f_hat' = l2 (p - p_hat),   p = M0 q'.

    Give `bandwidth` w, for l1 = 2 w and l2 = w^2 (both poles at -w), or `l1` and `l2`.  Then
    f_tilde = f - f_hat obeys f_tilde" + l1 f_tilde' + l2 f_tilde = f" + l1 f': a constant f is
    found exactly, a changing one with the lag l1/l2. It starts at the measured momentum and f_hat =
    0.

    Args:
      bandwidth: w, () or (n,) [1/s], > 0; l1 and l2 count if not given.
      l1: gain of the innovation on p_hat, () or (n,) [1/s], > 0; 2 w if not given.
      l2: gain of the innovation on f_hat, () or (n,) [1/s^2], > 0; w^2 if not given.

    Source: J. Han, IEEE Trans. Industrial Electronics 56 (2009) 900-906; Z. Gao, ACC 2003,
      4989-4996 (one bandwidth).
    """

    bandwidth: Leaf = leaf("1/s", sign="positive", default=None)
    l1: Leaf = leaf("1/s", sign="positive", default=None)
    l2: Leaf = leaf("1/s^2", sign="positive", default=None)

    def check(self) -> None:
        """Raises ValueError unless either `bandwidth` or both `l1` and `l2` are given."""
        given = tuple(x is not None for x in (self.bandwidth, self.l1, self.l2))
        if given not in ((True, False, False), (False, True, True)):
            named = dict(zip(("bandwidth", "l1", "l2"), given, strict=True))
            got = [name for name, given in named.items() if given]
            raise checks.fail(
                "ExtendedState",
                got,
                "either `bandwidth`, or both `l1` and `l2`",
                "Such as ExtendedState(bandwidth=40.0).",
            )

    @property
    def _gains(self) -> tuple[jax.Array, jax.Array]:
        """l1 [1/s] and l2 [1/s^2], (n,)."""
        if self.bandwidth is None:
            return self.l1, self.l2
        return 2.0 * self.bandwidth, self.bandwidth**2

    def init(self, q: jax.Array, dq: jax.Array, model: Robot) -> ExtendedStateValues:
        """The measured momentum, and no estimate yet."""
        return ExtendedStateValues(momentum(model, q, dq), jnp.zeros_like(q))

    def estimate(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, model: Robot, state: ExtendedStateValues
    ) -> jax.Array:
        """f_hat, (n,) [N m]."""
        return state.f_hat

    def derivative(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: Robot,
        state: ExtendedStateValues,
    ) -> ExtendedStateValues:
        """p_hat' and f_hat'."""
        l1, l2 = self._gains
        innovation = momentum(model, q, dq) - state.p_hat
        drift = energy_gradient(model, q, dq) - model.gravity(q)
        return ExtendedStateValues(tau + drift + state.f_hat + l1 * innovation, l2 * innovation)

    def advance(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: Robot,
        state: ExtendedStateValues,
        period: jax.Array,
    ) -> ExtendedStateValues:
        """p_hat and f_hat a period later, exact: with z = (p_hat, f_hat), z' = A z + b, so z moves
        by A^-1 (exp(A period) - 1) z'.

        exp(A T) = exp(-w T) [C + S (A + w)],  w = l1 / 2,  S = sinh(d T) / d,  C = cosh(d T),  d^2
        = w^2 - l2.
        """
        l1, l2 = self._gains
        rate = self.derivative(t, q, dq, tau, model, state)
        w, fade, C, S = self._over(period)
        # (exp(A T) - 1) z', and then A^-1 of it: A = [[-l1, 1], [-l2, 0]].
        p = fade * (C * rate.p_hat + S * (rate.f_hat - w * rate.p_hat)) - rate.p_hat
        f = fade * (C * rate.f_hat + S * (w * rate.f_hat - l2 * rate.p_hat)) - rate.f_hat
        moved_p = -f / l2
        return ExtendedStateValues(state.p_hat + moved_p, state.f_hat + p + l1 * moved_p)

    def at_period(self, period: jax.Array) -> ExtendedState:
        """l1 T = 2 - (z1 + z2) and l2 T^2 = (1 - z1)(1 - z2), with z1, z2 = exp(-w T) (C -+ d S)
        the poles over T, the period.
        """
        _, fade, C, _ = self._over(period)
        both, product = 2.0 * fade * C, fade**2
        return ExtendedState(l1=(2.0 - both) / period, l2=(1.0 - both + product) / period**2)

    def _over(self, period: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """w, exp(-w T), C and S of `advance`, (n,) each."""
        l1, l2 = self._gains
        w = 0.5 * l1
        if self.bandwidth is None:
            # Even functions of a root, real or not, by its square: cosh(root), sinh(root)/root.
            square = (w * w - l2) * period**2
            is_small = jnp.abs(square) < 1e-12
            root = jnp.sqrt(jnp.maximum(jnp.abs(square), 1e-12))
            cosh = jnp.where(square > 0, jnp.cosh(root), jnp.cos(root))
            sinh = jnp.where(square > 0, jnp.sinh(root), jnp.sin(root))
            C = jnp.where(is_small, 1.0, cosh)
            S = period * jnp.where(is_small, 1.0, sinh / root)
        else:
            C, S = jnp.ones_like(w), period * jnp.ones_like(w)
        return w, jnp.exp(-w * period), C, S
