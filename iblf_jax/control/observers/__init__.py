"""Disturbance observers.  The contract is the base class `Observer`."""

from iblf_jax.control.observers._base import Observer as Observer
from iblf_jax.control.observers._base import State as State
from iblf_jax.control.observers.extended_state import ExtendedState as ExtendedState
from iblf_jax.control.observers.level import LevelObserver as LevelObserver
from iblf_jax.control.observers.momentum import Momentum as Momentum
from iblf_jax.control.observers.none import NoObserver as NoObserver
from iblf_jax.control.observers.printed import Printed as Printed
from iblf_jax.control.observers.state_observer import StateObserver as StateObserver

MEMBERS = {
    "none": NoObserver,
    "printed": Printed,
    "momentum": Momentum,
    "extended_state": ExtendedState,
    "level": LevelObserver,
    "state_observer": StateObserver,
}
"""Every observer by the name that a scenario file gives it."""

__all__ = [
    "MEMBERS",
    "ExtendedState",
    "LevelObserver",
    "Momentum",
    "NoObserver",
    "Observer",
    "Printed",
    "State",
    "StateObserver",
]
