"""The contract of an actuator: it maps the command of a law to the torque on the joints.

The integrator advances the state of an actuator together with the plant.  Friction belongs to the
plant.  The commands of a sampled law have the delay of its `Sampling`; the input of a continuous
loop has the delay of the actuator `Delay`.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax

from iblf_jax.core.optional import OptionalMembers

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


class Actuator(Protocol):
    """The contract of an actuator.

    The command of a law is a torque.  Under a law that commands another input, such as a voltage,
    the actuator may take that input; the observer receives the command, so the observer of such a
    loop may not use it as a torque.

    An actuator may have further members:

    - `unlimited`: the same actuator without its limits.  The fastest mode of a sampled loop is
      computed with it.
    - `smooth`: an actuator with the same state, without a dead zone, play and rounding.  The
      fastest mode of every loop is computed with it.
    - `deviation`: where it has `smooth`, the width of the interval in which the difference of both
      torques lies, () or (n,) [N m].  The numerical error of a run is bounded with it.
    - `resolution`, the distance between two levels, () or (n,) [N m], of an actuator that rounds;
      with it `distance_to_jump(command, dq, state)`, the distance of the command to the next jump
      of the torque, (n,) [N m].
    - `at(t)`: the actuator at time t [s], if it changes with time, such as a drive that fails.
    - `jump_times()`: the times (m,) [s] at which it is discontinuous in time.  Steps of a run are
      divided there, as for disturbances.
    """

    def init(self, tau: jax.Array) -> State:
        """The state in which the actuator delivers the torque `tau`, (n,) [N m]."""
        ...

    def deliver(self, command: jax.Array, dq: jax.Array, state: State) -> Delivered:
        """The torque and the rate of the state.

        Args:
          command: the law's command, (n,): a torque [N m], or the actuator's own input in its unit.
          dq: velocity of the joints, (n,) [rad/s].
          state: of the actuator.
        """
        ...


actuator_member = OptionalMembers(
    unlimited=None,
    smooth=None,
    deviation=None,
    resolution=None,
    input_delay=None,
    with_history=None,
)
"""Reads optional members of an actuator.  Only `Delay` and a `Chain` with a `Delay` have the last
two: `input_delay` is that `Delay`, and `with_history(dt)` is the actuator with a history that is
long enough for steps dt [s]."""


def unlimited(actuator: Actuator) -> Actuator:
    """An actuator without its limits; itself if it declares none."""
    return actuator_member.variant(actuator, "unlimited")  # type: ignore[no-any-return]


def smooth(actuator: Actuator) -> Actuator:
    """An actuator without dead zone, play and rounding; itself if it declares none."""
    return actuator_member.variant(actuator, "smooth")  # type: ignore[no-any-return]


def input_delay(actuator: Actuator) -> Any:
    """The `Delay` of an actuator or of its first part; None without one."""
    return actuator_member(actuator, "input_delay")
