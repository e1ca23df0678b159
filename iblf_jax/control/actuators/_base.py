"""The contract of an actuator: it takes the law's command and gives a torque.

Its state is integrated with the plant.  Friction belongs to the plant.  The delay of a sampled law
belongs to its `Sampling`, that of a continuous one is a `Delay`.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax

from iblf_jax.core.optional import OptionalMembers

State = Any
"""A pytree of arrays of floats; `()` for an actuator without memory."""


class Delivered(NamedTuple):
    """The output of an actuator at one instant; torque and flag are (n,)."""

    tau: jax.Array
    """Torque on the joint [N m]."""
    limited: jax.Array
    """bool: a limit was active."""
    rate: State
    """Rate of its state."""


class Actuator(Protocol):
    """The contract of an actuator.

    The command of a law is a torque.  An actuator may take another input, such as a voltage, under
    a law that commands one; an observer is given the command, so such a loop needs one that does
    not use it.

    An actuator with limits also has the property `unlimited`, the same actuator without them; the
    fastest mode of a sampled loop is computed with it.  One with a dead zone, a play or rounding
    has the property `smooth`, an actuator without these that has the same state; the fastest mode
    of every loop is computed with it.  An actuator that changes with time, such as a drive
    that fails, has `at(t)`, the actuator at time t [s], and, if it is discontinuous in time,
    `jump_times()`, (m,) [s]; steps of a run are divided there, as for disturbances.
    """

    def init(self, tau: jax.Array) -> State:
        """State at the start, where it delivers the torque `tau`, (n,) [N m]."""
        ...

    def deliver(self, command: jax.Array, dq: jax.Array, state: State) -> Delivered:
        """The torque and the rate of the state.

        Args:
          command: the law's command, (n,): a torque [N m], or the actuator's own input in its unit.
          dq: velocity of the joints, (n,) [rad/s].
          state: its own.
        """
        ...


actuator_member = OptionalMembers(
    unlimited=None, smooth=None, input_delay=None, with_history=None, advice=list
)
"""Reads optional members of an actuator.  `input_delay` is the `Delay` of the loop's input, and
`with_history(dt)` the actuator with a history that is long enough for steps dt [s]."""


def unlimited(actuator: Actuator) -> Actuator:
    """An actuator without its limits; itself if it declares none."""
    return actuator_member.variant(actuator, "unlimited")  # type: ignore[no-any-return]


def smooth(actuator: Actuator) -> Actuator:
    """An actuator without dead zone, play and rounding; itself if it declares none."""
    return actuator_member.variant(actuator, "smooth")  # type: ignore[no-any-return]


def input_delay(actuator: Actuator) -> Any:
    """The `Delay` of the input of a loop; None without one."""
    return actuator_member(actuator, "input_delay")
