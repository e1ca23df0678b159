"""Backlash: play between the command and the torque."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Actuator, Delivered
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import INPUT


@component
class Backlash(Actuator):
    """y' = bandwidth (max(u - y - gap/2, 0) + min(u - y + gap/2, 0)),   tau = y.

    The torque is constant while it differs from the command by gap/2 at most.  Otherwise it follows
    the command at a distance of gap/2 with a first-order lag.  For bandwidth -> infinity this is
    the play operator; with a finite bandwidth the rate is continuous.  A run is of second order in
    the time step where the command enters or leaves the gap.  The fastest mode is computed without
    the gap (`smooth`).

    Args:
      gap: width of the play in units of the command, () or (n,) [N m], >= 0.
      bandwidth: inverse time constant of the lag, () or (n,) [1/s], > 0.

    Source: the play operator, M. Brokate, J. Sprekels, Hysteresis and Phase Transitions, 1996,
      section 2.1; the lag regularises it.
    """

    gap: Leaf = leaf(INPUT, sign="nonnegative")
    bandwidth: Leaf = leaf("1/s", sign="positive")

    @property
    def smooth(self) -> Backlash:
        """The same actuator without the gap."""
        return dataclasses.replace(self, gap=jnp.zeros_like(self.gap))

    @property
    def deviation(self) -> Leaf:
        """`gap`: the torque stays within half of it of the torque without the gap."""
        return self.gap

    def init(self, tau: jax.Array) -> jax.Array:
        """The state y: the torque itself, (n,) [N m]."""
        return tau

    def deliver(self, command: jax.Array, dq: jax.Array, state: jax.Array) -> Delivered:
        """The torque y, and its rate."""
        difference = command - state
        half_gap = 0.5 * self.gap
        above = jnp.maximum(difference - half_gap, 0.0)
        below = jnp.minimum(difference + half_gap, 0.0)
        rate = self.bandwidth * (above + below)
        return Delivered(state, jnp.zeros(command.shape, bool), rate)
