"""A quantiser: the torque has a finite resolution."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Delivered
from iblf_jax.control.actuators.ideal import Ideal
from iblf_jax.control.sensors._base import rounded
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import INPUT


@component
class Quantiser:
    """tau = step round(u / step).

    The torque jumps at surfaces in the state that steps of a run are not divided at: in a
    continuous loop a run is of first order in the time step, and where the loop chatters between
    two levels the time step decides how fast.  In a sampled loop the torque is constant between the
    samples, and the order of the integrator remains.

    The derivative of tau by u is defined as 1, that of the torque before rounding, because the
    derivative of the rounding is 0 almost everywhere; the derivatives of a run are therefore those
    of a loop whose quantisation error is a given disturbance.  The fastest mode is computed without
    the rounding (`smooth`).

    Args:
      step: distance of two levels, () or (n,) [N m], > 0.

    Source: D. Liberzon, Switching in Systems and Control, 2003, section 5.3.
    """

    step: Leaf = leaf(INPUT, sign="positive")

    @property
    def smooth(self) -> Ideal:
        """No rounding."""
        return Ideal()

    def init(self, tau: jax.Array) -> tuple[()]:
        """No state."""
        return ()

    def deliver(self, command: jax.Array, dq: jax.Array, state: tuple[()]) -> Delivered:
        """The nearest level."""
        return Delivered(rounded(command, self.step), jnp.zeros(command.shape, bool), ())
