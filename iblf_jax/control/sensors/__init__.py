"""Sensors: the measurements of q and q', or of all levels of a plant, for a sampled law.  The
contracts are the base classes `RobotSensor`, `Sensor`, `LevelSensor` and `Velocity`.
"""

from typing import TYPE_CHECKING

from iblf_jax.control.sensors._base import AnySensor as AnySensor
from iblf_jax.control.sensors._base import LevelSensor as LevelSensor
from iblf_jax.control.sensors._base import Measurement as Measurement
from iblf_jax.control.sensors._base import RobotSensor as RobotSensor
from iblf_jax.control.sensors._base import Sensor as Sensor
from iblf_jax.control.sensors._base import State as State
from iblf_jax.control.sensors._base import Velocity as Velocity
from iblf_jax.control.sensors.direct import Direct as Direct
from iblf_jax.control.sensors.encoder import Encoder as Encoder
from iblf_jax.control.sensors.filtered_difference import FilteredDifference as FilteredDifference
from iblf_jax.control.sensors.ideal import Ideal as Ideal
from iblf_jax.control.sensors.levels import Levels as Levels
from iblf_jax.control.sensors.measured import Measured as Measured
from iblf_jax.control.sensors.tracking import Tracking as Tracking
from iblf_jax.control.sensors.unmeasured import Unmeasured as Unmeasured
from iblf_jax.core import former_names

if not TYPE_CHECKING:  # with it, a type checker would accept every name
    __getattr__ = former_names.explained(__name__)

MEMBERS = {"ideal": Ideal, "encoder": Encoder, "levels": Levels}
"""Every sensor by the name that a scenario file gives it."""
LEVEL_SENSORS = {"direct": Direct, "unmeasured": Unmeasured}
"""Every sensor of one level by the name that a scenario file gives it."""
VELOCITIES = {"measured": Measured, "filtered_difference": FilteredDifference, "tracking": Tracking}
"""Every velocity estimate by the name that a scenario file gives it."""

__all__ = [
    "LEVEL_SENSORS",
    "MEMBERS",
    "VELOCITIES",
    "AnySensor",
    "Direct",
    "Encoder",
    "FilteredDifference",
    "Ideal",
    "LevelSensor",
    "Levels",
    "Measured",
    "Measurement",
    "RobotSensor",
    "Sensor",
    "State",
    "Tracking",
    "Unmeasured",
    "Velocity",
]
