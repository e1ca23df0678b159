"""Joint encoders: positions in counts, with an offset and noise, and a velocity that follows from
them.
"""

from __future__ import annotations

import dataclasses
import math

import jax

from iblf_jax.control.sensors._base import Measurement, RobotSensor, State, Velocity, rounded
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import POSITION


@component
class Encoder(RobotSensor):
    """y = step round((q + offset + noise w) / step),   step = 2 pi / counts,   w standard normal.

    The derivative of y by q is defined as 1, that of the reading before rounding, because the
    derivative of the rounding is 0 almost everywhere.

    Args:
      velocity: the velocity estimate, any of `iblf_jax.sensors.VELOCITIES`.
      counts: counts per turn, () or (n,) [1], > 0; not rounded if not given.
      offset: reading at the position 0, () or (n,) [rad]; 0 if not given.
      noise: standard deviation of the reading, () or (n,) [rad], >= 0; none if not given.

    Source: none; the construction is common.
    """

    velocity: Velocity
    counts: Leaf = leaf("1", sign="positive", default=None)
    offset: Leaf = leaf(POSITION, default=0.0)
    noise: Leaf = leaf(POSITION, sign="nonnegative", default=None)

    def check(self) -> None:
        """Raises ValueError if `velocity` does not fit `Velocity`."""
        checks.conforms(
            "Encoder.velocity", self.velocity, Velocity, "iblf_jax.sensors.VELOCITIES has them."
        )

    @property
    def draws(self) -> int:
        """One for the position if it has noise, and the velocity's."""
        return (self.noise is not None) + self.velocity.draws

    def advice(self, period: jax.Array) -> list[str]:
        """The velocity's warnings."""
        return self.velocity.advice(period)

    @property
    def unrounded(self) -> Encoder:
        """The same without counts."""
        return dataclasses.replace(self, counts=None)

    @property
    def resolution(self) -> jax.Array | float:
        """Size of a count, () or (n,) [rad]; 0 if not rounded."""
        return 0.0 if self.counts is None else 2.0 * math.pi / self.counts

    def _read(self, q: jax.Array) -> jax.Array:
        """A position rounded to counts, (n,) [rad]."""
        if self.counts is None:
            return q
        return rounded(q, self.resolution)

    def init(self, q: jax.Array, dq: jax.Array, period: jax.Array) -> State:
        """The velocity's, for the position that is read without noise."""
        return self.velocity.init(self._read(q + self.offset), dq, period)

    def measure(
        self, q: jax.Array, dq: jax.Array, normal: jax.Array, period: jax.Array, state: State
    ) -> tuple[Measurement, State]:
        """The position in counts, and the velocity."""
        position = q + self.offset
        if self.noise is not None:
            position = position + self.noise * normal[0]
            normal = normal[1:]
        y = self._read(position)
        v, state = self.velocity.estimate(y, dq, normal, period, state)
        return Measurement(y, v), state
