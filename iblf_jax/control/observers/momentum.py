"""The paper's observer in momentum form: exact for every mass matrix."""

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
from iblf_jax.world.robots import Robot, energy_gradient


@component
class Momentum(RobotObserver):
    """f_hat = eta + kf M0 q',   eta' = -kf eta - kf (tau - C0 q' - G0 + kf M0 q' + M0' q').

    It is (3.11) of the paper, corrected: f_tilde' = f' - kf f_tilde holds exactly, since
    (M0 q')' = tau + f - C0 q' - G0 + M0' q'.  (M0' q' - C0 q' is dT/dq.)

    Args:
      kf: gain, () or (n,) [1/s], > 0; Theorem 2 asks for more than 1/2, and for more than 1 where f
        changes.
      eta0: eta(0), added to what `start` says, () or (n,) [N m]; 0 if not given.
      start: "zero": eta(0) = eta0, as printed; "matched": eta(0) = eta0 - kf M0 q'(0), so that
        f_hat(0) = eta0; "zero" if not given.

    Source: A. De Luca, R. Mattone, ICRA 2005, 999-1004 (generalised momentum); Zhang & Yan 2024 for
      the form.
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
        checks.one_of("Momentum.start", self.start, STARTS)

    @property
    def error_gain(self) -> jax.Array:
        """kf: f_tilde' = f' - kf f_tilde, (n,) [1/s]."""
        return self.kf

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
        return -self.kf * (f_hat + tau + energy_gradient(model, q, dq) - model.gravity(q))
