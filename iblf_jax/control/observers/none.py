"""No observer: the law works without an estimate."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.control.observers._base import (
    DisturbanceObserver,
    Observer,
    RobotObserver,
    RobotObserverAdapter,
)
from iblf_jax.core.pytree import component
from iblf_jax.world.plants import Plant
from iblf_jax.world.robots import Robot


@component
class _NoEstimate(Observer):
    """d_hat = 0 for any plant: a `NoObserver` in the closed loop.  Source: none; the baseline."""

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


def observer_of_x(observer: DisturbanceObserver) -> Observer:
    """An observer as the closed loop calls it."""
    if isinstance(observer, Observer):
        return observer
    # It serves any plant; a class that inherits from it has an estimate of its own.
    if type(observer) is NoObserver:
        return _NoEstimate()
    assert isinstance(observer, RobotObserver)
    return RobotObserverAdapter(observer)
