"""Robots: the plant that moves and the model that the law knows.  The contract is the
base class `Robot`.
"""

from iblf_jax.world.robots._base import Dynamics as Dynamics
from iblf_jax.world.robots._base import Limits as Limits
from iblf_jax.world.robots._base import Robot as Robot
from iblf_jax.world.robots._base import at_time as at_time
from iblf_jax.world.robots._base import coriolis_from_mass_matrix as coriolis_from_mass_matrix
from iblf_jax.world.robots._base import energy_gradient as energy_gradient
from iblf_jax.world.robots._base import friction_torque as friction_torque
from iblf_jax.world.robots._base import from_energy as from_energy
from iblf_jax.world.robots._base import inverse_dynamics as inverse_dynamics
from iblf_jax.world.robots._base import joint_names as joint_names
from iblf_jax.world.robots._base import mass_matrix_rate as mass_matrix_rate
from iblf_jax.world.robots._base import momentum as momentum
from iblf_jax.world.robots.arm import Arm as Arm
from iblf_jax.world.robots.arm import Pose as Pose
from iblf_jax.world.robots.load import load as load
from iblf_jax.world.robots.payload import Payload as Payload
from iblf_jax.world.robots.planar_chain import PlanarChain as PlanarChain
from iblf_jax.world.robots.two_link import TwoLink as TwoLink
from iblf_jax.world.robots.with_motors import WithMotors as WithMotors

MEMBERS = {"two_link": TwoLink, "planar_chain": PlanarChain, "arm": Arm, "with_motors": WithMotors}
"""Every robot by the name that a scenario file gives it."""

__all__ = [
    "MEMBERS",
    "Arm",
    "Limits",
    "Payload",
    "PlanarChain",
    "Pose",
    "Robot",
    "TwoLink",
    "WithMotors",
    "at_time",
    "coriolis_from_mass_matrix",
    "energy_gradient",
    "friction_torque",
    "from_energy",
    "inverse_dynamics",
    "joint_names",
    "load",
    "mass_matrix_rate",
    "momentum",
]
