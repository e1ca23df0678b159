"""Explicit Runge-Kutta steps on pytrees, each method a Butcher table.

A step is given the slope at its start, because the time loop has it already: the closed loop is evaluated there for the record
and the metrics.  Fixed steps: the loop is sampled in practice, gradients are exact, and a batch stays in step.
"""

from __future__ import annotations

from typing import NamedTuple

import jax

from iblf_jax import checks


class Tableau(NamedTuple):
    """An explicit method: x + dt sum_i b_i k_i, with k_i = f(t + c_i dt, x + dt sum_j a_ij k_j).

    In every method here a stage starts from the slope before it alone: a_ij = 0 for j < i - 1.
    """

    c: tuple[float, ...]
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    order: int
    stability: float
    """|dt * mode| up to which the method is stable, on the negative real axis."""
    differences: tuple[float, ...]
    """Weights of the last rates, oldest first, in the estimate of a step's error (`accuracy`)."""
    halfway: int = 0
    """The stage in the middle of a step, whose rate is one of these; 0 if there is none."""


TABLEAUS = {
    "euler": Tableau(c=(0.0,), a=((),), b=(1.0,), order=1, stability=2.0, differences=(-0.5, 0.5)),
    "heun": Tableau(c=(0.0, 1.0), a=((), (1.0,)), b=(0.5, 0.5), order=2, stability=2.0, differences=(1.0, -2.0, 1.0)),
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


def tableau(method: str) -> Tableau:
    """The table of a method by name; ValueError for another name."""
    checks.one_of("method", method, tuple(TABLEAUS))
    return TABLEAUS[method]


def stages(method: str) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """c_i, a_i,i-1 (0 for the first) and b_i of every stage, for a loop over the stages."""
    table = tableau(method)
    return table.c, (0.0, *(row[-1] for row in table.a[1:])), table.b


def _combine(state, dt, weights, slopes):
    def one(x, *ks):
        total = None
        for weight, k in zip(weights, ks, strict=True):
            if weight != 0.0:
                total = weight * k if total is None else total + weight * k
        return x if total is None else x + dt * total

    return jax.tree.map(one, state, *slopes)


def step(method: str, slope, t: jax.Array, state, dt: jax.Array, first_slope):
    """The state one step later.

    Args:
      method: "euler", "heun" or "rk4".
      slope: function (t, state) -> rate of the state, same structure.
      t, dt: time and step, () [s].
      state: pytree of arrays.
      first_slope: slope(t, state).
    """
    return combined(method, state, dt, stage_slopes(method, slope, t, state, dt, first_slope))


def stage_slopes(method: str, slope, t: jax.Array, state, dt: jax.Array, first_slope) -> list:
    """The slopes of a step's stages; arguments as `step`."""
    table = tableau(method)
    slopes = [first_slope]
    for c, row in zip(table.c[1:], table.a[1:], strict=True):
        slopes.append(slope(t + c * dt, _combine(state, dt, row, slopes)))
    return slopes


def combined(method: str, state, dt: jax.Array, slopes: list):
    """The state one step later, from the slopes of its stages."""
    return _combine(state, dt, tableau(method).b, slopes)
