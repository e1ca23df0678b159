"""Faults of links and joints in robot files, and the rules by which `load(..., repair=True)`
corrects them.

A body's second moments of mass about its centre are, with V orthogonal,

    S = int r r^T dm = 1/2 tr(J) 1 - J = V diag(s) V^T,

and no body has a negative s: J is then positive, and no principal moment exceeds the sum of the two
others.  The nearest inertia that a body can have (the least change of S, and so of the
pseudo-inertia, in the Frobenius norm; mass and centre stay) is

    S' = V diag(max(s, f)) V^T,   J' = tr(S') 1 - S',

with f = 0.  A moving link that would add no inertia to its joint gets f = m (L / 100)^2, with its
mass m and the length L of the longest link of the chain: it becomes a compact body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.world.robots.description import Shown

ROUNDING = 1e-6
"""Relative error of a body's moments in a file that has seven digits."""
LENGTH_RESOLUTION = 1e-6
"""Accuracy of the lengths of links [m]; moments below mass LENGTH_RESOLUTION^2 count as zero."""
GYRATION_FRACTION = 0.01
"""Radius of gyration that a link without inertia receives, relative to the longest link."""


POSITIVE_DEFINITE = ("a positive definite inertia [kg m^2]", "A body that moves needs one.")
"""What a message expects of the inertia of a moving body, and the remedy."""


class Fault(NamedTuple):
    """A fault of a link or joint, and the value that repairs it."""

    where: str
    got: str
    error: ValueError
    repaired: str = ""
    """The value after the repair; empty if there is no repair."""


def fault(
    field: str, got: object, expected: str, repaired: str = "", *, remedy: str = "", where: str = ""
) -> Fault:
    """A fault with its error.

    Args:
      field: the faulty field, for the error.
      got: its value, as `checks.fail` takes it.
      expected: what the field must be.
      repaired: the value after the repair; empty if there is no repair.
      remedy: what a user can do in place of a repair.
      where: what the list of repairs calls the place; the field if not given.
    """
    return Fault(where or field, str(got), checks.fail(field, got, expected, remedy), repaired)


class Repairs:
    """Handles faults: repairs and lists them if `enabled`, and raises their errors otherwise."""

    def __init__(self, enabled: bool) -> None:
        self.enabled = enabled
        self.lines: list[str] = []

    def handle(self, fault: Fault) -> None:
        """Lists the repair of a fault; raises its error if no repair exists or is allowed."""
        if not fault.repaired:
            raise fault.error
        if not self.enabled:
            raise ValueError(
                f"{fault.error} Or load it with repair=True, which makes of it: {fault.repaired}."
            )
        line = f"{fault.where}: from {fault.got} to {fault.repaired}"
        if line not in self.lines:
            self.lines.append(line)


class Weight(NamedTuple):
    """Mass and inertia of a body, about its centre and along given axes."""

    mass: float = 0.0
    inertia: np.ndarray = np.zeros((3, 3))
    """(3, 3) [kg m^2]."""
    fault: Fault | None = None
    nearest: np.ndarray | None = None
    """The inertia that replaces it, where a fault can be repaired."""

    def repaired(self, repairs: Repairs) -> Weight:
        """The weight after the repair of its fault."""
        if self.fault is None:
            return self
        repairs.handle(self.fault)
        if self.nearest is None:
            return Weight(self.mass, self.inertia)
        return Weight(self.mass, self.nearest)


def symmetric(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> np.ndarray:
    """A symmetric matrix, (3, 3), of its six numbers."""
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def second_moments(J: np.ndarray) -> np.ndarray:
    """S of an inertia J, both (3, 3)."""
    return 0.5 * np.trace(J) * np.eye(3) - J


def thickened(J: np.ndarray, least: float) -> np.ndarray:
    """The inertia nearest to J whose second moments are at least `least` [kg m^2]."""
    s, V = np.linalg.eigh(second_moments(J))
    S = (V * np.maximum(s, least)) @ V.T
    return np.trace(S) * np.eye(3) - S


def moments_of(J: np.ndarray) -> Shown:
    """The text by which messages show an inertia."""
    return Shown("principal moments " + ", ".join(f"{x:.4g}" for x in np.linalg.eigvalsh(J)))


def is_nothing(J: np.ndarray, mass: float) -> bool:
    """Whether a body with this inertia is a point, within rounding."""
    return bool(np.trace(J) <= mass * LENGTH_RESOLUTION**2)


def checked_weight(where: str, mass: float, J: np.ndarray) -> Weight:
    """The weight that a file gives a body, with its fault if it has one.

    Args:
      where: name of the body in messages.
      mass: [kg].
      J: (3, 3) about the centre [kg m^2]; a point mass and a thin rod are bodies, too.
    """
    field = f"{where}: inertia"
    if mass < 0:
        return Weight(fault=fault(f"{where}: mass", mass, "a mass >= 0 kg"))
    if mass == 0:
        if not np.any(J):
            return Weight()
        nearest = thickened(J, 0.0)
        remedy = "Give it its mass, or remove its inertia: tools differ in what they make of this."
        without_mass = fault(
            f"{where}: inertial",
            Shown("an inertia without a mass"),
            "both or neither",
            f"a body that turns but weighs nothing, {moments_of(nearest)}",
            remedy=remedy,
            where=field,
        )
        return Weight(0.0, J, without_mass, nearest)
    moments = np.linalg.eigvalsh(J)
    s = np.linalg.eigvalsh(second_moments(J))
    rounding = ROUNDING * np.abs(moments).sum() + mass * LENGTH_RESOLUTION**2
    if s[0] >= -0.5 * rounding:
        return Weight(mass, J)
    nearest = thickened(J, 0.0)
    expected = "none above the sum of the two others"
    remedy = "No body has such an inertia: look at the units, the signs and the frame."
    if moments[0] < -rounding:
        expected, remedy = POSITIVE_DEFINITE
    found = fault(field, moments_of(J), expected, moments_of(nearest), remedy=remedy)
    return Weight(mass, J, found, nearest)
