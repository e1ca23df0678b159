"""The ideal actuator: the applied torque equals the command."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Actuator, Delivered
from iblf_jax.core.pytree import component


@component
class Ideal(Actuator):
    """The applied torque equals the command, without delay.  Source: none; the baseline."""

    def deliver(self, command: jax.Array, dq: jax.Array, state: tuple[()]) -> Delivered:
        """The command itself."""
        return Delivered(command, jnp.zeros(command.shape, bool), ())
