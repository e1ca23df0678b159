"""An electric drive: a first-order lag, limits of torque and rate, and a torque-speed line."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Actuator, Delivered, State
from iblf_jax.core import checks
from iblf_jax.core.input_limits import check_lower_limit, is_beyond, lower_or_opposite
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import INPUT, VELOCITY, PlantUnit


@component
class Motor(Actuator):
    """A first-order lag with limits of torque and rate, and a torque-speed line.

        v = clip(u, lower_limit, limit),   y' = clip(bandwidth (v - y), +-rate_limit),
        tau = clip(y, +-stall max(1 - |q'|/no_load_speed, 0))

    A limit or a lag that is not given is left out; without a bandwidth y = v.  Beyond the no-load
    speed the torque is 0 in both directions.  The integrator of the run advances the lag: after a
    jump of the command the error of the torque is below 1e-5 of the jump where
    dt bandwidth <= 0.2 (rk4), and that of the positions is far smaller.  A run is of second order
    in the time step where a limit becomes active or inactive.

    Args:
      bandwidth: inverse time constant of the current loop, () or (n,) [1/s], > 0; no lag if not
        given.
      limit: largest torque, () or (n,) [N m], > 0; none if not given.
      rate_limit: largest rate of the torque, () or (n,) [N m/s], > 0; none if not given.  It needs
        a bandwidth.
      stall: torque at a standstill, () or (n,) [N m], > 0; none if not given.  It needs a
        no_load_speed.
      no_load_speed: speed at which the torque is 0, () or (n,) [rad/s], > 0; none if not given.
      lower_limit: smallest torque, () or (n,) [N m], below the limit, such as 0 for a pump;
        -limit if not given.  It needs a limit.

    Source: R. Krishnan, Electric Motor Drives, 2001, chapter 2: the torque-speed line of a DC
      motor.
    """

    bandwidth: Leaf = leaf("1/s", sign="positive", default=None)
    limit: Leaf = leaf(INPUT, sign="positive", default=None)
    rate_limit: Leaf = leaf(PlantUnit("N m/s", "u/s"), sign="positive", default=None)
    stall: Leaf = leaf(INPUT, sign="positive", default=None)
    no_load_speed: Leaf = leaf(VELOCITY, sign="positive", default=None)
    lower_limit: Leaf = leaf(INPUT, default=None)

    def check(self) -> None:
        """Raises ValueError for one of stall and no_load_speed without the other, a rate_limit
        without a bandwidth, or a lower_limit without a larger limit.
        """
        if (self.stall is None) != (self.no_load_speed is None):
            name = "no_load_speed" if self.no_load_speed is None else "stall"
            raise checks.fail(f"Motor.{name}", None, "stall and no_load_speed together, or neither")
        if self.rate_limit is not None and self.bandwidth is None:
            raise checks.fail(
                "Motor.bandwidth",
                None,
                "a bandwidth, as there is a rate_limit",
                "Such as bandwidth=1000.0.",
            )
        check_lower_limit("Motor", self.lower_limit, self.limit)

    @property
    def unlimited(self) -> Motor:
        """The same drive without limits."""
        return dataclasses.replace(
            self, limit=None, rate_limit=None, stall=None, no_load_speed=None, lower_limit=None
        )

    def init(self, tau: jax.Array) -> Any:
        """The state y: the torque itself, (n,) [N m]; `()` without a lag."""
        return () if self.bandwidth is None else tau

    def deliver(self, command: jax.Array, dq: jax.Array, state: State) -> Delivered:
        """The torque, and the rate of the lag; `limited` where a limit changes one of them."""
        limited = jnp.zeros(command.shape, bool)
        v: jax.Array = command
        rate: Any = ()
        if self.limit is not None:
            lower = lower_or_opposite(self.lower_limit, self.limit)
            limited |= is_beyond(command, self.lower_limit, self.limit)
            v = jnp.clip(command, lower, self.limit)
        if self.bandwidth is not None:
            rate = self.bandwidth * (v - state)
            if self.rate_limit is not None:
                limited |= jnp.abs(rate) > self.rate_limit
                rate = jnp.clip(rate, -self.rate_limit, self.rate_limit)
            v = state
        if self.stall is not None:
            line = jnp.maximum(self.stall * (1.0 - jnp.abs(dq) / self.no_load_speed), 0.0)
            limited |= jnp.abs(v) > line
            v = jnp.clip(v, -line, line)
        return Delivered(v, limited, rate)
