"""The robot of a scenario for MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import ROOT

import iblf_jax as ij

pytest.importorskip("mujoco", reason='needs the extra "robots"')
from iblf_jax.deployment.ros2.robot_model import plant_of

PAPER = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(1e-3))
CHAIN = ij.with_parts(
    PAPER,
    robot=ij.robots.PlanarChain(
        mass=[2.0, 0.8], length=[0.4, 0.3], centre=[0.2, 0.1], inertia=[0.05, 0.01]
    ),
)


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "payload"), [(PAPER, 0.4), (CHAIN, 0.0)])
def test_a_planar_arm_moves_in_mujoco_as_in_simulate(scenario, payload):
    scenario = ij.with_parameters(scenario, {"plant.payload": payload})
    plant, joints = plant_of(scenario, None, None)
    assert joints == ("joint_1", "joint_2")
    run = ij.simulate(scenario, duration=0.2, dt=1e-3)
    other = ij.cosimulate(scenario, plant, duration=0.2, dt=1e-3)
    np.testing.assert_allclose(other.q, run.q, atol=1e-8)
    np.testing.assert_allclose(other.disturbance, run.disturbance, atol=1e-7)
    if payload:  # of which the law does not know
        light = ij.simulate(PAPER, duration=0.2, dt=1e-3)
        assert np.max(np.abs(np.asarray(light.q - run.q))) > 1e-3


def test_the_joints_of_a_file_have_its_names_unless_others_are_given():
    file = ROOT / "examples" / "two_link.xml"
    assert plant_of(PAPER, file, None) == (file, ("shoulder", "elbow"))
    assert plant_of(PAPER, file, ["elbow", "shoulder"]) == (file, ("elbow", "shoulder"))
    with pytest.raises(ValueError, match=r"joints: got .*--joints"):
        plant_of(PAPER, file, ["elbow"])


@pytest.mark.slow
def test_a_robot_without_a_file_is_named():
    with pytest.raises(ValueError, match=r"plant: got 'Arm'.*--plant"):
        plant_of(ij.presets.ur5(), None, None)
