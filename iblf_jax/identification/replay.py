"""The plant under torques that were logged, many stretches of a log at once, and how its motion
depends on the plant's numbers.

    q"(t) = acceleration(x; t, q, q', tau_k)   for t_k <= t < t_{k+1}
    tau_k: the mean torque of a step e(x; t, q, q', q") = M q" + C q' + G - disturbance - friction
      what the joints have to be given

x are the numbers of the leaves that are looked for.  The tangents of a stretch follow from those of
e, one point a step: with q" held e = tau, so d(q")/dx = -M^-1 de/dx, and as e has n rows, n
  cotangents give them for any number of leaves.  A stretch goes point by point,
one after another: what is in reach of the processor is faster than what is side by side (7 joints
  and 28 leaves: 0.08 ms a point, 1.4 ms
with a tangent for each leaf side by side).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.simulation import integrators
from iblf_jax.simulation.closed_loop import acceleration, torque_needed
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world.robots import at_time


class Place(NamedTuple):
    """Where the numbers of a leaf are in x; static."""

    path: str
    shape: tuple[int, ...]
    start: int
    size: int


class Stretches(NamedTuple):
    """W stretches of K steps."""

    t: Any
    """Times of the samples, (W, K + 1) [s]."""
    q: Any
    """Where they start, (W, n) [rad]."""
    dq: Any
    """(W, n) [rad/s]."""
    tau: Any
    """Torque of each step, (W, K, n) [N m]."""


class Slopes(NamedTuple):
    """e and its derivatives at P points."""

    torque: Any
    """e, (P, n) [N m]."""
    mass: Any
    """M, (P, n, n)."""
    by_q: Any
    """(P, n, n)."""
    by_dq: Any
    """(P, n, n)."""
    by_x: Any
    """(P, n, p)."""


def leaves_of(places: tuple[Place, ...], x: Any) -> Mapping[str, Any]:
    """Path -> value, of x (p,)."""
    return {
        place.path: x[place.start : place.start + place.size].reshape(place.shape)
        for place in places
    }


@partial(jax.jit, static_argnames=("places", "substeps"))
def replayed(
    scenario: Scenario,
    x: jax.Array,
    stretches: Stretches,
    *,
    places: tuple[Place, ...],
    substeps: int,
) -> tuple[jax.Array, ...]:
    """Positions and velocities at the samples of all stretches, (W, K + 1, n) each, by `substeps`
    steps of RK4 from sample to sample.
    """
    scenario = with_parameters(scenario, leaves_of(places, x))

    def advanced(state, step):
        t, dt, tau = step

        def small(i, state):
            def rate(t, state):
                return (state[1], acceleration(scenario, t, state[0], state[1], tau)), None

            return integrators.step("rk4", rate, t + i * dt, state, dt, rolled=True).state

        state = jax.lax.fori_loop(0, substeps, small, state)
        return state, state

    def one(stretch):
        dt = jnp.diff(stretch.t) / substeps
        start = stretch.q, stretch.dq
        _, later = jax.lax.scan(advanced, start, (stretch.t[:-1], dt, stretch.tau))
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, later)

    return jax.lax.map(one, stretches)


@partial(jax.jit, static_argnames="places")
def slopes(
    scenario: Scenario,
    x: jax.Array,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    ddq: jax.Array,
    *,
    places,
) -> Slopes:
    """What the joints need, e, and its derivatives where the motion is given, P points: t (P,), q,
    dq, ddq (P, n).
    """
    return jax.lax.map(lambda point: _slope(scenario, places, x, *point), (t, q, dq, ddq))


@partial(jax.jit, static_argnames="places")
def slopes_under(
    scenario: Scenario,
    x: jax.Array,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    tau: jax.Array,
    *,
    places,
) -> Slopes:
    """What the joints need, e, and its derivatives where the torque is given; its q" is the
    plant's.
    """
    moved = with_parameters(scenario, leaves_of(places, x))

    def one(point):
        t, q, dq, tau = point
        return _slope(scenario, places, x, t, q, dq, acceleration(moved, t, q, dq, tau))

    return jax.lax.map(one, (t, q, dq, tau))


def _slope(scenario: Scenario, places: tuple[Place, ...], x, t, q, dq, ddq) -> Slopes:
    def needed(q, dq, x):
        moved = with_parameters(scenario, leaves_of(places, x))
        return torque_needed(moved, t, q, dq, ddq), at_time(moved.plant, t).mass_matrix(q)

    torque, back, mass = jax.vjp(needed, q, dq, x, has_aux=True)
    by_q, by_dq, by_x = jax.vmap(back)(jnp.eye(len(q), dtype=q.dtype))
    return Slopes(torque, mass, by_q, by_dq, by_x)


def tangents(stretches: Stretches, along: Slopes, by_input: np.ndarray) -> np.ndarray:
    """How q of the samples depends on start, x and what moves the torque, by the implicit midpoint
    rule.

        X_{k+1} = (1 - h/2 F)^-1 ((1 + h/2 F) X_k + h G),     F = -M^-1 [de/dq de/dq'],  G = -M^-1
        de/dx

    Args:
      stretches: W of K steps.
      along: at the middle of each step, P = W K points.
      by_input: derivative of each step's torque by what else moves it, (W, K, n, m).

    Returns:
      dq/d(q(0), q'(0), x, inputs), (W, K + 1, n, 2 n + p + m).
    """
    W, K, n, _ = by_input.shape
    forces = np.concatenate(
        [-along.by_q, -along.by_dq, -along.by_x, by_input.reshape(W * K, n, -1)], axis=-1
    )
    rates = np.linalg.solve(along.mass, forces).reshape(W, K, n, -1)
    half = 0.5 * np.diff(np.asarray(stretches.t))
    X = np.zeros((W, 2 * n, rates.shape[-1]))
    X[:, np.arange(2 * n), np.arange(2 * n)] = 1.0
    found = np.empty((W, K + 1, n, rates.shape[-1]))
    found[:, 0] = X[:, :n]
    one = np.eye(2 * n)
    for k in range(K):
        F, G = np.zeros((W, 2 * n, 2 * n)), np.zeros_like(X)
        F[:, :n, n:] = np.eye(n)
        F[:, n:] = rates[:, k, :, : 2 * n]
        G[:, n:, 2 * n :] = rates[:, k, :, 2 * n :]
        h = half[:, k, None, None]
        X = np.linalg.solve(one - h * F, X + h * (F @ X) + 2.0 * h * G)
        found[:, k + 1] = X[:, :n]
    return found
