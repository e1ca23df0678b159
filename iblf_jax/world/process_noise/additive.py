"""White noise of constant intensity."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.world.process_noise._base import (
    ProcessNoise,
    check_rows,
    check_structure,
    intensity_unit,
)


@component
class Additive(ProcessNoise):
    """sigma_i = intensity_i: white noise whose size depends neither on the time nor on the state.

    Args:
      intensity: one number for all levels and components, or a row for each of `levels`, (m, n),
        in the unit of the level per sqrt(s) [1/s^0.5], >= 0.
      levels: the levels with noise, counted from 1; the second, of a robot the acceleration, if not
        given.
      substeps: number of Brownian increments whose sum is that of a step; 1 if not given.

    Source: P. E. Kloeden, E. Platen, Numerical Solution of Stochastic Differential Equations, 1992,
      section 10.2.
    """

    intensity: Leaf = leaf("1/s^0.5", sign="nonnegative", shape="level")
    levels: tuple[int, ...] = static(default=(2,))
    substeps: int = static(default=1)
    additive: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError for `levels` or `substeps` that are not valid, or rows that do not fit
        the levels.
        """
        check_structure(self)
        check_rows("Additive.intensity", self.intensity, self.levels)

    def leaf_units(self) -> dict[str, Any]:
        """The unit of each row of `intensity`."""
        return {"intensity": intensity_unit(self.levels)}

    def diffusion(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """The intensity, (m, n)."""
        return jnp.broadcast_to(self.intensity, (len(self.levels), x.shape[1])).astype(x.dtype)
