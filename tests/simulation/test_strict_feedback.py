"""Closed loops of plants in strict-feedback form against the independent program."""

import dataclasses

import chain_cases
import independent_chains as other
import jax.numpy as jnp
import numpy as np
import pytest
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import bounds, controllers, plants

DATA = np.load(other.FILE)
WALL = ij.Bounds(lower=bounds.Constant(-1.0), upper=bounds.Constant(1.0))
STEPS = {"flexible": 2e-4, "surface": 5e-4, "coupled": 1e-3}
"""Cases whose runs are compared; `test_event_trigger` has the pendulum."""


def closed_loop(name: str) -> ij.Scenario:
    return chain_cases.scenario(name, observer=ij.observers.LevelObserver(other.CASES[name].kappa))


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
def test_equal_to_the_independent_program(name):
    """Every fifth instant of its run: states, input, estimates, sum w_i V_i, what x_i follows
    (alpha_{i-1}, filtered on a surface), and d_i, the disturbance where plant and model agree."""
    run = {key: DATA[f"{name}.run.{key}"][::5] for key in ("x", "u", "d_hat", "V", "alpha")}
    filtered = DATA["surface.run.beta"][::5]
    how = {"dt": STEPS[name], "record_every": round(0.05 / STEPS[name])}
    found = ij.simulate(closed_loop(name), duration=4.0, throw=True, **how)
    np.testing.assert_allclose(found.x, run["x"], rtol=1e-8, atol=2e-8)
    np.testing.assert_allclose(found.tau, run["u"], rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(found.disturbance_estimate, run["d_hat"], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.V, run["V"], rtol=1e-6, atol=1e-9)
    followed = filtered if name == "surface" else run["alpha"][:, :-1]
    np.testing.assert_allclose((found.x - found.e)[:, 1:], followed, rtol=1e-6, atol=1e-6)
    d = [other.CASES[name].disturbance(float(t), x) for t, x in zip(found.t, found.x, strict=True)]
    np.testing.assert_allclose(found.disturbance, d, atol=1e-10)


@pytest.mark.slow
def test_a_flexible_joint_starts_at_the_equilibrium_of_its_springs():
    start = ij.Initial(q=other.ARM_START, dq=[0.1, 0.0])
    scenario = chain_cases.scenario("flexible", initial=start)
    run = ij.simulate(scenario, duration=0.01, dt=1e-3)
    gravity = np.asarray(scenario.plant.robot.gravity(jnp.asarray(other.ARM_START)))
    np.testing.assert_allclose(run.x[0, 2], other.ARM_START + gravity / other.STIFFNESS)
    np.testing.assert_allclose(run.x[0, 3], [0.1, 0.0])
    field = ij.vector_field(scenario)
    assert "x[2, 0]" in field.names and field.unpack(field.start).x.shape == (4, 2)


def test_bounds_have_one_entry_for_each_level():
    """A single Bounds replaces that of the first level."""
    preset = ij.presets.motor_driven_pendulum()
    first, second, third = preset.bounds
    parts = {"controller": controllers.BarrierBackstepping(k=(2.0, 15.0, 60.0))}
    for given, expected in (
        ((first, None, third), (first, None, third)),
        ([first, second], (first, second, None)),
        ((first,), (first, None, None)),
    ):
        changed = ij.with_parts(preset, bounds=given, **parts)
        assert changed.bounds == changed.context.bounds == expected
    assert dataclasses.replace(preset, bounds=second, **parts).bounds == (second, None, None)
    arm, law = ij.presets.flexible_joint_two_link(), controllers.BarrierBackstepping(k=(2.0, 10.0))
    given = (*arm.bounds[:2], None, None)
    rigid = ij.with_parts(arm, robot=arm.plant.robot, bounds=given, controller=law)
    assert rigid.bounds == arm.bounds[:2]
    for one in (ij.presets.zhang_yan_2024_full_state(), preset):
        changed = ij.with_parts(one, bounds=WALL)
        np.testing.assert_array_equal(changed.bounds[0].upper.value, 1.0)
        assert changed.bounds[1:] == one.bounds[1:]


def test_bounds_that_are_refused():
    preset = ij.presets.motor_driven_pendulum()
    for given, message in (
        ((WALL,) * 4, r"bounds: got '4 bounds', expected at most 3, for the levels 1 to 3"),
        ((WALL, 2.0), r"bounds\[1\]: got 2\.0?, expected a Bounds, or None for a level without"),
        ((None, WALL), r"bounds\[0\]: got None, expected the bounds of the first level"),
        ((), r"bounds\[0\]: got None, expected the bounds of the first level"),
        (2.0, r"bounds: got 2\.0?, expected a Bounds, .*, or a tuple of one for each level"),
    ):
        assert_refused(rf"Scenario\.{message}", ij.with_parts, preset, bounds=given)


def test_paths_of_earlier_versions_lead_to_the_bounds_of_levels():
    preset = ij.presets.motor_driven_pendulum()
    paths = {
        "bounds.lower.value": "bounds[0].lower.value",
        "velocity_bounds.upper.value": "bounds[1].upper.value",
        "state_bounds[0].lower.value[0]": "bounds[1].lower.value[0]",
        "state_bounds[1].upper.value": "bounds[2].upper.value",
    }
    for i, (earlier, path) in enumerate(paths.items()):
        value = 3.0 + 0.1 * i
        changed = ij.with_parameters(preset, {earlier: value})
        assert float(jnp.ravel(ij.paths.get(changed, path))[0]) == value
        assert ij.paths.get(changed, earlier) == ij.paths.get(changed, path)
        assert ij.paths.unit_at(preset, earlier) == ij.paths.unit_at(preset, path)
    with pytest.raises(ValueError, match=r"'bounds\.lower\.valu'.*Did you mean bounds\[0\]\.lower"):
        ij.with_parameters(preset, {"bounds.lower.valu": 1.0})


@pytest.mark.slow
def test_a_rigid_law_on_stiff_joints_tends_to_the_robot_with_motors():
    """With first order in 1/K, with the inertia of the motors in the model."""
    paper = ij.presets.zhang_yan_2024(variant="corrected")
    law = controllers.Backstepping(k1=2.0, K2=[4.0, 0.6], o=0.1, variant="corrected")
    parts = {"controller": law, "observer": ij.observers.NoObserver()}

    def end(stiffness):
        motors = {"motor_inertia": [0.1, 0.02], "motor_damping": [2.0, 0.5]}
        plant = plants.FlexibleJoint(paper.plant, stiffness=stiffness or 1.0, **motors)
        parts["model"] = plant.rigid()
        scenario = ij.with_parts(paper, plant=plant if stiffness else parts["model"], **parts)
        return ij.simulate(scenario, duration=0.4, dt=2e-4, record_every=20).q

    errors = np.array([np.max(np.abs(end(K) - end(None))) for K in (2e3, 4e3, 8e3, 16e3)])
    assert np.all(np.abs(np.log2(errors[:-1] / errors[1:]) - 1.0) < 0.15), errors
    assert errors[-1] < 5e-4
