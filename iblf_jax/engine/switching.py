"""Derivatives of a closed loop whose command jumps at surfaces in the state.

A law may declare functions g_i(t, q, q') at whose zeros its command jumps
(`switching` of `controllers.RobotLaw`).  The closed loop is then a hybrid system.  Where its
state crosses g_i = 0 at a time t*, with the rate f- before and f+ after the jump, a perturbation of
the state jumps as well, and an integral of a signal L that jumps with the command gains a term:

    dx+ = dx- + (f- - f+) dt*,                                                        (J.1)
    dt* = -(grad g_i . dx- + partial derivatives of g_i by parameters) / g_i'-,
    d(integral of L) = (integral of dL) + (L- - L+) dt*.

The derivative of a fixed step across the jump has no such terms.  A step that reaches a surface
therefore keeps its value, and its derivative is that of the same step in pieces: from its start to
the first crossing, from there to the next one, and to its end.  Each piece is a step of the
midpoint rule with the rate on its own side of every surface, and it ends where the next g_i
vanishes,

    h = -g/g',   x* = x + h f(t + h/2, x + h f/2),                                    (J.2)
    then one step of Newton's method on g(x*) = 0.

Where the rates of both sides point towards a surface, the state slides along it.  From the crossing
on, the rate is then the combination of both that keeps g_i' = 0 (Filippov),

    f = f+ + a (f- - f+),   a = g_i'+ / (g_i'+ - g_i'-).                              (J.3)

The derivative is of second order in the time step at crossings and of first order where the state
slides, in forward and in reverse mode. None exists where a state only touches a surface without
crossing it.

Sources: (J.1) M. A. Aizerman, F. R. Gantmacher, Quart. J. Mech. Appl. Math. 11 (1958) 225-241;
(J.3) A. F. Filippov, Differential Equations with Discontinuous Righthand Sides, 1988.  The scheme
(J.2) is a design of this package.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation.closed_loop import LoopState
from iblf_jax.simulation.integrators import StepResult, stage_states, tableau
from iblf_jax.simulation.scenario import Scenario

T = TypeVar("T")

SURFACE_CLEARANCE = 1e-4
"""Smallest distance from a surface at which a rate is evaluated, relative to the distance by which
the step moves the state across it."""
MAX_PREDICTION = 2.0
"""Steps.  A crossing that is predicted further away does not belong to the step."""


class SwitchedLoop(NamedTuple):
    """A closed loop along a step."""

    scenario: Scenario
    """Its law is not sampled."""
    evaluate: Callable
    """Function (t, state) -> (rate of the state, sample)."""
    gains_of: Callable
    """Function of a sample: what the accumulators of the run gain from it per second, a list of
    arrays."""


class Signs(NamedTuple):
    """The sides of m surfaces on which a step lies; (m,) each."""

    start: jax.Array
    """The switching functions at the start of the step."""
    end: jax.Array
    """And at its end."""
    touched: jax.Array
    """Whether a stage of the integrator lies on the other side than the start, bool."""

    @property
    def above(self) -> jax.Array:
        """Whether g > 0 at the start, (m,) bool."""
        return self.start > 0

    @property
    def changed(self) -> jax.Array:
        """Whether the end lies on the other side, (m,) bool."""
        return self.above != (self.end > 0)

    @property
    def size(self) -> jax.Array:
        """The distance by which the step moves the state across each surface, (m,)."""
        return jnp.abs(self.start) + jnp.abs(self.end)


class Crossings(NamedTuple):
    """The surfaces that a step reaches; (m,) each."""

    above: jax.Array
    """Whether g > 0 at the start of the step, bool."""
    crossed: jax.Array
    """Whether the step reaches the surface, bool."""
    rank: jax.Array
    """How many other surfaces the step reaches before this one, int."""
    clearance: jax.Array
    """Smallest |g| at which rates are evaluated."""

    def after(self, number: jax.Array) -> jax.Array:
        """Whether g > 0 after so many crossings, (m,) bool."""
        return self.above ^ (self.crossed & (self.rank < number))

    def numbered(self, number: jax.Array) -> jax.Array:
        """Which surface is reached after so many others, (m,) bool; none where there are not so
        many.
        """
        return self.crossed & (self.rank == number)


class Progress(NamedTuple):
    """The state after some pieces of a step, and the sums along them."""

    state: LoopState
    since: jax.Array
    """Time since the start of the step, () [s]."""
    rate: LoopState
    """Of the state at the end of the last piece, on that piece's side of the surface."""
    sliding: LoopState
    """The term that is added to the rate, so that the state stays on the surfaces along which it
    slides."""
    gains: list[jax.Array]
    """Rates of the accumulators in the last piece, on that piece's side of the surface."""
    sliding_gains: list[jax.Array]
    """The term that sliding adds to these rates."""
    gained: list[jax.Array]
    """Increments of the accumulators in the pieces, by the midpoint rule."""
    usable: jax.Array
    """Whether every crossing was found within about a step, () bool."""


