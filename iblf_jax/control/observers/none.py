"""No observer: the law works without an estimate."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.control.observers._base import Observer
from iblf_jax.core.pytree import component
from iblf_jax.world.robots import Robot


@component
class NoObserver(Observer):
    """f_hat = 0.  Source: none; the baseline."""

    def init(self, q: jax.Array, dq: jax.Array, model: Robot) -> tuple[()]:
        """No state."""
        return ()

    def estimate(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, model: Robot, state: tuple[()]
    ) -> jax.Array:
        """Zero, (n,) [N m]."""
        return jnp.zeros_like(q)

    def derivative(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: Robot,
        state: tuple[()],
    ) -> tuple[()]:
        """No state, no rate."""
        return ()

    def advance(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: Robot,
        state: tuple[()],
        period: jax.Array,
    ) -> tuple[()]:
        """No state."""
        return ()
