"""A plant whose parameters follow a Markov chain in continuous time."""

from __future__ import annotations

import copy
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.time import joined, jump_times_of
from iblf_jax.world.plants._modes import (
    NEVER,
    ModeValues,
    RobotOrPlant,
    changed,
    fit_modes,
    member_of_inner,
    piecewise_constant,
    switching_results,
    value_of_mode,
)

MOST_SWITCHES = 64
"""Largest `switches`; the compiled step compares the time with every switching time."""
ROUNDING = 1e-6
"""Largest sum of a row of the rates, relative to the largest rate."""


@component
class MarkovSwitched:
    """x' = f_s(t, x, u), P(s(t + h) = j | s(t) = i) = q_ij h + o(h): random jumps of parameters.

    A run draws its path from its key, as a sensor draws its noise: the time in mode i has an
    exponential distribution with the mean -1/q_ii, and the next mode is j with the probability
    -q_ij/q_ii.  Every run of a study has a path of its own.  Derivatives of a run are pathwise, so
    that the derivative with respect to `rates` is 0.  A run that would have more than `switches`
    switches stays in its last mode and is flagged MODES_EXHAUSTED.

    Args:
      plant: any of `iblf_jax.robots` or `iblf_jax.plants`; the default model of a scenario.
      parameters: path of a parameter of the plant -> its value in each of M modes, such as
        {"mass[1]": (0.85, 1.5)}.
      rates: Q, (M, M) [1/s]: q_ij >= 0 of the switch from mode i to mode j, and rows of sum 0.  A
        run uses the rates with i != j only, so that a study may vary one of them alone.
      start: mode at t = 0, from 0; 0 if not given.
      switches: largest number of switches in a run; 16 if not given.
      times: of the switches of a run, shape (m,) with m = switches + 1 [s], > 0; none if not given.
        Every run replaces them.
      sequence: mode after each of the switches, shape (m,) [1], >= 0; `start` if not given.  Every
        run replaces it.

    Source: O. L. V. Costa, M. D. Fragoso, M. G. Todorov, Continuous-Time Markov Jump Linear
      Systems, 2013, chapter 2; the path by D. T. Gillespie, J. Physical Chemistry 81 (1977) 2340.
    """

    plant: RobotOrPlant
    parameters: tuple[ModeValues, ...]
    rates: Leaf = leaf("1/s", shape="any")
    start: int = static(default=0)
    switches: int = static(default=16)
    times: Leaf = leaf("s", sign="positive", shape="any", default=None)
    sequence: Leaf = leaf("1", sign="nonnegative", shape="any", default=None)
    wraps: ClassVar[str] = "plant"
    geometry_fields: ClassVar[tuple[str, ...]] = ()
    __getattr__ = member_of_inner

    def check(self) -> None:
        """Raises ValueError for parameters or rates that do not fit the plant or each other."""
        modes = fit_modes(self)
        name = "MarkovSwitched.rates"
        checks.shape_is(name, self.rates, (modes, modes))
        if checks.is_concrete(self.rates):
            Q = np.asarray(self.rates)
            is_zero = np.abs(Q.sum(axis=1)) <= ROUNDING * np.max(np.abs(Q))
            if np.any(Q - np.diag(np.diag(Q)) < 0) or not np.all(is_zero):
                expected = "q_ij >= 0 for i != j, and rows of sum 0"
                raise checks.fail(name, Q, expected, "Such as [[-0.5, 0.5], [1.0, -1.0]].")
        checks.positive_integer("MarkovSwitched.switches", self.switches, most=MOST_SWITCHES)
        checks.positive_integer("MarkovSwitched.start", self.start, least=0, most=modes - 1)
        shape = (self.switches + 1,)
        for name, value in (("times", NEVER), ("sequence", float(self.start))):
            given = vars(self)[name]
            if given is None:
                object.__setattr__(self, name, jnp.full(shape, value, self.rates.dtype))
                continue
            checks.shape_is(f"MarkovSwitched.{name}", given, shape)

    @property
    def nominal(self) -> Any:
        """The inner plant."""
        return self.plant

    @property
    def mode_draws(self) -> int:
        """Number of pairs of random numbers of a path: one for each of `switches`, and one for the
        next switch, which shows whether the path is complete.
        """
        return self.switches + 1

    def with_path(self, uniforms: jax.Array) -> MarkovSwitched:
        """The plant with the switching times and modes of a run.

        Args:
          uniforms: independent and uniform between 0 and 1, (switches + 1, 2).  The first of a pair
            gives the dwell time, -log(u)/|q_ii|, the second one the next mode.
        """
        Q = jax.lax.stop_gradient(self.rates)
        # A replaced rate does not change the diagonal: the rate of leaving is a sum of the others.
        to_others = jnp.where(np.eye(len(Q), dtype=bool), 0.0, Q)

        def switch(before, pair):
            t, mode = before
            row = value_of_mode(to_others, mode)
            leaving = jnp.sum(row)
            is_final = ~(leaving > 0)
            rate = jnp.where(is_final, 1.0, leaving)
            t = jnp.where(is_final, NEVER, jnp.minimum(t - jnp.log(pair[0]) / rate, NEVER))
            mode = jnp.where(is_final, mode, _next_mode(row, pair[1] * rate))
            return (t, mode), (t, mode)

        # Written out, XLA repeats the earlier switches in the code of every later one.
        start = jnp.zeros((), Q.dtype), jnp.full((), self.start, Q.dtype)
        _, (times, sequence) = jax.lax.scan(switch, start, uniforms.astype(Q.dtype))
        # A copy without checks: its numbers may be traced.
        new = copy.copy(self)
        object.__setattr__(new, "times", times)
        object.__setattr__(new, "sequence", sequence)
        return new

    def at(self, t: jax.Array) -> Any:
        """The inner plant with its parameters at time t [s]."""
        start = jnp.full((1,), self.start, self.sequence.dtype)
        modes = jnp.concatenate([start, self.sequence[:-1]])
        mode = piecewise_constant(modes, self.times[:-1], t)
        plant = self.plant
        for part in self.parameters:
            plant = changed(plant, part.path, value_of_mode(part.values, mode))
        return plant.at(t)

    def jump_times(self) -> jax.Array:
        """The switching times and those of the inner plant, (m,) [s]."""
        return joined([self.times[:-1], jump_times_of("plant", self.plant)])

    def switching(self, end: jax.Array) -> dict[str, jax.Array]:
        """`switches`, `shortest_dwell_time` and `mean_dwell_time` of a run until `end` [s]."""
        return switching_results(self.times[:-1], end)

    def has_complete_path(self, end: jax.Array) -> jax.Array:
        """Whether a run until `end` [s] has no more than `switches` switches, () bool."""
        return self.times[-1] >= end


def _next_mode(row: jax.Array, level: jax.Array) -> jax.Array:
    """The next mode: the first k with sum_{j <= k} row_j > level.

    Args:
      row: rates to other modes, and 0 for the present mode, (modes,) [1/s].
      level: uniform between 0 and the sum of the row, () [1/s].
    """
    total = jnp.zeros_like(level)
    found = jnp.zeros_like(level)
    last = jnp.zeros_like(level)
    is_found = jnp.zeros((), bool)
    for k in range(len(row)):
        total = total + row[k]
        is_first = (total > level) & ~is_found
        found = jnp.where(is_first, float(k), found)
        is_found = is_found | is_first
        last = jnp.where(row[k] > 0, float(k), last)
    # Rounding may leave the sum of all rates below the level.
    return jnp.where(is_found, found, last)