@partial(jax.jit, inline=True)  # so that it is traced once for all that is made of it
def surfaces(scenario: Scenario, t: jax.Array, state: LoopState) -> jax.Array | None:
    """The switching functions of the scenario's law at a state, (m,), or None if its command does
    not jump.
    """
    loop = scenario.loop
    x = state.x[: loop.model.order]
    # Switching functions of laws of robots do not depend on the estimate.
    d_hat = jnp.zeros(loop.model.estimate_shape, x.dtype)
    if unwrapped(scenario.controller).receives_x:
        d_hat = loop.observer.estimate(t, x, loop.model, state.observer)
    return loop.law.switching(t, x, d_hat, scenario.context, state.controller)


def with_hybrid_derivative(
    loop: SwitchedLoop,
    method: str,
    t: jax.Array,
    before: LoopState,
    dt: jax.Array,
    stepped: StepResult,
    sums: list[jax.Array],
) -> tuple[LoopState, list[jax.Array]]:
    """The state after a step and the accumulators, unchanged in value, with the derivatives of the
    hybrid flow.

    Args:
      loop: the closed loop, and how metrics weigh its samples.
      method: the integrator.
      t: start of the step, () [s].
      before: state at its start.
      dt: its length, () [s].
      stepped: the result of the integrator.
      sums: the accumulators of the run, those that are floating-point numbers.
    """
    start = surfaces(loop.scenario, t, before)
    if start is None or start.size == 0:
        return stepped.state, sums
    end: Any = surfaces(loop.scenario, t + dt, stepped.state)
    # A surface is touched where a stage of the integrator lies on its other side.
    above = start > 0
    touched = jnp.zeros_like(above)
    stages = stage_states(method, before, dt, stepped.slopes)
    for c, state in zip(tableau(method).c[1:], stages, strict=True):
        side: Any = surfaces(loop.scenario, t + c * dt, state)
        touched |= (side > 0) != above
    signs = jax.lax.stop_gradient(Signs(start, end, touched))

    def in_pieces(after):
        return _in_pieces(loop, t, before, dt, after, stepped.slopes[0], gains, signs)

    after = stepped.state, sums
    gains = loop.gains_of(stepped.aux)
    reached = jnp.any(signs.changed | signs.touched)
    return _with_derivative_of(after, jax.lax.cond(reached, in_pieces, lambda same: same, after))


@jax.custom_jvp
def _with_derivative_of(value: T, other: T) -> T:
    """`value`, whose derivative is that of `other`."""
    return value


@_with_derivative_of.defjvp
def _(primals, tangents):
    return _with_derivative_of(*primals), tangents[1]


