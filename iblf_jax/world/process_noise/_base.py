"""The contract of process noise: white noise on levels of the plant.

    dx_i = (f_i + G_i x_{i+1} + d_i) dt + sigma_i(t, x) dW_i                                (P.1)

W has independent standard Brownian motions, one for each component of each level with noise.
(P.1) is an equation in the sense of Ito.  Law and observer do not know the noise: it moves the
state that they receive.
"""

from __future__ import annotations

import abc
from typing import Any

import jax

from iblf_jax.core import checks
from iblf_jax.core.families import Part, adopt, attribute
from iblf_jax.core.units import ByLevel, PlantUnit

MOST_SUBSTEPS = 1024
"""Largest `substeps`; the compiled step contains the code of each increment."""


class ProcessNoise(Part):
    """The contract of process noise.  All methods are pure functions of one state."""

    @attribute
    @abc.abstractmethod
    def levels(self) -> tuple[int, ...]:
        """The levels with noise, counted from 1; m of them."""

    @attribute
    def additive(self) -> bool:
        """Whether `diffusion` does not depend on x.  Methods of strong order 1 need it."""
        return False

    @attribute
    def substeps(self) -> int:
        """The increment of a step is the sum of this number of independent increments.  Runs whose
        time steps are in the ratio of their `substeps` have the same Brownian path at their common
        instants.
        """
        return 1

    @abc.abstractmethod
    def diffusion(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """The intensity sigma of each level with noise, (m, n), in the unit of the level per
        sqrt(s).

        Args:
          t: time, () [s].
          x: state of the plant, (r, n); of a robot q and q'.
        """


def check_structure(noise: ProcessNoise) -> None:
    """Raises ValueError for levels that are not increasing whole numbers >= 1, or `substeps` that
    is not a whole number from 1 to `MOST_SUBSTEPS`.
    """
    adopt(type(noise), ProcessNoise)
    name = type(noise).__name__
    levels = noise.levels
    if not isinstance(levels, tuple | list) or not levels:
        expected = "the levels with noise, a tuple such as (2,)"
        raise checks.fail(f"{name}.levels", levels, expected)
    for level in levels:
        checks.positive_integer(f"{name}.levels", level)
    if list(levels) != sorted(set(levels)):
        raise checks.fail(f"{name}.levels", levels, "increasing numbers of levels")
    checks.positive_integer(f"{name}.substeps", noise.substeps, most=MOST_SUBSTEPS)


def intensity_unit(levels: tuple[int, ...], of_state: bool = True) -> ByLevel:
    """The unit of the intensity on each level: that of the level per sqrt(s), or, of an intensity
    relative to the state (`of_state` False), 1/sqrt(s).
    """
    if not of_state:
        return ByLevel("1/s^0.5" for _ in levels)
    return ByLevel(PlantUnit("1/s^0.5", f"x{level}/s^0.5") for level in levels)


def check_rows(name: str, value: Any, levels: tuple[int, ...]) -> None:
    """Raises ValueError for a leaf that is neither one number nor one row for each level."""
    if value.ndim and len(value) != len(levels):
        expected = f"one number, or {len(levels)} rows, one for each of the levels {tuple(levels)}"
        remedy = "Such as intensity=[[0.3, 0.2]] for one level of two joints."
        raise checks.fail(name, value, expected, remedy)
