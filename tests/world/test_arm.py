"""Arms in space: MuJoCo's dynamics, the planar closed form, what they carry, names and checks."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import ARMS, REAL, as_mjcf, dynamics_of, random_arm, without_constraints
from hypothesis import given, settings
from hypothesis import strategies as st
from iblf_jax.robots import Arm, Payload, coriolis_from_mass_matrix
from members import TWO_LINK
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.simulation import paths
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.scenario import canonical

mujoco = pytest.importorskip("mujoco")


@jax.jit
def dynamics(arm, q, v):
    return arm.mass_matrix(q), arm.coriolis(q, v, v) + arm.gravity(q), arm.gravity(q)


@jax.jit
def everything(arm, q, v):
    return dynamics(arm, q, v)[:2], arm.pose(q), arm.twist_jacobian(q)


def relative(a, b) -> float:
    return float(np.max(np.abs(np.asarray(a) - b)) / np.max(np.abs(b)))


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_real_arms_have_the_dynamics_that_mujoco_gives(name):
    arm, rng, states = ij.robots.load(ARMS / REAL[name]), np.random.default_rng(0), 200
    model = without_constraints(mujoco.MjModel.from_xml_path(str(ARMS / REAL[name])))
    q, v = rng.uniform(-np.pi, np.pi, (states, arm.n)), rng.normal(size=(states, arm.n)) * 2
    found = jax.jit(jax.vmap(dynamics, (None, 0, 0)))(arm, q, v)
    for i, ours in enumerate(zip(*found, strict=True)):
        expected = *dynamics_of(model, q[i], v[i]), dynamics_of(model, q[i], 0 * v[i])[1]
        assert max(map(relative, ours, expected)) < 1e-9


@pytest.mark.slow
@settings(max_examples=25)
@given(n=st.sampled_from([1, 4, 7]), seed=st.integers(0, 2**32 - 1))
def test_random_chains_have_the_dynamics_that_mujoco_gives(n, seed):
    rng = np.random.default_rng(seed)
    arm = random_arm(n, seed, armature=rng.uniform(0, 0.2, n))
    model = without_constraints(mujoco.MjModel.from_xml_string(as_mjcf(arm)))
    q, v = rng.normal(size=(2, n))
    M, bias = dynamics_of(model, q, v)
    ours, pose, twist = everything(arm, q, v)
    assert relative(ours[0], M) < 1e-9 and relative(ours[1], bias) < 1e-9
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(pose.position, data.site("tip").xpos, atol=1e-12)
    np.testing.assert_allclose(pose.rotation, data.site("tip").xmat.reshape(3, 3), atol=1e-12)
    linear, angular = np.zeros((2, 3, n))
    mujoco.mj_jacSite(model, data, linear, angular, 0)
    np.testing.assert_allclose(twist, np.concatenate([linear, angular]), atol=1e-12)


@pytest.mark.slow
def test_momentum_and_inverse_dynamics_are_the_products_of_the_matrices(rng):
    load = Payload(mass=0.7, centre=[0.1, -0.2, 0.3], inertia=[0.1, 0.2, 0.2, 0.0, 0.0, 0.1])
    arm = dataclasses.replace(random_arm(4, 1), payload=0.4, carried=load, armature=0.1)
    q, v, u, a = jnp.asarray(rng.normal(size=(4, 4)))

    @jax.jit
    def differences(arm):
        M, rest = arm.mass_matrix(q), arm.gravity(q) + arm.mass_matrix(q) @ a
        christoffel = coriolis_from_mass_matrix(arm.mass_matrix, q, v, u)
        change = ij.robots.mass_matrix_rate(arm, q, v) @ v - arm.coriolis(q, v, v)
        return (
            arm.coriolis(q, v, u) - christoffel,
            arm.energy_gradient(q, v) - change,
            arm.momentum(q, v) - M @ v,
            arm.inverse_dynamics(q, v, u, a) - arm.coriolis(q, v, u) - rest,
            arm.inverse_dynamics(q, v, v, a) - arm.coriolis(q, v, v) - rest,
            # The form for one velocity and that for two.
            arm.coriolis(q, v, v) - arm.coriolis(q, v, 1.0 * v),
            arm.gravity(q) - jax.grad(arm.potential)(q),
        )

    for difference in differences(arm):
        np.testing.assert_allclose(difference, 0.0, atol=1e-12 * float(jnp.max(arm.mass_matrix(q))))


def two_link_in_space(**fields) -> Arm:
    """The paper's arm as an Arm: both axes along y, gravity down."""
    p, along, across = TWO_LINK, np.eye(3)[0], np.eye(6)[1]
    return Arm(
        mass=p.mass,
        centre=np.outer(p.centre, along),
        inertia=np.outer(p.inertia, across),
        position=np.outer([0.0, p.length[0]], along),
        axis=[0.0, -1.0, 0.0],
        tip_position=float(p.length[1]) * along,
        **fields,
    )


