"""Tracking laws.  The contract is `Controller` in `_base.py`."""

from iblf_jax.controllers._base import Command as Command
from iblf_jax.controllers._base import Controller as Controller
from iblf_jax.controllers._base import Setting as Setting
from iblf_jax.controllers.backstepping import Backstepping as Backstepping

MEMBERS = {"backstepping": Backstepping}
"""Every law by the name that a scenario file gives it."""

__all__ = ["MEMBERS", "Backstepping", "Command", "Controller", "Setting"]
