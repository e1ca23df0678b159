"""Runs of plants in strict-feedback form by every executor, their derivatives, and the tools that
choose a step or a period."""

import jax
import jax.numpy as jnp
import loops_of_plants
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.engine.structural_constants import robot_constants
from iblf_jax.simulation.paths import get

SHORT = {"duration": 0.3, "dt": 1e-3}
CASES = loops_of_plants.CASES


@pytest.mark.slow
def test_derivatives_by_leaves_are_differences():
    """In one program for the gradient by all of them, and one for the derivative along all."""
    scenario = CASES["flexible joint"]()
    paths = ("plant.stiffness", "model.motor_inertia", "controller.k[2]", "initial.q")
    start = {path: jnp.asarray(get(scenario, path)) for path in paths}

    def error(values):
        run = ij.simulate(ij.with_parameters(scenario, values), **SHORT)
        return 1e4 * jnp.sum(run.e1[-1] ** 2)

    reverse = {path: jnp.sum(x) for path, x in jax.grad(error)(start).items()}
    forward = jax.jvp(error, (start,), (jax.tree.map(jnp.ones_like, start),))[1]
    np.testing.assert_allclose(sum(reverse.values()), forward, rtol=1e-9)
    for path, x in start.items():
        size = 1e-6 * max(1.0, float(jnp.max(jnp.abs(x))))
        ends = [error(start | {path: x + sign * size}) for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2.0 * size)
        np.testing.assert_allclose(reverse[path], slope, rtol=1e-3, atol=1e-6, err_msg=path)


@pytest.mark.slow
def test_the_error_of_a_sampled_loop_includes_all_levels():
    sampled = CASES["electric drive"](
        sampling=ij.Sampling(2e-3), actuator=ij.actuators.Motor(bandwidth=300.0, limit=60.0)
    )
    run, finer = (ij.simulate(sampled, duration=0.2, dt=dt) for dt in (2e-3, 1e-4))
    error = float(jnp.max(jnp.abs(run.q[-1] - finer.q[-1])))
    assert 0.1 * error < float(jnp.max(run.metrics.numerical_error)) < 1e-3


@pytest.mark.slow
def test_the_geometry_of_the_robot_inside_a_plant_is_compiled_in():
    arm = ij.robots.Arm(
        mass=[2.0, 1.0],
        centre=[[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]],
        inertia=[[0.02, 0.03, 0.03, 0.0, 0.0, 0.0], [0.01, 0.01, 0.02, 0.0, 0.0, 0.0]],
        position=[[0.0, 0.0, 0.3], [0.4, 0.0, 0.0]],
        axis=[[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]],
    )
    plant = ij.plants.FlexibleJoint(arm, stiffness=300.0, motor_inertia=0.02)
    rigid, flexible, mixed = (
        [x.value for x in robot_constants(scenario).numbers if x is not None]
        for scenario in (
            loops_of_plants.rigid_law(plant=arm, model=arm),
            loops_of_plants.flexible_joint(plant=plant),
            loops_of_plants.rigid_law(plant=plant, model=arm),
        )
    )
    assert rigid == flexible == mixed
    assert robot_constants(loops_of_plants.user_class()) is None
