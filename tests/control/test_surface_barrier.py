"""The barrier on a surface: its torque by hand, what the surface implies for the error, and what it
refuses."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from independent import Loop, sine

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers

START, END, RATE = 6.0, 0.3, 1.0
FUNNEL = bounds.Bounds(bounds.Funnel(-START, -END, RATE), bounds.Funnel(START, END, RATE))


def scenario(**changes):
    law = controllers.SurfaceBarrier(a=2.0, K=[4.0, 8.0], surface=FUNNEL)
    width = (START - END) / (2.0 - RATE) + 1.0
    sides = (bounds.Funnel(sign * width, sign * END / 2, RATE) for sign in (-1.0, 1.0))
    tube = bounds.Bounds(*sides)
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
    arguments = map(jnp.asarray, (t, q, dq, np.ones(2)))
    command, _ = base.controller.command(*arguments, base.context, ())
    q_d, dq_d, _ = sine(*Loop().reference)(t)
    sigma, rho = dq - dq_d + 2.0 * (q - q_d), (START - END) * np.exp(-RATE * t) + END
    x, k = sigma / rho, np.array([1.0, 2.0])
    expected = -2 * k * np.log((1 + x) / (1 - x)) / ((1 - x**2) * rho)
    np.testing.assert_allclose(command.tau, expected, rtol=1e-12)
    np.testing.assert_allclose(dq - command.alpha, sigma, rtol=1e-12)


@pytest.mark.slow
def test_the_funnel_of_the_surface_is_one_of_the_error():
    run = ij.simulate(scenario(), duration=4.0, dt=1e-3)
    assert int(run.status) == 0
    sigma, t = np.asarray(run.dq - run.alpha), np.asarray(run.t)[:, None]
    assert np.all(np.abs(sigma) < (START - END) * np.exp(-RATE * t) + END)
    # e1' + a e1 = sigma, solved with |sigma| at its bound.
    fading, fast = np.exp(-t), np.exp(-2 * t)
    implied = fast * np.abs(run.e1[0]) + (START - END) * (fading - fast) + END / 2 * (1 - fast)
    assert np.all(np.abs(run.e1) <= implied + 1e-9)


def of(surface, **fields):
    return controllers.SurfaceBarrier(a=2.0, K=4.0, surface=surface, **fields)


def run_between(lower, upper):
    law = of(bounds.Bounds(bounds.Constant(lower), bounds.Constant(upper)))
    filtered = controllers.SafetyFilter(law=law)
    return ij.simulate(scenario(controller=filtered), duration=0.1, dt=1e-3)


NOT_BETWEEN = r"SurfaceBarrier\.surface: .*expected lower < 0 < upper at t = 0"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: of(barriers.Log()), r"Barrier\.surface: .*expected an iblf_jax.bounds.Bounds"),
        (lambda: of(FUNNEL, barrier=FUNNEL), r"SurfaceBarrier\.barrier"),
        (lambda: run_between(1.0, [2.0, 3.0]), NOT_BETWEEN),
        (lambda: run_between(-1.0, [2.0, 0.0]), NOT_BETWEEN),
    ],
)
def test_what_it_refuses(make, words):
    with pytest.raises(ValueError, match=words):
        make()
