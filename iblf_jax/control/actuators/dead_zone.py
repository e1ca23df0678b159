"""A dead zone: small commands deliver nothing."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators._base import Actuator, Delivered
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import INPUT, PlantUnit


@component
class DeadZone(Actuator):
    """tau = slope (u - upper) for u > upper,   slope (u - lower) for u < lower,   0 between them.

    The torque is a continuous function of the command with a kink at both ends of the zone.  A run
    is of second order in the time step where the command crosses an end, and its derivatives are
    those of the branch on which the command lies.  The fastest mode is computed without the dead
    zone (`smooth`), because the loop is open inside it.

    Args:
      lower: command below which a torque is delivered, () or (n,) [N m], <= 0.
      upper: command above which a torque is delivered, () or (n,) [N m], >= 0.
      slope: torque per command outside of the zone, () or (n,) [1], > 0; 1 if not given.

    Source: G. Tao, P. V. Kokotovic, Adaptive Control of Systems with Actuator and Sensor
      Nonlinearities, 1996, chapter 2.
    """

    lower: Leaf = leaf(INPUT)
    upper: Leaf = leaf(INPUT, sign="nonnegative")
    slope: Leaf = leaf(PlantUnit("1", "1"), sign="positive", default=1.0)

    def check(self) -> None:
        """Raises ValueError for a `lower` above 0."""
        if checks.is_concrete(self.lower) and np.any(np.asarray(self.lower) > 0):
            remedy = "A command of 0 lies in the dead zone."
            raise checks.fail("DeadZone.lower", self.lower, "a command <= 0", remedy)

    @property
    def smooth(self) -> DeadZone:
        """The same actuator without the zone."""
        zero = jnp.zeros_like(self.upper)
        return dataclasses.replace(self, lower=zero, upper=zero)

    @property
    def deviation(self) -> jax.Array:
        """The width slope (upper - lower)."""
        return self.slope * (self.upper - self.lower)

    def deliver(self, command: jax.Array, dq: jax.Array, state: tuple[()]) -> Delivered:
        """The torque of a command outside the zone; 0 inside it."""
        above = jnp.maximum(command - self.upper, 0.0)
        below = jnp.minimum(command - self.lower, 0.0)
        return Delivered(self.slope * (above + below), jnp.zeros(command.shape, bool), ())
