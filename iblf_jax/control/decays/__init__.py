"""Decays: how fast a law drives the error of a level to zero.  The contract is the
base class `Decay`.
"""

from iblf_jax.control.decays._base import Decay as Decay
from iblf_jax.control.decays.exponential import Exponential as Exponential
from iblf_jax.control.decays.finite_time import FiniteTime as FiniteTime
from iblf_jax.control.decays.fixed_time import FixedTime as FixedTime
from iblf_jax.control.decays.prescribed_time import PrescribedTime as PrescribedTime

MEMBERS = {
    "exponential": Exponential,
    "finite_time": FiniteTime,
    "fixed_time": FixedTime,
    "prescribed_time": PrescribedTime,
}
"""Every decay by the name that a scenario file gives it."""

__all__ = ["MEMBERS", "Decay", "Exponential", "FiniteTime", "FixedTime", "PrescribedTime"]
