"""The plant under logged torques, for many windows of a log at once, and its sensitivities.

    q"(t) = acceleration(x; t, q, q', tau_k)   for t_k <= t < t_{k+1}
    tau_k: the mean torque of a step
    e(x; t, q, q', q") = M q" + C q' + G - disturbance - friction:  the torque that a motion needs

x are the identified parameters.  The sensitivities of a window follow from the derivatives of e at
one point of each step: e = tau for the simulated motion, so d(q")/dx = -M^-1 de/dx, and n reverse-
mode passes give the derivatives of the n rows of e by any number of parameters.  The points are
evaluated one after another, because a small working set in the cache is faster than a batch (7
joints and 28 leaves: 0.08 ms a point, 1.4 ms with a batch of one tangent for each leaf).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.simulation import integrators
from iblf_jax.simulation.levels import acceleration, torque_needed
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world.robots import at_time


class LeafSlice(NamedTuple):
    """The entries of x that belong to a leaf; static."""

    path: str
    shape: tuple[int, ...]
    start: int
    size: int


class WindowInputs(NamedTuple):
    """Initial states and torques of W windows of a log, of K steps each."""

    t: np.ndarray | jax.Array
    """Times of the samples, (W, K + 1) [s]."""
    q: np.ndarray | jax.Array
    """Initial positions, (W, n) [rad]."""
    dq: np.ndarray | jax.Array
    """(W, n) [rad/s]."""
    tau: np.ndarray | jax.Array
    """Torque of each step, (W, K, n) [N m]."""


class InverseDynamics(NamedTuple):
    """The torque e that a motion needs, and its derivatives, at P points."""

    torque: np.ndarray | jax.Array
    """e, (P, n) [N m]."""
    mass: np.ndarray | jax.Array
    """M, (P, n, n)."""
    by_q: np.ndarray | jax.Array
    """(P, n, n)."""
    by_dq: np.ndarray | jax.Array
    """(P, n, n)."""
    by_x: np.ndarray | jax.Array
    """(P, n, p)."""


def values_by_path(places: tuple[LeafSlice, ...], x: np.ndarray | jax.Array) -> Mapping[str, Any]:
    """The values of the leaves, by path, from x (p,)."""
    return {
        place.path: x[place.start : place.start + place.size].reshape(place.shape)
        for place in places
    }


@partial(jax.jit, static_argnames=("places", "substeps"))
def simulate_windows(
    scenario: Scenario,
    x: jax.Array,
    inputs: WindowInputs,
    *,
    places: tuple[LeafSlice, ...],
    substeps: int,
) -> tuple[jax.Array, ...]:
    """Positions and velocities at the samples of all windows, (W, K + 1, n) each, by `substeps`
    steps of RK4 from sample to sample.
    """
    scenario = with_parameters(scenario, values_by_path(places, x))

    def advanced(state, step):
        t, dt, tau = step

        def small(i, state):
            def rate(t, state):
                return (state[1], acceleration(scenario, t, state[0], state[1], tau)), None

            return integrators.step("rk4", rate, t + i * dt, state, dt, rolled=True).state

        state = jax.lax.fori_loop(0, substeps, small, state)
        return state, state

    def one(window):
        dt = jnp.diff(window.t) / substeps
        start = window.q, window.dq
        _, later = jax.lax.scan(advanced, start, (window.t[:-1], dt, window.tau))
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, later)

    return jax.lax.map(one, inputs)


@partial(jax.jit, static_argnames="places")
def inverse_dynamics(
    scenario: Scenario,
    x: jax.Array,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    ddq: jax.Array,
    *,
    places,
) -> InverseDynamics:
    """The torque e and its derivatives for a given motion at P points: t (P,), q, dq, ddq (P,
    n).
    """
    return jax.lax.map(
        lambda point: _inverse_dynamics_at(scenario, places, x, *point), (t, q, dq, ddq)
    )


@partial(jax.jit, static_argnames="places")
def inverse_dynamics_for_torque(
    scenario: Scenario,
    x: jax.Array,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    tau: jax.Array,
    *,
    places,
) -> InverseDynamics:
    """The torque e and its derivatives for a given torque tau (P, n); q" is the plant's."""
    changed = with_parameters(scenario, values_by_path(places, x))

    def one(point):
        t, q, dq, tau = point
        return _inverse_dynamics_at(
            scenario, places, x, t, q, dq, acceleration(changed, t, q, dq, tau)
        )

    return jax.lax.map(one, (t, q, dq, tau))


def _inverse_dynamics_at(
    scenario: Scenario, places: tuple[LeafSlice, ...], x, t, q, dq, ddq
) -> InverseDynamics:
    def needed(q, dq, x):
        changed = with_parameters(scenario, values_by_path(places, x))
        return torque_needed(changed, t, q, dq, ddq), at_time(changed.plant, t).mass_matrix(q)

    torque, back, mass = jax.vjp(needed, q, dq, x, has_aux=True)
    by_q, by_dq, by_x = jax.vmap(back)(jnp.eye(len(q), dtype=q.dtype))
    return InverseDynamics(torque, mass, by_q, by_dq, by_x)


def position_sensitivities(
    inputs: WindowInputs, along: InverseDynamics, by_input: np.ndarray
) -> np.ndarray:
    """Derivatives of q at the samples by the initial state, x and inputs, by the implicit midpoint
    rule.

        X_{k+1} = (1 - h/2 F)^-1 ((1 + h/2 F) X_k + h G),     F = -M^-1 [de/dq de/dq'],  G = -M^-1
        de/dx

    Args:
      inputs: of W windows of K steps.
      along: at the middle of each step, P = W K points.
      by_input: derivative of each step's torque by m further inputs, (W, K, n, m).

    Returns:
      dq/d(q(0), q'(0), x, inputs), (W, K + 1, n, 2 n + p + m).
    """
    W, K, n, _ = by_input.shape
    forces = np.concatenate(
        [-along.by_q, -along.by_dq, -along.by_x, by_input.reshape(W * K, n, -1)], axis=-1
    )
    rates = np.linalg.solve(along.mass, forces).reshape(W, K, n, -1)
    half = 0.5 * np.diff(np.asarray(inputs.t))
    X = np.zeros((W, 2 * n, rates.shape[-1]))
    X[:, np.arange(2 * n), np.arange(2 * n)] = 1.0
    positions = np.empty((W, K + 1, n, rates.shape[-1]))
    positions[:, 0] = X[:, :n]
    one = np.eye(2 * n)
    for k in range(K):
        F, G = np.zeros((W, 2 * n, 2 * n)), np.zeros_like(X)
        F[:, :n, n:] = np.eye(n)
        F[:, n:] = rates[:, k, :, : 2 * n]
        G[:, n:, 2 * n :] = rates[:, k, :, 2 * n :]
        h = half[:, k, None, None]
        X = np.linalg.solve(one - h * F, X + h * (F @ X) + 2.0 * h * G)
        positions[:, k + 1] = X[:, :n]
    return positions
