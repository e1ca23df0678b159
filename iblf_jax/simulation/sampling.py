"""Timing of a sampled law: its period and the arrival of its commands.

A period holds m time steps dt. Instant k is the start of a sample where k is a multiple of m. A
command arrives `delay` after the start of its sample, anywhere in a step: the integrator divides
that step in two.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.actuators.delay import WHOLE_TOLERANCE
from iblf_jax.control.controllers.event_compensated import check_relative
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.units import INPUT

OBSERVER_STEPS = ("exact", "poles", "euler")
PERIOD_TOLERANCE = 1e-4
"""Largest relative distance of a period from a whole number of steps."""


class SentCommand(NamedTuple):
    """The command that an event trigger sent last."""

    input: jax.Array
    """Input of the plant, (n,): of a robot the torque [N m]."""
    torque: jax.Array
    """Torque of the law, (n,) [N m], which observers receive; the input itself, unless an input map
    such as `controllers.WithDrive` has another."""
    number: jax.Array
    """Number of commands sent so far, () of floating-point type."""


@component
class EventTrigger:
    """The command of a sample is sent where it differs enough from the last one that was sent.

        |u_i - u_held,i| > relative_i |u_held,i| + absolute_i   for any component i

    Otherwise the actuator and the observer keep the held command.  A message to the drives carries
    the commands of all joints, so one component beyond its threshold sends all components.  The
    number of events is therefore the number of messages, and the error |u_i - u_held,i| of each
    component at a sample is bounded by its own threshold.  The first command is always sent, and so
    is a command that is not finite, which stops the run.  With a period of one step dt the
    condition is checked at every step, as for a law in continuous time.

    The derivative of a held command is that of the command that was sent; the instants of the
    events have no derivative.

    Args:
      relative: relative threshold delta, () or (n,) [1], >= 0 and < 1; 0 if not given.
      absolute: absolute threshold m, () or (n,) [N m], >= 0; 0 if not given.

    Source: L. Xing, C. Wen, Z. Liu, H. Su, J. Cai, IEEE Trans. Automatic Control 62 (2017)
      2071-2076, for one input; the condition for several inputs is a design of this package.
    """

    relative: Leaf = leaf("1", sign="nonnegative", default=0.0)
    absolute: Leaf = leaf(INPUT, sign="nonnegative", default=0.0)

    def check(self) -> None:
        """Raises ValueError for a relative threshold of 1 or more."""
        check_relative("EventTrigger.relative", self.relative)

    def sent(self, u: jax.Array, torque: jax.Array, last: SentCommand) -> SentCommand:
        """The command after a sample: the new one if it is sent, else the held one.

        Args:
          u: input of the plant that the law commands, (n,).
          torque: of the law, (n,) [N m].
          last: the command that was sent last.
        """
        threshold = self.relative * jnp.abs(last.input) + self.absolute
        # A comparison with NaN is False. Written this way, the trigger sends a command that is not
        # finite, and the run stops as it does without a trigger.
        is_within = jnp.abs(u - last.input) <= threshold
        fires = ~jnp.all(is_within) | (last.number == 0.0)
        return SentCommand(
            jnp.where(fires, u, last.input),
            jnp.where(fires, torque, last.torque),
            last.number + jnp.where(fires, 1.0, 0.0).astype(last.number.dtype),
        )


def nothing_sent(u: jax.Array) -> SentCommand:
    """The `SentCommand` before the first sample: the input u, (n,), and no event."""
    return SentCommand(u, u, jnp.zeros((), u.dtype))


@component
class Sampling:
    """Law and observer run once a period on the measurement at its start; their torque is constant
    over a period (zero-order hold) and arrives `delay` later.

        y_k = sensor(x(t_k)),   (tau_k, z_(k+1)) = law(t_k, y_k, z_k),   tau(t) = tau_k for t_k +
        delay <= t < t_(k+1) + delay

    Until the first command arrives the torque is G0(q(0)) of the model.  The instants of the
    samples have no derivative by the period; the torque has one by the delay, unless that is 0.

    Args:
      period: () [s], > 0; a whole number of steps dt.
      delay: () [s], >= 0, of any length; 0 if not given.
      observer: discretisation of the observer; "exact" if not given.  "exact": (3.11) integrated
        over the period with the measurement and the command at its start; as the robot moves
        meanwhile, f_hat is off by about kf period / 2 times the torque that accelerates it.
        "poles": an Euler step with gains that give the observer's poles over a period, without
        that bias.  "euler": an Euler step with the observer's own gains, unstable from
        kf period = 2 on.
      queue: largest number of commands in transit at once; as many as the delay needs if not given.
        A study with longer delays needs more.
      trigger: an `EventTrigger`; every command is sent if not given.

    Source: K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, 3rd ed. 1997, chapters 2 and
      3.
    """

    period: Leaf = leaf("s", sign="positive", shape="scalar")
    delay: Leaf = leaf("s", sign="nonnegative", shape="scalar", default=0.0)
    observer: str = static(default="exact")
    queue: int = static(default=None)
    trigger: EventTrigger | None = None

    def check(self) -> None:
        """Raises ValueError for an unknown step of the observer, a queue that is too short, or a
        trigger that is not an `EventTrigger`.
        """
        if not isinstance(self.trigger, EventTrigger | None):
            remedy = "Such as ij.EventTrigger(relative=0.1, absolute=0.05)."
            expected = "an EventTrigger, or None"
            raise checks.fail("Sampling.trigger", self.trigger, expected, remedy)
        checks.one_of("Sampling.observer", self.observer, OBSERVER_STEPS)
        name, queue, least = "Sampling.queue", self.queue, 0
        if checks.is_concrete(self):
            checks.time_span("Sampling.period", self.period)
            checks.time_span("Sampling.delay", self.delay, zero=True)
            least = self.needed
            if least > checks.MAX_ENTRIES:
                expected = f"at most {checks.MAX_ENTRIES} periods of {float(self.period):g} s"
                raise checks.fail("Sampling.delay", self.delay, expected)
            if queue is None:
                queue = least
        if queue is None:
            expected = "a whole number, where period or delay is traced"
            raise checks.fail(name, None, expected, "Such as queue=1.")
        queue = checks.positive_integer(name, queue, least=0, most=checks.MAX_ENTRIES)
        if queue < least:
            expected = f"at least {least}, for a delay of {float(self.delay):g} s"
            raise checks.fail(name, queue, expected)
        object.__setattr__(self, "queue", queue)

    @property
    def needed(self) -> int:
        """Largest number of commands in transit at once."""
        return commands_in_transit(float(self.delay), float(self.period))


def commands_in_transit(delay: float, period: float) -> int:
    """Largest number of commands in transit at once, the one that arrives with a sample included;
    delay and period in [s].
    """
    if not delay > 0:
        return 0
    return math.floor(delay / period + WHOLE_TOLERANCE) + 1


class Instant(NamedTuple):
    """Position of an instant between samples."""

    sampling_index: jax.Array
    """Number of the last sample, () int."""
    phase: jax.Array
    """Steps since its start, () int."""


def _steps(sampling: Sampling, dt: jax.Array) -> jax.Array:
    """Number of steps in a period, () [1]."""
    return jnp.maximum(jnp.round(sampling.period / dt), 1.0)


def instant(sampling: Sampling, dt: jax.Array, index: jax.Array) -> Instant:
    """Position of the instant with this number between samples."""
    steps = _steps(sampling, dt).astype(index.dtype)
    sample = jax.lax.div(index, steps)
    return Instant(sample, index - sample * steps)


class StepCommands(NamedTuple):
    """The commands of a step, (n,) each [N m], and the time of the change between them."""

    first: jax.Array
    """From the start of the step."""
    next: jax.Array
    """From the arrival of the next command."""
    arrival: jax.Array
    """Its arrival, counted from the start of the step, () [steps]; 1 where none arrives."""
    arrives: jax.Array
    """Whether a command arrives in the step or at its end, () bool."""


def step_commands(
    sampling: Sampling, dt: jax.Array, now: Instant, commands: jax.Array
) -> StepCommands:
    """The commands at the actuator in a step, within which they may change once.

    A command that arrives at the end of a step belongs to that step, so that it has a derivative by
    the delay there, too.

    Args:
      sampling: the period and the delay.
      dt: of the step, () [s].
      now: its start.
      commands: newest first, (queue + 1, n) [N m].
    """
    if sampling.queue == 0:
        # Only commands without a delay fit in an empty queue.
        first = _if_consistent(sampling, dt, sampling.delay <= 0, commands[0])
        return StepCommands(first, commands[0], jnp.ones_like(dt), jnp.zeros((), bool))
    age, arrival, arrives = _arrival(sampling, dt, now.phase)
    old = command_at(commands, age)
    new = command_at(commands, age - 1.0)
    first = _if_consistent(sampling, dt, age <= sampling.queue, old)
    return StepCommands(first, new, jnp.where(arrives, arrival, 1.0), arrives)


def _arrival(
    sampling: Sampling, dt: jax.Array, phase: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Commands at a step that begins `phase` steps after a sample.

    Returns:
      The age of the active command at the start of the step, counted from the newest [samples]; the
      arrival of the command after it, from the start of the step [steps]; and whether that lies
      within the step.
    """
    delay = sampling.delay / dt
    rounded = jnp.round(delay)
    tolerance = WHOLE_TOLERANCE + 4.0 * jnp.finfo(dt.dtype).eps * delay
    correction = jnp.where(jnp.abs(delay - rounded) < tolerance, rounded - delay, 0.0)
    delay = delay + jax.lax.stop_gradient(correction)
    steps, phase = _steps(sampling, dt), phase.astype(dt.dtype)
    age = jnp.maximum(jnp.ceil(jax.lax.stop_gradient(delay - phase) / steps), 0.0)
    arrival = delay - phase - (age - 1.0) * steps
    return age, arrival, (age > 0) & (arrival <= 1.0)


