"""Integrators: order conditions, measured order of convergence, stability limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from iblf_jax.simulation.integrators import TABLEAUS, step, tableau

methods = pytest.mark.parametrize("method", TABLEAUS)


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
