"""How fast the closed loop's fastest mode is.

The gain K2 acts through M0^-1, so the fastest mode is about K2 / lambda_min(M0): near 1000 1/s for the paper's gains.  An
explicit step is stable only while dt times that mode stays inside the method's stability region; beyond it the numbers grow
without any physics behind them.  So every run measures its fastest mode, at its start, where it was nearest to its bound
(there the barrier is stiffest) and at its end, and says when the step was too large.

Derivatives of the loop are central differences of its rate: the rate is compiled as it is, its derivative would take thrice as long.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax.core.linalg import matmul_in_order
from iblf_jax.simulation.closed_loop import LoopState, rate
from iblf_jax.simulation.scenario import Scenario

POWER_ITERATIONS, AVERAGED = 48, 16
"""Steps of the power iteration, and how many of the last are averaged over: a power of two, and a third of the steps."""
SLOWEST = 1.0
"""1/s.  A loop slower than this still follows a reference."""


class Growth(NamedTuple):
    """State of the power iteration: a direction of length one, and the sum of the last logarithms of its growth."""

    direction: jax.Array
    total: jax.Array


def growth_start(x: jax.Array) -> Growth:
    """A direction that no mode is orthogonal to, for a state (m,)."""
    start = jnp.cos(jnp.arange(1, x.size + 1, dtype=x.dtype))
    return Growth(start / jnp.sqrt(jnp.sum(start**2)), jnp.zeros((), x.dtype))


def grown(growth: Growth, w: jax.Array, iteration: jax.Array) -> Growth:
    """The growth after one of POWER_ITERATIONS, in which the Jacobian has made w of the direction."""
    size = jnp.maximum(jnp.sqrt(jnp.sum(w * w)), jnp.finfo(w.dtype).tiny)
    counted = iteration >= POWER_ITERATIONS - AVERAGED
    return Growth(w / size, growth.total + jnp.where(counted, jnp.log(size), jnp.zeros_like(size)))


def growth_rate(growth: Growth) -> jax.Array:
    """The mode that was found, () [1/s].  It is averaged over iterations, so that a pair of complex modes is measured too."""
    return jnp.exp(growth.total / AVERAGED)


def growth_rate_by(jacobian: jax.Array) -> jax.Array:
    """The mode that the power iteration of a Jacobian finds, () [1/s]: of all its steps at once, as J^16 and J^32 are found by squaring."""
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
    lengths = [jnp.log(jnp.maximum(jnp.sqrt(matmul_in_order(w.T, w)[0, 0]), tiny)) for w in (before, after)]
    return jnp.exp((logarithm / 2.0 + lengths[1] - lengths[0]) / AVERAGED)


def along(rate_at: Callable, x: jax.Array, direction: jax.Array) -> jax.Array:
    """The derivative of `rate_at`, (m,) -> (m,), at x along a direction, one evaluation at a time."""
    size = jnp.finfo(x.dtype).eps ** (1 / 3) * jnp.maximum(1.0, jnp.sum(jnp.abs(x * direction)))
    rates = jax.lax.map(rate_at, jnp.stack([x + size * direction, x - size * direction]))
    return (rates[0] - rates[1]) / (2.0 * size)


@jax.jit
def jacobian(scenario: Scenario, t: jax.Array, state: LoopState) -> jax.Array:
    """The closed loop's Jacobian at (t, state), (m, m) [1/s]."""
    x, whole = ravel_pytree(state)

    def rate_at(y):
        return ravel_pytree(rate(scenario, t, whole(y)))[0]

    return jax.lax.map(lambda unit: along(rate_at, x, unit), jnp.eye(x.size, dtype=x.dtype)).T
