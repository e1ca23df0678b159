"""Actuators in series."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import (
    Actuator,
    Delivered,
    actuator_member,
    input_delay,
    smooth,
    unlimited,
)
from iblf_jax.core import checks
from iblf_jax.core.pytree import component
from iblf_jax.core.time import as_at, joined, jump_times_of


@component
class Chain:
    """Each actuator receives the torque of the previous one: `Chain((Motor(bandwidth=2000.0,
    limit=40.0), Motor(bandwidth=300.0)))`.

    Args:
      parts: any actuators, a tuple or a list, from the command to the joint; at least one.  A
        `Delay` comes first.

    Source: none; what a current loop and a transmission with a lag of its own make together.
    """

    parts: tuple[Actuator, ...]

    def check(self) -> None:
        """Takes a list for a tuple; raises ValueError for a part that is not an actuator, or none
        at all.
        """
        if not isinstance(self.parts, tuple | list) or not self.parts:
            raise checks.fail(
                "Chain.parts",
                self.parts,
                "a tuple of actuators",
                "Such as Chain((Motor(limit=40.0), Motor(bandwidth=300.0))).",
            )
        object.__setattr__(self, "parts", tuple(self.parts))
        for i, part in enumerate(self.parts):
            checks.conforms(f"Chain.parts[{i}]", part, Actuator)
            if i > 0 and input_delay(part) is not None:
                expected = "a Delay as the first part only"
                remedy = "It is the command that is late: Chain((Delay(...), ...))."
                raise checks.fail(f"Chain.parts[{i}]", part, expected, remedy)

    @property
    def unlimited(self) -> Chain:
        """The same without limits."""
        return dataclasses.replace(self, parts=tuple(map(unlimited, self.parts)))

    @property
    def smooth(self) -> Chain:
        """The same without dead zones, play and rounding."""
        return dataclasses.replace(self, parts=tuple(map(smooth, self.parts)))

    @property
    def input_delay(self) -> Any:
        """The `Delay` of the first part; None without one."""
        return input_delay(self.parts[0])

    def with_history(self, dt: float) -> Chain:
        """The same with a history of its delay that is long enough for steps dt [s]."""
        first = self.parts[0]
        fitted = actuator_member(first, "with_history")
        if fitted is None:
            return self
        return dataclasses.replace(self, parts=(fitted(dt), *self.parts[1:]))

    def at(self, t: jax.Array) -> Chain:
        """The chain as it is at time t [s]."""
        now = copy.copy(self)
        object.__setattr__(now, "parts", tuple(as_at(part, t) for part in self.parts))
        return now

    def jump_times(self) -> jax.Array:
        """The parts' jump times together, (m,) [s]."""
        return joined(
            [jump_times_of(f"Chain.parts[{i}]", part) for i, part in enumerate(self.parts)]
        )

    def init(self, tau: jax.Array) -> Any:
        """The parts' states, each of which delivers the torque."""
        return tuple(part.init(tau) for part in self.parts)

    def deliver(self, command: jax.Array, dq: jax.Array, state: Any) -> Delivered:
        """What the last delivers; a limit of any is one of the chain."""
        torque, limited, rates = command, jnp.zeros(command.shape, bool), []
        for part, own in zip(self.parts, state, strict=True):
            delivered = part.deliver(torque, dq, own)
            torque, limited = delivered.tau, limited | delivered.limited
            rates.append(delivered.rate)
        return Delivered(torque, limited, tuple(rates))
