"""The barrier on a surface: its torque by hand, what the surface implies for the error, and what it
refuses."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers

START, END, RATE = 6.0, 0.3, 1.0
FUNNEL = bounds.Bounds(
    lower=bounds.Funnel(-START, -END, RATE), upper=bounds.Funnel(START, END, RATE)
)


def scenario(**changes):
    law = controllers.SurfaceBarrier(a=2.0, K=[4.0, 8.0], surface=FUNNEL)
    width = (START - END) / (2.0 - RATE) + 1.0
    tube = bounds.Bounds(
        lower=bounds.Funnel(-width, -END / 2, RATE), upper=bounds.Funnel(width, END / 2, RATE)
    )
    parts = {
        "controller": law,
        "observer": ij.observers.NoObserver(),
        "bounds": tube,
        "initial": ij.Initial([1.5, -0.4], [1.0, 0.5]),
    }
    return ij.with_parts(ij.presets.zhang_yan_2024(law="pd"), **(parts | changes))


def test_its_torque_is_the_published_one():
    base, t = scenario(), 0.7
    q, dq = np.array([0.9, 0.2]), np.array([0.3, -0.8])
    command, _ = base.controller.command(
        jnp.asarray(t), jnp.asarray(q), jnp.asarray(dq), jnp.ones(2), base.context, ()
    )
    q_d, dq_d = (
        0.5 + 0.14 * np.array([np.sin(t), np.cos(t)]),
        0.14 * np.array([np.cos(t), -np.sin(t)]),
    )
    sigma, rho = dq - dq_d + 2.0 * (q - q_d), (START - END) * np.exp(-RATE * t) + END
    x, k = sigma / rho, np.array([1.0, 2.0])
    np.testing.assert_allclose(
        command.tau, -2 * k * np.log((1 + x) / (1 - x)) / ((1 - x**2) * rho), rtol=1e-12
    )
    np.testing.assert_allclose(dq - command.alpha, sigma, rtol=1e-12)


@pytest.mark.slow
def test_the_funnel_of_the_surface_is_one_of_the_error():
    run = ij.simulate(scenario(), duration=4.0, dt=1e-3)
    assert int(run.status) == 0
    sigma, t = np.asarray(run.dq - run.alpha), np.asarray(run.t)[:, None]
    assert np.all(np.abs(sigma) < (START - END) * np.exp(-RATE * t) + END)
    # e1' + a e1 = sigma, solved with |sigma| at its bound.
    implied = (
        np.exp(-2 * t) * np.abs(run.e1[0])
        + (START - END) * (np.exp(-t) - np.exp(-2 * t))
        + END / 2 * (1 - np.exp(-2 * t))
    )
    assert np.all(np.abs(run.e1) <= implied + 1e-9)


def test_what_it_refuses():
    with pytest.raises(
        ValueError, match=r"SurfaceBarrier\.surface: .*expected an iblf_jax.bounds.Bounds"
    ):
        controllers.SurfaceBarrier(a=2.0, K=4.0, surface=barriers.Log())
    with pytest.raises(ValueError, match=r"SurfaceBarrier\.barrier"):
        controllers.SurfaceBarrier(a=2.0, K=4.0, surface=FUNNEL, barrier=FUNNEL)
    for lower, upper in ((2.0, -2.0), (1.0, [2.0, 3.0]), (-1.0, [2.0, 0.0])):
        law = controllers.SurfaceBarrier(
            a=2.0, K=4.0, surface=bounds.Bounds(bounds.Constant(lower), bounds.Constant(upper))
        )
        with pytest.raises(
            ValueError, match=r"SurfaceBarrier\.surface: .*expected lower < 0 < upper at t = 0"
        ):
            ij.simulate(
                scenario(controller=controllers.SafetyFilter(law=law)), duration=0.1, dt=1e-3
            )