def _in_pieces(
    loop: SwitchedLoop,
    t: jax.Array,
    before: LoopState,
    dt: jax.Array,
    after: tuple[LoopState, list[jax.Array]],
    slope: LoopState,
    gains: list[jax.Array],
    signs: Signs,
) -> tuple[LoopState, list[jax.Array]]:
    """The end of the step by (J.2), piece by piece; `after` where it reaches no surface or a
    crossing was not found.

    The accumulators get what they gain in the pieces in place of what the trapezoidal rule gives
    for the whole step, `gains` per second at its start.
    """
    crossings = _crossings(signs, signs.changed | _slides(loop, t, before, slope, signs))
    none = jax.tree.map(jnp.zeros_like, before)
    nothing = [jnp.zeros_like(x) for x in after[1]]
    start = Progress(
        before,
        jnp.zeros_like(dt),
        none,
        none,
        nothing,
        nothing,
        nothing,
        jnp.any(crossings.crossed),
    )

    def piece(progress, number):
        return _piece(loop, t, dt, crossings, number, progress), None

    numbers = jnp.arange(signs.start.size + 1, dtype=crossings.rank.dtype)
    done, _ = jax.lax.scan(piece, start, numbers)
    end = loop.evaluate(t + dt, _with_derivative_of(after[0], done.state))[1]
    full_step = [
        0.5 * dt * (first + last) for first, last in zip(gains, loop.gains_of(end), strict=True)
    ]
    found = (
        done.state,
        [x + more - less for x, more, less in zip(after[1], done.gained, full_step, strict=True)],
    )
    return jax.tree.map(lambda new, old: jnp.where(done.usable, new, old), found, after)


def _slides(
    loop: SwitchedLoop, t: jax.Array, state: LoopState, slope: LoopState, signs: Signs
) -> jax.Array:
    """Along which surfaces that a stage has touched the state slides, (m,) bool: both rates point
    towards them.

    An integrator holds a sliding state near its surface by stages on either side, and may never end
    a step on the other one.
    """
    above = signs.above ^ signs.touched
    other = loop.evaluate(
        t, _on_its_side(loop.scenario, t, state, above, SURFACE_CLEARANCE * signs.size)
    )[0]
    here, beyond = (_along(loop.scenario, t, state, rate)[1] for rate in (slope, other))
    towards_from_above = (here < 0) & (beyond > 0)
    towards_from_below = (here > 0) & (beyond < 0)
    return signs.touched & jnp.where(signs.above, towards_from_above, towards_from_below)


def _crossings(signs: Signs, crossed: jax.Array) -> Crossings:
    """The order in which a step reaches surfaces."""
    fraction = jnp.abs(signs.start) / jnp.where(signs.size > 0, signs.size, 1.0)
    number = jnp.arange(fraction.size)
    sooner = fraction[None, :] < fraction[:, None]
    sooner |= (fraction[None, :] == fraction[:, None]) & (number[None, :] < number[:, None])
    rank = jnp.sum(jnp.where(sooner & crossed[None, :], 1, 0), axis=1)
    return Crossings(signs.above, crossed, rank, SURFACE_CLEARANCE * signs.size)


