"""Actuators in series."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import Actuator, Delivered, State
from iblf_jax.core import checks
from iblf_jax.core.pytree import component
from iblf_jax.core.time import joined, jump_times_of


@component
class Chain(Actuator):
    """Each actuator receives the torque of the previous one as its command.

        u_1 = u,   u_(i+1) = tau_i,   tau = tau_m   for parts 1 to m

    Such as `Chain((Motor(bandwidth=2000.0, limit=40.0), Motor(bandwidth=300.0)))`.  An observer
    receives the command u of the law.

    Args:
      parts: any actuators, a tuple or a list, from the command to the joint; at least one.  A
        `Delay` comes first.

    Source: none; a series connection, such as that of a current loop and a transmission.
    """

    parts: tuple[Actuator, ...]

    def check(self) -> None:
        """Makes a tuple of the parts; raises ValueError for no part, a part that is not an
        actuator, or a `Delay` behind another part.
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
            if i > 0 and part.input_delay is not None:
                expected = "a Delay as the first part only"
                remedy = "It is the command that is late: Chain((Delay(...), ...))."
                raise checks.fail(f"Chain.parts[{i}]", part, expected, remedy)

    @property
    def unlimited(self) -> Chain:
        """The same chain without limits."""
        return dataclasses.replace(self, parts=tuple(part.unlimited for part in self.parts))

    @property
    def smooth(self) -> Chain:
        """The same chain without dead zones, play and rounding."""
        return dataclasses.replace(self, parts=tuple(part.smooth for part in self.parts))

    @property
    def deviation(self) -> Any:
        """The sum of those of all parts; None if a part with a dead zone, play or rounding has
        none.
        """
        widths = [part.deviation for part in self.parts if part.smooth is not part]
        if any(width is None for width in widths):
            return None
        return sum(widths)

    @property
    def resolution(self) -> Any:
        """Of the first part that rounds; None without one."""
        found = [part.resolution for part in self.parts]
        return next((step for step in found if step is not None), None)

    def distance_to_jump(self, command: jax.Array, dq: jax.Array, state: State) -> jax.Array:
        """The smallest distance of all parts that round, (n,) [N m]; 0 behind a part with a state,
        whose torque passes the levels between two samples.
        """
        torque, moves = command, False
        distance = jnp.full(command.shape, jnp.inf)
        for part, state_of_part in zip(self.parts, state, strict=True):
            if part.resolution is not None:
                own = part.distance_to_jump(torque, dq, state_of_part)
                distance = jnp.minimum(distance, jnp.zeros_like(own) if moves else own)
            moves = moves or bool(jax.tree.leaves(state_of_part))
            torque = part.deliver(torque, dq, state_of_part).tau
        return distance

    @property
    def input_delay(self) -> Any:
        """The `Delay` of the first part; None without one."""
        return self.parts[0].input_delay

    def with_history(self, dt: float) -> Chain:
        """The same chain, whose delay has a history that is long enough for steps dt [s]."""
        if self.input_delay is None:
            return self
        first, *others = self.parts
        return dataclasses.replace(self, parts=(first.with_history(dt), *others))

    def at(self, t: jax.Array) -> Chain:
        """The chain as it is at time t [s]."""
        now = copy.copy(self)
        object.__setattr__(now, "parts", tuple(part.at(t) for part in self.parts))
        return now

    def jump_times(self) -> jax.Array:
        """The jump times of all parts, (m,) [s]."""
        times = [jump_times_of(f"Chain.parts[{i}]", part) for i, part in enumerate(self.parts)]
        return joined(times)

    def init(self, tau: jax.Array) -> Any:
        """The states in which each part delivers the torque `tau`, (n,) [N m]."""
        return tuple(part.init(tau) for part in self.parts)

    def deliver(self, command: jax.Array, dq: jax.Array, state: State) -> Delivered:
        """The torque of the last part, and the rates of all; `limited` where any part is."""
        torque = command
        limited = jnp.zeros(command.shape, bool)
        rates = []
        for part, state_of_part in zip(self.parts, state, strict=True):
            delivered = part.deliver(torque, dq, state_of_part)
            torque = delivered.tau
            limited = limited | delivered.limited
            rates.append(delivered.rate)
        return Delivered(torque, limited, tuple(rates))
