"""PD with gravity compensation: the yardstick that needs the model's gravity only."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.controllers._base import Command, LawContext, RobotLaw
from iblf_jax.core.pytree import Leaf, component, leaf


@component
class PDGravity(RobotLaw):
    """tau = G0(q) - Kp e1 - Kd e1' - f_hat.

    Classical without an observer (`NoObserver`, f_hat = 0).  alpha is q_d' and V1 = 1/2 Kp e1^2; it
    claims nothing about the bounds, and convergence only for a reference at rest.

    Args:
      Kp: stiffness, () or (n,) [N m/rad], > 0.
      Kd: damping, () or (n,) [N m s/rad], > 0.

    Source: M. Takegaki, S. Arimoto, ASME J. Dynamic Systems, Measurement and Control 103 (1981)
      119-125.
    """

    Kp: Leaf = leaf("N m/rad", sign="positive")
    Kd: Leaf = leaf("N m s/rad", sign="positive")
    gains: ClassVar[tuple[str, ...]] = ("Kp", "Kd")

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
        e1, de1 = q - tube.q_d, dq - tube.dq_d
        tau = context.model.gravity(q) - self.Kp * e1 - self.Kd * de1 - f_hat
        never = jnp.zeros(q.shape, bool)
        return Command(tau, tube.dq_d, 0.5 * self.Kp * e1**2, never, never), ()
