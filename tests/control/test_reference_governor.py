"""The reference governor beside an independent program, and what it keeps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import Loop
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import bounds, controllers
from iblf_jax.control.controllers.reference_governor import GovernorState
from iblf_jax.simulation.closed_loop import LoopState, initial_state, rate

LAWS = {
    "pd": controllers.PDGravity(Kp=[30.0, 10.0], Kd=[1.5, 0.3]),
    "computed_torque": controllers.ComputedTorque(Kp=[40.0, 30.0], Kd=3.0),
}
GOAL = (0.25, 0.8)


def scenario_of(law):
    """A step of the reference towards the walls; constant bounds, no disturbance."""
    rest = ij.references.Sinusoid(offset=GOAL, amplitude=0.0)
    walls = bounds.Bounds(lower=bounds.Constant([0.2, 0.15]), upper=bounds.Constant([0.9, 0.85]))
    parts = {"disturbance": ij.disturbances.Nothing(), "observer": ij.observers.NoObserver()}
    parts |= {"controller": law, "reference": rest, "bounds": walls}
    return ij.with_parts(ij.presets.zhang_yan_2024(), initial=ij.Initial([0.75, 0.3]), **parts)


def independent_rate(name, governor, x):
    q, v, g = x[:2], x[2:4], x[4:]
    M, C, G, _ = Loop().arm(q)
    Kp, Kd = (np.asarray(getattr(governor.law, k)) * np.ones(2) for k in ("Kp", "Kd"))
    low, high = np.array([0.2, 0.15]) + 0.02, np.array([0.9, 0.85]) - 0.02
    asked, stored = -Kp * (q - g) - Kd * v, 0.5 * np.sum(Kp * (q - g) ** 2)
    if name == "pd":
        tau, V = G + asked, 0.5 * v @ M @ v + stored
    else:
        tau, V = M @ asked + C(v) @ v + G, 0.5 * v @ v + stored
    distance = np.minimum(g - low, high - g)
    level = 0.5 * np.min(Kp * np.maximum(distance, 0) ** 2)
    away = np.asarray(GOAL) - g
    field = (
        away / max(np.linalg.norm(away), 0.02)
        + np.maximum(1 - (g - low) / 0.02, 0)
        - np.maximum(1 - (high - g) / 0.02, 0)
    )
    dg = float(governor.eta) * max(level - V, 0.0) * field
    return np.concatenate([v, Loop().acceleration(q, v, tau), dg])


@pytest.mark.parametrize("name", LAWS)
def test_the_vector_field_is_that_of_an_independent_program(name, rng):
    governor = controllers.ReferenceGovernor(law=LAWS[name])
    scenario, moved = scenario_of(governor), 0
    start = initial_state(scenario)

    @jax.jit
    def field(x, g):
        return rate(scenario, jnp.zeros(()), LoopState(x, start.controller._replace(g=g), ()))

    for _ in range(40):
        g = rng.uniform([0.2, 0.15], [0.9, 0.85])
        q, dq = g + rng.uniform(-0.05, 0.05, 2), rng.uniform(-0.2, 0.2, 2)
        found = field(jnp.stack([q, dq]), jnp.asarray(g))
        expected = independent_rate(name, governor, np.concatenate([q, dq, g]))
        rates = np.concatenate([found.q, found.dq, found.controller.g])
        np.testing.assert_allclose(rates, expected, rtol=1e-9, atol=1e-9)
        moved += np.any(expected[4:] != 0.0)
    assert 10 < moved < 40


@pytest.mark.slow
def test_V_stays_below_Gamma():
    governor = controllers.ReferenceGovernor(law=LAWS["pd"])
    run = ij.simulate(scenario_of(governor), duration=3.0, dt=1e-3)
    context, g = run.scenario.context, run.controller_state.g
    V = jax.vmap(lambda q, dq, g: governor.energy(q, dq, g, context))(run.q, run.dq, g)
    level = jax.vmap(lambda t, g: governor.level(t, g, context))(run.t, g)
    assert np.all(level * (1 + 1e-6) + 1e-12 >= V)
    assert float(jnp.max(jnp.abs(run.e1[-1]))) < 0.02  # and it gets there


def test_its_state_starts_inside_the_margin():
    governor = controllers.ReferenceGovernor(law=LAWS["pd"])
    state = governor.init(jnp.array([0.205, 0.5]), jnp.zeros(2), scenario_of(governor).context)
    assert isinstance(state, GovernorState)
    np.testing.assert_allclose(state.g, [0.22, 0.5])


def test_other_laws_are_refused():
    with pytest.raises(ValueError, match="a PDGravity or a ComputedTorque"):
        controllers.ReferenceGovernor(law=controllers.Backstepping(k1=2.0, K2=20.0))
    assert_refused(">= 0", controllers.ReferenceGovernor, law=LAWS["pd"], margin=-0.1)
