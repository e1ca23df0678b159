"""The contract of an actuator: it maps the command of a law to the torque on the joints.

The integrator advances the state of an actuator together with the plant.  Friction belongs to the
plant.  The commands of a sampled law have the delay of its `Sampling`; the input of a continuous
loop has the delay of the actuator `Delay`.
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.families import attribute
from iblf_jax.core.time import TimeVarying

State = Any
"""A pytree of arrays of floats; `()` for an actuator without memory."""


class Delivered(NamedTuple):
    """The output of an actuator at one instant."""

    tau: jax.Array
    """Torque on the joints, (n,) [N m]."""
    limited: jax.Array
    """Whether a limit is active, (n,) bool."""
    rate: State
    """Rate of the actuator's state, per second."""


class Actuator(TimeVarying):
    """The contract of an actuator.

    The command of a law is a torque.  Under a law that commands another input, such as a voltage,
    the actuator may take that input; the observer receives the command, so the observer of such a
    loop may not use it as a torque.
    """

    @attribute
    def unlimited(self) -> Actuator:
        """The same actuator without its limits.  The fastest mode of a sampled loop is computed
        with it.
        """
        return self

    @attribute
    def smooth(self) -> Actuator:
        """An actuator with the same state, without a dead zone, play and rounding.  The fastest
        mode of every loop is computed with it.
        """
        return self

    @attribute
    def deviation(self) -> Any:
        """The width of the interval in which the difference to the torque of `smooth` lies, () or
        (n,) [N m]; None if it is not known.  The numerical error of a run is bounded with it.
        """
        return None

    @attribute
    def resolution(self) -> Any:
        """The distance between two levels of an actuator that rounds, () or (n,) [N m], or None."""
        return None

    @attribute
    def input_delay(self) -> Any:
        """The `Delay` of an actuator or of its first part; None without one."""
        return None

    def with_history(self, dt: float) -> Actuator:
        """The actuator with a history of commands that is long enough for steps dt [s]."""
        return self

    def distance_to_jump(self, command: jax.Array, dq: jax.Array, state: State) -> jax.Array:
        """The distance of the command to the next jump of the torque of an actuator that rounds,
        (n,) [N m]; 0 where it is not known.
        """
        return jnp.zeros_like(command)

    def init(self, tau: jax.Array) -> State:
        """The state in which the actuator delivers the torque `tau`, (n,) [N m]; `()` for one
        without a state.
        """
        return ()

    @abc.abstractmethod
    def deliver(self, command: jax.Array, dq: jax.Array, state: State) -> Delivered:
        """The torque and the rate of the state.

        Args:
          command: the law's command, (n,): a torque [N m], or the actuator's own input in its unit.
          dq: velocity of the joints, (n,) [rad/s].
          state: of the actuator.
        """
