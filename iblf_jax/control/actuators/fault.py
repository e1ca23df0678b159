"""A fault of a drive: a loss of effectiveness and a bias that begin at a given time."""

from __future__ import annotations

import copy

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Actuator, Delivered
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import INPUT


@component
class Fault(Actuator):
    """tau = u for t < time,   tau = effectiveness u + bias for t >= time.

    A `Chain` describes several faults: Chain((Fault(0.7, 0.0, 1.0), Fault(0.5, 0.2, 2.0))).  Steps
    of a run are divided at `time`, so that a run is differentiable with respect to it.  An observer
    receives the command u, so its estimate contains the lost torque.

    Args:
      effectiveness: delivered share of the command, () or (n,) [1], >= 0; 1 without a loss.
      bias: added torque, () or (n,) [N m]; 0 if not given.
      time: time of the fault, () [s]; 0 if not given.

    Source: M. Blanke et al., Diagnosis and Fault-Tolerant Control, 3rd ed. 2016, chapter 3.
    """

    effectiveness: Leaf = leaf("1", sign="nonnegative")
    bias: Leaf = leaf(INPUT, default=0.0)
    time: Leaf = leaf("s", shape="scalar", default=0.0)

    def at(self, t: jax.Array) -> Fault:
        """The actuator at time t [s]: before the fault it has neither loss nor bias."""
        now = copy.copy(self)
        failed = t >= self.time
        object.__setattr__(now, "effectiveness", jnp.where(failed, self.effectiveness, 1.0))
        object.__setattr__(now, "bias", jnp.where(failed, self.bias, 0.0))
        return now

    def jump_times(self) -> jax.Array:
        """`time`, (1,) [s]."""
        return jnp.atleast_1d(self.time)

    def deliver(self, command: jax.Array, dq: jax.Array, state: tuple[()]) -> Delivered:
        """The torque with loss and bias; `at(t)` leaves them out before the fault."""
        tau = self.effectiveness * command + self.bias
        return Delivered(tau, jnp.zeros(command.shape, bool), ())
