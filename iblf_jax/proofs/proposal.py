"""The level that `prove` takes if the caller gives none: one whose set contains the start.

The level set of a weight w contains the start if

    V1 + e2^T M0 e2 / 2 + w |f_tilde|^2 / 2 <= level   at t = 0,

for the plants at the corners of the box, because f_tilde depends on the plant.  Up to which level
V_w' < 0 holds at the points that are found, for a weight of these, is searched by bisection.  The
least levels that contain the start may leave weights only that are too small.  Near the largest
level a proof needs many boxes, so that half of it is taken, or the least one that was found if that
is more.  The proof decides; nothing here is part of it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core import programs
from iblf_jax.proofs.problem import LevelSetProblem
from iblf_jax.proofs.sampled_values import before_sampling, terms
from iblf_jax.proofs.torque import without_limits
from iblf_jax.simulation import closed_loop, paths
from iblf_jax.simulation.scenario import Scenario

SHARE = 0.5
"""Part of the largest level without a point with V_w' > 0 that is taken."""
RATIO = 1.1
"""Ratio of two levels at which the bisection ends."""
DOUBLINGS = 12
"""Doublings of the least level that are tried."""
LEAST = 1e-6
"""The least level: V_w of a start on the reference may be 0."""
ROOM = 1.4
"""Factor of a weight with which its set still contains the start: `prove` tries larger ones."""


class Start(NamedTuple):
    """V_w of the start, the largest one of the plants at the corners of the box."""

    energy: float
    """Without the term of f_tilde [N m rad]."""
    half_square: float
    """|f_tilde|^2/2 [(N m)^2]."""

    def level(self, weight: float) -> float:
        """V_w at a weight [N m rad]."""
        return self.energy + weight * self.half_square


class LevelChoice(NamedTuple):
    """Between which levels `prove` chose, in the unit of V_w."""

    start: float
    """V_w of the start at the weight of the proof, the largest one of the plants at the corners of
    the box."""
    largest: float
    """The greatest level at which no point with V_w' > 0, and no torque beyond limits that the
    bound cannot take as active, was found for a weight whose set contains the start; 0 if there is
    none."""


class Proposal(NamedTuple):
    """A level, and the weights with which its set contains the start."""

    level: float
    weights: list[float]
    largest: float
    """As in `LevelChoice`."""


def start_of(problem: LevelSetProblem) -> Start:
    """V_w of the start of a robot's scenario."""
    uncertain = problem.uncertain
    energies, squares = [], []
    for corner in itertools.product(*zip(uncertain.low, uncertain.high, strict=True)):
        with_plant = paths.with_parameters(problem.scenario, uncertain.values(corner))
        energy, square = _terms_of_start(before_sampling(without_limits(with_plant)[0]))
        energies.append(float(energy))
        squares.append(float(square))
    return Start(max(energies), max(squares))


@programs.jit
def _terms_of_start(scenario: Scenario) -> tuple[jax.Array, jax.Array]:
    """V_w without the term of f_tilde, and |f_tilde|^2/2, at the start."""
    return terms(scenario, jnp.zeros(()), closed_loop.initial_state(scenario))


def proposed_level(
    start: Start, weights: Sequence[float], decreases: Callable[[float, list[float]], bool]
) -> Proposal:
    """A level whose set contains the start.

    Args:
      start: of the scenario.
      weights: that may be chosen [rad/(N m)].
      decreases: level and weights -> whether a weight has no point of the level set with V_w' > 0
        or with a torque beyond limits that may not be active, as far as one was found; False for a
        level that is not admitted.
    """
    least = min(start.level(ROOM * w) for w in weights)

    def containing(level: float) -> list[float]:
        return [w for w in weights if start.level(ROOM * w) <= level]

    low = max(least, LEAST)
    succeeded: list[float] = []
    for doubling in range(DOUBLINGS):
        high = low * 2.0**doubling
        if decreases(high, containing(high)):
            succeeded.append(high)
        elif succeeded:
            break
    if not succeeded:
        return Proposal(low, containing(low), 0.0)
    largest = succeeded[-1]
    high = 2.0 * largest
    while high > RATIO * largest:
        middle = math.sqrt(largest * high)
        if decreases(middle, containing(middle)):
            largest = middle
        else:
            high = middle
    level = max(SHARE * largest, succeeded[0])
    return Proposal(level, containing(level), largest)
