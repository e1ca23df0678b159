"""Where a step is divided: at the instants at which the right-hand side of the closed loop jumps.

A Runge-Kutta step across a jump is of first order, whatever the method.  So a step is integrated in
pieces that end where

    a jump time of the scenario lies in it,   t_k < t_j <= t_(k+1)   (`Scenario.jump_times`),
    a command of a sampled law arrives in it  (`sampling.arriving`).

A jump at the end of a step belongs to that step.  A piece of length 0 follows it, through which the
state has a derivative by the jump time there, too.  The lengths of the pieces carry the derivatives
by jump times and delays, so the jump of the right-hand side reaches the derivative of the state.
Jumps at one time are one cut.  They have the derivative of all together, which the first of them
gets.

The stages of a piece see one-sided limits: a piece that ends at a jump is evaluated before it, one
that begins there after it.  A jump time may be the result of rounding, so stages keep away from it
by `APART` units in the last place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.simulation import integrators

MOST_CUTS = 4
"""Different jump times at which one step is divided at most; the accuracy of a step with more is
not known."""
APART = 4.0
"""Units in the last place between a stage and a jump time."""


class Span(NamedTuple):
    """A step in time."""

    start: jax.Array
    """() [s]."""
    end: jax.Array
    """() [s]; the start of the next step to the last bit, so that each jump belongs to one step."""
    length: jax.Array
    """() [s]."""
    counts: Any = True
    """Whether the step is one of the run, () bool; a step after the end is not divided."""


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
    """Time after which none is."""
    arrived: Any
    """Whether the command that arrives within the step has arrived, () bool."""


class Division(NamedTuple):
    """The pieces of a step."""

    pieces: tuple[Piece, ...]
    overfull: Any
    """Whether jumps lie at more times than `MOST_CUTS`, () bool; None where that cannot be."""


@jax.custom_jvp
def _limited(t: jax.Array, least: jax.Array, most: jax.Array) -> jax.Array:
    """The time t within two limits, with the derivative of t itself."""
    return jnp.minimum(jnp.maximum(t, least), most)


@_limited.defjvp
def _(primals, tangents):
    return _limited(*primals), tangents[0]


def stage_time(piece: Piece, t: jax.Array) -> jax.Array:
    """The time at which a stage is evaluated, () [s]: on its piece's side of every jump."""
    return t if piece.earliest is None else _limited(t, piece.earliest, piece.latest)


def divided(
    times: jax.Array, span: Span, arrival: tuple[jax.Array, jax.Array] | None = None
) -> Division:
    """The pieces of a step.

    Args:
      times: the scenario's jump times, (J,) [s].
      span: the step.
      arrival: when a command arrives within the step, counted from its start, () [s], and whether
        one does; None where none can.
    """
    count = times.size
    most = min(count, MOST_CUTS) + (arrival is not None)
    if most == 0:
        return Division((Piece(span.start, span.length, True, None, None, False),), None)
    passed = times <= span.start
    places = _limited(times - span.start, jnp.zeros_like(span.length), span.length)
    pending = ~passed & (times <= span.end) & span.counts
    if arrival is not None:
        places = jnp.concatenate([arrival[0][None], places])
        pending = jnp.concatenate([(arrival[1] & span.counts)[None], pending])
    pieces: list[Piece] = []
    begin, done = span.start, jnp.zeros_like(pending)
    since: Any = None
    made: Any = True
    for number in range(most + 1):
        until, chosen = span.length, None
        if number < most:
            first = _first(places, pending)
            until = jnp.where(jnp.any(first), jnp.sum(jnp.where(first, places, 0.0)), span.length)
            chosen = (
                _with_equal_times(first, places, pending, count, span)
                if count > MOST_CUTS
                else first
            )
        earliest, latest = _limits(times, passed | done[-count:], span) if count else (None, None)
        arrived = _arrived(done, number, count, arrival is not None)
        pieces.append(
            Piece(begin, until if since is None else until - since, made, earliest, latest, arrived)
        )
        if chosen is not None:
            begin, since, made = span.start + until, until, jnp.any(chosen)
            pending, done = pending & ~chosen, done | chosen
    return Division(tuple(pieces), jnp.any(pending) if count > MOST_CUTS else None)


