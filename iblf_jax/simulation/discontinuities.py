"""Division of a time step at the instants at which the right-hand side of the loop jumps.

A Runge-Kutta step across a jump is of first order, whatever the method. A step is therefore
integrated in pieces that end where

    a jump time of the scenario lies in it,   t_k < t_j <= t_(k+1)   (`Scenario.jump_times`),
    a command of a sampled law arrives in it  (`sampling.step_commands`).

A jump at the end of a step belongs to that step and is followed by a piece of length 0. The
lengths of the pieces, this one included, depend on jump times and delays, so the derivative of the
state by these contains the jump of the right-hand side. Jumps at equal times are one cut; the first
of them receives the derivative of all together.

The stages of a piece use one-sided limits: a piece that ends at a jump is evaluated before it, and
a piece that begins there after it. Because a jump time may have a rounding error, stages keep a
distance of `JUMP_SEPARATION` units in the last place from it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.simulation import integrators

MAX_CUTS = 4
"""Largest number of different jump times at which one step is divided. The accuracy of a step with
more of them is unknown."""
JUMP_SEPARATION = 4.0
"""Units in the last place between a stage and a jump time."""


class Span(NamedTuple):
    """Start, end and length of a step."""

    start: jax.Array
    """() [s]."""
    end: jax.Array
    """() [s]; the start of the next step to the last bit, so that each jump belongs to one step."""
    length: jax.Array
    """() [s]."""
    in_run: Any = True
    """Whether the step belongs to the run, () bool; a step after the end is not divided."""


class Piece(NamedTuple):
    """A part of a step in which the right-hand side does not jump."""

    begin: jax.Array
    """Time at which it begins, () [s]."""
    length: jax.Array
    """() [s]."""
    exists: Any
    """Whether the step has this piece, () bool; True for the first."""
    earliest: jax.Array | None
    """Time before which no stage is evaluated, () [s]; None in scenarios without jump times."""
    latest: jax.Array | None
    """Time after which no stage is evaluated, () [s]; None in scenarios without jump times."""
    command_arrived: Any
    """Whether the command that arrives within the step has arrived, () bool."""
    noise_rate: jax.Array | None = None
    """The increment of the Brownian motion over the piece as a rate, (m, n) [1/s^0.5]; None for
    plants without process noise."""


class Division(NamedTuple):
    """The pieces of a step."""

    pieces: tuple[Piece, ...]
    too_many_jumps: jax.Array | None
    """Whether jumps lie at more times than `MAX_CUTS`, () bool; None where this cannot happen."""


class _Cut(NamedTuple):
    """An instant at which a step is divided."""

    offset: jax.Array
    """From the start of the step, () [s]; the length of the step if no event is left."""
    events: jax.Array
    """Which events are there, (E,) bool."""


@jax.custom_jvp
def _clipped(t: jax.Array, lower: jax.Array, upper: jax.Array) -> jax.Array:
    """The time t clipped to two limits, with the derivative of t itself."""
    return jnp.minimum(jnp.maximum(t, lower), upper)


@_clipped.defjvp
def _(primals, tangents):
    return _clipped(*primals), tangents[0]


def stage_time(piece: Piece, t: jax.Array) -> jax.Array:
    """The time at which a stage is evaluated, () [s]: on the side of every jump on which the piece
    lies.
    """
    if piece.earliest is None or piece.latest is None:
        return t
    return _clipped(t, piece.earliest, piece.latest)


def divide_step(
    times: jax.Array, span: Span, arrival: tuple[jax.Array, jax.Array] | None = None
) -> Division:
    """The pieces of a step.

    The events of a step are the arrival of a command and the jumps, at offsets from the start of
    the step. The number of cuts is fixed, and each takes the earliest event that is left.

    Args:
      times: the scenario's jump times, (J,) [s].
      span: the step.
      arrival: when a command arrives within the step, counted from its start, () [s], and whether
        one does; None where none can.
    """
    jumps = times.size
    number = min(jumps, MAX_CUTS) + (arrival is not None)
    if number == 0:
        return Division((Piece(span.start, span.length, True, None, None, False),), None)
    passed = times <= span.start
    offsets = _clipped(times - span.start, jnp.zeros_like(span.length), span.length)
    pending = ~passed & (times <= span.end) & span.in_run
    if arrival is not None:
        offsets = jnp.concatenate([arrival[0][None], offsets])
        pending = jnp.concatenate([(arrival[1] & span.in_run)[None], pending])
    cuts, left_over = _cuts(offsets, pending, number, jumps, span)

    def limits(done: jax.Array) -> tuple[jax.Array | None, jax.Array | None]:
        if not jumps:
            return None, None
        return _limits(times, passed | done[-jumps:], span)

    done = jnp.zeros_like(pending)
    pieces = [Piece(span.start, cuts[0].offset, True, *limits(done), False)]
    ends = [*(cut.offset for cut in cuts[1:]), span.length]
    for cut, end in zip(cuts, ends, strict=True):
        done = done | cut.events
        command_arrived: jax.Array | bool = arrival is not None
        if command_arrived and jumps:
            command_arrived = done[0]
        begin, exists = span.start + cut.offset, jnp.any(cut.events)
        pieces.append(Piece(begin, end - cut.offset, exists, *limits(done), command_arrived))
    too_many_jumps = None
    if jumps > MAX_CUTS:
        too_many_jumps = jnp.any(left_over)
    return Division(tuple(pieces), too_many_jumps)


def _cuts(
    offsets: jax.Array, pending: jax.Array, number: int, jumps: int, span: Span
) -> tuple[list[_Cut], jax.Array]:
    """The cuts of a step in the order of their times, and the pending events that are left."""
    cuts = []
    for _ in range(number):
        first = _first(offsets, pending)
        events = first
        offset = jnp.where(jnp.any(first), jnp.sum(jnp.where(first, offsets, 0.0)), span.length)
        if jumps > MAX_CUTS:
            # If the first event is a jump, the pending jumps at its time are events, too.
            apart = JUMP_SEPARATION * jnp.finfo(offsets.dtype).eps * jnp.abs(span.end)
            at = jax.lax.stop_gradient(jnp.sum(jnp.where(first, offsets, 0.0)))
            equal = jnp.abs(jax.lax.stop_gradient(offsets) - at) <= apart
            is_jump = np.arange(offsets.size) >= offsets.size - jumps
            events = first | (pending & equal & is_jump & jnp.any(first & is_jump))
        cuts.append(_Cut(offset, events))
        pending = pending & ~events
    return cuts, pending


def _first(offsets: jax.Array, pending: jax.Array) -> jax.Array:
    """Mask of the earliest pending event, (E,) bool; all False if none is pending."""
    if offsets.size == 1:
        return pending
    order = jnp.where(pending, jax.lax.stop_gradient(offsets), jnp.inf)
    earliest = jnp.argmin(order).astype(jnp.int32)
    return pending & (jnp.arange(offsets.size, dtype=jnp.int32) == earliest)


def _limits(times: jax.Array, passed: jax.Array, span: Span) -> tuple[jax.Array, jax.Array]:
    """The earliest and the latest time of a stage of a piece, () [s] each: after the passed jumps
    and before the others.
    """
    times = jax.lax.stop_gradient(times)
    apart = JUMP_SEPARATION * jnp.finfo(times.dtype).eps * jnp.abs(times)
    earliest = jnp.max(jnp.where(passed, times + apart, span.start))
    latest = jnp.min(jnp.where(passed, span.end + span.length, times - apart))
    return jax.lax.stop_gradient((earliest, latest))


def before_jumps(times: jax.Array, t: jax.Array) -> jax.Array:
    """The time t, or a time just before it where there is a jump, () [s]."""
    times = jax.lax.stop_gradient(times)
    apart = JUMP_SEPARATION * jnp.finfo(times.dtype).eps * jnp.abs(times)
    least = jnp.min(jnp.where(jnp.abs(times - t) <= apart, times - apart, t))
    return _clipped(t, least, least)


def has_jump(times: jax.Array, after: jax.Array, until: jax.Array) -> jax.Array:
    """Whether a jump lies in the interval (after, until], () bool."""
    return jnp.any((times > after) & (times <= until))


def last_piece_length(
    times: jax.Array, before: Span, arrival: tuple[jax.Array, jax.Array] | None = None
) -> jax.Array:
    """Length of the last piece of a step, () [s]; the length of the step if it is not divided.

    Args:
      times: the scenario's jump times, (J,) [s].
      before: the step.
      arrival: as for `divide_step`.
    """
    zero, found = jnp.zeros_like(before.length), before.length
    if times.size:
        here = (times > before.start) & (times <= before.end)
        elapsed = _clipped(before.end - times, zero, before.length)
        found = jnp.min(jnp.where(here, elapsed, before.length))
    if arrival is not None:
        found = jnp.minimum(found, jnp.where(arrival[1], before.length - arrival[0], before.length))
    return found


class DividedStepResult(NamedTuple):
    """Result of integrating over the pieces of a step."""

    state: Any
    """State at the end of the step."""
    aux: Any
    """What the function returned besides the rate at the start of the step."""
    piece_slopes: list[tuple[jax.Array, list]]
    """Length [s] of each piece, and the slopes of its stages; 0 for a piece that the step lacks."""


def integrate_pieces(
    method: str, evaluate: Callable, division: Division, state: Any, *, rolled: bool = False
) -> DividedStepResult:
    """One step of the integrator over every piece of a step.

    Args:
      method: a name in `integrators.TABLEAUS`.
      evaluate: function (t, state) -> (rate of the state, anything else), as for
        `integrators.step`.
      division: the pieces of the step.
      state: state at the start of the step.
      rolled: as for `integrators.step`.
    """

    def over(piece: Piece, state: Any) -> integrators.StepResult:
        return integrators.step(
            method,
            lambda t, x: evaluate(stage_time(piece, t), x),
            piece.begin,
            state,
            piece.length,
            rolled=rolled,
        )

    start = over(division.pieces[0], state)
    state, piece_slopes = start.state, [(division.pieces[0].length, start.slopes)]
    no_slopes = jax.tree.map(jnp.zeros_like, start.slopes)

    def skip(state):
        return state, no_slopes

    for piece in division.pieces[1:]:

        def integrate(state, piece=piece):
            result = over(piece, state)
            return result.state, result.slopes

        state, slopes = jax.lax.cond(piece.exists, integrate, skip, state)
        piece_slopes.append((piece.length, slopes))
    return DividedStepResult(state, start.aux, piece_slopes)
