"""The robot of a scenario for MuJoCo: its file, or the MJCF of a planar arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.deployment.mujoco_plant import LEAST_INERTIA, MujocoPlant, MujocoSource
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world.plants import declared_joints
from iblf_jax.world.robots import PlanarChain, TwoLink
from iblf_jax.world.robots.tree import mujoco_package

MIN_RADIUS = 0.01
"""Of the capsules that are drawn for the links [m]."""


def plant_of(
    scenario: Scenario, plant: MujocoSource | None, joints: Sequence[str] | None
) -> tuple[Any, tuple[str, ...]]:
    """A robot for MuJoCo and the names of its joints.

    Args:
      scenario: the scenario.
      plant: MJCF or URDF; None for the scenario's own planar arm.
      joints: the names; None for those of the scenario, or of the file in its order if the
        scenario's joints have none.

    Raises:
      ValueError: a scenario whose robot has no description here, or a file that has other joints.
    """
    if plant is None:
        plant = mujoco_package().MjSpec.from_string(planar_mjcf(scenario.plant))
    names = tuple(joints or declared_joints(scenario.plant))
    if not names:
        names = MujocoPlant(plant, (), scenario.n, {}, None).joint_names
    if len(names) == scenario.n:
        return plant, names
    remedy = "Name the joints of the file in the order of the scenario: --joints shoulder elbow."
    raise checks.fail("joints", list(names), f"{scenario.n} names", remedy)


def planar_mjcf(robot: Any) -> str:
    """The MJCF of a planar arm: gravity along -y, hinges about z, a point mass as payload.

    Raises:
      ValueError: another robot.
    """
    if not isinstance(robot, TwoLink | PlanarChain):
        remedy = "Give the file of the robot: --plant arm.urdf, or plant=..."
        expected = "a planar arm where no file is given"
        raise checks.fail("plant", type(robot).__name__, expected, remedy)
    columns = (robot.mass, robot.length, robot.centre, robot.inertia)
    links = list(zip(*(np.asarray(x, float).tolist() for x in columns), strict=True))
    inner = ""
    payload = float(robot.payload)
    if payload > 0:
        tip = f"<inertial pos='0 0 0' mass='{payload!r}' diaginertia='1e-12 1e-12 1e-12'/>"
        inner = f"<body name='payload' pos='{links[-1][1]!r} 0 0'>{tip}</body>"
    for i in reversed(range(len(links))):
        mass, length, centre, inertia = links[i]
        start = 0.0
        if i > 0:
            start = links[i - 1][1]
        radius = max(0.05 * length, MIN_RADIUS)
        moment = max(inertia, LEAST_INERTIA)
        inner = (
            f"<body name='link_{i + 1}' pos='{start!r} 0 0'>"
            f"<joint name='joint_{i + 1}' axis='0 0 1'/>"
            f"<inertial pos='{centre!r} 0 0' mass='{mass!r}'"
            f" diaginertia='{moment!r} {moment!r} {moment!r}'/>"
            f"<geom type='capsule' fromto='0 0 0 {length!r} 0 0' size='{radius!r}'"
            " contype='0' conaffinity='0'/>"
            f"{inner}</body>"
        )
    return (
        "<mujoco><compiler angle='radian'/>"
        f"<option timestep='0.0005' gravity='0 {-float(robot.g)!r} 0'/>"
        f"<worldbody>{inner}</worldbody></mujoco>"
    )
