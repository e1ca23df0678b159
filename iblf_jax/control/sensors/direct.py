"""A sensor that reads one level of a plant directly, such as a current sensor."""

from __future__ import annotations

import dataclasses

import jax

from iblf_jax.control.sensors._base import LevelSensor, rounded
from iblf_jax.core.pytree import Leaf, component, leaf


@component
class Direct(LevelSensor):
    """y = resolution round((x + offset + noise w) / resolution),   w standard normal.

    It reads one level, a part of `Levels`; all numbers are in the unit of that level.  The
    derivative of y by x is defined as 1.

    Args:
      noise: standard deviation of the reading, () or (n,) [1], >= 0; none if not given.
      resolution: step of the readings, () or (n,) [1], > 0; not rounded if not given.
      offset: reading where the level is 0, () or (n,) [1]; 0 if not given.

    Source: none; the construction is common.
    """

    noise: Leaf = leaf("1", sign="nonnegative", default=None)
    resolution: Leaf = leaf("1", sign="positive", default=None)
    offset: Leaf = leaf("1", default=0.0)

    @property
    def draws(self) -> int:
        """One if it has noise."""
        return int(self.noise is not None)

    @property
    def unrounded(self) -> Direct:
        """The same without resolution."""
        return dataclasses.replace(self, resolution=None)

    def measure_level(
        self, x: jax.Array, normal: jax.Array, period: jax.Array, state: tuple[()]
    ) -> tuple[jax.Array, tuple[()]]:
        """The reading, (n,)."""
        reading = x + self.offset
        if self.noise is not None:
            reading = reading + self.noise * normal[0]
        if self.resolution is not None:
            reading = rounded(reading, self.resolution)
        return reading, ()
