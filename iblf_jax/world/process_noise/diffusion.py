"""White noise whose intensity is a user's function."""

from __future__ import annotations

from collections.abc import Callable

import jax

from iblf_jax.core import checks
from iblf_jax.core.pytree import component, static
from iblf_jax.world.process_noise._base import ProcessNoise, check_structure


@component
class Diffusion(ProcessNoise):
    """sigma = diffusion(t, x): white noise whose intensity varies with the time or the state.

    The function is part of the structure: a run with another function is compiled again.  To sweep
    or tune numbers of the noise, write a class with `levels` and the method `diffusion` whose
    numbers are leaves (`iblf_jax.component`).

    Args:
      diffusion: function (t, x) -> sigma, (m, n), of the time [s] and the state (r, n), a row for
        each of the m `levels` in the unit of the level per sqrt(s).
      levels: the levels with noise, counted from 1; the second if not given.
      additive: whether `diffusion` does not depend on x; False if not given.
      substeps: number of Brownian increments whose sum is that of a step; 1 if not given.

    Source: P. E. Kloeden, E. Platen, Numerical Solution of Stochastic Differential Equations, 1992,
      section 4.8.
    """

    diffusion: Callable[[jax.Array, jax.Array], jax.Array] = static()  # type: ignore[assignment]
    levels: tuple[int, ...] = static(default=(2,))
    additive: bool = static(default=False)
    substeps: int = static(default=1)

    def check(self) -> None:
        """Raises ValueError for a `diffusion` that is not a function, or other fields that are not
        valid.
        """
        if not callable(self.diffusion):
            expected = "a function (t, x) -> an array"
            raise checks.fail("Diffusion.diffusion", self.diffusion, expected)
        checks.boolean("Diffusion.additive", self.additive)
        check_structure(self)
