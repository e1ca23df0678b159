"""The fastest mode of the closed loop, and the stability of a sampled loop.

The gain K2 acts through M0^-1, so the fastest mode is about K2 / lambda_min(M0): near 1000 1/s for
the paper's gains. An explicit step is stable only while dt times that mode lies inside the method's
stability region; beyond it the numbers grow without a physical cause. Every run therefore measures
its fastest mode at its start, where it was nearest to its bound (there the barrier is stiffest),
and at its end, and its status reports a step that was too large.

Derivatives of the loop are central differences of its rate, because compiling its derivative would
take three times as long as compiling the rate.

A law such as |e2|^a sign(e2) with a < 1 has an infinite derivative where e2 = 0. One instant there
says nothing about the time step: an oscillation that a step excites stops growing at the amplitude
at which the difference quotient is small enough. A smooth loop has the same derivative by
differences of any small size. Every derivative is therefore measured by differences of three sizes,
h0, 10 h0 and THIRD_SIZE (less near a bound, where the barrier is stiff). Where one of the larger
ones gives much less than h0, the one of THIRD_SIZE counts (`resolved_jacobian`).

Stability of a sampled loop is that of the map from one period to the next. The derivative of the
map follows from those of plant and law: the plant's state evolves with exp(A t), A the derivative
of its rate, while the torque is constant. The loop is stable only while the spectral radius of the
map, taken over all states with memory, is below 1.  Slow growth that the derivatives show in
continuous time as well does not count (`growth_by_sampling`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax.core import checks, programs
from iblf_jax.kernels import matmul_in_order
from iblf_jax.simulation.closed_loop import (
    LoopState,
    integrated_part,
    perturbed_rate,
    perturbed_state,
)
from iblf_jax.simulation.levels import has_speed_limits
from iblf_jax.simulation.sampling import Sampling
from iblf_jax.simulation.scenario import Scenario

POWER_ITERATIONS, AVERAGED_STEPS = 48, 16
"""Iterations of the power iteration, and the number of last iterations over which it averages: a
power of two, and a third of the iterations."""
TAYLOR_TERMS, HALVINGS = 8, 8
"""Terms of the Taylor series of a flow, and the number of times its duration is halved first: exact
to rounding for |A| t up to 30."""
SQUARINGS = 20
"""Number of times a map is squared to compute its spectral radius."""
RADIUS = "sampling_radius"
"""Name of the spectral radius among the metrics of a sampled run: the largest at the assessed
states of that run.  Below 1 small deviations from these states decay."""
SECOND_SIZE, THIRD_SIZE = 10.0, 1e-2
"""The second size of a difference, relative to the first, and the third [rad/s, or the unit of the
state]. An oscillation of 0.01 rad/s with a period of a few steps moves the positions by only 1e-5
rad."""
THIRD_SIZE_OF_POSITION = 1e-3
"""The third size of a difference in a position [rad]."""
MAX_BOUND_FRACTION = 0.25
"""Largest size of a difference, relative to the distance from a bound."""
INFINITE_RATIO = 0.8
"""Ratio of the derivatives by differences of the second and the first size below which the
derivative is taken to be infinite."""
TRANSIENT_GROWTH = 10.0
"""Largest rate that the derivatives at one instant may have in continuous time although the errors
of the loop decay [1/s]; the largest that was measured is 4.8."""
SLOWEST_RATE = 1.0
"""Rate of the slowest mode of a loop that follows a reference [1/s]."""


class PowerIteration(NamedTuple):
    """State of the power iteration."""

    direction: jax.Array
    """A unit vector, (m,)."""
    log_growth: jax.Array
    """Sum of the logarithms of its growth over the last iterations, ()."""


def power_iteration_start(x: jax.Array) -> PowerIteration:
    """The start of the power iteration for a state x, (m,), with a direction that no mode is
    orthogonal to.
    """
    start = jnp.cos(jnp.arange(1, x.size + 1, dtype=x.dtype))
    return PowerIteration(start / jnp.sqrt(jnp.sum(start**2)), jnp.zeros((), x.dtype))


def power_iteration_step(
    growth: PowerIteration, w: jax.Array, iteration: jax.Array
) -> PowerIteration:
    """The state after one of POWER_ITERATIONS; w is the Jacobian times the direction."""
    size = jnp.maximum(jnp.sqrt(jnp.sum(w * w)), jnp.finfo(w.dtype).tiny)
    counted = iteration >= POWER_ITERATIONS - AVERAGED_STEPS
    return PowerIteration(
        w / size, growth.log_growth + jnp.where(counted, jnp.log(size), jnp.zeros_like(size))
    )


def growth_rate(growth: PowerIteration) -> jax.Array:
    """The rate of the fastest mode, () [1/s]. The average over iterations makes it valid for a pair
    of complex modes, too.
    """
    return jnp.exp(growth.log_growth / AVERAGED_STEPS)


@jax.jit
def growth_rate_of_matrix(jacobian: jax.Array) -> jax.Array:
    """The `growth_rate` of a power iteration with Jacobians J, (...) [1/s].

    It is (|J^48 v| / |J^32 v|)^(1/16) for the direction v at the start; repeated squaring gives the
    powers of J.

    Args:
      jacobian: (m, m, ...) [1/s]; the runs of small ones are the last axis, because a processor
        computes neighbours in memory together.
    """
    tiny = jnp.finfo(jacobian.dtype).tiny
    start = power_iteration_start(jacobian.ravel()[: len(jacobian)]).direction

    def squared(_, powers):
        _, power, log_factor = powers
        size = jnp.maximum(jnp.max(jnp.abs(power), axis=(0, 1)), tiny)
        power = power / size
        return power, matmul_in_order(power, power), 2.0 * (log_factor + jnp.log(size))

    def log_length(w):
        squares = matmul_in_order(jnp.swapaxes(w, 0, 1), w)[0, 0]
        return jnp.log(jnp.maximum(jnp.sqrt(squares), tiny))

    # J^16 and J^32, each up to a factor, and the logarithm of the factor of J^32.
    powers = (jacobian, jacobian, jnp.zeros_like(jacobian[0, 0]))
    J16, J32, log_factor = jax.lax.fori_loop(0, AVERAGED_STEPS.bit_length(), squared, powers)
    before = matmul_in_order(J32, start.reshape(-1, *[1] * (jacobian.ndim - 1)))
    after = matmul_in_order(J16, before)
    growth = log_factor / 2.0 + log_length(after) - log_length(before)
    return jnp.exp(growth / AVERAGED_STEPS)


def difference_sizes(x: jax.Array, direction: jax.Array, largest: jax.Array) -> jax.Array:
    """The three sizes of central differences at x along a direction, (3,); `largest` is the largest
    useful one, ().
    """
    first = jnp.finfo(x.dtype).eps ** (1 / 3) * jnp.maximum(1.0, jnp.sum(jnp.abs(x * direction)))
    third = jnp.maximum(first, largest)
    return jnp.stack([first, jnp.minimum(SECOND_SIZE * first, third), third])


def directional_derivative(
    rate_at: Callable, x: jax.Array, direction: jax.Array, size: jax.Array
) -> jax.Array:
    """The derivative of `rate_at`, (m,) -> (m,), at x along a direction by a central difference,
    one evaluation at a time.
    """
    rates = jax.lax.map(rate_at, jnp.stack([x + size * direction, x - size * direction]))
    return (rates[0] - rates[1]) / (2.0 * size)


def largest_difference_sizes(
    scenario: Scenario, t: jax.Array, plant: LoopState, size: int
) -> jax.Array:
    """The largest sizes of differences of a `closed_loop.perturbed_state`, (size,): small near
    bounds, THIRD_SIZE elsewhere.
    """
    tube = scenario.context.tube(t, acceleration=False)
    side = jnp.minimum(plant.q - tube.lower, tube.upper - plant.q)
    near = [jnp.clip(MAX_BOUND_FRACTION * side, 0.0, THIRD_SIZE_OF_POSITION)]
    if has_speed_limits(scenario):
        slow, fast = scenario.context.speed_limits(t)
        side = jnp.minimum(plant.dq - slow, fast - plant.dq)
        near.append(jnp.clip(MAX_BOUND_FRACTION * side, 0.0, THIRD_SIZE))
    rest = jnp.full((size - sum(x.size for x in near),), THIRD_SIZE, plant.q.dtype)
    return jnp.concatenate([*near, rest])


def has_infinite_derivative(jacobians: jax.Array, sampled: bool) -> jax.Array:
    """Which columns of a Jacobian are infinite derivatives or nearly so, (..., m) bool.

    Args:
      jacobians: by differences of three sizes, (..., 3, m, m).  Close to an infinite derivative the
        two small ones agree, and the large one is smaller.
      sampled: whether they are of a sampled loop.  There the large one is not used: a position
        that moves so far between two samples means a velocity at which the torque saturates.
    """
    return is_infinite(jnp.sum(jnp.abs(jacobians), axis=-2), sampled)


def is_infinite(lengths: jax.Array, sampled: bool) -> jax.Array:
    """As `has_infinite_derivative`, from the lengths of the columns, (..., 3, m)."""
    larger = lengths[..., 1, :]
    if not sampled:
        larger = jnp.minimum(larger, lengths[..., 2, :])
    return larger < INFINITE_RATIO * lengths[..., 0, :]


def resolved_jacobian(jacobians: jax.Array, sampled: bool) -> jax.Array:
    """One Jacobian, (..., m, m), from those by differences of three sizes, (..., 3, m, m).

    A column with an infinite derivative is that of the largest size, and others are that of the
    smallest.
    """
    steep = has_infinite_derivative(jacobians, sampled)[..., None, :]
    return jnp.where(steep, jacobians[..., 2, :, :], jacobians[..., 0, :, :])


@programs.jit
def jacobian(scenario: Scenario, t: jax.Array, state: LoopState) -> jax.Array:
    """The derivative of `closed_loop.perturbed_rate` at (t, state), (m, m): the Jacobian of the
    closed loop [1/s] where the law is not sampled.
    """
    x, unflatten = ravel_pytree(perturbed_state(state))
    largest = largest_difference_sizes(scenario, t, state, x.size)

    def rate_at(y):
        return ravel_pytree(perturbed_rate(scenario, t, unflatten(y)))[0]

    def column(each):
        unit, size = each
        return directional_derivative(rate_at, x, unit, size)

    units = jnp.eye(x.size, dtype=x.dtype)
    sizes = jax.vmap(partial(difference_sizes, x))(units, largest)
    found = jax.lax.map(column, (jnp.repeat(units, 3, axis=0), sizes.ravel()))
    by_size = jnp.transpose(found.reshape(x.size, 3, x.size), (1, 2, 0))
    return resolved_jacobian(by_size, scenario.sampling is not None)


@jax.jit
def linear_flow(A: jax.Array, B: jax.Array, t: jax.Array) -> jax.Array:
    """The flow of x' = A x + B u over a time t with a constant u: the derivative of x(t) by x(0)
    and by u, (m, m + n) for A (m, m) and B (m, n).
    """
    m, scale = len(A), t / 2.0**HALVINGS
    by_input = jnp.concatenate([jnp.zeros_like(A), B], axis=1) * scale
    unit, small = jnp.eye(m, m + B.shape[1], dtype=A.dtype), A * scale

    def next_term(k, found):
        return unit + (matmul_in_order(small, found) + by_input) / (TAYLOR_TERMS - k).astype(
            A.dtype
        )

    def doubled(_, found):
        constant_part = jnp.concatenate([jnp.zeros_like(A), found[:, m:]], axis=1)
        return matmul_in_order(found[:, :m], found) + constant_part

    short = jax.lax.fori_loop(0, TAYLOR_TERMS, next_term, unit)
    return jax.lax.fori_loop(0, HALVINGS, doubled, short)


@jax.jit
def spectral_radius(A: jax.Array) -> jax.Array:
    """The spectral radius max |lambda_i(A)|, () [1]: |A^m|^(1/m) for m = 2^SQUARINGS."""
    tiny = jnp.finfo(A.dtype).tiny

    def squared(k, found):
        power, logarithm = found
        size = jnp.maximum(jnp.max(jnp.abs(power)), tiny)
        power = power / size
        return matmul_in_order(power, power), logarithm + jnp.log(size) / 2.0 ** k.astype(A.dtype)

    _, logarithm = jax.lax.fori_loop(0, SQUARINGS, squared, (A, jnp.zeros((), A.dtype)))
    return jnp.exp(logarithm)


def period_map(scenario: Scenario, state: LoopState, derivative: jax.Array) -> jax.Array:
    """The one-period map of a sampled loop: the derivative of its state (plant, memory, commands in
    transit) at the next sample by that at this one, (m, m) [1].

    Args:
      scenario: with a sampling.
      state: of the loop, for its structure.
      derivative: of `closed_loop.perturbed_rate` by `closed_loop.perturbed_state`, (M, M).
    """
    sampling = checks.given(scenario.sampling)
    n, queue, size = scenario.n, sampling.queue, len(derivative)
    plant = ravel_pytree(integrated_part(state))[0].size
    memory = size - plant - n
    A, B = derivative[:plant, :plant], derivative[:plant, plant : plant + n]
    # Law and memory depend on x, the plant and the memory, and not on the newest command.
    x = jnp.concatenate([jnp.arange(plant), jnp.arange(plant + n, size)])
    law_by_x = derivative[plant : plant + n, x]
    memory_by_x = derivative[plant + n :, x]
    by_plant, by_command = _plant_over_period(sampling, A, B)

    def zeros(rows: int, columns: int) -> jax.Array:
        return jnp.zeros((rows, columns), A.dtype)

    def row(*blocks: jax.Array) -> jax.Array:
        return jnp.concatenate(blocks, axis=1)

    plant_by_x = row(by_plant, zeros(plant, memory)) + matmul_in_order(by_command[0], law_by_x)
    rows = [row(plant_by_x, *by_command[1:]), row(memory_by_x, zeros(memory, queue * n))]
    if queue:
        older = (queue - 1) * n
        rows.append(row(law_by_x, zeros(n, queue * n)))
        rows.append(row(zeros(older, plant + memory), jnp.eye(older, queue * n, dtype=A.dtype)))
    return jnp.concatenate(rows)


def _plant_over_period(
    sampling: Sampling, A: jax.Array, B: jax.Array
) -> tuple[jax.Array, list[jax.Array]]:
    """The derivative of the plant's state a period later by its state, (m, m), and by each command,
    (m, n): the new one first, then those in transit.
    """
    plant = len(A)
    if not sampling.queue:
        by_state, by_torque = jnp.split(linear_flow(A, B, sampling.period), [plant], axis=1)
        return by_state, [by_torque]
    # The delay is a number of periods and a rest; the torque changes once a period, after the rest.
    periods = jnp.floor(sampling.delay / sampling.period + 1e-9)
    rest = jnp.maximum(sampling.delay - periods * sampling.period, 0.0)
    before, after = jax.lax.map(
        partial(linear_flow, A, B), jnp.stack([rest, sampling.period - rest])
    )
    after, by_later = after[:, :plant], after[:, plant:]
    by_state, by_earlier = jnp.split(matmul_in_order(after, before), [plant], axis=1)
    by_command = [
        jnp.where(periods == k, by_later, 0.0) + jnp.where(periods == k - 1, by_earlier, 0.0)
        for k in range(sampling.queue + 1)
    ]
    return by_state, by_command


def continuous_map(scenario: Scenario, state: LoopState, derivative: jax.Array) -> jax.Array:
    """The map over one period of the same loop with a law in continuous time and without delay,
    exp(A_c T), (m, m) [1].

    It shows the growth that a loop has at any period: the derivatives at one instant of a loop
    whose gains depend on the time or on the error may have an eigenvalue above 0, although the
    errors decay.  The states of law and observer have their mean rates over a period.

    The map is zero, which excuses no growth, for a loop whose sensor or actuator has states: their
    lags make loops unstable with growth as slow as that of such gains.

    Args:
      scenario, state, derivative: as `period_map`.
    """
    if jax.tree.leaves((state.actuator, state.sampled.sensor)):
        return jnp.zeros((1, 1), derivative.dtype)
    sampling = checks.given(scenario.sampling)
    n, size = scenario.n, len(derivative)
    plant = ravel_pytree(integrated_part(state))[0].size
    x = jnp.concatenate([jnp.arange(plant), jnp.arange(plant + n, size)])
    B = derivative[:plant, plant : plant + n]
    by_command = matmul_in_order(B, derivative[plant : plant + n, x])
    plant_rate = derivative[:plant, x] + by_command
    unchanged = jnp.eye(len(x), dtype=derivative.dtype)[plant:]
    memory_rate = (derivative[plant + n :, x] - unchanged) / sampling.period
    rate = jnp.concatenate([plant_rate, memory_rate])
    return linear_flow(rate, jnp.zeros((len(x), 0), rate.dtype), sampling.period)


def growth_by_sampling(radius: Any, continuous_radius: Any, period: Any) -> Any:
    """The spectral radius of a period map relative to the slow growth that sampling does not cause
    [1]: above 1 the law is sampled too slowly.

    It is the radius itself where the loop in continuous time is stable.  Otherwise that loop
    explains a growth of up to twice its own rate, and of at most TRANSIENT_GROWTH.

    Args:
      radius: of the `period_map`.
      continuous_radius: of the `continuous_map`.
      period: of the sampling [s].
    """
    own = jnp.maximum(1.0, continuous_radius) ** 2
    return radius / jnp.minimum(own, jnp.exp(TRANSIENT_GROWTH * period))


def growth_in_words(radius: float) -> str:
    """How much a deviation grows over one period at a spectral radius above 1, such as "0.02 %"."""
    if radius < 2.0:
        return f"{100.0 * (radius - 1.0):.2g} %"
    return f"a factor of {radius:.3g}"


def period_map_as_rate(scenario: Scenario, state: LoopState, derivative: jax.Array) -> jax.Array:
    """The one-period map as a rate, (m, m) [1/s]: the rate at which errors of a sampled loop grow
    or decay.
    """
    sampling = checks.given(scenario.sampling)
    found = period_map(scenario, state, derivative)
    return (found - jnp.eye(len(found), dtype=found.dtype)) / sampling.period
