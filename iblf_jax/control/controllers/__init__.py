"""Tracking laws.  The contract of a law of robots is the base class `RobotLaw`, that of a law of
plants in strict-feedback form `Law`; `law_by_name` makes the paper's systems.
"""

from typing import TYPE_CHECKING

from iblf_jax.control.controllers._base import Command as Command
from iblf_jax.control.controllers._base import Law as Law
from iblf_jax.control.controllers._base import LawContext as LawContext
from iblf_jax.control.controllers._base import LyapunovLaw as LyapunovLaw
from iblf_jax.control.controllers._base import RobotLaw as RobotLaw
from iblf_jax.control.controllers._base import State as State
from iblf_jax.control.controllers._base import TrackingLaw as TrackingLaw
from iblf_jax.control.controllers._base import law_of_x as law_of_x
from iblf_jax.control.controllers.adaptive_network import AdaptiveNetwork as AdaptiveNetwork
from iblf_jax.control.controllers.adaptive_parameters import (
    AdaptiveParameters as AdaptiveParameters,
)
from iblf_jax.control.controllers.adaptive_parameters import AdaptiveState as AdaptiveState
from iblf_jax.control.controllers.adaptive_rbf import AdaptiveRBF as AdaptiveRBF
from iblf_jax.control.controllers.backstepping import Backstepping as Backstepping
from iblf_jax.control.controllers.barrier_backstepping import (
    BarrierBackstepping as BarrierBackstepping,
)
from iblf_jax.control.controllers.computed_torque import ComputedTorque as ComputedTorque
from iblf_jax.control.controllers.dynamic_surface import DynamicSurface as DynamicSurface
from iblf_jax.control.controllers.event_compensated import EventCompensated as EventCompensated
from iblf_jax.control.controllers.pd_gravity import PDGravity as PDGravity
from iblf_jax.control.controllers.reference_governor import ReferenceGovernor as ReferenceGovernor
from iblf_jax.control.controllers.safety_filter import SafetyFilter as SafetyFilter
from iblf_jax.control.controllers.saturated import Saturated as Saturated
from iblf_jax.control.controllers.saturated import within_effort as within_effort
from iblf_jax.control.controllers.surface_barrier import SurfaceBarrier as SurfaceBarrier
from iblf_jax.control.controllers.systems import KEEPERS as KEEPERS
from iblf_jax.control.controllers.systems import LAWS as LAWS
from iblf_jax.control.controllers.systems import law_by_name as law_by_name
from iblf_jax.control.controllers.terminal_sliding_mode import (
    TerminalSlidingMode as TerminalSlidingMode,
)
from iblf_jax.control.controllers.with_drive import WithDrive as WithDrive
from iblf_jax.core import former_names

if not TYPE_CHECKING:  # with it, a type checker would accept every name
    __getattr__ = former_names.explained(__name__)

MEMBERS = {
    "backstepping": Backstepping,
    "barrier_backstepping": BarrierBackstepping,
    "dynamic_surface": DynamicSurface,
    "adaptive_rbf": AdaptiveRBF,
    "adaptive_network": AdaptiveNetwork,
    "adaptive_parameters": AdaptiveParameters,
    "surface_barrier": SurfaceBarrier,
    "terminal_sliding_mode": TerminalSlidingMode,
    "computed_torque": ComputedTorque,
    "pd_gravity": PDGravity,
    "event_compensated": EventCompensated,
    "saturated": Saturated,
    "safety_filter": SafetyFilter,
    "reference_governor": ReferenceGovernor,
    "with_drive": WithDrive,
}
"""Every law by the name that a scenario file gives it."""

__all__ = [
    "KEEPERS",
    "LAWS",
    "MEMBERS",
    "AdaptiveNetwork",
    "AdaptiveParameters",
    "AdaptiveRBF",
    "AdaptiveState",
    "Backstepping",
    "BarrierBackstepping",
    "Command",
    "ComputedTorque",
    "DynamicSurface",
    "EventCompensated",
    "Law",
    "LawContext",
    "LyapunovLaw",
    "PDGravity",
    "ReferenceGovernor",
    "RobotLaw",
    "SafetyFilter",
    "Saturated",
    "State",
    "SurfaceBarrier",
    "TerminalSlidingMode",
    "TrackingLaw",
    "WithDrive",
    "law_by_name",
    "law_of_x",
    "within_effort",
]
