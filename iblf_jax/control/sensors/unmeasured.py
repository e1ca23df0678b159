"""A level of a plant that no sensor measures."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.sensors._base import LevelSensor
from iblf_jax.core.pytree import component


@component
class Unmeasured(LevelSensor):
    """No measurement of a level, a part of `Levels`; `None` means the same.

    An observer that has `complete`, such as `observers.StateObserver`, then estimates the level.

    Source: none.
    """

    draws: ClassVar[int] = 0
    is_measured: ClassVar[bool] = False

    def measure_level(
        self, x: jax.Array, normal: jax.Array, period: jax.Array, state: tuple[()]
    ) -> tuple[jax.Array, tuple[()]]:
        """Zeros in the place of the level, (n,); the loop replaces them by an estimate."""
        return jnp.zeros_like(x), ()
