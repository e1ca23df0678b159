"""How fast the closed loop's fastest mode is.

The gain K2 acts through M0^-1, so the fastest mode is about K2 / lambda_min(M0): near 1000 1/s for the paper's gains.  An
explicit step is stable only while dt times that mode stays inside the method's stability region; beyond it the numbers grow
without any physics behind them.  So every run measures its fastest mode, at its start, where it was nearest to its bound
(there the barrier is stiffest) and at its end, and says when the step was too large.

The Jacobian comes from central differences of the loop's rate: the rate is compiled as it is, its derivative would take thrice as long.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax.closed_loop import LoopState, rate
from iblf_jax.scenario import Scenario

POWER_ITERATIONS = 48
AVERAGED = 16
SLOWEST = 1.0
"""1/s.  A loop slower than this still follows a reference."""


def moved(x: jax.Array, index: jax.Array) -> jax.Array:
    """The `index`-th of the 2 m states around x, (m,), whose rates give the Jacobian: up along every entry, then down."""
    upward = index < x.size
    entry = jnp.arange(x.size) == jnp.where(upward, index, index - x.size)
    return x + jnp.where(entry, jnp.where(upward, 1.0, -1.0) * _size(x), 0.0)


def _size(x: jax.Array) -> jax.Array:
    """How far each entry is moved, (m,).  Short, as the slope of a barrier changes within the distance to its wall."""
    return jnp.sqrt(jnp.finfo(x.dtype).eps) * jnp.maximum(1.0, jnp.abs(x))


def jacobian_from(x: jax.Array, rates: jax.Array) -> jax.Array:
    """The Jacobian at x, (m, m), entry (i, j) of rate i by number j, from the rates (2 m, m) at the states `moved`."""
    return ((rates[: x.size] - rates[x.size :]) / (2.0 * _size(x))[:, None]).T


def jacobian_by_differences(rate_at: Callable, x: jax.Array) -> jax.Array:
    """The Jacobian of `rate_at`, (m,) -> (m,), at x, one evaluation at a time."""
    return jacobian_from(x, jax.lax.map(lambda index: rate_at(moved(x, index)), jnp.arange(2 * x.size)))


@jax.jit
def jacobian(scenario: Scenario, t: jax.Array, state: LoopState) -> jax.Array:
    """The closed loop's Jacobian at (t, state), (m, m) [1/s]."""
    x, whole = ravel_pytree(state)
    return jacobian_by_differences(lambda y: ravel_pytree(rate(scenario, t, whole(y)))[0], x)


def spectral_radius(matrix: jax.Array) -> jax.Array:
    """The largest modulus of an eigenvalue of an (m, m) matrix, () [1/s], by power iteration.

    The growth is averaged over the last iterations, so that a pair of complex modes is measured too.
    """
    # A direction that no mode is orthogonal to.
    start = jnp.cos(jnp.arange(1, len(matrix) + 1, dtype=matrix.dtype))

    def iterate(growth, index):
        direction, total = growth
        w = jnp.sum(matrix * direction, axis=1)
        size = jnp.maximum(jnp.sqrt(jnp.sum(w * w)), jnp.finfo(w.dtype).tiny)
        counted = index >= POWER_ITERATIONS - AVERAGED
        return (w / size, total + jnp.where(counted, jnp.log(size), jnp.zeros_like(size))), None

    before = (start / jnp.sqrt(jnp.sum(start**2)), jnp.zeros((), matrix.dtype))
    (_, total), _ = jax.lax.scan(iterate, before, jnp.arange(POWER_ITERATIONS))
    return jnp.exp(total / AVERAGED)


def fastest_mode(scenario: Scenario, t: jax.Array, state: LoopState) -> jax.Array:
    """Spectral radius of the closed loop's Jacobian at (t, state), () [1/s]."""
    return spectral_radius(jacobian(scenario, t, state))
