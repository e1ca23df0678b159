"""The nonsingular terminal sliding mode against a program of its own in plain NumPy, its band and
its settling time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import loop_on
from independent_arm import TwoLinkArm
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax.core import notices
from iblf_jax.core.status import Status

ARM = TwoLinkArm(mass=(1.2, 0.7), length=(0.4, 0.3), centre=(0.2, 0.16), inertia=(0.02, 0.01))
LAW = {
    "beta": np.array([1.3, 0.8]),
    "K": np.array([25.0, 18.0]),
    "layer": np.array([0.02, 0.05]),
    "p": np.array([1.4, 1.7]),
    "smoothing": np.array([0.02, 0.05]),
}


def reference(t):
    """q_d, q_d' and q_d" of the loops here."""
    phase = np.array([0.0, 0.4])
    angle = 1.5 * t + phase
    return (0.3 + 0.2 * np.sin(angle), 0.3 * np.cos(angle), -0.45 * np.sin(angle))


def surface(law, e, v):
    """Sigma, and the derivative of g: g(v) = v (v^2 + delta^2)^((p-1)/2)."""
    p, delta = law["p"], law["smoothing"]
    g = v * (v * v + delta * delta) ** ((p - 1) / 2)
    dg = (v * v + delta * delta) ** ((p - 1) / 2) + (p - 1) * v * v * (v * v + delta * delta) ** (
        (p - 3) / 2
    )
    return e + g / law["beta"], dg


def torque(law, arm, t, q, dq, f_hat):
    """The law, from its equations."""
    q_d, dq_d, ddq_d = reference(t)
    e, v = q - q_d, dq - dq_d
    sigma, dg = surface(law, e, v)
    reaching = law["K"] * np.minimum(np.maximum(sigma / law["layer"], -1.0), 1.0)
    acceleration = ddq_d - law["beta"] * v / dg - reaching
    return arm.inverse_dynamics(q, dq, acceleration) - f_hat


def loop(law, **parts):
    """The scenario of this law on the arm of `ARM`."""
    return loop_on(ARM, ij.controllers.TerminalSlidingMode(**law), **parts)


def test_the_torque_at_random_states_and_parameters(rng):
    scenario = loop(LAW)

    @jax.jit
    def command(law, t, q, dq, f_hat):
        return law.command(t, q, dq, f_hat, scenario.context, ())[0].tau

    for _ in range(50):
        law = {
            "beta": rng.uniform(0.3, 3.0, 2),
            "K": rng.uniform(5.0, 50.0, 2),
            "layer": rng.uniform(0.01, 0.5, 2),
            "p": rng.uniform(1.1, 1.9, 2),
            "smoothing": rng.uniform(0.005, 0.1, 2),
        }
        t, f_hat = rng.uniform(0.0, 5.0), rng.normal(size=2)
        q, dq = rng.normal(size=2), rng.normal(size=2)
        part = ij.controllers.TerminalSlidingMode(**law)
        found = command(part, jnp.asarray(t), jnp.asarray(q), jnp.asarray(dq), jnp.asarray(f_hat))
        expected = torque(law, ARM, t, q, dq, f_hat)
        np.testing.assert_allclose(found, expected, atol=1e-12 * max(1.0, np.max(np.abs(expected))))


def push(t):
    """The disturbance torque of the loops here."""
    return np.array([0.3 * np.sin(3.0 * t), 0.1 * np.cos(2.0 * t)])


def solved(law, duration, q, dq):
    """The closed loop by DOP853, with `push`."""

    def rate(t, x):
        tau = torque(law, ARM, t, x[:2], x[2:], 0.0) + push(t)
        return np.concatenate([x[2:], ARM.acceleration(x[:2], x[2:], tau)])

    return solve_ivp(
        rate,
        (0.0, duration),
        np.concatenate([q, dq]),
        method="DOP853",
        rtol=1e-11,
        atol=1e-12,
        max_step=2e-3,
    )


