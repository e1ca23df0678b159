"""Disturbance observers: the error equations that they are said to obey, point by point and along a
run."""

from __future__ import annotations

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from iblf_jax.observers import AsPublished, Momentum, NoObserver
from iblf_jax.robots import mass_matrix_rate

import iblf_jax as ij
from iblf_jax.control.observers.none import observer_of_x
from iblf_jax.simulation.closed_loop import LoopState, evaluate
from iblf_jax.simulation.scenario import canonical


@pytest.fixture(scope="module")
def estimate_rate():
    """f_hat' along the closed loop, f - f_hat, and M0' q', at a state."""

    @jax.jit
    def at(scenario, t, q, dq, eta):
        state = LoopState(jnp.stack([q, dq]), (), eta)
        rate, sample = evaluate(scenario, t, state)

        def f_hat(q, dq, eta):
            return scenario.observer.estimate(t, q, dq, scenario.model, eta)

        _, df_hat = jax.jvp(f_hat, (q, dq, eta), (rate.q, rate.dq, rate.observer))
        return (
            df_hat,
            sample.disturbance - sample.disturbance_estimate,
            mass_matrix_rate(scenario.model, q, dq) @ dq,
        )

    return at


@pytest.mark.parametrize("payload", [0.0, 0.5], ids=["nominal", "unknown-payload"])
@pytest.mark.parametrize("kind", [Momentum, AsPublished])
def test_error_equation(estimate_rate, kind, payload, rng):
    """f_hat' = kf f_tilde: f_tilde' = f' - kf f_tilde exactly (momentum), and less kf M0' q' as
    printed."""
    base = ij.presets.zhang_yan_2024()
    kf = np.asarray([20.0, 12.0])
    plant = dataclasses.replace(base.plant, payload=payload)
    scenario = dataclasses.replace(base, plant=plant, observer=kind(kf=kf))
    for _ in range(5):
        q, dq, eta = rng.uniform(0.3, 0.7, 2), rng.normal(size=2), rng.normal(size=2)
        df_hat, f_tilde, rest = estimate_rate(
            scenario, jnp.asarray(0.4), *map(jnp.asarray, (q, dq, eta))
        )
        expected = kf * f_tilde + (kf * rest if kind is AsPublished else 0.0)
        np.testing.assert_allclose(df_hat, expected, rtol=1e-9, atol=1e-9)
        assert np.max(np.abs(rest)) > 1e-3


def test_the_momentum_observer_finds_a_constant_torque():
    """f' = 0: f_tilde decays as exp(-kf t); here the plant is driven open loop, off any law."""
    model, f, kf = ij.presets.customary_two_link(), jnp.asarray([0.7, -0.4]), 15.0
    observer = Momentum(kf=kf)

    @jax.jit
    def run():
        def slope(t, x):
            q, dq, eta = x
            tau = jnp.stack([3 * jnp.sin(5 * t), jnp.cos(3 * t)])
            ddq = jnp.linalg.solve(
                model.mass_matrix(q), tau + f - model.coriolis(q, dq, dq) - model.gravity(q)
            )
            return dq, ddq, observer.derivative(t, q, dq, tau, model, eta)

        def one(x, i):
            from iblf_jax.simulation.integrators import step

            t = i * 1e-3
            return step(
                "rk4", lambda t, x: (slope(t, x), None), t, x, 1e-3
            ).state, f - observer.estimate(t, x[0], x[1], model, x[2])

        q, dq = jnp.asarray([0.3, 0.2]), jnp.asarray([1.0, -0.5])
        return jax.lax.scan(one, (q, dq, observer.init(q, dq, model)), jnp.arange(400.0))[1]

    f_tilde = np.asarray(run())
    times = 1e-3 * np.arange(400)
    np.testing.assert_allclose(f_tilde, f_tilde[0] * np.exp(-kf * times)[:, None], atol=1e-7)


def test_no_observer_estimates_nothing():
    robot, drive = ij.presets.zhang_yan_2024(), ij.presets.motor_driven_two_link()
    for scenario, shape in ((robot, (2,)), (drive, (3, 2))):
        model = scenario.loop.model
        x = jnp.ones((model.order, 2))
        observer = observer_of_x(NoObserver())
        estimate = observer.estimate(0.0, x, model, ())
        assert estimate.shape == shape and not np.any(np.asarray(estimate))
        assert jax.tree.leaves(observer.init(x, model)) == []
    q = jnp.ones(2)
    assert not np.any(np.asarray(NoObserver().estimate(0.0, q, q, robot.model, ())))


def test_a_law_without_an_observer_is_not_advised_about_kf(paper):
    """Theorem 2 is about laws that use f_hat."""
    low = dataclasses.replace(paper, observer=ij.observers.Momentum(kf=0.4))
    with pytest.warns(UserWarning, match="Theorem 2 needs kf"):
        canonical(low)
    law = ij.controllers.AdaptiveRBF(k1=2.0, K2=20.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        canonical(dataclasses.replace(low, controller=law))
