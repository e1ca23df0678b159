"""The contract of a disturbance observer.

An observer knows the model, measures q and q', receives the applied torque and returns f_hat, an
estimate of the lumped uncertain term f of (2.1).  Its state is part of the loop's state
and is integrated with the plant; in a sampled loop it goes from one period to the next.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, Self

import jax

from iblf_jax.core.families import attribute
from iblf_jax.core.pytree import Leaf
from iblf_jax.core.time import Timed
from iblf_jax.world.robots import Robot

State = Any
"""A pytree of arrays; `()` for an observer without memory."""


class Observer(Timed):
    """The contract of a disturbance observer.

    An observer of plants in strict-feedback form has the class attribute `receives_x = True`.  Its
    methods then receive the state x, (r, n), in the place of q and q', a `plants.Plant` as the
    model and the input u as `tau`; its estimate is d_hat, (r, n), what the disturbance adds to x'.
    Other observers serve the robot inside such a plant, and `tau` is the torque on its joints.
    """

    receives_x: ClassVar[bool] = False
    """Whether it is an observer of plants in strict-feedback form."""
    kf: Leaf = None
    """Gain of an observer of the form (3.11), (n,) [1/s]; None for another one."""

    @attribute
    def error_gain(self) -> jax.Array | None:
        """The claim that the error of the estimate obeys f_tilde' = f' - kappa f_tilde: kappa, (n,)
        [1/s], or that of d_tilde, (r,) or (r, n) [1/s]; None without a claim.  `certify` checks it
        under laws of plants in strict-feedback form.
        """
        return None

    @attribute
    def noise_gain(self) -> jax.Array | None:
        """The factor from the noise of the measured levels to that of d_hat, (), (r,) or (r, n)
        [1/s]; None if it is not known.  A scenario whose sensor has noise warns with the product.
        """
        return None

    @attribute
    def measured(self) -> tuple[int, ...] | None:
        """The levels that an observer with `complete` reads, counted from 1; None for all."""
        return None

    @attribute
    def advances(self) -> bool:
        """Whether it has `advance`."""
        return type(self).advance is not Observer.advance

    @attribute
    def completes(self) -> bool:
        """Whether it has `complete`."""
        return type(self).complete is not Observer.complete

    def check_model(self, model: Any) -> None:
        """Raises ValueError for a plant that does not fit the fields."""
        return

    def advice(self) -> list[str]:
        """Warnings about the values of the fields."""
        return []

    @abc.abstractmethod
    def init(self, q: jax.Array, dq: jax.Array, model: Robot) -> State:
        """State at the start of a run, given q [rad] and dq [rad/s] there."""

    @abc.abstractmethod
    def estimate(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, model: Robot, state: State
    ) -> jax.Array:
        """f_hat, (n,) [N m]."""

    @abc.abstractmethod
    def derivative(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, tau: jax.Array, model: Robot, state: State
    ) -> State:
        """Rate of the state, given the torque `tau` (n,) [N m] that was applied (after any
        saturation).
        """

    def advance(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: Robot,
        state: State,
        period: jax.Array,
    ) -> State | None:
        """The state a period [s] later for constant measurements and torque; an observer without
        this method makes a step of Euler.
        """
        return None

    def at_period(self, period: jax.Array) -> Self:
        """The observer with gains for which a step of Euler has the same poles as the continuous
        observer has over one period [s].
        """
        return self

    def complete(self, t: jax.Array, x: jax.Array, model: Any, state: State) -> jax.Array | None:
        """The levels x, (r, n), with the estimates of an observer of levels in the place of those
        that the sensor need not measure; None for an observer that estimates none.
        """
        return None

    def limit_excess(self, t: jax.Array, x: jax.Array, model: Any, state: State) -> Any:
        """Positive where a limit of the estimates that the law receives is active, () [1]; `()` for
        an observer without limits.
        """
        return ()
