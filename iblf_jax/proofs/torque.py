"""The torque of the law on {V_w <= level}: the limits of a loop, and bounds that are proved.

Where every command of the law on the set is inside the limits, the loop with limits and the loop
without them have the same vector field on the set, and one statement of invariance is about both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from iblf_jax.control.actuators import Ideal, Motor
from iblf_jax.control.controllers import Saturated
from iblf_jax.core.input_limits import lower_or_opposite
from iblf_jax.proofs.points import POINTS, increased
from iblf_jax.proofs.problem import LevelSetProblem
from iblf_jax.proofs.search import SearchResult
from iblf_jax.proofs.support import unsupported
from iblf_jax.simulation.scenario import Scenario

MARGINS = (0.1, 0.2, 0.5, 2.0)
"""Distances of the bounds from the extremes that were found, in parts of the largest torque that
was found of the joint; the least one with a proof is stated."""
BOXES = 2_000_000
"""Boxes of the search with one of these distances. Two links need 0.3 to 0.5 million for the least
one."""


class TorqueRange(NamedTuple):
    """The torque of the law on {V_w <= level} of each joint, (n,) each [N m]."""

    lowest: np.ndarray
    """Proved lower bound of the whole set; -inf without a proof."""
    highest: np.ndarray
    """Proved upper bound of the whole set; inf without a proof."""
    found_lowest: np.ndarray
    """The least torque that was found at points of V_w = level."""
    found_highest: np.ndarray
    """The largest torque that was found there."""
    boxes: int
    """Boxes of the search that proved the bounds, or of the last one."""

    @property
    def largest(self) -> np.ndarray:
        """The proved bound of |tau| of each joint, (n,) [N m]."""
        return np.maximum(-self.lowest, self.highest)

    @property
    def is_proved(self) -> bool:
        """Whether the bounds are proved."""
        return bool(np.isfinite(self.largest).all())

    def excess(self, limits: np.ndarray) -> float:
        """How far the torque that was found is beyond limits, (2, n) [N m], in parts of their
        distance [1]; 0 or less where it is inside.
        """
        lower, upper = limits
        beyond = np.maximum(lower - self.found_lowest, self.found_highest - upper)
        return float(np.max(beyond / (upper - lower)))


def without_limits(scenario: Scenario) -> tuple[Scenario, np.ndarray | None]:
    """The loop without limits of its torque, and the limits, (2, n) [N m]; None without any.

    Limits are those of `Saturated`, also with an auxiliary state, which stays 0 inside them, and
    those of a `Motor` that has nothing but limits.

    Raises:
      ValueError: a smooth limit, or limits that exclude each other.
    """
    law, actuator = scenario.controller, scenario.actuator
    ends = []
    if type(law) is Saturated:
        if law.edge != "hard":
            reason = "A smooth limit changes the torque inside the limits, too."
            raise unsupported("controller.edge", law.edge, '"hard"', reason)
        ends.append((lower_or_opposite(law.lower_limit, law.limit), law.limit))
        law = law.law
    if type(actuator) is Motor and _has_only_limits(actuator):
        ends.append((lower_or_opposite(actuator.lower_limit, actuator.limit), actuator.limit))
        actuator = Ideal()
    free = dataclasses.replace(scenario, controller=law, actuator=actuator)
    if not ends:
        return free, None
    lowers, uppers = zip(*ends, strict=True)
    one = np.ones(scenario.n)
    lower = np.max([one * np.asarray(x, float) for x in lowers], axis=0)
    upper = np.min([one * np.asarray(x, float) for x in uppers], axis=0)
    if np.any(lower >= upper):
        reason = "No torque is within the limits of law and actuator."
        raise unsupported("actuator", f"{lower} to {upper} N m", "limits that overlap", reason)
    return free, np.stack([lower, upper])


def _has_only_limits(motor: Motor) -> bool:
    others = (motor.bandwidth, motor.rate_limit, motor.stall)
    return motor.limit is not None and all(x is None for x in others)


def found_torque(
    problem: LevelSetProblem, constants: Sequence[np.ndarray], seed: int
) -> TorqueRange:
    """The extremes of the torque that were found at points of V_w = level, without a proof."""
    points = problem.sample(seed, POINTS)
    n = problem.scenario.n
    ends = np.empty((2, n))
    for row, sign in enumerate((-1.0, 1.0)):
        for joint in range(n):

            def signed(some: np.ndarray, joint: int = joint, sign: float = sign) -> np.ndarray:
                return sign * problem.torques(some, constants)[:, joint]

            ends[row, joint] = sign * increased(signed, problem, points, seed)[1][0]
    unknown = np.full(n, np.inf)
    return TorqueRange(-unknown, unknown, ends[0], ends[1], 0)


def proved_torque(
    problem: LevelSetProblem,
    constants: Sequence[np.ndarray],
    found: TorqueRange,
    limits: np.ndarray | None,
    searched: Callable[..., SearchResult],
    max_boxes: int,
) -> TorqueRange:
    """Bounds of the torque on the whole set, which are not wider than limits; `found` without a
    proof.

    Args:
      problem: the statement.
      constants: of its weight and level.
      found: the extremes that were found.
      limits: of the torque, (2, n) [N m], or None.
      searched: `search` with options of the caller.
      max_boxes: of the last search, if there are limits.
    """
    size = np.maximum(np.abs(found.found_lowest), np.abs(found.found_highest))
    assert problem.torque is not None
    lower, upper, scales = problem.whole_set
    for margin in MARGINS:
        ends = np.stack([found.found_lowest - margin * size, found.found_highest + margin * size])
        most = min(BOXES, max_boxes)
        if limits is not None:
            ends = np.clip(ends, *limits)
            most = max_boxes if margin == MARGINS[-1] else most
        result = searched(
            problem.torque.excess,
            lower,
            upper,
            [*constants, *ends],
            scales=scales,
            max_boxes=most,
        )
        found = found._replace(boxes=result.boxes)
        if result.proved:
            return found._replace(lowest=ends[0], highest=ends[1])
    return found
