"""White noise in proportion to the level on which it acts."""

from __future__ import annotations

from typing import Any

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
class Proportional(ProcessNoise):
    """sigma_i = intensity_i x_i: a rate of the level that fluctuates, such as viscous friction.

    Args:
      intensity: one number for all levels and components, or a row for each of `levels`, (m, n)
        [1/s^0.5], >= 0.
      levels: the levels with noise, counted from 1; the second, of a robot its velocity, if not
        given.
      substeps: number of Brownian increments whose sum is that of a step; 1 if not given.

    Source: P. E. Kloeden, E. Platen, Numerical Solution of Stochastic Differential Equations, 1992,
      section 4.4.
    """

    intensity: Leaf = leaf("1/s^0.5", sign="nonnegative", shape="level")
    levels: tuple[int, ...] = static(default=(2,))
    substeps: int = static(default=1)

    def check(self) -> None:
        """Raises ValueError for `levels` or `substeps` that are not valid, or rows that do not fit
        the levels.
        """
        check_structure(self)
        check_rows("Proportional.intensity", self.intensity, self.levels)

    def leaf_units(self) -> dict[str, Any]:
        """The unit of each row of `intensity`."""
        return {"intensity": intensity_unit(self.levels, of_state=False)}

    def diffusion(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """intensity_i x_i, (m, n)."""
        rows = jnp.stack([x[level - 1] for level in self.levels])
        return self.intensity * rows
