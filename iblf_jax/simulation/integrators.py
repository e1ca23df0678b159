"""Explicit Runge-Kutta steps on pytrees; each method is a Butcher tableau.

The time step is fixed for three reasons: the loop is sampled in practice, gradients are exact, and
the runs of a batch advance together. The integrated function may return other values besides the
rate (the closed loop returns a sample to record); a step passes on those of its start. A new method
is a new row of TABLEAUS. `error_estimate` has the local error by stages for Euler's method, methods
of two stages and rk4; a row of another kind needs a formula there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax.core import checks
from iblf_jax.core.pytree import Pytree


class Tableau(NamedTuple):
    """An explicit method: x + dt sum_i b_i k_i, with k_i = f(t + c_i dt, x + dt sum_j a_ij k_j)."""

    c: tuple[float, ...]
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    order: int
    stability: float
    """|dt * mode| up to which the method is stable, on the negative real axis."""
    differences: tuple[float, ...]
    """Weights of the last rates, oldest first, in `error_estimate`."""
    halfway: int = 0
    """Index of the stage in the middle of a step that enters `differences`; 0 if there is none."""


TABLEAUS = {
    "euler": Tableau(c=(0.0,), a=((),), b=(1.0,), order=1, stability=2.0, differences=(-0.5, 0.5)),
    "heun": Tableau(
        c=(0.0, 1.0),
        a=((), (1.0,)),
        b=(0.5, 0.5),
        order=2,
        stability=2.0,
        differences=(1.0, -2.0, 1.0),
    ),
    "rk4": Tableau(
        c=(0.0, 0.5, 0.5, 1.0),
        a=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)),
        b=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
        order=4,
        stability=2.785,
        differences=(1 / 18, -4 / 18, 6 / 18, -4 / 18, 1 / 18),
        halfway=2,
    ),
}

STOCHASTIC = {
    "euler_maruyama": TABLEAUS["euler"],
    "stochastic_heun": TABLEAUS["heun"],
}
"""Methods for plants with process noise, as tableaus for the rate f + sigma dW/dt, in which the
increment dW of the Brownian motion over a step makes a constant rate.  The Euler method is then
that of Maruyama, of strong order 1/2, and of order 1 for additive noise; Heun's method is of strong
order 1 for additive noise, and of order 2 where there is none."""
METHODS = (*TABLEAUS, *STOCHASTIC)
"""The names of all methods."""


def tableau(method: str) -> Tableau:
    """The tableau of a method by name; ValueError for an unknown name."""
    tableaus = TABLEAUS | STOCHASTIC
    checks.one_of("method", method, tableaus)
    return tableaus[method]


class StepResult(NamedTuple):
    """Result of one step of the integrator."""

    state: Pytree
    """The state one step later."""
    slopes: list
    """The slopes of the stages."""
    aux: Any
    """What the function returned besides the rate at the start."""


def step(
    method: str,
    evaluate,
    t: jax.Array,
    state,
    dt: jax.Array,
    *,
    rolled: bool = False,
    inputs: Sequence[jax.Array] | None = None,
) -> StepResult:
    """One step of an explicit Runge-Kutta method.

    Args:
      method: a name in TABLEAUS.
      evaluate: function (t, state) -> (rate of the state, of its structure; anything else).
      t, dt: time and step, () [s].
      state: pytree of arrays.
      rolled: run the stages as a loop, so that `evaluate` is compiled once and not once a stage.
      inputs: an array for each stage, which `evaluate` takes as a third argument; none if not
        given.
    """
    take_step = _rolled if rolled else _unrolled
    return take_step(tableau(method), evaluate, t, state, dt, inputs)


def _unrolled(table: Tableau, evaluate, t, state, dt, inputs) -> StepResult:
    """A step whose stages are written out."""
    given: Sequence[tuple] = [()] * len(table.c)
    if inputs is not None:
        given = [(u,) for u in inputs]
    slope, aux = evaluate(t, state, *given[0])
    slopes = [slope]
    for c, row, own in zip(table.c[1:], table.a[1:], given[1:], strict=True):
        slopes.append(evaluate(t + c * dt, _combine(state, dt, row, slopes), *own)[0])
    return StepResult(_combine(state, dt, table.b, slopes), slopes, aux)


def stage_states(method: str, state, dt: jax.Array, slopes: list) -> list:
    """The states at which a step evaluates its later stages, given the slopes of all of them."""
    return [_combine(state, dt, row, slopes[: len(row)]) for row in tableau(method).a[1:]]


def _combine(state, dt, weights, slopes):
    """State + dt sum_i weights_i slopes_i, leaf by leaf."""

    def combine_leaf(x, *ks):
        # weight * dt is shared by all leaves and runs; x is added last, so it is rounded once.
        terms = [weight * dt * k for weight, k in zip(weights, ks, strict=True) if weight != 0.0]
        if not terms:
            return x
        return x + sum(terms[1:], terms[0])

    return jax.tree.map(combine_leaf, state, *slopes)


def _rolled(table: Tableau, evaluate, t, state, dt, inputs) -> StepResult:
    """A step whose stages are a loop over the rows of the tableau, on the flat state."""
    x, unflatten = ravel_pytree(state)
    stages = len(table.c)
    rows = jnp.asarray([(*row, *[0.0] * (stages - len(row))) for row in table.a], x.dtype)

    def stage(slopes, at):
        index, c, row, *own = at
        stage_state = unflatten(x + dt * jnp.sum(row[:, None] * slopes, axis=0))
        slope, other = evaluate(t + c * dt, stage_state, *own)
        flat, _ = ravel_pytree(slope)
        return jax.lax.dynamic_update_index_in_dim(slopes, flat, index, 0), other

    at_stages: tuple = (jnp.arange(stages), jnp.asarray(table.c, x.dtype), rows)
    if inputs is not None:
        at_stages = (*at_stages, jnp.stack(inputs))
    slopes, others = jax.lax.scan(stage, jnp.zeros((stages, x.size), x.dtype), at_stages)
    total = jnp.sum(jnp.asarray(table.b, x.dtype)[:, None] * slopes, axis=0)
    aux = jax.tree.map(lambda y: y[0], others)
    return StepResult(unflatten(x + dt * total), [unflatten(k) for k in slopes], aux)
