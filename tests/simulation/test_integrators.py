"""Integrators: order conditions, measured order of convergence, stability limits."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax.simulation.closed_loop import initial_state, rate
from iblf_jax.simulation.integrators import TABLEAUS, step, tableau

methods = pytest.mark.parametrize("method", TABLEAUS)


@methods
def test_order_conditions(method):
    """Butcher's conditions up to the order that the table claims, and the first one beyond it
    fails."""
    table = tableau(method)
    s = len(table.b)
    a, b, c = np.zeros((s, s)), np.asarray(table.b), np.asarray(table.c)
    for i, row in enumerate(table.a):
        a[i, : len(row)] = row
    np.testing.assert_allclose(a.sum(axis=1), c)
    conditions = {
        1: [b.sum() - 1],
        2: [b @ c - 1 / 2],
        3: [b @ c**2 - 1 / 3, b @ a @ c - 1 / 6],
        4: [
            b @ c**3 - 1 / 4,
            (b * c) @ a @ c - 1 / 8,
            b @ a @ c**2 - 1 / 12,
            b @ a @ a @ c - 1 / 24,
        ],
        5: [b @ c**4 - 1 / 5],
    }
    for order in range(1, table.order + 1):
        np.testing.assert_allclose(conditions[order], 0, atol=1e-15)
    assert max(abs(x) for x in conditions[table.order + 1]) > 1e-3


@methods
def test_stability_limit(method):
    """y' = -y: the amplification of one step reaches 1 at the limit that the table states."""

    def factor(z):
        return abs(float(step(method, lambda t, y: (-y, None), 0.0, jnp.ones(()), z).state))

    limit = tableau(method).stability
    assert factor(0.999 * limit) < 1 < factor(1.001 * limit)


def order_of(method, slope, x0, exact, end, counts):
    """The slope of log error over log dt, the number of steps being traced so that it compiles
    once."""

    @jax.jit
    def solve(count):
        dt = end / count

        def one(i, x):
            t = i * dt
            return step(method, lambda t, x: (slope(t, x), None), t, x, dt).state

        return jax.lax.fori_loop(0, count, one, x0)

    errors = []
    for count in counts:
        off = jax.tree.map(lambda a, b: np.max(np.abs(a - b)), solve(count), exact)
        errors.append(max(jax.tree.leaves(off)))
    return np.polyfit(np.log(end / np.asarray(counts)), np.log(errors), 1)[0], errors


@methods
def test_order_on_a_nonlinear_problem_in_time(method):
    """A driven pendulum, against SciPy."""

    def rhs(t, x, xp=np):
        return xp.stack([x[1], -3 * xp.sin(x[0]) - 0.2 * x[1] * t + xp.cos(2 * t)])

    x0 = np.asarray([1.0, 0.5])
    exact = solve_ivp(rhs, (0, 1.5), x0, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    counts = [40, 80, 160, 320] if method == "rk4" else [200, 400, 800, 1600]
    order, _ = order_of(method, lambda t, x: rhs(t, x, jnp), jnp.asarray(x0), exact, 1.5, counts)
    assert order == pytest.approx(tableau(method).order, abs=0.15)


@pytest.mark.slow
@methods
def test_order_on_the_closed_loop(method):
    """Softer gains and a short stretch on which e1 keeps its sign, so that the loop is smooth."""
    scenario = ij.with_parameters(
        ij.presets.zhang_yan_2024(),
        {"controller.K2": 1.0, "observer.kf": 2.0, "initial.q": [0.8, 0.85]},
    )
    x0, end = initial_state(scenario), 0.05
    exact = _exact(scenario, x0, end)
    counts = [16, 32, 64, 128] if method == "rk4" else [200, 400, 800, 1600]
    order, errors = order_of(method, lambda t, x: rate(scenario, t, x), x0, exact, end, counts)
    assert order == pytest.approx(tableau(method).order, abs=0.2), errors


_EXACT = {}


def _exact(scenario, x0, end):
    """The state at the end by RK4 with 20,000 steps: its error is far below those that are
    measured."""
    if not _EXACT:

        @jax.jit
        def solve():
            dt = end / 20_000
            slope = lambda t, x: rate(scenario, t, x)  # noqa: E731
            return jax.lax.fori_loop(
                0,
                20_000,
                lambda i, x: step("rk4", lambda t, x: (slope(t, x), None), i * dt, x, dt).state,
                x0,
            )

        _EXACT["x"] = solve()
    return _EXACT["x"]


def test_a_step_on_a_tree_is_a_step_on_its_leaves():
    tree = {"a": jnp.ones(2), "b": (jnp.zeros(()),)}
    slope = lambda t, x: {"a": -x["a"], "b": (jnp.asarray(1.0),)}  # noqa: E731
    out = step("heun", lambda t, x: (slope(t, x), None), 0.0, tree, 0.1).state
    np.testing.assert_allclose(out["a"], 1 - 0.1 + 0.005)
    np.testing.assert_allclose(out["b"][0], 0.1)
