"""A measured velocity, for example by a tachometer."""

from __future__ import annotations

from typing import ClassVar

import jax

from iblf_jax.control.sensors._base import Velocity
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import VELOCITY


@component
class Measured(Velocity):
    """The velocity v = q' + noise w,   w standard normal.

    Args:
      noise: standard deviation, () or (n,) [rad/s], >= 0; 0 if not given.

    Source: none; the construction is common.
    """

    noise: Leaf = leaf(VELOCITY, sign="nonnegative", default=0.0)
    draws: ClassVar[int] = 1

    def estimate(
        self, y: jax.Array, dq: jax.Array, normal: jax.Array, period: jax.Array, state: tuple[()]
    ) -> tuple[jax.Array, tuple[()]]:
        """The velocity and its noise, (n,) [rad/s]."""
        return dq + self.noise * normal[0], ()
