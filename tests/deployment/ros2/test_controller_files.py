"""The numbers in the files of a controller for ros2_control, which are written around the C of a
law; `test_ros2_control.py` compiles and runs them."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

import iblf_jax as ij
from iblf_jax.deployment.ros2.ros2_control import ros2_control_files

NO_PARAMETERS = SimpleNamespace(fields=())
NO_C = SimpleNamespace(files={"arm.h": "", "arm.c": ""}, parameters=NO_PARAMETERS)
DESCRIPTION = {
    "joints": ["shoulder", "elbow"],
    "has_joint_names": True,
    "reads_velocity": False,
    "torque_limits": [50.0, 20.0],
    "on_fault": "hold",
    "hold_stiffness": [3.0, 2.0],
    "hold_damping": [0.5, 0.25],
    "gains": [],
}


@pytest.mark.parametrize(("period", "rate"), [(1e-3, 1000), (2e-3, 500), (0.02, 50), (1 / 3, 3)])
def test_period_rate_joints_and_limits_are_those_of_the_law(period, rate):
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(period))
    law = SimpleNamespace(name="arm", scenario=scenario)
    found = ros2_control_files(law, NO_C, DESCRIPTION)
    source = found["src/law_controller.cpp"]
    assert f"kPeriod = {period!r};" in source
    assert f"kPeriodNanoseconds = {round(period * 1e9)};" in source
    assert f"kRate = {rate};" in source
    assert 'kNames = {"shoulder", "elbow"};' in source
    assert "kTorqueLimits = {50.0, 20.0};" in source
    assert "kHoldStiffness = {3.0, 2.0};" in source
    assert "kHoldDamping = {0.5, 0.25};" in source
    assert "kReadsVelocity = false;" in source
    parameters = found["config/controllers.yaml"]
    assert parameters.count(f"update_rate: {rate}\n") == 2
    assert "torque_limits: [50.0, 20.0]" in parameters
