"""The disturbance observer as the paper prints it: exact for a constant mass matrix only."""

from __future__ import annotations

import jax

from iblf_jax.control.observers._base import RobotObserver
from iblf_jax.control.observers._eta import (
    STARTS,
    advanced_eta,
    eta_and_momentum,
    initial_eta,
    kf_advice,
    with_discrete_gain,
)
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.world.robots import Robot


@component
class AsPublished(RobotObserver):
    """f_hat = eta + kf M0 q',   eta' = -kf eta - kf (tau - C0 q' - G0 + kf M0 q').    (3.11)

    Its error obeys f_tilde' = f' - kf f_tilde - kf M0' q': the last term is what `Momentum`
    removes.

    Args:
      kf: gain, () or (n,) [1/s], > 0; Theorem 2 asks for more than 1/2, and for more than 1 where f
        changes.
      eta0: eta(0), added to what `start` says, () or (n,) [N m]; 0 if not given.
      start: "zero": eta(0) = eta0, as printed; "matched": eta(0) = eta0 - kf M0 q'(0), so that
        f_hat(0) = eta0; "zero" if not given.

    Source: Zhang & Yan 2024, (3.11), with the signs of its derivation.
    """

    kf: Leaf = leaf("1/s", sign="positive")
    eta0: Leaf = leaf("N m", default=0.0)
    start: str = static(default="zero")
    advice = kf_advice
    init = initial_eta
    estimate = eta_and_momentum
    advance = advanced_eta
    at_period = with_discrete_gain

    def check(self) -> None:
        """Raises ValueError for an unknown `start`."""
        checks.one_of("AsPublished.start", self.start, STARTS)

    def derivative(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: Robot,
        state: jax.Array,
    ) -> jax.Array:
        """eta', (n,) [N m/s]."""
        f_hat = self.estimate(t, q, dq, model, state)
        return -self.kf * (f_hat + tau - model.coriolis(q, dq, dq) - model.gravity(q))
