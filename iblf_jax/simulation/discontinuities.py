"""Division of a time step at the instants at which the right-hand side of the loop jumps.

A Runge-Kutta step across a jump is of first order, whatever the method. A step is therefore
integrated in pieces that end where

    a jump time of the scenario lies in it,   t_k < t_j <= t_(k+1)   (`Scenario.jump_times`),
    a command of a sampled law arrives in it  (`sampling.arriving`).

A jump at the end of a step belongs to that step. A piece of length 0 follows it, through which the
state has a derivative by the jump time there, too. The lengths of the pieces carry the derivatives
by jump times and delays, so the jump of the right-hand side enters the derivative of the state.
Jumps at equal times are one cut; the first of them receives the derivative of all together.

The stages of a piece see one-sided limits: a piece that ends at a jump is evaluated before it, and
one that begins there after it. A jump time may carry a rounding error, so stages keep a distance of
`JUMP_SEPARATION` units in the last place from it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.simulation import integrators

MAX_CUTS = 4
"""Largest number of different jump times at which one step is divided; the accuracy of a step with
more is unknown."""
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
    counts: Any = True
    """Whether the step belongs to the run, () bool; a step after the end is not divided."""


class Piece(NamedTuple):
    """A part of a step in which the right-hand side does not jump."""

    begin: jax.Array
    """Time at which it begins, () [s]."""
    length: jax.Array
    """() [s]."""
    made: Any
    """Whether there is such a piece, () bool; True for the first."""
    earliest: Any
    """Time before which no stage is evaluated, () [s]; None in scenarios without jump times."""
    latest: Any
    """Time after which no stage is evaluated, () [s]; None likewise."""
    arrived: Any
    """Whether the command that arrives within the step has arrived, () bool."""


class Division(NamedTuple):
    """The pieces of a step."""

    pieces: tuple[Piece, ...]
    overfull: Any
    """Whether jumps lie at more times than `MAX_CUTS`, () bool; None where that cannot be."""


@jax.custom_jvp
def _limited(t: jax.Array, least: jax.Array, most: jax.Array) -> jax.Array:
    """The time t clipped to two limits, with the derivative of t itself."""
    return jnp.minimum(jnp.maximum(t, least), most)


@_limited.defjvp
def _(primals, tangents):
    return _limited(*primals), tangents[0]


def stage_time(piece: Piece, t: jax.Array) -> jax.Array:
    """The time at which a stage is evaluated, () [s]: on the piece's own side of every jump."""
    if piece.earliest is None:
        return t
    return _limited(t, piece.earliest, piece.latest)


def divided(
    times: jax.Array, span: Span, arrival: tuple[jax.Array, jax.Array] | None = None
) -> Division:
    """The pieces of a step.

    The events of a step are the arrival of a command and the jumps, at offsets from the start of
    the step. Each of a fixed number of cuts takes the earliest event that no cut has taken yet.

    Args:
      times: the scenario's jump times, (J,) [s].
      span: the step.
      arrival: when a command arrives within the step, counted from its start, () [s], and whether
        one does; None where none can.
    """
    count = times.size
    cuts = min(count, MAX_CUTS) + (arrival is not None)
    if cuts == 0:
        return Division((Piece(span.start, span.length, True, None, None, False),), None)
    passed = times <= span.start
    offsets = _limited(times - span.start, jnp.zeros_like(span.length), span.length)
    pending = ~passed & (times <= span.end) & span.counts
    if arrival is not None:
        offsets = jnp.concatenate([arrival[0][None], offsets])
        pending = jnp.concatenate([(arrival[1] & span.counts)[None], pending])
    pieces: list[Piece] = []
    begin, done = span.start, jnp.zeros_like(pending)
    since: Any = None  # offset at which the piece begins; None for the first
    made: Any = True
    for number in range(cuts + 1):
        until, chosen = span.length, None
        if number < cuts:
            chosen = first = _first(offsets, pending)
            until = jnp.where(jnp.any(first), jnp.sum(jnp.where(first, offsets, 0.0)), span.length)
            if count > MAX_CUTS:
                chosen = _with_equal_times(first, offsets, pending, count, span)
        earliest, latest = None, None
        if count:
            earliest, latest = _limits(times, passed | done[-count:], span)
        arrived = _arrived(done, number, count, arrival is not None)
        length = until
        if since is not None:
            length = until - since
        pieces.append(Piece(begin, length, made, earliest, latest, arrived))
        if chosen is not None:
            begin, since, made = span.start + until, until, jnp.any(chosen)
            pending, done = pending & ~chosen, done | chosen
    overfull = jnp.any(pending) if count > MAX_CUTS else None
    return Division(tuple(pieces), overfull)


