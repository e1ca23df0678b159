"""Nonsingular terminal sliding mode with a boundary layer: settling in finite time up to a band.

With e1 = q - q_d, every joint has the surface

    sigma = e1 + g(e1')/beta,    g(v) = v (v^2 + delta^2)^((p-1)/2),    1 < p < 2.

For delta = 0 it is e1 + |e1'|^p sign(e1')/beta: on it e1' = -(beta |e1|)^(1/p) sign(e1), which
arrives at 0 in finite time.  The smoothing speed delta > 0 removes the infinite slope that the
torque then has at e1' = 0.  With the torque of `TerminalSlidingMode`,

    sigma' = g'(e1')/beta (M0^-1 f_tilde - K sat(sigma/phi)),                                 (T.1)
    g'(v) = (v^2 + delta^2)^((p-3)/2) (p v^2 + delta^2) > 0,

joint by joint, where (M0^-1 f_tilde)_i is a component of M0^-1 f_tilde.  So V = 1/2 sum sigma^2 has

    V' = -sum g'(e1')/beta K sigma sat(sigma/phi) + dV/dq' . M0^-1 f_tilde,                   (T.2)

an equality.  If |(M0^-1 f_tilde)_i| <= F < K, then |sigma| decreases wherever |sigma| > phi F/K,
and e1' has the sign of sigma - e1, so every joint converges to the band

    |e1| <= phi F/K,    |e1'| <= (2 beta phi F/K)^(1/p).                                      (T.3)

With F = 0 both are 0.  On the surface the error falls from e0 to the size 2^((p-1)/2) delta^p/beta
within p/(p-1) (2^((p-1)/2)/beta)^(1/p) |e0|^(1-1/p), and below that size exponentially.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers._base import Command, LawContext, LyapunovLaw
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.bounds import Tube
from iblf_jax.world.robots import inverse_dynamics

BEYOND_LAYER = 1e6
"""Width of the layer of `TerminalSlidingMode.unlimited`, relative to that of the law."""


@component
class TerminalSlidingMode(LyapunovLaw):
    """tau = C0 q' + G0 + M0 (q_d" - beta e1'/g'(e1') - K sat(sigma/layer)) - f_hat.

    Head of this module; sat(x) is x between -1 and 1.  The law does not keep bounds: it claims
    (T.2) and the band (T.3) about the error, and nothing about `Scenario.bounds`.  alpha is q_d'
    and V1 = 1/2 sigma^2 [rad^2].

    Args:
      beta: of the surface, () or (n,) [rad^(p-1)/s^p], > 0.
      K: largest acceleration against the surface, () or (n,) [rad/s^2], > 0; larger than the
        components of M0^-1 f_tilde.
      layer: half width phi of the boundary layer, () or (n,) [rad], > 0.
      p: exponent, () or (n,) [1], > 0, between 1 and 2; 1.5 if not given.
      smoothing: delta, () or (n,) [rad/s], > 0; 0.01 if not given.  The error below the smoothed
        part falls at the rate beta smoothing^(1-p) [1/s], which the time step must resolve.

    Source: Y. Feng, X. Yu, Z. Man, Automatica 38 (2002) 2159-2167 (surface and torque); boundary
      layer and smoothing as derived here.
    """

    beta: Leaf = leaf("rad^(p-1)/s^p", sign="positive")
    K: Leaf = leaf("rad/s^2", sign="positive")
    layer: Leaf = leaf("rad", sign="positive")
    p: Leaf = leaf("1", sign="positive", default=1.5)
    smoothing: Leaf = leaf("rad/s", sign="positive", default=0.01)
    gains: ClassVar[tuple[str, ...]] = ("beta", "K")
    includes_e2: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError for an exponent that is not between 1 and 2."""
        if not checks.is_concrete(self.p):
            return
        p = np.asarray(self.p)
        if np.any((p <= 1.0) | (p >= 2.0)):
            expected = "1 < p < 2"
            remedy = "p = 1 is a linear surface, and the torque is singular from p = 2 on."
            raise checks.fail("TerminalSlidingMode.p", self.p, expected, remedy)

    @property
    def unlimited(self) -> TerminalSlidingMode:
        """The law with the slope K/layer of the reaching term also outside the layer, where that
        term is constant and the law has no feedback of the position.
        """
        return dataclasses.replace(self, K=BEYOND_LAYER * self.K, layer=BEYOND_LAYER * self.layer)

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: LawContext,
        state: tuple[()],
    ) -> tuple[Command, tuple[()]]:
        """The torque and what belongs to it."""
        tube = context.tube(t)
        sigma, slope = self._surface(tube, q, dq)
        along_surface = (dq - tube.dq_d) / slope
        acceleration = tube.ddq_d - self.K * self._saturated(sigma) - along_surface
        tau = inverse_dynamics(context.model, q, dq, dq, acceleration) - f_hat
        never = jnp.zeros(q.shape, bool)
        return Command(tau, tube.dq_d, 0.5 * sigma**2, never, never), ()

    def _surface(self, tube: Tube, q: jax.Array, dq: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The surface sigma [rad] and its slope dsigma/dq' = g'(e1')/beta [s], (n,)
        each.
        """
        e, v = q - tube.q_d, dq - tube.dq_d
        square = v**2 + self.smoothing**2
        root = square ** (0.5 * (self.p - 1.0))
        slope = root * (self.p * v**2 + self.smoothing**2) / square
        return e + v * root / self.beta, slope / self.beta

    def _saturated(self, sigma: jax.Array) -> jax.Array:
        """sat(sigma/layer), (n,) [1]."""
        return jnp.clip(sigma / self.layer, -1.0, 1.0)

    def lyapunov(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_tilde: jax.Array,
        context: LawContext,
        state: tuple[()],
    ) -> jax.Array:
        """V = 1/2 sigma^2, (n,) [rad^2]."""
        sigma, _ = self._surface(context.tube(t, acceleration=False), q, dq)
        return 0.5 * sigma**2

    def decay(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_tilde: jax.Array,
        context: LawContext,
        state: tuple[()],
    ) -> jax.Array:
        """W = g'(e1')/beta K sigma sat(sigma/layer), (n,) [rad^2/s].  (T.2)"""
        sigma, slope = self._surface(context.tube(t, acceleration=False), q, dq)
        return slope * self.K * sigma * self._saturated(sigma)
