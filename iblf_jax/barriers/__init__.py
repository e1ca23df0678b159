"""Barriers: V1, its slope and the virtual velocity of each.  The contract is `Barrier` in `_base.py`."""

from iblf_jax.barriers._base import Barrier as Barrier
from iblf_jax.barriers.integral import Integral as Integral
from iblf_jax.barriers.log import Log as Log

MEMBERS = {"integral": Integral, "log": Log}
"""Every barrier by the name that a scenario file gives it."""

__all__ = ["MEMBERS", "Barrier", "Integral", "Log"]
