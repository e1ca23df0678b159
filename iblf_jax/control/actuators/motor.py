"""An electric drive: a lag, limits of torque and of its rate, and the line between torque and
speed.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Delivered
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import INPUT, VELOCITY, PlantUnit


@component
class Motor:
    """v = clip(command, +-limit);   y' = clip(bandwidth (v - y), +-rate_limit);   tau = clip(y,
    +-stall (1 - |q'|/no_load_speed)).

    What is not given is not there; without a bandwidth y = v.  Nothing is delivered beyond the
    no-load speed.  The lag is integrated with the plant: behind a jump of the command the torque is
    right to 1e-5 of the jump where dt bandwidth <= 0.2 (rk4), the positions far better.

    Args:
      bandwidth: of the current loop, () or (n,) [1/s], > 0; no lag if not given.
      limit: largest torque, () or (n,) [N m], > 0; none if not given.
      rate_limit: largest rate of the torque, () or (n,) [N m/s], > 0; none if not given.  It needs
        a bandwidth.
      stall: torque at a standstill, () or (n,) [N m], > 0; none if not given.  It comes with
        no_load_speed.
      no_load_speed: speed at which no torque is left, () or (n,) [rad/s], > 0; none if not given.

    Source: the torque-speed line of a DC motor, any text on drives.
    """

    bandwidth: Leaf = leaf("1/s", sign="positive", default=None)
    limit: Leaf = leaf(INPUT, sign="positive", default=None)
    rate_limit: Leaf = leaf(PlantUnit("N m/s", "u/s"), sign="positive", default=None)
    stall: Leaf = leaf(INPUT, sign="positive", default=None)
    no_load_speed: Leaf = leaf(VELOCITY, sign="positive", default=None)

    def check(self) -> None:
        """Raises ValueError for half a torque-speed line, or a limit of the rate without a
        bandwidth.
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

    @property
    def unlimited(self) -> Motor:
        """The same without limits."""
        return dataclasses.replace(
            self, limit=None, rate_limit=None, stall=None, no_load_speed=None
        )

    def init(self, tau: jax.Array) -> Any:
        """The torque that it delivers, (n,) [N m]; no state without a lag."""
        return () if self.bandwidth is None else tau

    def deliver(self, command: jax.Array, dq: jax.Array, state: Any) -> Delivered:
        """Lag and limits."""
        limited = jnp.zeros(command.shape, bool)
        v: jax.Array = command
        rate: Any = ()
        if self.limit is not None:
            limited |= jnp.abs(command) > self.limit
            v = jnp.clip(command, -self.limit, self.limit)
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
