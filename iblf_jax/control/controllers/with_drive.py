"""The input map of a law of robots on a robot with electric drives.

The law commands a torque tau, and the plant `ElectricDrive` takes a voltage.  The voltage here is
the one that keeps the current of that torque in the steady state,

    u = R i_d + Kb q',   i_d = tau/Kt.

The current then follows i_d with the time constant L/R of the motors, i' = (R/L) (i_d - i), so that
the loop tends to that of the rigid robot for a small inductance.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax

from iblf_jax.control.controllers._base import Command, Controller, State, Wrapping
from iblf_jax.core import checks
from iblf_jax.core.pytree import component, unwrapped
from iblf_jax.world.plants import ElectricDrive


@component
class WithDrive(Wrapping):
    """u = R tau/Kt + Kb q', the voltage of a drive for the torque tau of a law of robots.

    It is the outermost law of a scenario.  Observers receive the torque tau of the law.  Paths
    reach through: "controller.K2" is the wrapped law's K2.

    Args:
      law: the law whose torque is commanded, any `Controller` for a robot as its model.
      drive: the motors as the law knows them, an `iblf_jax.plants.ElectricDrive`; its robot is not
        used.

    Source: none; the construction is common.
    """

    law: Controller
    drive: ElectricDrive
    input_unit: ClassVar[str] = "V"

    def check(self) -> None:
        """Raises ValueError for something that is not a law, or no drive."""
        checks.conforms("WithDrive.law", self.law, Controller, "iblf_jax.controllers has them.")
        if not isinstance(self.drive, ElectricDrive):
            expected = "an iblf_jax.plants.ElectricDrive"
            remedy = "Such as the plant itself: WithDrive(law, drive=plant)."
            raise checks.fail("WithDrive.drive", self.drive, expected, remedy)

    def command(self, *arguments: Any) -> tuple[Command, State]:
        """The wrapped law's command with the voltage as its input.  Arguments as those of the
        wrapped law.
        """
        command, rate = self.law.command(*arguments)
        current = command.tau / self.drive.torque_constant
        voltage = self.drive.voltage(current, self._velocity(*arguments))
        return command._replace(input=voltage), rate

    def _velocity(self, t: jax.Array, *state: Any) -> jax.Array:
        """The velocity q' among the arguments t, q, q' or t, x of a law, (n,) [rad/s]."""
        if unwrapped(self.law).receives_x:
            return state[0][1]  # type: ignore[no-any-return]
        return state[1]  # type: ignore[no-any-return]
