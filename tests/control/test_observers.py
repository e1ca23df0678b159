"""Disturbance observers: the error equations that they are said to obey, point by point."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import members
import numpy as np
import pytest
from iblf_jax.observers import AsPublished, Momentum
from iblf_jax.robots import mass_matrix_rate
from jax.flatten_util import ravel_pytree

import iblf_jax as ij
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
        rest = mass_matrix_rate(scenario.model, q, dq) @ dq
        return df_hat, sample.disturbance - sample.disturbance_estimate, rest

    return at


POLES = {
    "printed": [-20.0, -10.0],
    "printed_matched": [-20.0, -20.0],
    "momentum": [-20.0, -10.0],
    "extended_state": [-40.0, -40.0, -30.0, -30.0],
    "extended_state_two_gains": [*np.roots([1.0, 80.0, 1600.0]), *np.roots([1.0, 80.0, 900.0])],
}
"""Member -> the poles that its docstring states for its gains."""


@pytest.mark.parametrize("name", sorted(members.OBSERVERS.keys() - {"none"}))
def test_an_observer_has_the_poles_that_it_states(name):
    """The characteristic polynomial of its rate, and of its exact step over a period."""
    observer, model, period = members.OBSERVERS[name], members.TWO_LINK, 4e-3
    q, dq, tau = jnp.asarray([[0.3, 0.5], [0.2, -0.4], [1.0, -2.0]])
    start, as_state = ravel_pytree(observer.init(q, dq, model))

    def rate(x):
        return ravel_pytree(observer.derivative(0.0, q, dq, tau, model, as_state(x)))[0]

    def after(x):
        state = observer.advance(0.0, q, dq, tau, model, as_state(x), jnp.asarray(period))
        return ravel_pytree(state)[0]

    both = jax.jit(lambda x: (jax.jacfwd(rate)(x), jax.jacfwd(after)(x)))
    of_rate, of_step = map(np.poly, both(start))
    np.testing.assert_allclose(of_rate, np.poly(POLES[name]), rtol=1e-9)
    poles = np.exp(period * np.asarray(POLES[name]))
    np.testing.assert_allclose(of_step, np.poly(poles), rtol=1e-9)


@pytest.mark.parametrize("payload", [0.0, 0.5], ids=["nominal", "unknown-payload"])
@pytest.mark.parametrize("kind", [Momentum, AsPublished])
def test_error_equation(estimate_rate, kind, payload, rng):
    """f_tilde' = f' - kf f_tilde exactly (momentum), and less kf M0' q' as printed."""
    base = ij.presets.zhang_yan_2024()
    kf, plant = np.asarray([20.0, 12.0]), dataclasses.replace(base.plant, payload=payload)
    scenario = dataclasses.replace(base, plant=plant, observer=kind(kf=kf))
    for _ in range(5):
        states = rng.uniform(0.3, 0.7, 2), rng.normal(size=2), rng.normal(size=2)
        df_hat, f_tilde, rest = estimate_rate(scenario, *map(jnp.asarray, (0.4, *states)))
        expected = kf * f_tilde + (kf * rest if kind is AsPublished else 0.0)
        np.testing.assert_allclose(df_hat, expected, rtol=1e-9, atol=1e-9)
        assert np.max(np.abs(rest)) > 1e-3


def test_a_law_without_an_observer_is_not_advised_about_kf(paper):
    """Theorem 2 is about laws that use f_hat."""
    low = dataclasses.replace(paper, observer=ij.observers.Momentum(kf=0.4))
    with pytest.warns(UserWarning, match="Theorem 2 needs kf"):
        canonical(low)
    law = ij.controllers.AdaptiveRBF(k1=2.0, K2=20.0)
    with warnings.catch_warnings(action="error"):
        canonical(dataclasses.replace(low, controller=law))
