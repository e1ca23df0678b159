"""The contract of a disturbance observer.

An observer knows the model, measures q and q', receives the applied torque and returns f_hat, an
estimate of the lumped uncertain term f of (2.1).  Its state is part of the loop's state
and is integrated with the plant; in a sampled loop it goes from one period to the next.
"""

from __future__ import annotations

from typing import Any, Protocol

import jax

from iblf_jax.core.optional import OptionalMembers
from iblf_jax.world.robots import Robot

State = Any
"""A pytree of arrays; `()` for an observer without memory."""


class Observer(Protocol):
    """The contract of a disturbance observer.

    An observer may have two further methods for sampled loops, which use a step of Euler without
    them.  `advance(t, q, dq, tau, model, state, period)` returns its state a period [s] later for
    constant measurements and torque.  `at_period(period)` returns the observer with gains for which
    a step of Euler has the same poles as the continuous observer has over one period.

    An observer of plants in strict-feedback form has the class attribute `receives_x = True`.  Its
    methods then receive the state x, (r, n), in the place of q and q', a `plants.Plant` as the
    model and the input u as `tau`; its estimate is d_hat, (r, n), what the disturbance adds to x'.
    Other observers serve the robot inside such a plant, and `tau` is the torque on its joints.
    An observer of levels may have these members; `observer_member` holds their defaults.

    - `check_model(model)`: raises ValueError for a plant that does not fit its fields.
    - `noise_gain`: the factor from the noise of the measured levels to that of d_hat, (), (r,) or
      (r, n) [1/s].  A scenario whose sensor has noise warns with the product.
    - `measured`: the levels, counted from 1, that it reads; all if not given.
    - `complete(t, x, model, state)`: x, (r, n), with its estimates in the place of the other
      levels, which the sensor need not measure.
    - `limit_excess(t, x, model, state)`: positive where a limit of the estimates that the law
      receives is active, () [1]; `()` for an observer without limits.

    An observer may claim that the error of its estimate obeys f_tilde' = f' - kappa f_tilde: its
    attribute `error_gain` is kappa, (n,) [1/s], or of d_tilde, (r,) or (r, n) [1/s].  `certify`
    checks it under laws of plants in strict-feedback form.
    """

    def init(self, q: jax.Array, dq: jax.Array, model: Robot) -> State:
        """State at the start of a run, given q [rad] and dq [rad/s] there."""
        ...

    def estimate(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, model: Robot, state: State
    ) -> jax.Array:
        """f_hat, (n,) [N m]."""
        ...

    def derivative(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, tau: jax.Array, model: Robot, state: State
    ) -> State:
        """Rate of the state, given the torque `tau` (n,) [N m] that was applied (after any
        saturation).
        """
        ...


observer_member = OptionalMembers(
    receives_x=False,
    advance=None,
    at_period=None,
    advice=list,
    check_model=lambda model: None,
    noise_gain=None,
    measured=None,
    complete=None,
    limit_excess=None,
    error_gain=None,
)
"""Reads optional members of an observer."""
