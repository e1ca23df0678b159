"""The actuator that does what it is told."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Delivered
from iblf_jax.core.pytree import component


@component
class Ideal:
    """The torque that is asked for, at once.  Source: none; the baseline."""

    def init(self, tau: jax.Array) -> tuple[()]:
        """No state."""
        return ()

    def deliver(self, asked: jax.Array, dq: jax.Array, state: tuple[()]) -> Delivered:
        """What is asked."""
        return Delivered(asked, jnp.zeros(asked.shape, bool), ())
