"""A plant in strict-feedback form made of a user's two functions."""

from __future__ import annotations

from collections.abc import Callable

import jax

from iblf_jax.core import checks
from iblf_jax.core.pytree import component, static
from iblf_jax.world.plants._base import Plant, Units, check_dimensions


@component
class StrictFeedback(Plant):
    """x_i' = drift_i(t, x) + gain_i(t, x) x_{i+1},   i = 1..order,   x_{order+1} = u.     (S.1)

    The functions are structure: a new pair compiles anew.  A plant whose numbers are to be swept,
    tuned or differentiated is a class with the methods `drift` and `gain`, whose numbers are
    leaves (`iblf_jax.component`).

    Args:
      drift: function (t, x) -> f, (order, n), of the time [s] and the state (order, n).  Row i may
        depend on t and on x[0] ... x[i] only; `iblf_jax.testing.check_plant` checks it.
      gain: function (t, x) -> G, (order, n, n), or (order, n) for diagonal gains; dependence as
        `drift`.
      n: numbers per level.
      order: number of levels, at least 2.
      units: of the levels and of the input, order + 1 texts, or tuples of n texts where components
        differ; "1" for all if not given.
      level_names: words for the levels, order texts; "level 1", "level 2", ... if not
        given.
      component_names: names of the n components; "component 0", ... if not given.

    Source: M. Krstic, I. Kanellakopoulos, P. Kokotovic, Nonlinear and Adaptive Control Design,
      1995, chapter 2.
    """

    drift: Callable[[jax.Array, jax.Array], jax.Array] = static()  # type: ignore[assignment]
    gain: Callable[[jax.Array, jax.Array], jax.Array] = static()  # type: ignore[assignment]
    n: int = static()
    order: int = static()
    units: tuple[Units, ...] | None = static(default=None)
    level_names: tuple[str, ...] | None = static(default=None)
    component_names: tuple[str, ...] = static(default=())

    def check(self) -> None:
        """Raises ValueError for something that is no function, or numbers and units that do not fit
        together.
        """
        for name, function in (("drift", self.drift), ("gain", self.gain)):
            if not callable(function):
                expected = "a function (t, x) -> an array"
                raise checks.fail(f"StrictFeedback.{name}", function, expected)
        check_dimensions("StrictFeedback", self)
