"""A constant delay of the input of a continuous loop."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Actuator, Delivered
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf, static

WHOLE_TOLERANCE = 1e-6
"""Largest distance [steps] at which a delay is rounded to a whole number of steps."""


@component
class Delay(Actuator):
    """tau(t) = u(t - delay) for t >= delay,   the torque that balances gravity before.

    The loop keeps the commands of the integrator's stages over the last steps
    (`simulation.delays`); the cost of a step grows with their number.  With a delay of a whole
    number of steps a run has the order of the integrator, with another delay it is of second order.
    It is of first order where the command itself jumps within a step.  In a chain a delay comes
    first, because it is the command that is late.  An observer receives the current command,
    without the delay.  The commands of a sampled law have the delay of its `Sampling`.

    The fastest mode of a run is that of the loop without the delay.  A derivative with respect to
    the delay is of second order in the time step for a whole number of steps, and of first order
    otherwise.  The derivatives of a loop whose command jumps lack the terms of these jumps.

    Args:
      delay: () [s], > 0; at least one time step.  A run of a study with a shorter one is flagged as
        not finite.
      history: number of past steps whose commands are kept; as many as the delay needs if not
        given.  It has to be given, as at least delay / dt rounded up, where the delay is traced.
        A study over delays needs the history of its longest delay; runs with a delay beyond the
        history are flagged as not finite.

    Source: A. Bellen, M. Zennaro, Numerical Methods for Delay Differential Equations, 2003,
      chapter 3: the method of steps.
    """

    delay: Leaf = leaf("s", sign="positive", shape="scalar")
    history: int = static(default=None)

    def check(self) -> None:
        """Raises ValueError for a delay that is not a time span in seconds, or a history that is
        not a positive whole number.
        """
        if checks.is_concrete(self.delay):
            checks.time_span("Delay.delay", self.delay)
        if self.history is not None:
            checks.positive_integer("Delay.history", self.history, most=checks.MAX_ENTRIES)

    @property
    def input_delay(self) -> Delay:
        """The delay of the input of the loop: the actuator itself."""
        return self

    def with_history(self, dt: float) -> Delay:
        """The same delay with a history that is long enough for steps dt [s].

        Raises:
          ValueError: the delay is shorter than a step, or it is traced and no history is given.
        """
        if not checks.is_concrete(self.delay):
            if self.history is None:
                expected = "a number of steps, as the delay is traced"
                remedy = "Such as Delay(delay=0.01, history=10) for dt = 1 ms."
                raise checks.fail("Delay.history", None, expected, remedy)
            return self
        steps = float(self.delay) / dt
        if steps < 1.0 - WHOLE_TOLERANCE:
            expected = f"a delay of at least one time step, {dt:g} s"
            remedy = f"Take dt={float(self.delay):g}, or this divided by a whole number."
            raise checks.fail("Delay.delay", float(self.delay), expected, remedy)
        needed = max(math.ceil(steps - WHOLE_TOLERANCE), 1)
        if self.history is not None and self.history >= needed:
            return self
        return dataclasses.replace(self, history=needed)

    def jump_times(self) -> jax.Array:
        """The time at which the first command arrives, (1,) [s]."""
        return jnp.atleast_1d(self.delay)

    def deliver(self, command: jax.Array, dq: jax.Array, state: tuple[()]) -> Delivered:
        """The command that the loop passes, which is delayed already."""
        return Delivered(command, jnp.zeros(command.shape, bool), ())
