"""Plants in strict-feedback form.  Robots are of order 2.

    x_i' = f_i(t, x_1..x_i) + G_i(t, x_1..x_i) x_{i+1} + d_i,   i = 1..r,   x_{r+1} = u      (S.1)

A class of your own has the base class `Plant`, which is on this page.
"""

from typing import Any

from iblf_jax.world.plants._base import MAX_ORDER as MAX_ORDER
from iblf_jax.world.plants._base import Dependence as Dependence
from iblf_jax.world.plants._base import Notation as Notation
from iblf_jax.world.plants._base import Plant as Plant
from iblf_jax.world.plants._base import Units as Units
from iblf_jax.world.plants._base import check_dependence as check_dependence
from iblf_jax.world.plants._base import check_dimensions as check_dimensions
from iblf_jax.world.plants._base import check_part as check_part
from iblf_jax.world.plants._base import component_names as component_names
from iblf_jax.world.plants._base import component_noun as component_noun
from iblf_jax.world.plants._base import components_in_words as components_in_words
from iblf_jax.world.plants._base import counted_components as counted_components
from iblf_jax.world.plants._base import declared_joints as declared_joints
from iblf_jax.world.plants._base import dependence_on_levels as dependence_on_levels
from iblf_jax.world.plants._base import flow as flow
from iblf_jax.world.plants._base import gain_times as gain_times
from iblf_jax.world.plants._base import has_modes as has_modes
from iblf_jax.world.plants._base import has_steady_levels as has_steady_levels
from iblf_jax.world.plants._base import input_name as input_name
from iblf_jax.world.plants._base import is_chain as is_chain
from iblf_jax.world.plants._base import level_input as level_input
from iblf_jax.world.plants._base import level_names as level_names
from iblf_jax.world.plants._base import level_rate as level_rate
from iblf_jax.world.plants._base import nominal_of as nominal_of
from iblf_jax.world.plants._base import order_of as order_of
from iblf_jax.world.plants._base import robot_of as robot_of
from iblf_jax.world.plants._base import robot_or_plant as robot_or_plant
from iblf_jax.world.plants._base import speed_limit as speed_limit
from iblf_jax.world.plants._base import state_of_levels as state_of_levels
from iblf_jax.world.plants._base import torque_as_rates as torque_as_rates
from iblf_jax.world.plants._base import transposed_gain as transposed_gain
from iblf_jax.world.plants._base import unit_symbols as unit_symbols
from iblf_jax.world.plants._base import units_of as units_of
from iblf_jax.world.plants._modes import SWITCHING_UNITS as SWITCHING_UNITS
from iblf_jax.world.plants._modes import ModeValues as ModeValues
from iblf_jax.world.plants.agents import Agents as Agents
from iblf_jax.world.plants.agents import NeighbourModel as NeighbourModel
from iblf_jax.world.plants.driven_pendulum import DrivenPendulum as DrivenPendulum
from iblf_jax.world.plants.electric_drive import ElectricDrive as ElectricDrive
from iblf_jax.world.plants.flexible_joint import FlexibleJoint as FlexibleJoint
from iblf_jax.world.plants.markov_switched import MarkovSwitched as MarkovSwitched
from iblf_jax.world.plants.restoring import Mooring as Mooring
from iblf_jax.world.plants.restoring import Restoring as Restoring
from iblf_jax.world.plants.rigid import Rigid as Rigid
from iblf_jax.world.plants.rigid import RobotPlant as RobotPlant
from iblf_jax.world.plants.strict_feedback import StrictFeedback as StrictFeedback
from iblf_jax.world.plants.switched import Switched as Switched
from iblf_jax.world.plants.vessel import Vessel as Vessel
from iblf_jax.world.robots import Robot as Robot


def as_plant(part: Any) -> Plant:
    """A plant in strict-feedback form: the part itself, or a robot as a `RobotPlant`."""
    if is_chain(part):
        return part  # type: ignore[no-any-return]
    return RobotPlant(part)


MEMBERS = {
    "agents": Agents,
    "neighbour_model": NeighbourModel,
    "rigid": Rigid,
    "driven_pendulum": DrivenPendulum,
    "electric_drive": ElectricDrive,
    "flexible_joint": FlexibleJoint,
    "markov_switched": MarkovSwitched,
    "strict_feedback": StrictFeedback,
    "switched": Switched,
    "vessel": Vessel,
}
"""Every plant by the name that a scenario file gives it."""
RESTORING = {"mooring": Mooring}
"""Every restoring force of a vessel by the name that a scenario file gives it."""

__all__ = [
    "MEMBERS",
    "RESTORING",
    "Agents",
    "DrivenPendulum",
    "ElectricDrive",
    "FlexibleJoint",
    "MarkovSwitched",
    "Mooring",
    "NeighbourModel",
    "Plant",
    "Restoring",
    "Rigid",
    "StrictFeedback",
    "Switched",
    "Units",
    "Vessel",
    "as_plant",
    "component_names",
    "component_noun",
    "components_in_words",
    "counted_components",
    "flow",
    "gain_times",
    "input_name",
    "is_chain",
    "level_input",
    "level_names",
    "level_rate",
    "nominal_of",
    "order_of",
    "robot_of",
    "state_of_levels",
    "torque_as_rates",
    "transposed_gain",
    "unit_symbols",
    "units_of",
]