def arrival_before(
    sampling: Sampling, dt: jax.Array, now: Instant
) -> tuple[jax.Array, jax.Array] | None:
    """The arrival of a command in the step before an instant, counted from the start of that step,
    () [s], and whether one arrived; None where commands have no delay.
    """
    if sampling.queue == 0:
        return None
    steps = _steps(sampling, dt).astype(now.phase.dtype)
    _, arrival, arrives = _arrival(sampling, dt, jnp.where(now.phase == 0, steps, now.phase) - 1)
    return arrival * dt, arrives


def command_before(
    sampling: Sampling, dt: jax.Array, before: jax.Array, after: jax.Array
) -> jax.Array:
    """The active command just before a sample, (n,) [N m].

    Args:
      sampling: the period and the delay.
      dt: of the step, () [s].
      before: the commands before the sample, newest first, (queue + 1, n) [N m].
      after: those after it.
    """
    if sampling.queue == 0:
        return before[0]
    # A command that arrives with the sample belongs to the step before, so the active command is at
    # least one sample old.
    age, _, _ = _arrival(sampling, dt, jnp.zeros((), jnp.int32))
    return command_at(after, jnp.maximum(age, 1.0))


def _if_consistent(
    sampling: Sampling, dt: jax.Array, fits: jax.Array, command: jax.Array
) -> jax.Array:
    """The command; NaN where it does not fit in the queue until it arrives, or where a period is
    not a whole number of steps.
    """
    steps = sampling.period / dt
    is_whole = jnp.abs(steps - _steps(sampling, dt)) <= PERIOD_TOLERANCE * steps
    return jnp.where(fits & is_whole, command, jnp.nan)


def command_at(commands: jax.Array, position: jax.Array) -> jax.Array:
    """The command at a position in a queue, a whole number of floating-point type; the newest for
    a negative one.

    Args:
      commands: newest first, (queue + 1, ...).
      position: () [1].
    """
    found = commands[0]
    for k in range(1, len(commands)):
        found = jnp.where(position >= k, commands[k], found)
    return found
