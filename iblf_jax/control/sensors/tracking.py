"""A velocity estimate from a model of the joint that tracks the measured position."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.sensors._base import Velocity, above_nyquist
from iblf_jax.core.pytree import Leaf, component, leaf


class TrackingValues(NamedTuple):
    """State of `Tracking`."""

    q_hat: jax.Array
    """Position of the model, (n,) [rad]."""
    v_hat: jax.Array
    """Its velocity, (n,) [rad/s]."""


@component
class Tracking(Velocity):
    """r = y - q_hat - T v_hat;   q_hat <- y - a^2 r,   v_hat <- v_hat + (1 - a)^2 r / T,   a =
    exp(-bandwidth T).

    Both poles are at a, so a constant velocity is estimated without lag.

    Args:
      bandwidth: bandwidth of the model, () or (n,) [rad/s], > 0.

    Source: alpha-beta filter, P. R. Kalata, IEEE Trans. Aerospace and Electronic Systems 20 (1984)
      174-182, critically damped.
    """

    bandwidth: Leaf = leaf("rad/s", sign="positive")
    draws: ClassVar[int] = 0

    def advice(self, period: jax.Array) -> list[str]:
        """A warning about a bandwidth that is above the Nyquist frequency."""
        return above_nyquist("bandwidth", self.bandwidth, period)

    def init(self, y: jax.Array, dq: jax.Array, period: jax.Array) -> TrackingValues:
        """Settled at the velocity dq."""
        return TrackingValues(y - period * dq, dq)

    def estimate(
        self,
        y: jax.Array,
        dq: jax.Array,
        normal: jax.Array,
        period: jax.Array,
        state: TrackingValues,
    ) -> tuple[jax.Array, TrackingValues]:
        """The velocity of the model, (n,) [rad/s]."""
        a = jnp.exp(-self.bandwidth * period)
        r = y - state.q_hat - period * state.v_hat
        v = state.v_hat + (1.0 - a) ** 2 * r / period
        return v, TrackingValues(y - a**2 * r, v)
