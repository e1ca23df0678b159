"""How fast the closed loop's fastest mode is.

The gain K2 acts through M0^-1, so the fastest mode is about K2 / lambda_min(M0): near 1000 1/s for the paper's gains.  An
explicit step is stable only while dt times that mode stays inside the method's stability region; beyond it the numbers grow
without any physics behind them.  So every run measures its fastest mode, at its start, where it was nearest to its bound
(there the barrier is stiffest) and at its end, and says when the step was too large.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax.closed_loop import LoopState, rate
from iblf_jax.one_function import as_one_function, is_long
from iblf_jax.scenario import Scenario

POWER_ITERATIONS = 48
AVERAGED = 16
SLOWEST = 1.0
"""1/s.  A loop slower than this still follows a reference."""


class Growth(NamedTuple):
    """State of the power iteration: a direction of length one, and the sum of the last logarithms of its growth."""

    direction: jax.Array
    total: jax.Array


def growth_start(state: LoopState | jax.Array) -> Growth:
    """A direction that no mode is orthogonal to."""
    flat, _ = ravel_pytree(state)
    start = jnp.cos(jnp.arange(1, flat.size + 1, dtype=flat.dtype))
    return Growth(start / jnp.sqrt(jnp.sum(start**2)), jnp.zeros((), flat.dtype))


def growth_step(scenario: Scenario, t: jax.Array, state: LoopState, growth: Growth, index: jax.Array) -> Growth:
    """One of POWER_ITERATIONS steps: the direction, pushed by the closed loop's Jacobian at (t, state)."""
    flat, unravel = ravel_pytree(state)
    w = jax.jvp(lambda x: ravel_pytree(rate(scenario, t, unravel(x)))[0], (flat,), (growth.direction,))[1]
    return _grown(growth, w, index)


def _grown(growth: Growth, w: jax.Array, index: jax.Array) -> Growth:
    """The growth after the direction has become w."""
    size = jnp.maximum(jnp.sqrt(jnp.sum(w * w)), jnp.finfo(w.dtype).tiny)
    counted = index >= POWER_ITERATIONS - AVERAGED
    return Growth(w / size, growth.total + jnp.where(counted, jnp.log(size), jnp.zeros_like(size)))


def growth_rate(growth: Growth) -> jax.Array:
    """The mode that was found, () [1/s]."""
    return jnp.exp(growth.total / AVERAGED)


def fastest_mode(scenario: Scenario, t: jax.Array, state: LoopState) -> jax.Array:
    """Spectral radius of the closed loop's Jacobian at (t, state), () [1/s], by power iteration on jvp.

    The growth is averaged over the last iterations, so that a pair of complex modes is measured too.
    """

    def iterate(growth, index):
        return growth_step(scenario, t, state, growth, index), None

    return growth_rate(jax.lax.scan(iterate, growth_start(state), jnp.arange(POWER_ITERATIONS))[0])


def fastest_mode_by_differences(rate, x: jax.Array) -> jax.Array:
    """As `fastest_mode`, from central differences: for a loop so long that compiling its derivative is what takes the time.

    Args:
      rate: function of the state as one vector (m,) -> its rate (m,).
      x: the state.
    """
    columns = jacobian_by_differences(rate, x)

    def iterate(growth, index):
        return _grown(growth, jnp.sum(columns * growth.direction[:, None], axis=0), index), None

    return growth_rate(jax.lax.scan(iterate, growth_start(x), jnp.arange(POWER_ITERATIONS))[0])


def jacobian_by_differences(rate, x: jax.Array) -> jax.Array:
    """The derivatives of `rate` at x, (m, m), one row an entry of x, by central differences, one evaluation at a time."""
    h = jnp.finfo(x.dtype).eps ** (1 / 3) * jnp.maximum(1.0, jnp.abs(x))
    rates = jax.lax.map(lambda move: rate(x + move), jnp.concatenate([jnp.diag(h), -jnp.diag(h)]))
    return (rates[: x.size] - rates[x.size :]) / (2.0 * h[:, None])


@jax.jit
def jacobian(scenario: Scenario, t: jax.Array, state: LoopState) -> jax.Array:
    """The closed loop's Jacobian at (t, state), (m, m) [1/s]."""
    x, whole = ravel_pytree(state)

    def rate_at(t, x):
        return ravel_pytree(rate(scenario, t, whole(x)))[0]

    if is_long(rate_at, t, x):
        return jacobian_by_differences(partial(as_one_function(rate_at), t), x).T
    return jax.jacfwd(partial(rate_at, t))(x)
