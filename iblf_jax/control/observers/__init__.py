"""Disturbance observers.  The contract of those of robots is the base class `RobotObserver`, that
of those of plants in strict-feedback form `Observer`.
"""

from typing import TYPE_CHECKING

from iblf_jax.control.observers._base import DisturbanceObserver as DisturbanceObserver
from iblf_jax.control.observers._base import Observer as Observer
from iblf_jax.control.observers._base import RobotObserver as RobotObserver
from iblf_jax.control.observers._base import State as State
from iblf_jax.control.observers.as_published import AsPublished as AsPublished
from iblf_jax.control.observers.extended_state import ExtendedState as ExtendedState
from iblf_jax.control.observers.level import LevelObserver as LevelObserver
from iblf_jax.control.observers.momentum import Momentum as Momentum
from iblf_jax.control.observers.none import NoObserver as NoObserver
from iblf_jax.control.observers.state_observer import StateObserver as StateObserver
from iblf_jax.core import former_names

if not TYPE_CHECKING:  # with it, a type checker would accept every name
    __getattr__ = former_names.explained(__name__)

MEMBERS = {
    "none": NoObserver,
    "printed": AsPublished,
    "momentum": Momentum,
    "extended_state": ExtendedState,
    "level": LevelObserver,
    "state_observer": StateObserver,
}
"""Every observer by the name that a scenario file gives it."""

__all__ = [
    "MEMBERS",
    "AsPublished",
    "DisturbanceObserver",
    "ExtendedState",
    "LevelObserver",
    "Momentum",
    "NoObserver",
    "Observer",
    "RobotObserver",
    "State",
    "StateObserver",
]
