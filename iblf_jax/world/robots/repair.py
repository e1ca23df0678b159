"""What a file says of a link or joint that cannot be, and the rule by which `load(...,
repair=True)` mends it.

A body's second moments of mass about its centre are, with V orthogonal,

    S = int r r^T dm = 1/2 tr(J) 1 - J = V diag(s) V^T,

and no body has a negative s: J is then positive, and no principal moment is above the sum of the
  two others.  The nearest inertia that a
body can have (the least change of S, and so of the pseudo-inertia, in the Frobenius norm; mass and
centre stay) is

    S' = V diag(max(s, f)) V^T,   J' = tr(S') 1 - S',

with f = 0; for a link that moves and would resist its joint with nothing, f = m (L / 100)^2, m its
mass and L the length of the longest link of the chain: a compact body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.world.robots.description import Shown

ROUNDING = 1e-6
"""Of a body's moments: what a file with seven digits cannot say."""
FINEST = 1e-6
"""[m]: no link is known to a finer length, so moments of mass FINEST^2 are none."""
COMPACT = 0.01
"""Radius of gyration, along each axis, of a link that had no inertia, by the length of the
longest."""


class Fault(NamedTuple):
    """What is wrong with a link or joint, and what it would become."""

    where: str
    got: str
    error: ValueError
    to: str = ""
    """What `repair=True` makes of it; nothing if it cannot be mended."""


class Repairs:
    """Meets faults: mends and lists them where that was asked for, refuses the file elsewhere."""

    def __init__(self, wanted: bool) -> None:
        self.wanted = wanted
        self.lines: list[str] = []

    def meet(self, fault: Fault) -> None:
        """Raises the fault, or lists what it becomes."""
        if not fault.to:
            raise fault.error
        if not self.wanted:
            raise ValueError(
                f"{fault.error} Or load it with repair=True, which makes of it: {fault.to}."
            )
        line = f"{fault.where}: from {fault.got} to {fault.to}"
        if line not in self.lines:
            self.lines.append(line)


class Weight(NamedTuple):
    """What a body weighs, about its centre and along given axes."""

    mass: float = 0.0
    inertia: np.ndarray = np.zeros((3, 3))
    """(3, 3) [kg m^2]."""
    fault: Fault | None = None
    nearest: np.ndarray | None = None
    """The inertia to take in its place, where there is a fault that can be mended."""

    def repaired(self, repairs: Repairs) -> Weight:
        """The weight to count, its fault met."""
        if self.fault is None:
            return self
        repairs.meet(self.fault)
        return Weight(self.mass, self.inertia if self.nearest is None else self.nearest)


def second_moments(J: np.ndarray) -> np.ndarray:
    """S of an inertia J, both (3, 3)."""
    return 0.5 * np.trace(J) * np.eye(3) - J


def thickened(J: np.ndarray, least: float) -> np.ndarray:
    """The inertia nearest to J whose second moments are at least `least` [kg m^2]."""
    s, V = np.linalg.eigh(second_moments(J))
    S = (V * np.maximum(s, least)) @ V.T
    return np.trace(S) * np.eye(3) - S


def moments_of(J: np.ndarray) -> Shown:
    """How an inertia is called in messages."""
    return Shown("principal moments " + ", ".join(f"{x:.4g}" for x in np.linalg.eigvalsh(J)))


def is_nothing(J: np.ndarray, mass: float) -> bool:
    """Whether a body with this inertia is a point, within rounding."""
    return bool(np.trace(J) <= mass * FINEST**2)


def judged(where: str, mass: float, J: np.ndarray) -> Weight:
    """The weight that a file gives a body, with what is wrong with it.

    Args:
      where: name of the body in messages.
      mass: [kg].
      J: (3, 3) about the centre [kg m^2]; a point mass and a thin rod are bodies, too.
    """
    field = f"{where}: inertia"
    if mass < 0:
        return Weight(
            fault=Fault(where, f"{mass} kg", checks.fail(f"{where}: mass", mass, "a mass >= 0 kg"))
        )
    if mass == 0:
        if not np.any(J):
            return Weight()
        remedy = "Give it its mass, or remove its inertia: tools differ in what they make of this."
        error = checks.fail(
            f"{where}: inertial", Shown("an inertia without a mass"), "both or neither", remedy
        )
        nearest = thickened(J, 0.0)
        return Weight(
            0.0,
            J,
            Fault(
                field,
                "an inertia without a mass",
                error,
                f"a body that turns but weighs nothing, {moments_of(nearest)}",
            ),
            nearest,
        )
    moments, s = np.linalg.eigvalsh(J), np.linalg.eigvalsh(second_moments(J))
    rounding = ROUNDING * np.abs(moments).sum() + mass * FINEST**2
    if s[0] >= -0.5 * rounding:
        return Weight(mass, J)
    shown, nearest = moments_of(J), thickened(J, 0.0)
    if moments[0] < -rounding:
        error = checks.fail(
            field, shown, "a positive definite inertia [kg m^2]", "A body that moves needs one."
        )
    else:
        remedy = "No body has such an inertia: look at the units, the signs and the frame."
        error = checks.fail(field, shown, "none above the sum of the two others", remedy)
    return Weight(mass, J, Fault(field, shown, error, moments_of(nearest)), nearest)
