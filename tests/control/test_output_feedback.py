"""Output feedback of robots: `StateObserver` against a program of its own in plain NumPy, its limit
for large bandwidths, limits of the estimates, and what a run reports about them."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import loop_on
from iblf_jax.observers import StateObserver
from independent_arm import TwoLinkArm
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax.core import notices
from iblf_jax.simulation.closed_loop import initial_state, rate
from iblf_jax.simulation.metrics import LevelEstimation, _positive_share

ARM = TwoLinkArm(mass=(1.2, 0.7), length=(0.4, 0.3), centre=(0.2, 0.16), inertia=(0.02, 0.01))
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
    angle = 1.5 * t + np.array([0.0, 0.4])
    q_d, dq_d, ddq_d = (0.3 + 0.2 * np.sin(angle), 0.3 * np.cos(angle), -0.45 * np.sin(angle))
    used = np.minimum(np.maximum(d_hat, -limit), limit)
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


@pytest.mark.release
def test_the_trajectory_with_an_active_limit():
    """To 1e-7 of DOP853, and the time of the limit and the peak of the error to 1e-4."""
    w, limit = 60.0, 5.0
    observer = StateObserver(
        bandwidth=w, offset=np.stack([np.zeros(2), V0]), disturbance_limit=limit
    )
    scenario = loop(observer)
    with notices.muted():
        run = ij.simulate(scenario, duration=0.5, dt=1e-4, record_every=100)
    q, v = np.array([0.45, 0.2]), np.array([0.1, 0.2])
    start = np.concatenate([q, v, q, v + V0, np.zeros(2)])
    field = partial(reference_rate, w, limit, np.zeros(2))
    times = np.linspace(0.0, 0.5, 50_001)
    found = solve_ivp(
        field, (0.0, 0.5), start, "DOP853", times, rtol=1e-11, atol=1e-12, max_step=1e-3
    )
    q, v, _, v_hat, d_hat = found.y.reshape(5, 2, -1)
    np.testing.assert_allclose(run.q[-1], q[:, -1], atol=1e-7)
    np.testing.assert_allclose(run.x_hat[-1, 1], v_hat[:, -1], atol=1e-6)
    active = np.mean(np.max(np.abs(d_hat), axis=0) > limit) * 0.5
    assert active > 0.02
    np.testing.assert_allclose(run.metrics["limited_time"], active, atol=3e-5)
    peak = run.metrics["peak_level_error"]
    np.testing.assert_allclose(peak[1], np.max(np.abs(v_hat - v), axis=1), rtol=1e-4)
    np.testing.assert_array_equal(peak[0], 0.0)
    assert dict(run.metrics.units)["peak_level_error"] == "rad; rad/s"


@pytest.mark.slow
def test_the_loop_tends_to_that_with_measured_velocity():
    """The deviation of q is proportional to 1/w for a high-gain observer, and for one that
    estimates the disturbance if its estimate is limited.  Without the limit it does not vanish,
    because the integral of the peak of d_hat does not depend on w."""
    bare = loop(ij.observers.NoObserver())
    offset = np.stack([np.zeros(2), V0])

    def run(scenario):
        with notices.muted():
            return np.asarray(ij.simulate(scenario, duration=0.4, dt=2.5e-4).q)

    measured = run(bare)

    def deviations(**fields):
        first = StateObserver(bandwidth=1.0, offset=offset, **fields)
        scenario = ij.with_parts(bare, observer=first)
        return [
            np.max(np.abs(run(ij.with_parameters(scenario, {"observer.bandwidth": w})) - measured))
            for w in (75.0, 150.0, 300.0)
        ]

    high_gain = deviations(disturbance=False)
    ratios = np.divide(high_gain[:-1], high_gain[1:])
    assert np.all((ratios > 1.7) & (ratios < 2.3)), high_gain
    limited = deviations(disturbance_limit=2.0)
    ratios = np.divide(limited[:-1], limited[1:])
    assert np.all((ratios > 1.4) & (ratios < 2.4)), limited
    unlimited = deviations()
    assert unlimited[-1] > 0.8 * unlimited[0] and unlimited[-1] > 3.0 * limited[-1]


def operations(scenario):
    """Number of operations of a step."""
    counts = ij.explain(scenario, varied=["initial.q"]).counts
    return sum(sum(counter.values()) for counter in counts.values())


@pytest.mark.slow
def test_output_feedback_costs_at_most_three_times_the_measured_velocity():
    bare = ij.with_parts(
        ij.presets.zhang_yan_2024(variant="corrected"), observer=ij.observers.NoObserver()
    )
    measured = operations(bare)
    for fields in ({"disturbance": False}, {"limit": 3.0, "disturbance_limit": 20.0}):
        observer = StateObserver(bandwidth=100.0, **fields)
        assert operations(ij.with_parts(bare, observer=observer)) < 3.0 * measured


def test_the_share_of_an_interval_with_a_positive_function():
    pairs = ((1.0, -3.0), (-3.0, 1.0), (2.0, 1.0), (-1.0, -2.0), (0.0, -1.0), (0.0, 2.0))
    expected = (0.25, 0.25, 1.0, 0.0, 0.0, 1.0)
    for (first, last), share in zip(pairs, expected, strict=True):
        found = _positive_share(jnp.asarray(first), jnp.asarray(last))
        assert float(found) == pytest.approx(share)


def test_limits_and_metrics_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"disturbance_limit.*disturbance=False"):
        StateObserver(bandwidth=9.0, disturbance=False, disturbance_limit=1.0)
    with pytest.raises(ValueError, match=r"observer\.limit.*2 rows"):
        loop(StateObserver(bandwidth=9.0, limit=(1.0, 2.0, 3.0)))
    with pytest.raises(ValueError, match="an observer of levels"):
        ij.simulate(
            loop(ij.observers.NoObserver()), duration=0.1, dt=1e-3, metrics=(LevelEstimation(),)
        )
