"""Integrators: order conditions, measured order of convergence, stability limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from iblf_jax.simulation.integrators import TABLEAUS, step, tableau

methods = pytest.mark.parametrize("method", TABLEAUS)


@methods
def test_order_conditions(method):
    """Butcher's conditions hold up to the order that the table claims, and not beyond."""
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
        4: [b @ c**3 - 1 / 4, (b * c) @ a @ c - 1 / 8, b @ a @ c**2 - 1 / 12],
        5: [b @ c**4 - 1 / 5],
    }
    conditions[4].append(b @ a @ a @ c - 1 / 24)
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


@methods
def test_order_on_a_nonlinear_problem_in_time(method):
    """A driven pendulum, against SciPy.  Orders of the closed loop are in `test_step_size`."""

    def rhs(t, x, xp=np):
        return xp.stack([x[1], -3 * xp.sin(x[0]) - 0.2 * x[1] * t + xp.cos(2 * t)])

    def slope(t, x):
        return rhs(t, x, jnp), None

    x0, end = np.asarray([1.0, 0.5]), 1.5
    exact = solve_ivp(rhs, (0, end), x0, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    counts = [40, 80, 160, 320] if method == "rk4" else [200, 400, 800, 1600]

    @jax.jit
    def solve(count):
        dt = end / count
        return jax.lax.fori_loop(
            0, count, lambda i, x: step(method, slope, i * dt, x, dt).state, jnp.asarray(x0)
        )

    errors = [np.max(np.abs(solve(count) - exact)) for count in counts]
    order = np.polyfit(np.log(end / np.asarray(counts)), np.log(errors), 1)[0]
    assert order == pytest.approx(tableau(method).order, abs=0.15)
