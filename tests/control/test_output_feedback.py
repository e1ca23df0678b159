"""Output feedback of robots: `StateObserver` against a program of its own in plain NumPy, its limit
for large bandwidths, limits of the estimates, and what a run reports about them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import loop_on
from iblf_jax.observers import StateObserver
from independent import Loop, sine

import iblf_jax as ij
from iblf_jax.core import notices
from iblf_jax.simulation.closed_loop import initial_state, rate
from iblf_jax.simulation.metrics import LevelEstimation, _positive_share

ARM = Loop(mass=(1.2, 0.7), length=(0.4, 0.3), centre=(0.2, 0.16), inertia=(0.02, 0.01))
KP, KD = np.array([40.0, 25.0]), np.array([12.0, 10.0])
V0 = np.array([0.4, -0.3])
"""Error of the estimated velocity at the start [rad/s]."""


def loop(observer, **parts):
    """Computed torque on the arm of `ARM`, which follows a sinusoid."""
    law = ij.controllers.ComputedTorque(Kp=KP, Kd=KD)
    return loop_on(ARM, law, observer=observer, **parts)


def reference_rate(w, limit, push, t, z):
    """The rate of (q, q', q_hat, v_hat, d_hat) of this loop, from its equations."""
    q, v, q_hat, v_hat, d_hat = z.reshape(5, 2)
    q_d, dq_d, ddq_d = sine(0.3, 0.2, 1.5, (0.0, 0.4))(t)
    used = np.clip(d_hat, -limit, limit)
    commanded = ddq_d - KD * (v_hat - dq_d) - KP * (q - q_d) - used
    tau = ARM.inverse_dynamics(q, v_hat, commanded)
    e = q - q_hat
    return np.concatenate([
        v,
        ARM.acceleration(q, v, tau + push),
        v_hat + 3.0 * w * e,
        ARM.acceleration(q, v_hat, tau) + d_hat + 3.0 * w**2 * e,
        w**3 * e,
    ])  # fmt: skip


def test_the_vector_field_at_random_states(rng):
    """To 1e-12 of its largest entry, with limits that are active at some states."""
    push = np.array([0.3, -0.2])
    pushed = ij.disturbances.Step(size=push, time=0.0)
    field = jax.jit(rate)
    for _ in range(20):
        w, limit = rng.uniform(10.0, 200.0, 2), rng.uniform(1.0, 4.0)
        observer = StateObserver(bandwidth=w, disturbance_limit=limit)
        scenario = loop(observer, disturbance=pushed)
        z, t = rng.normal(size=(5, 2)), rng.uniform(0.0, 3.0)
        z[4] *= 3.0
        state = initial_state(scenario)
        inner = state.observer._replace(x_hat=jnp.asarray(z[2:4]), d_hat=jnp.asarray(z[4])[None])
        state = state._replace(x=jnp.asarray(z[:2]), observer=inner)
        found = field(scenario, jnp.asarray(t), state)
        x_hat, d_hat = found.observer
        rates = np.concatenate([found.q, found.dq, *np.asarray(x_hat), d_hat[0]])
        expected = reference_rate(w, limit, push, t, z.reshape(-1))
        np.testing.assert_allclose(rates, expected, atol=1e-12 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_a_run_reports_for_how_long_a_limit_acted_and_the_largest_error_of_an_estimate():
    """Beside the estimates that it recorded."""
    limit, offset = 5.0, np.stack([np.zeros(2), V0])
    scenario = loop(StateObserver(bandwidth=60.0, offset=offset, disturbance_limit=limit))
    with notices.muted():
        run = ij.simulate(scenario, duration=0.4, dt=2.5e-4)
    active = np.mean(np.max(np.abs(run.observer_state.d_hat), axis=(1, 2)) > limit) * 0.4
    assert active > 0.02
    np.testing.assert_allclose(run.metrics["limited_time"], active, atol=5e-4)
    error = np.max(np.abs(run.x_hat - run.x), axis=0)
    np.testing.assert_allclose(run.metrics["peak_level_error"], error, rtol=1e-4)
    assert error[1].min() > 0.2
    assert dict(run.metrics.units)["peak_level_error"] == "rad; rad/s"


def test_the_share_of_an_interval_with_a_positive_function():
    pairs = ((1.0, -3.0), (-3.0, 1.0), (2.0, 1.0), (-1.0, -2.0), (0.0, -1.0), (0.0, 2.0))
    expected = (0.25, 0.25, 1.0, 0.0, 0.0, 1.0)
    for (first, last), share in zip(pairs, expected, strict=True):
        found = _positive_share(jnp.asarray(first), jnp.asarray(last))
        assert float(found) == pytest.approx(share)


def test_the_metric_of_estimates_needs_an_observer_of_levels():
    scenario = loop(ij.observers.NoObserver())
    with pytest.raises(ValueError, match="an observer of levels"):
        ij.simulate(scenario, duration=0.1, dt=1e-3, metrics=(LevelEstimation(),))
