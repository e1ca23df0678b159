"""Actuators map the command of a law to the delivered torque.  The contract is the
base class `Actuator`.
"""

from iblf_jax.control.actuators._base import Actuator as Actuator
from iblf_jax.control.actuators._base import Delivered as Delivered
from iblf_jax.control.actuators._base import State as State
from iblf_jax.control.actuators.backlash import Backlash as Backlash
from iblf_jax.control.actuators.chain import Chain as Chain
from iblf_jax.control.actuators.dead_zone import DeadZone as DeadZone
from iblf_jax.control.actuators.delay import Delay as Delay
from iblf_jax.control.actuators.fault import Fault as Fault
from iblf_jax.control.actuators.ideal import Ideal as Ideal
from iblf_jax.control.actuators.motor import Motor as Motor
from iblf_jax.control.actuators.quantiser import Quantiser as Quantiser

MEMBERS = {
    "ideal": Ideal,
    "motor": Motor,
    "chain": Chain,
    "fault": Fault,
    "dead_zone": DeadZone,
    "quantiser": Quantiser,
    "backlash": Backlash,
    "delay": Delay,
}
"""Every actuator by the name that a scenario file gives it."""

__all__ = [
    "MEMBERS",
    "Actuator",
    "Backlash",
    "Chain",
    "DeadZone",
    "Delay",
    "Delivered",
    "Fault",
    "Ideal",
    "Motor",
    "Quantiser",
    "State",
]