def scenario_with(plant) -> ij.Scenario:
    paper = ij.presets.zhang_yan_2024(variant="corrected")
    return dataclasses.replace(paper, plant=plant, model=two_link_in_space())


@pytest.mark.slow
def test_friction_of_the_joints_acts_on_the_plant_and_the_model_does_not_know_of_a_load():
    dq, found = np.array([0.3, -0.4]), []
    for friction in ({}, {"damping": [0.5, 0.2], "friction": 0.1}):
        scenario = canonical(scenario_with(two_link_in_space(**friction)))
        start = initial_state(scenario)
        state = start._replace(x=start.x.at[1].set(dq))
        found.append(np.asarray(evaluate(scenario, jnp.zeros(()), state)[0].dq))
    M = np.asarray(two_link_in_space().mass_matrix(jnp.asarray([0.8, 0.8])))
    expected = -(np.array([0.5, 0.2]) * dq + 0.1 * np.tanh(dq / 0.05))
    np.testing.assert_allclose(M @ (found[1] - found[0]), expected, atol=1e-12)
    picked = two_link_in_space(carried=Payload(mass=1.2, start=1.0))
    scenario = canonical(dataclasses.replace(scenario_with(picked), model=picked))
    state = initial_state(scenario)
    before, after = (evaluate(scenario, jnp.asarray(t), state)[1] for t in (0.5, 3.0))
    np.testing.assert_allclose(after.gravity, before.gravity)
    assert np.max(np.abs(after.disturbance - before.disturbance)) > 0.1, "what is picked up is in f"


def test_a_load_that_is_picked_up_has_its_share_of_all_moments():
    load = {"mass": 1.2, "centre": [0.0, 0.2, 0.1], "inertia": [0.01, 0.02, 0.015, 0.0, 0.0, 0.001]}
    held, picked = Payload(**load), Payload(**load, start=1.0, rise=0.2)
    for t, share in ((0.9, 0.0), (1.1, 0.5), (1.3, 1.0)):
        found = picked.at(jnp.asarray(t)).moments()
        np.testing.assert_allclose(found, share * held.moments(), rtol=1e-12, atol=1e-15)


def test_rows_have_names():
    named = two_link_in_space(links=("upper arm", "fore/arm"), joints=("shoulder", "elbow"))
    scenario = scenario_with(named)
    assert float(paths.get(scenario, "plant.link[fore/arm].mass")) == float(scenario.plant.mass[1])
    values = {"plant.link[fore/arm].centre[2]": 0.3, "plant.joint[elbow].damping": 0.7}
    changed = ij.with_parameters(scenario, values)
    assert float(changed.plant.centre[1, 2]) == 0.3 and float(changed.plant.damping[1]) == 0.7
    both = dataclasses.replace(scenario, model=scenario.plant)
    both = ij.with_parameters(both, {"robot.link[0].mass": 3.0})
    assert float(both.plant.mass[0]) == float(both.model.mass[0]) == 3.0
    listed = {p.path: p for p in ij.parameters(scenario)}
    assert listed["plant.link[fore/arm].mass"].unit == "kg"
    assert listed["plant.joint[shoulder].axis"].shape == (3,)
    assert not any("[elbow]" in p.path for p in ij.parameters(scenario, named=False))
    assert paths.sign_at(scenario, "plant.link[1].mass") == "nonnegative"
    assert paths.unit_at(scenario, "plant.joint[elbow].damping") == "N m s/rad"
    assert paths.sign_at(scenario, "plant.joint[elbow].effort") == "positive"


def test_unknown_rows_and_two_names_for_one_number_are_refused():
    scenario, some = scenario_with(two_link_in_space()), ij.factor(ij.uniform(0.7, 1.3))
    unknown = ("link[forearms].mass", "link[9].mass", "link[link1].damping", "link")
    for path in (*(f"plant.{row}" for row in unknown), "plant[link1].mass"):
        with pytest.raises(ValueError, match=rf"{re.escape(path)}.*expected the path of a leaf"):
            paths.get(scenario, path)
    assert_refused(r"plant\.link\[link1\]\.mass", paths.get, scenario, "plant.link[link7].mass")
    draws = {"plant.link[link2].mass": some, "plant.mass[1]": some}
    assert_refused("do not overlap", ij.monte_carlo, scenario, draws, runs=2, duration=0.1, dt=1e-3)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"centre": np.zeros((3, 3))}, "Arm.centre"),
        ({"inertia": np.zeros((2, 3))}, "Arm.inertia"),
        ({"axis": np.zeros((2, 3))}, "Arm.axis"),
        ({"kinds": ("revolute", "helical")}, "Arm.kinds"),
        ({"links": ("a", "a")}, "Arm.links"),
        ({"lower": 1.0, "upper": 0.0}, "Arm.lower"),
        ({"carried": 3.0}, "Arm.carried"),
    ],
)
def test_fields_that_do_not_fit_are_refused(fields, message):
    assert_refused(message, dataclasses.replace, two_link_in_space(), **fields)
