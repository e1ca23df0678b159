"""A user's scalar plant of order 2 with bounds on both levels,

    x1' = x2 + cos x1 - 0.5 exp(-x1^2),   x2' = u + cos(x1 x2),

under `BarrierBackstepping`, against a program of the same law in NumPy."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, plants, references

SIDES = (((-0.6, 0.8, 0.0), (0.9, 0.1, 0.5 * np.pi)), ((-1.0, 0.3, 0.0), (0.4, 0.1, 0.5 * np.pi)))
"""Offset, amplitude and phase of the lower and the upper bound of x1 and of x2."""
K = (2.0, 6.0)
START = (0.2, -0.3)


def drift(t, x):
    first = jnp.cos(x[0]) - 0.5 * jnp.exp(-(x[0] ** 2))
    return jnp.stack([first, jnp.cos(x[0] * x[1])])


def scenario(amplitude):
    """The plant with x_d = amplitude sin t."""
    sides = [
        [
            bounds.Sinusoid(offset=offset, amplitude=size, phase=phase)
            for offset, size, phase in level
        ]
        for level in SIDES
    ]
    mapping = barriers.TransformedError()
    return ij.Scenario(
        plant=plants.StrictFeedback(drift, lambda t, x: jnp.ones_like(x), n=1, order=2),
        reference=references.Sinusoid(offset=0.0, amplitude=amplitude),
        bounds=[ij.Bounds(*pair) for pair in sides],
        controller=controllers.BarrierBackstepping(k=K, barriers=(mapping, mapping)),
        initial=ij.Initial(x=[[START[0]], [START[1]]]),
    )


def mapped(i, t, x, centre, rate):
    """Error, slope and virtual velocity of `TransformedError` on row i, in NumPy."""
    (low, low_size, low_phase), (high, high_size, high_phase) = SIDES[i]
    k_l = centre - low - low_size * np.sin(t + low_phase)
    k_u = high + high_size * np.sin(t + high_phase) - centre
    dk_l = rate - low_size * np.cos(t + low_phase)
    dk_u = high_size * np.cos(t + high_phase) - rate
    e = x - centre
    room = (k_l + e) * (k_u - e)
    z, z_e = e * k_l * k_u / room, k_l * k_u * (k_l * k_u + e**2) / room**2
    z_t = e**2 * k_u / ((k_l + e) ** 2 * (k_u - e)) * dk_l
    z_t = z_t - e**2 * k_l / ((k_l + e) * (k_u - e) ** 2) * dk_u
    return e, z * z_e, rate - (K[i] * z + z_t) / z_e


def alone(t, x):
    """The closed loop for x_d = 0.3 sin t."""
    x1, x2 = x

    def first(t, x1):
        _, slope, rate = mapped(0, t, x1, 0.3 * np.sin(t), 0.3 * np.cos(t))
        return slope, rate - np.cos(x1) + 0.5 * np.exp(-(x1**2))

    dx1 = x2 + np.cos(x1) - 0.5 * np.exp(-(x1**2))
    slope, alpha = first(t, x1)
    step = 1e-30
    dalpha = first(t + 1j * step, x1 + 1j * step * dx1)[1].imag / step
    e2, s2, rate = mapped(1, t, x2, alpha, dalpha)
    return [dx1, rate - e2 / s2 * slope]


@pytest.mark.slow
def test_bounds_on_both_levels_are_kept_and_the_motion_is_that_of_the_other_program():
    run = ij.simulate(scenario(0.3), duration=8.0, dt=1e-3)
    assert run.ok, run
    x, t = np.asarray(run.x)[..., 0], np.asarray(run.t)
    for i, level in enumerate(SIDES):
        lower, upper = (offset + size * np.sin(t + phase) for offset, size, phase in level)
        assert np.all(lower < x[:, i])
        assert np.all(x[:, i] < upper)
    assert np.all(np.diff(run.V) < 1e-12)
    assert np.abs(run.e1[t > 7.0]).max() < 1e-3
    found = solve_ivp(alone, (0.0, 8.0), START, "DOP853", t_eval=t[::100], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(x[::100], found.y.T, atol=1e-7)
