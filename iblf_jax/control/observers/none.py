"""No observer: the law works without an estimate."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.control.observers._base import Observer, RobotObserver
from iblf_jax.core.pytree import component
from iblf_jax.world.plants import Plant
from iblf_jax.world.robots import Robot


@component
class _NoEstimate(Observer):
    """d_hat = 0, for a plant in strict-feedback form.  Source: none; the baseline."""

    def init(self, x: jax.Array, model: Plant) -> tuple[()]:
        """No state."""
        return ()

    def estimate(self, t: jax.Array, x: jax.Array, model: Plant, state: tuple[()]) -> jax.Array:
        """Zero, (n,) [N m] for a robot, (r, n) for another plant."""
        return jnp.zeros(model.estimate_shape, x.dtype)

    def derivative(
        self, t: jax.Array, x: jax.Array, u: jax.Array, model: Plant, state: tuple[()]
    ) -> tuple[()]:
        """No state, no rate."""
        return ()


@component
class NoObserver(RobotObserver):
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

    def of_x(self) -> Observer:
        """No estimate for any plant; a class that inherits from this one has its own."""
        if type(self) is not NoObserver:
            return super().of_x()
        return _NoEstimate()
