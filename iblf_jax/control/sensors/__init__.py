"""Sensors: the measurements of q and q' for a sampled law.  The contracts are `Sensor` and
`Velocity` in `_base.py`.
"""

from iblf_jax.control.sensors._base import Measurement as Measurement
from iblf_jax.control.sensors._base import Sensor as Sensor
from iblf_jax.control.sensors._base import State as State
from iblf_jax.control.sensors._base import Velocity as Velocity
from iblf_jax.control.sensors.encoder import Encoder as Encoder
from iblf_jax.control.sensors.filtered_difference import FilteredDifference as FilteredDifference
from iblf_jax.control.sensors.ideal import Ideal as Ideal
from iblf_jax.control.sensors.measured import Measured as Measured
from iblf_jax.control.sensors.tracking import Tracking as Tracking

MEMBERS = {"ideal": Ideal, "encoder": Encoder}
"""Every sensor by the name that a scenario file gives it."""
VELOCITIES = {"measured": Measured, "filtered_difference": FilteredDifference, "tracking": Tracking}
"""Every velocity estimate by the name that a scenario file gives it."""

__all__ = [
    "MEMBERS",
    "VELOCITIES",
    "Encoder",
    "FilteredDifference",
    "Ideal",
    "Measured",
    "Measurement",
    "Sensor",
    "State",
    "Tracking",
    "Velocity",
]
