"""The delay of the input of a continuous loop, by the method of steps.

The loop keeps the commands at the integrator's stages over the last steps. With a delay of m steps
the stage s of step k receives the command of the stage s of step k - m. On an interval of the
length of the delay the input is a known function of time; the intervals together form an ordinary
differential equation, and the scheme is the integrator applied to it. A run therefore has the order
of the integrator.

With another delay a stage receives the value of a polynomial in time through the commands of one
past step. Where several stages have the same time, the polynomial takes their mean. It is quadratic
for rk4, with an error of third order, and linear for Heun's method, with an error of second order.
The state has a kink where the first command arrives, so the command has one there, too. A run is of
second order where this kink lies within a step.

The first command arrives at the time t = delay, which the actuator declares as a jump; a step is
divided there. Before it the input balances gravity, as in a sampled loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators.delay import WHOLE_TOLERANCE
from iblf_jax.core.pytree import Absent
from iblf_jax.simulation.integrators import TABLEAUS, tableau
from iblf_jax.simulation.sampling import command_at
from iblf_jax.simulation.scenario import Scenario

STAGES = max(len(table.c) for table in TABLEAUS.values())
"""Number of commands that are kept of a step; a method of fewer stages repeats its last one."""


def initial_commands(scenario: Scenario, balance: jax.Array) -> Any:
    """The commands before the start, (history, STAGES, n) [N m]; `()` without a delay.

    Args:
      scenario: the scenario.
      balance: the input that balances gravity, (n,) [N m].
    """
    delay = scenario.actuator.input_delay
    if delay is None:
        return ()
    return jnp.broadcast_to(balance, (delay.history or 1, STAGES, balance.size))


class ArrivingCommands(NamedTuple):
    """The commands that arrive within a step."""

    method: str
    """The integrator."""
    start: jax.Array
    """Start of the step, () [s]."""
    dt: jax.Array
    """Length of the step, () [s]."""
    delay: jax.Array
    """Delay of the input, () [s]."""
    shift: jax.Array
    """The delay rounded up to whole steps, less the delay, () [steps] in [0, 1)."""
    is_whole: jax.Array
    """Whether the delay is a whole number of steps, () bool."""
    tolerance: jax.Array
    """Bound of the rounding error of a time within the step, () [steps]."""
    is_one_step: jax.Array
    """Whether the delay is one step, () bool."""
    is_first: jax.Array
    """Whether the first command arrives within the step or at its end, () bool."""
    earlier: jax.Array
    """Commands of the past step that began the delay, rounded up to whole steps, ago,
    (STAGES, n)."""
    later: jax.Array
    """Commands of the step after that one, (STAGES, n)."""

    def with_commands_of_step(self, commands: Sequence[jax.Array]) -> ArrivingCommands:
        """The same with the commands of the step itself, where the delay is one step.

        The first command of a run then arrives at the end of the step that computed it.

        Args:
          commands: of the stages of the first piece of the step, (n,) each.
        """
        own = jnp.stack(_padded(commands))
        return self._replace(later=jnp.where(self.is_one_step, own, self.later))

    def at(self, t: jax.Array) -> jax.Array:
        """The command that arrives at time t [s], (n,)."""
        position = (t - self.start) / self.dt + self.shift
        has_passed = (position >= 1.0) & ~self.is_whole
        is_later = jnp.where(self.is_first, t >= self.delay, has_passed)
        commands = jnp.where(is_later, self.later, self.earlier)
        return interpolated(self.method, commands, position - jnp.where(is_later, 1.0, 0.0))

    def at_stages(self, times: Sequence[jax.Array], length: jax.Array) -> list[jax.Array]:
        """The commands that arrive at the stages of the integrator, (n,) each.

        Args:
          times: of the stages, () [s] each.
          length: of the piece of the step to which the stages belong, () [s].
        """
        # The stages of an undivided step coincide with those of the past step, whose commands are
        # passed on exactly. The polynomial contributes the derivative with respect to time.
        coincides = self.is_whole & self.is_full(length)
        found = []
        for i, (c, t) in enumerate(zip(tableau(self.method).c, times, strict=True)):
            difference = self.earlier[i] - interpolated(self.method, self.earlier, c)
            found.append(self.at(t) + jnp.where(coincides, difference, 0.0))
        return found

    def is_full(self, length: jax.Array) -> jax.Array:
        """Whether a piece of this length, () [s], is the whole step, () bool."""
        return length >= (1.0 - self.tolerance) * self.dt


def arriving(
    scenario: Scenario, method: str, dt: jax.Array, number: jax.Array, commands: Any
) -> ArrivingCommands | Absent:
    """The commands that arrive within a step; `()` without a delay.

    The commands are NaN where the delay is shorter than a step or longer than the history, so that
    the run is flagged.

    Args:
      scenario: the scenario.
      method: the integrator.
      dt: length of the step, () [s].
      number: number of the step, () of floating-point type.
      commands: of the steps before it, newest first, (history, STAGES, n) [N m].
    """
    actuator = scenario.actuator.input_delay
    if actuator is None:
        return ()
    delay = actuator.delay
    steps = delay / dt
    rounding_error = 4.0 * jnp.finfo(dt.dtype).eps
    nearest = jnp.round(steps)
    is_whole = jnp.abs(steps - nearest) < WHOLE_TOLERANCE + rounding_error * steps
    number_of_steps = jax.lax.stop_gradient(jnp.where(is_whole, nearest, jnp.ceil(steps)))
    correction = jax.lax.stop_gradient(jnp.where(is_whole, nearest - steps, 0.0))
    steps = steps + correction
    consistent = (steps >= 1.0) & (number_of_steps <= len(commands))
    earlier = jnp.where(consistent, command_at(commands, number_of_steps - 1.0), jnp.nan)
    return ArrivingCommands(
        method=method,
        start=number * dt,
        dt=dt,
        delay=delay,
        shift=number_of_steps - steps,
        is_whole=is_whole,
        # The times of a step have a rounding error that grows with its number.
        tolerance=WHOLE_TOLERANCE + rounding_error * jnp.maximum(steps, number),
        is_one_step=is_whole & (number_of_steps == 1.0),
        is_first=number + 1.0 == number_of_steps,
        earlier=earlier,
        later=command_at(commands, number_of_steps - 2.0),
    )


def interpolated(
    method: str, commands: jax.Array | list[jax.Array], position: jax.Array | float
) -> jax.Array:
    """The value of the Lagrange polynomial through the commands of a step, (n,).

    Args:
      method: the integrator.
      commands: of the stages of the step, (n,) each.
      position: time since the start of the step, () [steps].
    """
    c = tableau(method).c
    nodes = sorted(set(c))
    found = jnp.zeros_like(commands[0])
    for node in nodes:
        at_node = [commands[i] for i, each in enumerate(c) if each == node]
        mean = sum(at_node[1:], at_node[0]) / len(at_node)
        weight: jax.Array | float = 1.0
        for other in nodes:
            if other != node:
                weight = weight * (position - other) / (node - other)
        found = found + weight * mean
    return found


class PieceCommands(NamedTuple):
    """The commands of the law at the stages of a piece of a step."""

    begin: jax.Array
    """Time at which the piece begins, () [s]."""
    length: jax.Array
    """Length of the piece, () [s]."""
    exists: jax.Array | bool
    """Whether the step has this piece, () bool."""
    commands: list[jax.Array]
    """Commands at the stages, (n,) each."""


def with_step(
    before: jax.Array, method: str, arrived: ArrivingCommands, pieces: Sequence[PieceCommands]
) -> jax.Array:
    """The commands of the past steps with those of one more step, newest first,
    (history, STAGES, n).

    The commands of a step that a jump divides are replaced by a straight line between its ends.

    Args:
      before: the commands before the step, (history, STAGES, n).
      method: the integrator.
      arrived: the commands that arrived within the step.
      pieces: the commands that the law computed in each piece of the step.
    """
    start = pieces[0].commands[0]
    end = pieces[0].commands[-1]
    for piece in pieces[1:]:
        end = jnp.where(piece.exists, piece.commands[-1], end)
    stages = [start + c * (end - start) for c in tableau(method).c]
    for piece in pieces:
        # The stages of a piece that fills its step have the times of those of an undivided step,
        # but a derivative with respect to the jump time at which the piece ends, which the
        # correction by the polynomial removes.
        is_full = arrived.is_full(piece.length)
        for i, (c, own) in enumerate(zip(tableau(method).c, piece.commands, strict=True)):
            offset = (piece.begin + c * piece.length - arrived.start) / arrived.dt - c
            corrected = interpolated(method, piece.commands, c - offset)
            on_grid = own + corrected - interpolated(method, piece.commands, c)
            stages[i] = jnp.where(is_full, on_grid, stages[i])
    return jnp.concatenate([jnp.stack(_padded(stages))[None], before[:-1]])


def _padded(stages: Sequence[jax.Array]) -> list[jax.Array]:
    """The commands of the stages of a step, (n,) each, with the last one repeated up to STAGES."""
    return [*stages, *[stages[-1]] * (STAGES - len(stages))]
