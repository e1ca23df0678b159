"""The reference governor: beside an independent program, and what it keeps where the law alone does
not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import Loop
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax import bounds, controllers
from iblf_jax.control.controllers.reference_governor import GovernorState

LAWS = {
    "pd": controllers.PDGravity(Kp=[30.0, 10.0], Kd=[1.5, 0.3]),
    "computed_torque": controllers.ComputedTorque(Kp=[40.0, 30.0], Kd=3.0),
}


def scenario_of(law, q=(0.75, 0.3), dq=(0.0, 0.0), goal=(0.25, 0.8)):
    """A step of the reference towards the walls; constant bounds, no disturbance."""
    rest = ij.references.Sinusoid(offset=goal, amplitude=0.0)
    walls = bounds.Bounds(lower=bounds.Constant([0.2, 0.15]), upper=bounds.Constant([0.9, 0.85]))
    parts = {"controller": law, "reference": rest, "bounds": walls, "initial": ij.Initial(q, dq)}
    return ij.with_parts(
        ij.presets.zhang_yan_2024(law="pd", variant="corrected"),
        **parts,
        disturbance=ij.disturbances.Nothing(),
    )


def independent_rate(name, governor, goal, x):
    """The rate of (q, q', g), from the equations alone."""
    q, v, g = x[:2], x[2:4], x[4:]
    M, C, G, _ = Loop().arm(q)
    Kp, Kd = (np.asarray(getattr(governor.law, k)) * np.ones(2) for k in ("Kp", "Kd"))
    low, high = np.array([0.2, 0.15]) + 0.02, np.array([0.9, 0.85]) - 0.02
    if name == "pd":
        tau, V = G - Kp * (q - g) - Kd * v, 0.5 * v @ M @ v + 0.5 * np.sum(Kp * (q - g) ** 2)
    else:
        tau, V = (
            M @ (-Kp * (q - g) - Kd * v) + C(v) @ v + G,
            0.5 * v @ v + 0.5 * np.sum(Kp * (q - g) ** 2),
        )
    distance = np.minimum(g - low, high - g)
    level = 0.5 * np.min(Kp * np.maximum(distance, 0) ** 2)
    away = np.asarray(goal) - g
    field = (
        away / max(np.linalg.norm(away), 0.02)
        + np.maximum(1 - (g - low) / 0.02, 0)
        - np.maximum(1 - (high - g) / 0.02, 0)
    )
    acceleration = np.linalg.solve(M, tau - C(v) @ v - G)
    return np.concatenate([v, acceleration, float(governor.eta) * max(level - V, 0.0) * field])


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LAWS))
def test_the_run_is_that_of_an_independent_program(name):
    governor = controllers.ReferenceGovernor(law=LAWS[name])
    scenario, t = scenario_of(governor), np.linspace(0.0, 3.0, 61)
    start = [0.75, 0.3, 0, 0, 0.75, 0.3]
    how = {"method": "DOP853", "t_eval": t, "rtol": 1e-10, "atol": 1e-12}
    found = solve_ivp(
        lambda t, x: independent_rate(name, governor, (0.25, 0.8), x), (0, 3.0), start, **how
    )
    run = ij.simulate(scenario, duration=3.0, dt=2.5e-4, record_every=200)
    np.testing.assert_allclose(run.q, found.y[:2].T, atol=1e-7)
    np.testing.assert_allclose(run.controller_state.g, found.y[4:].T, atol=1e-7)


@pytest.mark.slow
def test_it_keeps_what_the_law_alone_breaks_from_random_starts():
    law = LAWS["computed_torque"]
    governor = controllers.ReferenceGovernor(law=law)
    perturbations = {
        "initial.q": ij.value(ij.uniform([0.3, 0.25], [0.8, 0.75])),
        "initial.dq": ij.value(ij.uniform(-0.3, 0.3)),
    }
    options = {"runs": 300, "duration": 3.0, "dt": 1e-3, "progress": False, "seed": 5}
    alone, governed = (
        ij.monte_carlo(scenario_of(x), perturbations, **options) for x in (law, governor)
    )
    scenario = scenario_of(governor)

    def inside(q, dq):  # V <= Gamma at the start
        g = governor.init(q, dq, scenario.context).g
        return governor.energy(q, dq, g, scenario.context) <= governor.level(
            jnp.zeros(()), g, scenario.context
        )

    fine = np.asarray(
        jax.vmap(inside)(governed.samples["initial.q"], governed.samples["initial.dq"])
    )
    assert np.sum(fine) > 100
    assert np.all(
        np.asarray(governed.metrics["margin"])[fine] > 0.0199
    )  # the margin of 0.02 is kept, but for the steps
    assert np.mean(np.min(np.asarray(alone.metrics["margin"])[fine], axis=1) < 0) > 0.3


@pytest.mark.slow
def test_V_stays_below_Gamma():
    governor = controllers.ReferenceGovernor(law=LAWS["pd"])
    run = ij.simulate(scenario_of(governor), duration=3.0, dt=1e-3)
    context = run.scenario.context
    V = jax.vmap(lambda q, dq, g: governor.energy(q, dq, g, context))(
        run.q, run.dq, run.controller_state.g
    )
    level = jax.vmap(lambda t, g: governor.level(t, g, context))(run.t, run.controller_state.g)
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
    with pytest.raises(ValueError, match=">= 0"):
        dataclasses.replace(controllers.ReferenceGovernor(law=LAWS["pd"]), margin=-0.1)