@pytest.mark.release
def test_the_trajectory_and_the_band():
    """The run is that of DOP853 to 1e-7, and ends within (T.3), F being the largest component of
    M0^-1 f_tilde on it."""
    pushed = ij.disturbances.Sinusoids(
        amplitude=[0.3, 0.1], frequency=[3.0, 2.0], phase=[0.0, np.pi / 2]
    )
    scenario = loop(LAW, disturbance=pushed)
    run = ij.simulate(scenario, duration=2.0, dt=2e-4, record_every=100)
    found = solved(LAW, 2.0, np.array([0.45, 0.2]), np.array([0.1, 0.2]))
    np.testing.assert_allclose(run.q[-1], found.y[:2, -1], atol=1e-7)
    np.testing.assert_allclose(run.dq[-1], found.y[2:, -1], atol=1e-6)
    found = solved(LAW, 5.0, np.array([0.32, 0.37]), np.array([0.3, 0.27]))
    late = found.t > 4.0
    effects = [
        np.abs(np.linalg.solve(ARM.mass_matrix(x[:2]), push(t)))
        for t, x in zip(found.t[late], found.y.T[late], strict=True)
    ]
    sigma = LAW["layer"] * np.max(effects, axis=0) / LAW["K"]
    q_d, dq_d, _ = np.stack([reference(t) for t in found.t[late]], axis=1)
    e, v = found.y[:2, late].T - q_d, found.y[2:, late].T - dq_d
    assert np.all(np.abs(e) <= 1.01 * sigma)
    assert np.all(np.abs(v) <= (2.02 * LAW["beta"] * sigma) ** (1.0 / LAW["p"]))


@pytest.mark.parametrize(
    ("observer", "term"),
    [
        pytest.param(ij.observers.Momentum(kf=20.0), "f_tilde", marks=pytest.mark.slow),
        pytest.param(
            ij.observers.StateObserver(bandwidth=100.0, offset=(0.0, 0.3)),
            "tau(x_hat)",
            marks=pytest.mark.release,
        ),
    ],
    ids=["measured velocity", "estimated velocity"],
)
def test_certify_checks_the_claim_of_the_law(observer, term):
    """(T.2) is an equality; with estimated velocities the error of the estimates is a part of T."""
    pushed = ij.disturbances.Sinusoids(amplitude=[0.3, 0.1], frequency=3.0)
    scenario = loop(LAW, observer=observer, disturbance=pushed)
    certificate = ij.certify(scenario, duration=0.1, dt=2e-4)
    line = {line.name: line for line in certificate.lines}["inequality, own V"]
    assert line.verdict == "holds" and abs(line.margin) < 1e-10
    assert term in line.statement


def test_an_exponent_without_a_law_is_refused():
    for p in (1.0, 2.0, [1.5, 2.5]):
        with pytest.raises(ValueError, match=r"TerminalSlidingMode\.p.*1 < p < 2"):
            ij.controllers.TerminalSlidingMode(beta=1.0, K=20.0, layer=0.1, p=p)


@pytest.mark.slow
def test_a_sampled_loop_is_assessed_with_the_slope_of_the_layer():
    """Outside the layer the torque does not depend on the position, which says nothing about the
    period.  A layer that is too thin for the period is reported."""
    law = LAW | {"beta": 2.0, "K": 20.0, "layer": 0.05}
    start = ij.Initial(q=[0.8, 0.6], dq=[0.0, 0.0])
    wide = loop(law, initial=start, sampling=ij.Sampling(period=1e-3))
    tube = wide.context.tube(jnp.zeros(()))
    sigma, _ = surface(law, np.asarray(start.q) - tube.q_d, np.asarray(start.dq) - tube.dq_d)
    assert np.all(np.abs(sigma) > law["layer"])
    radii, reported = [], []
    for layer in (0.05, 1e-4):
        with notices.muted():
            run = ij.simulate(
                ij.with_parameters(wide, {"controller.layer": layer}), duration=0.1, dt=1e-3
            )
        radii.append(float(run.metrics.sampling_radius))
        reported.append(bool(int(run.status) & int(Status.SAMPLING_TOO_SLOW)))
    assert radii[0] < 1.0 < radii[1]
    assert reported == [False, True]


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrapped",
    [
        lambda law: ij.controllers.Saturated(law, limit=1e-3),
        lambda law: ij.controllers.Saturated(law, limit=1e-3, auxiliary=5.0, edge="smooth"),
        lambda law: ij.controllers.SafetyFilter(law, limit=30.0),
    ],
    ids=["limit", "auxiliary state", "filter"],
)
def test_limits_of_laws_within_others_are_left_out_of_the_linearisation(wrapped):
    """Wherever a limit is active the radius would be at least 1, that of an open loop."""
    law = LAW | {"beta": 2.0, "K": 20.0, "layer": 0.05}
    start = ij.Initial(q=[0.8, 0.6], dq=[0.0, 0.0])
    scenario = loop(law, initial=start, sampling=ij.Sampling(period=1e-3))
    scenario = ij.with_parts(scenario, controller=wrapped(scenario.controller))
    with notices.muted():
        run = ij.simulate(scenario, duration=0.02, dt=1e-3)
    assert float(run.metrics.sampling_radius) < 1.0
    assert not int(run.status) & int(Status.SAMPLING_TOO_SLOW)
