"""The input map of a law of robots on a robot with electric drives.

The law commands a torque tau, and the plant `ElectricDrive` takes a voltage.  The voltage here is
the one that keeps the current of that torque in the steady state,

    u = R i_d + Kb q',   i_d = tau/Kt.

The current then follows i_d with the time constant L/R of the motors, i' = (R/L) (i_d - i), so that
the loop tends to that of the rigid robot for a small inductance.
"""

from __future__ import annotations

from typing import ClassVar

import jax

from iblf_jax.control.controllers._base import (
    Command,
    LawContext,
    State,
    TrackingLaw,
    Wrapping,
    check_law,
)
from iblf_jax.core import checks
from iblf_jax.core.pytree import component
from iblf_jax.world.plants import ElectricDrive


@component
class WithDrive(Wrapping):
    """u = R tau/Kt + Kb q', the voltage of a drive for the torque tau of a law of robots.

    It is the outermost law of a scenario.  Observers receive the torque tau of the law.  Paths
    reach through: "controller.K2" is the wrapped law's K2.

    Args:
      law: the law whose torque is commanded, any law for a robot as its model.
      drive: the motors as the law knows them, an `iblf_jax.plants.ElectricDrive`; its robot is not
        used.

    Source: none; the construction is common.
    """

    law: TrackingLaw
    drive: ElectricDrive
    input_unit: ClassVar[str] = "V"

    def check(self) -> None:
        """Raises ValueError for something that is not a law, or no drive."""
        check_law("WithDrive.law", self.law, "iblf_jax.controllers has them.")
        if not isinstance(self.drive, ElectricDrive):
            expected = "an iblf_jax.plants.ElectricDrive"
            remedy = "Such as the plant itself: WithDrive(law, drive=plant)."
            raise checks.fail("WithDrive.drive", self.drive, expected, remedy)

    def command(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> tuple[Command, State]:
        """The wrapped law's command with the voltage as its input."""
        command, rate = self.inner.command(t, x, d_hat, context, state)
        return command._replace(input=self.voltage(command.tau, x[1])), rate

    def voltage(self, tau: jax.Array, dq: jax.Array) -> jax.Array:
        """R tau/Kt + Kb q', (n,) [V]."""
        return self.drive.voltage(tau / self.drive.torque_constant, dq)