def _piece(
    loop: SwitchedLoop,
    t: jax.Array,
    dt: jax.Array,
    crossings: Crossings,
    number: jax.Array,
    before: Progress,
) -> Progress:
    """One piece of a step: to the crossing with this number, or to the end of the step."""
    scenario, state, since = loop.scenario, before.state, before.since
    above, target = crossings.after(number), crossings.numbered(number)

    def evaluated(since, state):
        cleared = _on_its_side(scenario, t + since, state, above, crossings.clearance)
        return loop.evaluate(t + since, cleared)

    def along(which, since, state, rate):
        g, dg = _along(scenario, t + since, state, rate)
        return jnp.sum(jnp.where(which, g, 0.0)), jnp.sum(jnp.where(which, dg, 0.0))

    first = _sum(evaluated(since, state)[0], before.sliding)
    came_from = crossings.numbered(number - 1)
    arriving = along(came_from, since, state, before.rate)[1]
    leaving = along(came_from, since, state, first)[1]
    weight = _filippov_weight(arriving, leaving)
    added = _mixed(weight, before.rate, first)
    first, sliding = _sum(first, added), _sum(before.sliding, added)

    aims = jnp.any(target)
    g, dg = along(target, since, state, first)
    until, early = _time_to(g, dg, dt)
    length = jnp.where(aims, until, dt - since)
    middle, sample = evaluated(since + 0.5 * length, _later(state, 0.5 * length, first))
    middle = _sum(middle, sliding)
    reached = _later(state, length, middle)
    last = jax.tree.map(lambda half, full: 2.0 * half - full, middle, first)
    g, dg = along(target, since + length, reached, last)
    correction, late = _time_to(g, dg, dt)

    length = length + correction
    gains = _sum(loop.gains_of(sample), before.sliding_gains)
    more = _mixed(weight, before.gains, gains)
    gains, sliding_gains = _sum(gains, more), _sum(before.sliding_gains, more)
    gained = [x + gain * length for x, gain in zip(before.gained, gains, strict=True)]
    usable = before.usable & ((early & late) | ~aims)
    return Progress(
        _later(reached, correction, last),
        since + length,
        last,
        sliding,
        gains,
        sliding_gains,
        gained,
        usable,
    )


def _filippov_weight(arriving: jax.Array, leaving: jax.Array) -> jax.Array:
    """The weight a of (J.3), () [1]; 0 where the state crosses the surface.

    Args:
      arriving, leaving: rates of the switching function before and beyond the surface, ().
    """
    slides = arriving * leaving < 0
    return jnp.where(slides, leaving, 0.0) / jnp.where(slides, leaving - arriving, 1.0)


def _mixed(weight: jax.Array, old: T, new: T) -> T:
    """The term a (f- - f+) of (J.3), for a rate of the state or of the accumulators."""
    return jax.tree.map(lambda a, b: weight * (a - b), old, new)


def _along(
    scenario: Scenario, t: jax.Array, state: LoopState, rate: LoopState
) -> tuple[jax.Array, jax.Array]:
    """The switching functions, and their rates along a rate of the state, (m,) each."""

    def at(h):
        return surfaces(scenario, t + h, _later(state, h, rate))

    return jax.jvp(at, (jnp.zeros_like(t),), (jnp.ones_like(t),))


def _time_to(g: jax.Array, dg: jax.Array, dt: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Time until g vanishes at the rate dg, () [s], 0 where it is far longer than the step; and
    whether it is not, () bool.
    """
    usable = (dg != 0) & (jnp.abs(g) <= MAX_PREDICTION * dt * jnp.abs(dg))
    return -jnp.where(usable, g, 0.0) / jnp.where(usable, dg, 1.0), usable


def _later(state: LoopState, time: jax.Array, rate: LoopState) -> LoopState:
    """The state a time later at a constant rate."""
    return jax.tree.map(lambda x, dx: x + time * dx, state, rate)


def _sum(one: T, other: T) -> T:
    return jax.tree.map(jnp.add, one, other)


def _on_its_side(
    scenario: Scenario, t: jax.Array, state: LoopState, above: jax.Array, clearance: jax.Array
) -> LoopState:
    """The state, moved to the given side of every surface, at least as far as the clearance."""
    fixed: Any = jax.lax.stop_gradient((scenario, t, state))

    def functions(x):
        return surfaces(fixed[0], fixed[1], fixed[2]._replace(x=x))

    g, pull = jax.vjp(functions, fixed[2].x)
    missing = jnp.where(above, jnp.maximum(clearance - g, 0.0), jnp.minimum(-clearance - g, 0.0))
    x = state.x
    for i, unit in enumerate(jnp.eye(g.size, dtype=g.dtype)):
        [slope] = pull(unit)
        square = jnp.sum(slope**2)
        step = jnp.where(square > 0, missing[i], 0.0) / jnp.where(square > 0, square, 1.0)
        x = x + step * slope
    return state._replace(x=x)
