"""The nonsingular terminal sliding mode: beside a program of its own, its claim, its layer."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import loop_on
from independent import Loop, sine

import iblf_jax as ij
from iblf_jax.core import notices
from iblf_jax.core.status import Status
from iblf_jax.engine.period import radius_at
from iblf_jax.simulation.scenario import canonical

ARM = Loop(mass=(1.2, 0.7), length=(0.4, 0.3), centre=(0.2, 0.16), inertia=(0.02, 0.01))
LAW = {"beta": [1.3, 0.8], "K": [25.0, 18.0], "layer": [0.02, 0.05]}
LAW |= {"p": np.array([1.4, 1.7]), "smoothing": np.array([0.02, 0.05])}
SAMPLED = LAW | {"beta": 2.0, "K": 20.0, "layer": 0.05}
WRAPPED = {
    "limit": partial(ij.controllers.Saturated, limit=1e-3),
    "auxiliary": partial(ij.controllers.Saturated, limit=1e-3, auxiliary=5.0, edge="smooth"),
    "filter": partial(ij.controllers.SafetyFilter, limit=30.0),
}
START = ij.Initial(q=[0.8, 0.6], dq=[0.0, 0.0])


def surface(law, e, v):
    """Sigma, and the derivative of g: g(v) = v (v^2 + delta^2)^((p-1)/2)."""
    p, square = law["p"], v * v + law["smoothing"] ** 2
    dg = square ** ((p - 1) / 2) + (p - 1) * v * v * square ** ((p - 3) / 2)
    return e + v * square ** ((p - 1) / 2) / law["beta"], dg


def torque(law, t, q, dq, f_hat):
    q_d, dq_d, ddq_d = sine(0.3, 0.2, 1.5, (0.0, 0.4))(t)
    v = dq - dq_d
    sigma, dg = surface(law, q - q_d, v)
    reaching = law["K"] * np.clip(sigma / law["layer"], -1.0, 1.0)
    return ARM.inverse_dynamics(q, dq, ddq_d - law["beta"] * v / dg - reaching) - f_hat


def loop(law, **parts):
    return loop_on(ARM, ij.controllers.TerminalSlidingMode(**law), **parts)


def test_the_torque_at_random_states_and_parameters(rng):
    scenario = loop(LAW)

    @jax.jit
    def command(law, t, q, dq, f_hat):
        return law.command(t, q, dq, f_hat, scenario.context, ())[0].tau

    ranges = {"beta": (0.3, 3.0), "K": (5.0, 50.0), "layer": (0.01, 0.5)}
    ranges |= {"p": (1.1, 1.9), "smoothing": (0.005, 0.1)}
    for _ in range(50):
        law = {name: rng.uniform(*ends, 2) for name, ends in ranges.items()}
        t, (q, dq, f_hat) = rng.uniform(0.0, 5.0), rng.normal(size=(3, 2))
        part = ij.controllers.TerminalSlidingMode(**law)
        found = command(part, *map(jnp.asarray, (t, q, dq, f_hat)))
        expected = torque(law, t, q, dq, f_hat)
        np.testing.assert_allclose(found, expected, atol=1e-12 * max(1.0, np.max(np.abs(expected))))


@pytest.mark.slow
def test_certify_checks_the_claim_of_the_law():
    """(T.2) is an equality; with estimated velocities the error of the estimates is a part of T."""
    pushed = ij.disturbances.Sinusoids(amplitude=[0.3, 0.1], frequency=3.0)
    observer = ij.observers.StateObserver(bandwidth=100.0, offset=(0.0, 0.3))
    scenario = loop(LAW, observer=observer, disturbance=pushed)
    line = ij.certify(scenario, duration=0.1, dt=2e-4)["inequality, own V"]
    assert line.verdict == "holds" and abs(line.margin) < 1e-10
    assert "tau(x_hat)" in line.statement


def test_an_exponent_without_a_law_is_refused():
    for p in (1.0, 2.0, [1.5, 2.5]):
        with pytest.raises(ValueError, match=r"TerminalSlidingMode\.p.*1 < p < 2"):
            ij.controllers.TerminalSlidingMode(beta=1.0, K=20.0, layer=0.1, p=p)


@pytest.mark.slow
def test_a_sampled_loop_is_assessed_with_the_slope_of_the_layer():
    """Outside the layer the torque does not depend on the position, which says nothing about it."""
    wide = loop(SAMPLED, initial=START, sampling=ij.Sampling(period=1e-3))
    tube = wide.context.tube(jnp.zeros(()))
    sigma, _ = surface(SAMPLED, np.asarray(START.q) - tube.q_d, np.asarray(START.dq) - tube.dq_d)
    assert np.all(np.abs(sigma) > SAMPLED["layer"])
    for layer, is_thin in ((0.05, False), (1e-4, True)):
        with notices.muted():
            scenario = ij.with_parameters(wide, {"controller.layer": layer})
            run = ij.simulate(scenario, duration=0.1, dt=1e-3)
        assert (float(run.metrics.sampling_radius) > 1.0) == is_thin, layer
        assert bool(int(run.status) & int(Status.SAMPLING_TOO_SLOW)) == is_thin, layer


@pytest.mark.slow
@pytest.mark.parametrize("name", WRAPPED)
def test_limits_of_laws_within_others_are_left_out_of_the_linearisation(name):
    """Wherever a limit is active the radius would be at least 1, that of an open loop."""
    scenario = loop(SAMPLED, initial=START, sampling=ij.Sampling(period=1e-3))
    scenario = canonical(ij.with_parts(scenario, controller=WRAPPED[name](scenario.controller)))
    assert radius_at(scenario, 1e-3, np.array([0.01, 0.02])) < 1.0