def _first(offsets: jax.Array, pending: jax.Array) -> jax.Array:
    """Which of the pending events comes first, (E,) bool: one, or none."""
    if offsets.size == 1:
        return pending
    order = jnp.where(pending, jax.lax.stop_gradient(offsets), jnp.inf)
    earliest = jnp.argmin(order).astype(jnp.int32)
    return pending & (jnp.arange(offsets.size, dtype=jnp.int32) == earliest)


def _with_equal_times(
    first: jax.Array, offsets: jax.Array, pending: jax.Array, jumps: int, span: Span
) -> jax.Array:
    """The first event and, if it is a jump, the pending jumps at its time, (E,) bool."""
    apart = JUMP_SEPARATION * jnp.finfo(offsets.dtype).eps * jnp.abs(span.end)
    offset = jax.lax.stop_gradient(jnp.sum(jnp.where(first, offsets, 0.0)))
    equal = jnp.abs(jax.lax.stop_gradient(offsets) - offset) <= apart
    is_jump = np.arange(offsets.size) >= offsets.size - jumps
    together = pending & equal & is_jump & jnp.any(first & is_jump)
    return first | together


def _arrived(done: jax.Array, number: int, jumps: int, can_arrive: bool) -> Any:
    """Whether the command has arrived before the piece of this number begins."""
    if not can_arrive or number == 0:
        return False
    return done[0] if jumps else True


def _limits(times: jax.Array, passed: jax.Array, span: Span) -> tuple[jax.Array, jax.Array]:
    """Between which times the stages of a piece lie, () [s] each: after the passed jumps, before
    the others.
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
    return _limited(t, least, least)


def within(times: jax.Array, after: jax.Array, until: jax.Array) -> jax.Array:
    """Whether a jump lies in the interval (after, until], () bool."""
    return jnp.any((times > after) & (times <= until))


def since_last(
    times: jax.Array, before: Span, arrival: tuple[jax.Array, jax.Array] | None = None
) -> jax.Array:
    """Length of the last piece of a step, () [s]; that of the step if it is not divided.

    Args:
      times: the scenario's jump times, (J,) [s].
      before: the step.
      arrival: as for `divided`.
    """
    zero, found = jnp.zeros_like(before.length), before.length
    if times.size:
        here = (times > before.start) & (times <= before.end)
        elapsed = _limited(before.end - times, zero, before.length)
        found = jnp.min(jnp.where(here, elapsed, before.length))
    if arrival is not None:
        found = jnp.minimum(found, jnp.where(arrival[1], before.length - arrival[0], before.length))
    return found


class Passage(NamedTuple):
    """Result of integrating over the pieces of a step."""

    state: Any
    """At the end of the step."""
    first: Any
    """What the function returned besides the rate at the start of the step."""
    parts: list[tuple[jax.Array, list]]
    """Length [s] of each piece, and the slopes of its stages; 0 where there is no such piece."""


def integrated(
    method: str, evaluate: Callable, division: Division, state: Any, *, rolled: bool = False
) -> Passage:
    """One step of the integrator over every piece of a step.

    Args:
      method: a name in `integrators.TABLEAUS`.
      evaluate: function (t, state) -> (rate of the state, anything else), as for
        `integrators.step`.
      division: of the step.
      state: at its start.
      rolled: as for `integrators.step`.
    """

    def over(piece: Piece, state: Any) -> integrators.Stepped:
        return integrators.step(
            method,
            lambda t, x: evaluate(stage_time(piece, t), x),
            piece.begin,
            state,
            piece.length,
            rolled=rolled,
        )

    start = over(division.pieces[0], state)
    state, parts = start.state, [(division.pieces[0].length, start.slopes)]
    no_slopes = jax.tree.map(jnp.zeros_like, start.slopes)

    def skip(state):
        return state, no_slopes

    for piece in division.pieces[1:]:

        def integrate(state, piece=piece):
            result = over(piece, state)
            return result.state, result.slopes

        state, slopes = jax.lax.cond(piece.made, integrate, skip, state)
        parts.append((piece.length, slopes))
    return Passage(state, start.first, parts)
