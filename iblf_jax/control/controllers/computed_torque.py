"""Computed torque: the yardstick that cancels the model and knows of no bound.

With the exact model and estimate the error obeys e1" + Kd e1' + Kp e1 = 0, joint by joint;
otherwise M0^-1 f_tilde drives it.
"""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.controllers._base import Command, LawContext, RobotLaw
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.robots import inverse_dynamics


@component
class ComputedTorque(RobotLaw):
    """tau = M0 (q_d" - Kd e1' - Kp e1) + C0 q' + G0 - f_hat.

    alpha is q_d' and V1 = 1/2 Kp e1^2; it claims nothing about the bounds.

    Args:
      Kp: stiffness of the error equation, () or (n,) [1/s^2], > 0.
      Kd: damping of the error equation, () or (n,) [1/s], > 0; 2 sqrt(Kp) is critical.

    Source: M. W. Spong, S. Hutchinson, M. Vidyasagar, Robot Modeling and Control, 2006, chapter 8.
    """

    Kp: Leaf = leaf("1/s^2", sign="positive")
    Kd: Leaf = leaf("1/s", sign="positive")
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
        tube, model = context.tube(t), context.model
        e1, de1 = q - tube.q_d, dq - tube.dq_d
        acceleration = tube.ddq_d - self.Kd * de1 - self.Kp * e1
        tau = inverse_dynamics(model, q, dq, dq, acceleration) - f_hat
        never = jnp.zeros(q.shape, bool)
        return Command(tau, tube.dq_d, 0.5 * self.Kp * e1**2, never, never), ()
