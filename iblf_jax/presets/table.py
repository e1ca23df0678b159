"""The table of presets by name, for the command line and for files."""

from __future__ import annotations

from collections.abc import Callable

from iblf_jax.presets.arms import iiwa14, ur5
from iblf_jax.presets.paper import (
    printed_gap,
    zhang_yan_2024,
    zhang_yan_2024_full_state,
    zhang_yan_2024_funnel,
    zhang_yan_2024_saturated,
)
from iblf_jax.presets.plants import (
    flexible_joint_iiwa14,
    flexible_joint_two_link,
    motor_driven_pendulum,
    motor_driven_two_link,
    vessel,
)
from iblf_jax.simulation.scenario import Scenario

PRESETS: dict[str, Callable[..., Scenario]] = {
    "zhang_yan_2024": zhang_yan_2024,
    "printed_gap": printed_gap,
    "zhang_yan_2024_saturated": zhang_yan_2024_saturated,
    "zhang_yan_2024_funnel": zhang_yan_2024_funnel,
    "zhang_yan_2024_full_state": zhang_yan_2024_full_state,
    "ur5": ur5,
    "iiwa14": iiwa14,
    "motor_driven_pendulum": motor_driven_pendulum,
    "motor_driven_two_link": motor_driven_two_link,
    "flexible_joint_two_link": flexible_joint_two_link,
    "flexible_joint_iiwa14": flexible_joint_iiwa14,
    "vessel": vessel,
}
"""Name of a preset -> the function that makes it."""
