"""How fast the closed loop's fastest mode is.

The gain K2 acts through M0^-1, so the fastest mode is about K2 / lambda_min(M0): near 1000 1/s for
the paper's gains.  An explicit step is stable only while dt times that mode stays inside the
method's stability region; beyond it the numbers grow without any physics behind them.  So every run
measures its fastest mode, at its start, where it was nearest to its bound (there the barrier is
stiffest) and at its end, and says when the step was too large.

Derivatives of the loop are central differences of its rate: the rate is compiled as it is, its
  derivative would take thrice as long.

A law such as |e2|^a sign(e2) with a < 1 has an infinite derivative where e2 = 0, and one instant
there says nothing about the time step: the oscillation that a step excites ends where the
  difference quotient over its amplitude is small enough.  A smooth loop has the same
derivative by differences of any small size.  So every derivative is measured by differences of
three sizes, h0, 10 h0 and WIDEST (less near a bound, where the barrier is stiff indeed); where one
of the larger ones gives much less than h0, the one of WIDEST counts (`resolved`).

Where the law is sampled, what counts is the map from one period to the next.  Its derivative
follows from those of plant and law: the plant's state goes with exp(A t), A its rate's derivative,
  while the torque is held.  The loop is stable only while the spectral radius of
that map, of all that is remembered, is below 1.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax.core.linalg import matmul_in_order
from iblf_jax.simulation.closed_loop import LoopState, change, moving, surroundings
from iblf_jax.simulation.scenario import Scenario

POWER_ITERATIONS, AVERAGED = 48, 16
"""Steps of the power iteration, and how many of the last are averaged over: a power of two, and a
third of the steps."""
TAYLOR, HALVINGS = 8, 8
"""Terms of a flow, and how often its time is halved before: exact to rounding for |A| t up to
30."""
SQUARINGS = 20
"""Of a map, for its spectral radius."""
RADIUS = "sampling_radius"
"""Name of what a sampled run says of this, beside its metrics."""
WIDER, WIDEST = 10.0, 1e-2
"""The second size of a difference, relative to the first, and the third [rad/s or the state's
unit]: an oscillation of 0.01 rad/s with the period of a few steps moves the positions by some 1e-5
rad."""
WIDEST_MOVE = 1e-3
"""rad.  The third size of a difference in a position."""
ROOM = 0.25
"""Largest size of a difference, relative to the distance from a bound."""
STEEP = 0.8
"""Ratio of the derivatives by differences of the second and the first size below which the
derivative is taken to be infinite."""
SLOWEST = 1.0
"""1/s.  A loop slower than this still follows a reference."""


class Growth(NamedTuple):
    """State of the power iteration: a direction of length one, and the sum of the last logarithms
    of its growth.
    """

    direction: jax.Array
    total: jax.Array


def growth_start(x: jax.Array) -> Growth:
    """A direction that no mode is orthogonal to, for a state (m,)."""
    start = jnp.cos(jnp.arange(1, x.size + 1, dtype=x.dtype))
    return Growth(start / jnp.sqrt(jnp.sum(start**2)), jnp.zeros((), x.dtype))


def grown(growth: Growth, w: jax.Array, iteration: jax.Array) -> Growth:
    """The growth after one of POWER_ITERATIONS, in which the Jacobian has made w of the
    direction.
    """
    size = jnp.maximum(jnp.sqrt(jnp.sum(w * w)), jnp.finfo(w.dtype).tiny)
    counted = iteration >= POWER_ITERATIONS - AVERAGED
    return Growth(w / size, growth.total + jnp.where(counted, jnp.log(size), jnp.zeros_like(size)))


def growth_rate(growth: Growth) -> jax.Array:
    """The mode that was found, () [1/s].  It is averaged over iterations, so that a pair of complex
    modes is measured too.
    """
    return jnp.exp(growth.total / AVERAGED)


def growth_rate_by(jacobian: jax.Array) -> jax.Array:
    """The mode that the power iteration of a Jacobian finds, () [1/s]: of all its steps at once, as
    J^16 and J^32 are found by squaring.
    """
    tiny = jnp.finfo(jacobian.dtype).tiny

    def squared(_, powers):
        _, last, logarithm = powers
        size = jnp.maximum(jnp.max(jnp.abs(last)), tiny)
        last = last / size
        return last, matmul_in_order(last, last), 2.0 * (logarithm + jnp.log(size))

    # J^AVERAGED and its square in the end, up to a factor, and the logarithm of the square's.
    powers = (jacobian, jacobian, jnp.zeros((), jacobian.dtype))
    last, first, logarithm = jax.lax.fori_loop(0, AVERAGED.bit_length(), squared, powers)
    before = matmul_in_order(first, growth_start(jacobian[0]).direction[:, None])
    after = matmul_in_order(last, before)
    lengths = [
        jnp.log(jnp.maximum(jnp.sqrt(matmul_in_order(w.T, w)[0, 0]), tiny)) for w in (before, after)
    ]
    return jnp.exp((logarithm / 2.0 + lengths[1] - lengths[0]) / AVERAGED)


def difference_sizes(x: jax.Array, direction: jax.Array, room: jax.Array) -> jax.Array:
    """The three sizes of central differences at x along a direction, (3,); `room` is the largest
    that makes sense, ().
    """
    first = jnp.finfo(x.dtype).eps ** (1 / 3) * jnp.maximum(1.0, jnp.sum(jnp.abs(x * direction)))
    third = jnp.maximum(first, room)
    return jnp.stack([first, jnp.minimum(WIDER * first, third), third])


def along(rate_at: Callable, x: jax.Array, direction: jax.Array, size: jax.Array) -> jax.Array:
    """The derivative of `rate_at`, (m,) -> (m,), at x along a direction by a central difference,
    one evaluation at a time.
    """
    rates = jax.lax.map(rate_at, jnp.stack([x + size * direction, x - size * direction]))
    return (rates[0] - rates[1]) / (2.0 * size)


def room_around(scenario: Scenario, t: jax.Array, plant: LoopState, size: int) -> jax.Array:
    """The largest sizes of differences of what `closed_loop.surroundings` gives, (size,): small
    near bounds, WIDEST elsewhere.
    """
    tube = scenario.context.tube(t, acceleration=False)
    side = jnp.minimum(plant.q - tube.lower, tube.upper - plant.q)
    near = [jnp.clip(ROOM * side, 0.0, WIDEST_MOVE)]
    if scenario.velocity_bounds is not None:
        slow, fast = scenario.context.speed_limits(t)
        side = jnp.minimum(plant.dq - slow, fast - plant.dq)
        near.append(jnp.clip(ROOM * side, 0.0, WIDEST))
    rest = jnp.full((size - sum(x.size for x in near),), WIDEST, plant.q.dtype)
    return jnp.concatenate([*near, rest])


def is_steep(jacobians: jax.Array, sampled: bool) -> jax.Array:
    """Which columns of a Jacobian are infinite derivatives or nearly so, (..., m) bool.

    Args:
      jacobians: by differences of three sizes, (..., 3, m, m).  Close to an infinite derivative the
        two small ones agree, and the large one is smaller.
      sampled: whether they are of a sampled loop.  There the large one tells nothing: a position
        that moves so far between two samples is a velocity at which the torque saturates.
    """
    lengths = jnp.sum(jnp.abs(jacobians), axis=-2)
    larger = lengths[..., 1, :]
    if not sampled:
        larger = jnp.minimum(larger, lengths[..., 2, :])
    return larger < STEEP * lengths[..., 0, :]


def resolved(jacobians: jax.Array, sampled: bool) -> jax.Array:
    """The Jacobian that counts, (..., m, m), from those by differences of three sizes, (..., 3, m,
    m), as for `is_steep`.
    """
    steep = is_steep(jacobians, sampled)[..., None, :]
    return jnp.where(steep, jacobians[..., 2, :, :], jacobians[..., 0, :, :])


@jax.jit
def jacobian(scenario: Scenario, t: jax.Array, state: LoopState) -> jax.Array:
    """The derivative of `closed_loop.change` at (t, state), (m, m): the closed loop's Jacobian
    [1/s] where the law is not sampled.
    """
    x, whole = ravel_pytree(surroundings(state))
    room = room_around(scenario, t, state, x.size)

    def rate_at(y):
        return ravel_pytree(change(scenario, t, whole(y)))[0]

    def column(each):
        unit, size = each
        return along(rate_at, x, unit, size)

    units = jnp.eye(x.size, dtype=x.dtype)
    sizes = jax.vmap(lambda unit, room: difference_sizes(x, unit, room))(units, room)
    found = jax.lax.map(column, (jnp.repeat(units, 3, axis=0), sizes.ravel()))
    return resolved(
        jnp.transpose(found.reshape(x.size, 3, x.size), (1, 2, 0)), scenario.sampling is not None
    )


def flow(A: jax.Array, B: jax.Array, t: jax.Array) -> jax.Array:
    """Where x' = A x + B u goes in a time t: its state by the one before and by u, which is held;
    (m, m + n) for A (m, m) and B (m, n).
    """
    m, scale = len(A), t / 2.0**HALVINGS
    held = jnp.concatenate([jnp.zeros_like(A), B], axis=1) * scale
    unit, small = jnp.eye(m, m + B.shape[1], dtype=A.dtype), A * scale

    def next_term(k, found):
        return unit + (matmul_in_order(small, found) + held) / (TAYLOR - k).astype(A.dtype)

    def twice(_, found):
        return matmul_in_order(found[:, :m], found) + jnp.concatenate(
            [jnp.zeros_like(A), found[:, m:]], axis=1
        )

    return jax.lax.fori_loop(0, HALVINGS, twice, jax.lax.fori_loop(0, TAYLOR, next_term, unit))


def spectral_radius(A: jax.Array) -> jax.Array:
    """The largest size of an eigenvalue, () [1]: |A^m|^(1/m) for m = 2^SQUARINGS."""
    tiny = jnp.finfo(A.dtype).tiny

    def squared(k, found):
        power, logarithm = found
        size = jnp.maximum(jnp.max(jnp.abs(power)), tiny)
        power = power / size
        return matmul_in_order(power, power), logarithm + jnp.log(size) / 2.0 ** k.astype(A.dtype)

    _, logarithm = jax.lax.fori_loop(0, SQUARINGS, squared, (A, jnp.zeros((), A.dtype)))
    return jnp.exp(logarithm)


def period_map(scenario: Scenario, state: LoopState, derivative: jax.Array) -> jax.Array:
    """The derivative of a sampled loop's state a period later by its state: plant, what is
    remembered, commands under way; (m, m) [1].

    Args:
      scenario: with a sampling.
      state: of the loop, for its structure.
      derivative: of `closed_loop.change` by `closed_loop.surroundings`, (M, M).
    """
    sampling: Any = scenario.sampling
    n = scenario.n
    plant, size, queue = ravel_pytree(moving(state))[0].size, len(derivative), sampling.queue
    A, B = derivative[:plant, :plant], derivative[:plant, plant : plant + n]
    knows = jnp.concatenate([jnp.arange(plant), jnp.arange(plant + n, size)])
    law, memory = derivative[plant : plant + n, knows], derivative[plant + n :, knows]

    if queue:
        whole = jnp.floor(sampling.delay / sampling.period + 1e-9)
        late = jnp.maximum(sampling.delay - whole * sampling.period, 0.0)
        before, after = jax.lax.map(partial(flow, A, B), jnp.stack([late, sampling.period - late]))
        then, after = after[:, plant:], after[:, :plant]
        by_state, before = jnp.split(matmul_in_order(after, before), [plant], axis=1)
        # Commands: the new one first, then those under way.
        each = [
            jnp.where(whole == k, then, 0.0) + jnp.where(whole == k - 1, before, 0.0)
            for k in range(queue + 1)
        ]
    else:
        by_state, then = jnp.split(flow(A, B, sampling.period), [plant], axis=1)
        each = [then]
    remembered = size - plant - n
    moved = jnp.concatenate(
        [by_state, jnp.zeros((plant, remembered), A.dtype)], axis=1
    ) + matmul_in_order(each[0], law)
    rows = [
        jnp.concatenate([moved, *each[1:]], axis=1),
        jnp.concatenate([memory, jnp.zeros((remembered, queue * n), A.dtype)], axis=1),
    ]
    if queue:
        rows.append(jnp.concatenate([law, jnp.zeros((n, queue * n), A.dtype)], axis=1))
        kept = jnp.eye((queue - 1) * n, queue * n, dtype=A.dtype)
        rows.append(
            jnp.concatenate(
                [jnp.zeros(((queue - 1) * n, plant + remembered), A.dtype), kept], axis=1
            )
        )
    return jnp.concatenate(rows)


def per_time(scenario: Scenario, state: LoopState, derivative: jax.Array) -> jax.Array:
    """What a period map is as a rate, (m, m) [1/s]: how errors of a sampled loop grow or fade."""
    sampling: Any = scenario.sampling
    found = period_map(scenario, state, derivative)
    return (found - jnp.eye(len(found), dtype=found.dtype)) / sampling.period