def _first(places: jax.Array, pending: jax.Array) -> jax.Array:
    """Which of the pending events comes first, (E,) bool: one, or none."""
    if places.size == 1:
        return pending
    order = jnp.where(pending, jax.lax.stop_gradient(places), jnp.inf)
    return pending & (
        jnp.arange(places.size, dtype=jnp.int32) == jnp.argmin(order).astype(jnp.int32)
    )


def _with_equal_times(
    first: jax.Array, places: jax.Array, pending: jax.Array, jumps: int, span: Span
) -> jax.Array:
    """The event that comes first with those of the pending jumps at its time, (E,) bool, if it is a
    jump itself.
    """
    apart = APART * jnp.finfo(places.dtype).eps * jnp.abs(span.end)
    place = jax.lax.stop_gradient(jnp.sum(jnp.where(first, places, 0.0)))
    equal = jnp.abs(jax.lax.stop_gradient(places) - place) <= apart
    is_jump = np.arange(places.size) >= places.size - jumps
    together = pending & equal & is_jump & jnp.any(first & is_jump)
    return first | together


def _arrived(done: jax.Array, number: int, jumps: int, can_arrive: bool) -> Any:
    """Whether the command has arrived before a piece of this number begins."""
    if not can_arrive or number == 0:
        return False
    return done[0] if jumps else True


def _limits(times: jax.Array, passed: jax.Array, span: Span) -> tuple[jax.Array, jax.Array]:
    """Between which times the stages of a piece lie, () [s] each: after some jumps, before
    others.
    """
    times = jax.lax.stop_gradient(times)
    apart = APART * jnp.finfo(times.dtype).eps * jnp.abs(times)
    earliest = jnp.max(jnp.where(passed, times + apart, span.start))
    latest = jnp.min(jnp.where(passed, span.end + span.length, times - apart))
    return jax.lax.stop_gradient((earliest, latest))


def before_jumps(times: jax.Array, t: jax.Array) -> jax.Array:
    """A time, or just before it where there is a jump, () [s]."""
    times = jax.lax.stop_gradient(times)
    apart = APART * jnp.finfo(times.dtype).eps * jnp.abs(times)
    least = jnp.min(jnp.where(jnp.abs(times - t) <= apart, times - apart, t))
    return _limited(t, least, least)


def within(times: jax.Array, after: jax.Array, until: jax.Array) -> jax.Array:
    """Whether a jump lies in the interval (after, until], () bool."""
    return jnp.any((times > after) & (times <= until))


def since_last(
    times: jax.Array, before: Span, arrival: tuple[jax.Array, jax.Array] | None = None
) -> jax.Array:
    """How long before the end of a step its last piece begins, () [s]; the step if it is whole.

    Args:
      times: the scenario's jump times, (J,) [s].
      before: the step.
      arrival: as for `divided`.
    """
    zero, found = jnp.zeros_like(before.length), before.length
    if times.size:
        here = (times > before.start) & (times <= before.end)
        ago = _limited(before.end - times, zero, before.length)
        found = jnp.min(jnp.where(here, ago, before.length))
    if arrival is not None:
        found = jnp.minimum(found, jnp.where(arrival[1], before.length - arrival[0], before.length))
    return found


class Passage(NamedTuple):
    """What integrating over a step gives."""

    state: Any
    """At its end."""
    first: Any
    """What was said besides the slope at its start."""
    parts: list[tuple[jax.Array, list]]
    """Length [s] of each piece, and the slopes of its stages; 0 where it is not made."""


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
    nothing = jax.tree.map(jnp.zeros_like, start.slopes)
    for piece in division.pieces[1:]:

        def further(state, piece=piece):
            made = over(piece, state)
            return made.state, made.slopes

        state, slopes = jax.lax.cond(piece.made, further, lambda state: (state, nothing), state)
        parts.append((piece.length, slopes))
    return Passage(state, start.first, parts)
