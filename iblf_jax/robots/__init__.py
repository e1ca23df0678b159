"""Robots: the plant that moves and the model that the law knows.  The contract is `Robot` in `_base.py`."""

from iblf_jax.robots._base import Robot as Robot
from iblf_jax.robots._base import coriolis_from_mass_matrix as coriolis_from_mass_matrix
from iblf_jax.robots._base import from_energy as from_energy
from iblf_jax.robots._base import mass_matrix_rate as mass_matrix_rate
from iblf_jax.robots.planar_chain import PlanarChain as PlanarChain
from iblf_jax.robots.two_link import TwoLink as TwoLink

MEMBERS = {"two_link": TwoLink, "planar_chain": PlanarChain}
"""Every robot by the name that a scenario file gives it."""

__all__ = ["MEMBERS", "PlanarChain", "Robot", "TwoLink", "coriolis_from_mass_matrix", "from_energy", "mass_matrix_rate"]
