"""A plant whose parameters change at stated times."""

from __future__ import annotations

from typing import Any, ClassVar

import jax

from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.time import joined, jump_times_of
from iblf_jax.world.plants._modes import (
    ModeValues,
    RobotOrPlant,
    changed,
    check_times,
    fit_modes,
    member_of_inner,
    piecewise_constant,
    switching_results,
)


@component
class Switched:
    """x' = f_s(t, x, u) with s = k for t_k <= t < t_{k+1}: parameters that jump at times t_k.

    The state does not jump.  A step of a run is divided at the times, and the derivatives of a
    trajectory with respect to them are exact.  All members of the inner plant are members of this
    one and use the inner plant's parameters.  The values of the modes apply to the simulated motion
    only (`at`).  The default model of a scenario is the inner plant.

    Args:
      plant: any of `iblf_jax.robots` or `iblf_jax.plants`.
      parameters: path of a parameter of the plant -> its value in each of k + 1 modes, such as
        {"mass[1]": (0.85, 1.5)}.
      times: of the switches, increasing, (k,) [s], > 0.

    Source: D. Liberzon, Switching in Systems and Control, 2003, chapters 1 and 3.
    """

    plant: RobotOrPlant
    parameters: tuple[ModeValues, ...]
    times: Leaf = leaf("s", sign="positive", shape="any")
    wraps: ClassVar[str] = "plant"
    geometry_fields: ClassVar[tuple[str, ...]] = ()
    __getattr__ = member_of_inner

    def check(self) -> None:
        """Raises ValueError for parameters or times that do not fit the plant or each other."""
        modes = fit_modes(self)
        check_times("Switched.times", self.times)
        switches = len(self.times)
        if modes != switches + 1:
            expected = f"{switches + 1} values of every parameter for {switches} switching times"
            raise checks.fail("Switched.parameters", f"{modes} values", expected)

    @property
    def nominal(self) -> Any:
        """The inner plant."""
        return self.plant

    def at(self, t: jax.Array) -> Any:
        """The inner plant with its parameters at time t [s]."""
        plant = self.plant
        for part in self.parameters:
            plant = changed(plant, part.path, piecewise_constant(part.values, self.times, t))
        return plant.at(t)

    def jump_times(self) -> jax.Array:
        """The switching times and those of the inner plant, (m,) [s]."""
        return joined([self.times, jump_times_of("plant", self.plant)])

    def switching(self, end: jax.Array) -> dict[str, jax.Array]:
        """`switches`, `shortest_dwell_time` and `mean_dwell_time` of a run until `end` [s]."""
        return switching_results(self.times, end)

    def has_complete_path(self, end: jax.Array) -> jax.Array:
        """True, () bool: the plant states all of its switches."""
        return end >= 0
