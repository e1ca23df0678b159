"""A quantiser: the torque has a finite resolution."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Actuator, Delivered
from iblf_jax.control.actuators.ideal import Ideal
from iblf_jax.control.sensors._base import rounded
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import INPUT


@component
class Quantiser(Actuator):
    """tau = step round(u / step).

    Steps of a run are not divided where the torque jumps from one level to the next.  A run of a
    continuous loop is therefore of first order in the time step, and where the loop chatters
    between two levels, the time step determines the frequency of the chatter.  In a sampled loop
    the torque is constant between samples, and a run has the order of the integrator.

    The derivative of tau with respect to u is defined as 1, that of the torque before rounding,
    because the derivative of the rounding is 0 almost everywhere; the derivatives of a run are
    therefore those of a loop whose quantisation error is a given disturbance.  The fastest mode is
    computed without the rounding (`smooth`).

    Args:
      step: distance between two levels, () or (n,) [N m], > 0.

    Source: D. Liberzon, Switching in Systems and Control, 2003, section 5.3.
    """

    step: Leaf = leaf(INPUT, sign="positive")

    @property
    def smooth(self) -> Ideal:
        """An actuator without rounding."""
        return Ideal()

    @property
    def resolution(self) -> Leaf:
        """`step`."""
        return self.step

    @property
    def deviation(self) -> Leaf:
        """`step`: the rounding error is at most half of it in both directions."""
        return self.step

    def distance_to_jump(self, command: jax.Array, dq: jax.Array, state: tuple[()]) -> jax.Array:
        """The distance of the command to the nearest limit between two levels, (n,) [N m]."""
        return 0.5 * self.step - jnp.abs(rounded(command, self.step) - command)

    def deliver(self, command: jax.Array, dq: jax.Array, state: tuple[()]) -> Delivered:
        """The nearest level."""
        return Delivered(rounded(command, self.step), jnp.zeros(command.shape, bool), ())
