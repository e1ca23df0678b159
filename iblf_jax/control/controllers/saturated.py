"""Actuator limits around any law; the paper leaves them to future work.

The loop passes the applied torque to observer and plant, so the observer estimates f without the
torque that was cut.  The claims of a law hold only while its torque is not cut.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers._base import (
    Command,
    Controller,
    State,
    wrapped_advice,
    wrapped_state,
    wrapped_switching,
)
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.units import INPUT
from iblf_jax.world.robots import Robot
from iblf_jax.world.robots._base import robot_member

EDGES = ("hard", "smooth")
SHARPNESS = 8
"""Even exponent of the smooth limit: at half the limit it takes off 0.05 %, at the limit 8 %."""


@component
class Saturated:
    """tau = clip(tau_law, -limit, limit) (hard), or tau_law / (1 + |tau_law/limit|^8)^(1/8)
    (smooth, for gradients).

    Paths reach through: "controller.K2" is the wrapped law's K2.

    Args:
      law: the law whose torque is limited, any `Controller`.
      limit: largest torque of each joint, () or (n,) [N m], > 0.
      edge: "hard" or "smooth"; "hard" if not given.

    Source: none; the construction is common.
    """

    law: Controller
    limit: Leaf = leaf(INPUT, sign="positive")
    edge: str = static(default="hard")
    wraps: ClassVar[str] = "law"
    advice = wrapped_advice
    init = wrapped_state
    switching = wrapped_switching

    def check(self) -> None:
        """Raises ValueError for something that is not a law, or an unknown edge."""
        checks.conforms("Saturated.law", self.law, Controller, "iblf_jax.controllers has them.")
        checks.one_of("Saturated.edge", self.edge, EDGES)

    def command(self, *arguments: Any) -> tuple[Command, State]:
        """The wrapped law's command with its torque limited; `saturated` says where it commanded
        more than the limit.  Arguments as those of the wrapped law.
        """
        command, rate = self.law.command(*arguments)
        saturated = command.saturated | (jnp.abs(command.tau) > self.limit)
        if self.edge == "hard":
            tau = jnp.clip(command.tau, -self.limit, self.limit)
        else:
            tau = self.limit * _smooth_clip(command.tau / self.limit)
        return command._replace(tau=tau, saturated=saturated), rate


UNLIMITED = 1e6
"""N m; the limit of a joint without one among others that have theirs: beyond any actuator."""


def within_effort(law: Controller, robot: Robot, *, edge: str = "hard") -> Controller:
    """A law within the largest torques of a robot: `Saturated` at its `effort`.

    Args:
      law: any.
      robot: such as `iblf_jax.robots.Arm`; the law is returned as it is if the robot has no
        `effort`, or an infinite one on every joint.
      edge: as `Saturated.edge`.

    Raises:
      ValueError: as `Saturated`.
    """
    effort = robot_member(robot, "effort")
    if effort is None or (checks.is_concrete(effort) and not np.isfinite(effort).any()):
        return law
    limit = jnp.where(jnp.isfinite(effort), effort, UNLIMITED)
    return Saturated(law=law, limit=limit, edge=edge)


def _smooth_clip(x: jax.Array) -> jax.Array:
    """X / (1 + x^8)^(1/8), written so that nothing overflows; the scale m cancels, in derivatives
    too.
    """
    m = jax.lax.stop_gradient(jnp.maximum(jnp.abs(x), 1.0))
    return (x / m) / ((1.0 / m) ** SHARPNESS + (x / m) ** SHARPNESS) ** (1.0 / SHARPNESS)
