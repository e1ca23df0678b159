"""Actuators: from the commanded to the delivered torque.  The contract is `Actuator` in
`_base.py`.
"""

from iblf_jax.control.actuators._base import Actuator as Actuator
from iblf_jax.control.actuators._base import Delivered as Delivered
from iblf_jax.control.actuators._base import State as State
from iblf_jax.control.actuators.chain import Chain as Chain
from iblf_jax.control.actuators.ideal import Ideal as Ideal
from iblf_jax.control.actuators.motor import Motor as Motor

MEMBERS = {"ideal": Ideal, "motor": Motor, "chain": Chain}
"""Every actuator by the name that a scenario file gives it."""

__all__ = ["MEMBERS", "Actuator", "Chain", "Delivered", "Ideal", "Motor", "State"]
