"""Identification with a plant that is no robot."""

from __future__ import annotations

import loops_of_plants
import pytest

import iblf_jax as ij


@pytest.mark.slow
def test_a_plant_that_is_no_robot_is_refused_with_the_remedy():
    scenario = loops_of_plants.flexible_joint()
    with pytest.raises(ValueError, match=r"scenario\.plant: got 'FlexibleJoint'.*plant\.robot"):
        ij.excitation(scenario, ["plant.stiffness"])
    with pytest.raises(ValueError, match=r"scenario\.plant: got 'MotorPendulum', expected a robot"):
        ij.identify(loops_of_plants.user_class(), {"t": [0.0]}, ["plant.D"])
