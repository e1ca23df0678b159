"""The ideal sensor: it measures position and velocity without error."""

from __future__ import annotations

from typing import ClassVar

import jax

from iblf_jax.control.sensors._base import Measurement, RobotSensor
from iblf_jax.core.pytree import component


@component
class Ideal(RobotSensor):
    """Position q and velocity q' as they are.  Source: none; the baseline."""

    draws: ClassVar[int] = 0

    def measure(
        self, q: jax.Array, dq: jax.Array, normal: jax.Array, period: jax.Array, state: tuple[()]
    ) -> tuple[Measurement, tuple[()]]:
        """The true position and velocity."""
        return Measurement(q, dq), ()
