"""Commands of a continuous loop that reach the actuator later: the method of steps.

The loop keeps the commands of the integrator's stages of the last steps. With a delay of m steps
the stage s of step k receives the command of the stage s of step k - m. This is the integrator
applied to the ordinary differential equation of all intervals of the length of the delay, so a run
has the order of the integrator.

Otherwise a stage receives the value of the polynomial in time through the commands of a past step:
the mean of those stages that belong to the same time, at each such time. For rk4 it is quadratic
and right to third order, for Heun's method linear and right to second order. The motion has a kink
where the first command arrives, hence the commands have one, and a run is of second order where
the kink does not lie on an instant.

The first command arrives at the delay, where the actuator declares a jump; a step is divided there.
Before it the input balances gravity, as in a sampled loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators._base import input_delay
from iblf_jax.control.actuators.delay import WHOLE_TOLERANCE
from iblf_jax.simulation.integrators import TABLEAUS, tableau
from iblf_jax.simulation.sampling import command_at
from iblf_jax.simulation.scenario import Scenario

STAGES = max(len(table.c) for table in TABLEAUS.values())
"""Commands that are kept of a step; a method of fewer stages repeats its last one."""


def initial_commands(scenario: Scenario, balance: jax.Array) -> Any:
    """The commands before the start, (history, STAGES, n) [N m]; `()` without a delay.

    Args:
      scenario: the scenario.
      balance: the input that balances gravity, (n,) [N m].
    """
    delay = input_delay(scenario.actuator)
    if delay is None:
        return ()
    return jnp.broadcast_to(balance, (delay.history or 1, STAGES, balance.size))


class ArrivingCommands(NamedTuple):
    """The commands that arrive within a step."""

    method: str
    start: jax.Array
    """Of the step, () [s]."""
    dt: jax.Array
    """() [s]."""
    delay: jax.Array
    """() [s]."""
    shift: jax.Array
    """Steps by which the delay is shorter than a whole number of steps, () in [0, 1)."""
    is_whole: jax.Array
    """Whether it is a whole number of steps, () bool."""
    tolerance: jax.Array
    """Difference that rounding may make, () [steps]."""
    is_one_step: jax.Array
    """Whether it is one step, () bool."""
    is_first: jax.Array
    """Whether the first command arrives within the step or at its end, () bool."""
    earlier: jax.Array
    """Commands of the past step that begins a whole number of steps ago, (STAGES, n)."""
    later: jax.Array
    """Those of the step after it, (STAGES, n)."""

    def with_commands_of_step(self, commands: Sequence[jax.Array]) -> ArrivingCommands:
        """The same with the commands of the step itself, the first of which arrives at its end
        where the delay is one step.

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
        is_full = length >= (1.0 - self.tolerance) * self.dt
        matches = self.is_whole & is_full
        found = []
        for i, (c, t) in enumerate(zip(tableau(self.method).c, times, strict=True)):
            difference = self.earlier[i] - interpolated(self.method, self.earlier, c)
            found.append(self.at(t) + jnp.where(matches, difference, 0.0))
        return found


def arriving(
    scenario: Scenario, method: str, dt: jax.Array, number: jax.Array, commands: Any
) -> Any:
    """The commands that arrive within a step; `()` without a delay.

    They are NaN where the delay is shorter than a step, or longer than the history.

    Args:
      scenario: the scenario.
      method: the integrator.
      dt: of the step, () [s].
      number: of the step, () as a floating-point number.
      commands: of the steps before it, newest first, (history, STAGES, n) [N m].
    """
    found = input_delay(scenario.actuator)
    if found is None:
        return ()
    delay = found.delay
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


def interpolated(method: str, commands: Any, position: Any) -> jax.Array:
    """The polynomial through the commands of a step at a position in it, (n,).

    Args:
      method: the integrator.
      commands: of its stages, (n,) each.
      position: () [steps].
    """
    c = tableau(method).c
    nodes = sorted(set(c))
    found = jnp.zeros_like(commands[0])
    for node in nodes:
        rows = [commands[i] for i, each in enumerate(c) if each == node]
        weight = 1.0
        for other in nodes:
            if other != node:
                weight = weight * (position - other) / (node - other)
        found = found + weight * (sum(rows[1:], rows[0]) / len(rows))
    return found


class PieceCommands(NamedTuple):
    """The commands of the stages of a piece of a step."""

    begin: jax.Array
    """() [s]."""
    length: jax.Array
    """() [s]."""
    exists: Any
    """Whether the step has this piece, () bool."""
    commands: list[jax.Array]
    """(n,) of each stage."""


def with_step(
    before: jax.Array, method: str, arrived: ArrivingCommands, pieces: Sequence[PieceCommands]
) -> jax.Array:
    """The commands of the past steps after one more, newest first, (history, STAGES, n).

    Of a step that is divided by a jump, the commands between its ends are those of a straight line.

    Args:
      before: those before the step.
      method: the integrator.
      arrived: the commands that arrived within the step.
      pieces: of the step.
    """
    c = tableau(method).c
    start, end = pieces[0].commands[0], pieces[0].commands[-1]
    for piece in pieces[1:]:
        end = jnp.where(piece.exists, piece.commands[-1], end)
    stages = [start + each * (end - start) for each in c]
    for piece in pieces:
        is_full = piece.length >= (1.0 - arrived.tolerance) * arrived.dt
        on_grid = _on_grid(method, arrived, piece)
        stages = [jnp.where(is_full, own, line) for own, line in zip(on_grid, stages, strict=True)]
    return jnp.concatenate([jnp.stack(_padded(stages))[None], before[:-1]])


def _padded(stages: Sequence[jax.Array]) -> list[jax.Array]:
    """The commands of the stages of a step, (n,) each, with the last one repeated up to STAGES."""
    return [*stages, *[stages[-1]] * (STAGES - len(stages))]


def _on_grid(method: str, arrived: ArrivingCommands, piece: PieceCommands) -> list[jax.Array]:
    """The commands of the stages of a piece that fills its step, (n,) each, at the times of an
    undivided step.

    The times of such a piece are these, but they have a derivative by the jump time at which it
    ends.
    """
    found = []
    for c, own in zip(tableau(method).c, piece.commands, strict=True):
        late = (piece.begin + c * piece.length - arrived.start) / arrived.dt - c
        moved = interpolated(method, piece.commands, c - late)
        found.append(own + moved - interpolated(method, piece.commands, c))
    return found
