"""The links of a chain with the bodies that are welded to them, and the test whether its mass
matrix is positive definite.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from iblf_jax.world.robots.description import Shown
from iblf_jax.world.robots.repair import (
    GYRATION_FRACTION,
    LENGTH_RESOLUTION,
    POSITIVE_DEFINITE,
    ROUNDING,
    Fault,
    Repairs,
    fault,
    is_nothing,
    moments_of,
    second_moments,
    thickened,
)

Pose = tuple[np.ndarray, np.ndarray]
"""Position and rotation matrix."""
SINGULAR_FRACTION = 1e-12
"""Share of a joint's inertia below which the rest, with the joints beyond it free, is rounding."""
CONFIGURATIONS = 8
"""Random configurations, besides zero and the middle of the ranges, at which the mass matrix is
tested."""


class Links(NamedTuple):
    """The links of a chain, with the bodies that are welded to them."""

    names: tuple[str, ...]
    position: np.ndarray
    rotation: np.ndarray
    moments: np.ndarray
    """Pseudo-inertias in the links' frames, (n, 4, 4)."""
    between: tuple[bool, ...]
    """Whether a link lies between two joints of one body, and so weighs nothing."""
    frames: dict[int, Pose]
    """Body -> its pose in the frame of the link that carries it."""
    carrier: dict[int, int]
    """Body -> that link, -1 for the base."""

    def repaired(self, joints: dict[str, Any], repairs: Repairs) -> Links:
        """The links after the repair of those that would leave the mass matrix singular.

        Args:
          joints: fields of an Arm: axis, armature, lower, upper, kinds.

        Raises:
          ValueError: a link that moves without a mass or an inertia.
        """
        links = self
        for i, P in enumerate(self.moments):
            if P[3, 3] > 0 and is_nothing(_about_centre(P), P[3, 3]):
                links = links._compact(i, repairs)
        while (k := links._without_inertia(joints)) is not None:
            if not links.moments[k, 3, 3] > 0:
                remedy = "Give it an inertial, lock or fix its joint, or take a tip before it."
                raise links._massless(k, remedy).error
            links = links._compact(k, repairs)
        for i, P in enumerate(self.moments):
            if not self.between[i] and not P[3, 3] > 0:
                kept = "no mass, as it is: the mass matrix is positive definite all the same"
                remedy = "Give it an inertial, or fix its joint."
                repairs.handle(self._massless(i, remedy, kept))
        return links

    def _massless(self, i: int, remedy: str, repaired: str = "") -> Fault:
        expected = "a mass [kg] of each link that moves"
        return fault(f"link {self.names[i]!r}", Shown("no mass"), expected, repaired, remedy=remedy)

    def _compact(self, i: int, repairs: Repairs) -> Links:
        """The links, with link i as a compact body where it is a point, or a rod along its
        joint.
        """
        P, where = self.moments[i], f"link {self.names[i]!r}: inertia"
        m, J = P[3, 3], _about_centre(P)
        if is_nothing(J, m):
            J = np.zeros((3, 3))
        expected, remedy = POSITIVE_DEFINITE
        nearest = thickened(J, m * (GYRATION_FRACTION * self._longest()) ** 2)
        found = fault(where, moments_of(J), expected, moments_of(nearest), remedy=remedy)
        # All links may be in one point, or the links beyond may be far heavier.
        if not np.trace(nearest) > np.trace(J) * (1.0 + ROUNDING):
            raise found.error
        repairs.handle(found)
        moments = self.moments.copy()
        moments[i, :3, :3] += second_moments(nearest) - second_moments(J)
        return self._replace(moments=moments)

    def _longest(self) -> float:
        """Length [m] of the longest link; if all links are in one point, the distance from the base
        to the first joint.
        """
        centres = self.moments[:, :3, 3] / np.maximum(self.moments[:, 3, 3], 1e-300)[:, None]
        places = [p for body, (p, _) in self.frames.items() if self.carrier[body] >= 0]
        longest = float(np.max(np.linalg.norm([*centres, *places, *self.position[1:]], axis=1)))
        if longest > LENGTH_RESOLUTION:
            return longest
        return float(np.linalg.norm(self.position[0]))

    def _without_inertia(self, joints: dict[str, Any]) -> int | None:
        """The link nearest to the tip that, at some configuration, adds no inertia to its joint
        when the joints beyond are free; None if all links add some.
        """
        is_revolute = np.array([kind == "revolute" for kind in joints["kinds"]])
        wide = np.where(is_revolute, np.pi, 1.0)
        lower, upper = np.clip(joints["lower"], -wide, wide), np.clip(joints["upper"], -wide, wide)
        shares = np.random.default_rng(0).uniform(size=(CONFIGURATIONS, len(is_revolute)))
        q = np.stack(
            [np.zeros(len(is_revolute)), 0.5 * (lower + upper), *(lower + shares * (upper - lower))]
        )
        found: list[int] = []
        for M in self._mass_matrices(q, is_revolute, joints["axis"]) + np.diag(joints["armature"]):
            threshold = SINGULAR_FRACTION * np.diag(M) + np.where(
                is_revolute, self.moments[:, 3, 3] * LENGTH_RESOLUTION**2, 0.0
            )
            for k in reversed(range(len(is_revolute))):
                if not M[k, k] > threshold[k]:
                    found.append(k)
                    break
                M[:k, :k] -= np.outer(M[:k, k], M[k, :k]) / M[k, k]
        return max(found, default=None)

    def _mass_matrices(
        self, q: np.ndarray, is_revolute: np.ndarray, axes: np.ndarray
    ) -> np.ndarray:
        """M_jk = tr(X_j C_k X_k^T), j <= k, at each row of q; C_k are the moments of all links from
        k on, X_j the 4 x 4 matrix of the motion of joint j.
        """
        H, motions, moments = np.broadcast_to(np.eye(4), (len(q), 4, 4)), [], []
        for i, axis in enumerate(axes):
            fixed, X, moved = np.eye(4), np.zeros((4, 4)), np.tile(np.eye(4), (len(q), 1, 1))
            fixed[:3, :3], fixed[:3, 3] = self.rotation[i], self.position[i]
            if is_revolute[i]:
                x, y, z = axis
                X[:3, :3] = K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
                moved[:, :3, :3] += np.sin(q[:, i])[:, None, None] * K + (1.0 - np.cos(q[:, i]))[
                    :, None, None
                ] * (K @ K)
            else:
                X[:3, 3] = axis
                moved[:, :3, 3] = q[:, i, None] * axis
            H = H @ fixed
            motions.append(H @ X @ np.linalg.inv(H))
            H = H @ moved
            moments.append(H @ self.moments[i] @ np.swapaxes(H, 1, 2))
        beyond = np.cumsum(moments[::-1], axis=0)[::-1]
        upper = np.einsum(
            "jbxy,kbyz,kbxz->bjk", np.array(motions), beyond, np.array(motions), optimize=True
        )
        return np.triu(upper) + np.swapaxes(np.triu(upper, 1), 1, 2)

    def parameters(self) -> dict[str, Any]:
        """The fields of an Arm."""
        mass = self.moments[:, 3, 3]
        centre = self.moments[:, :3, 3] / np.where(mass > 0, mass, 1.0)[:, None]
        J = np.array([_about_centre(P) for P in self.moments])
        inertia = np.stack(
            [J[:, i, k] for i, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], axis=1
        )
        rotation = np.array([quaternion(R) for R in self.rotation])
        return {
            "mass": mass,
            "centre": centre,
            "inertia": inertia,
            "position": self.position,
            "rotation": rotation,
        }


def _about_centre(P: np.ndarray) -> np.ndarray:
    """Inertia about the centre, (3, 3), of a pseudo-inertia."""
    mass = P[3, 3]
    centre = P[:3, 3] / (mass if mass > 0 else 1.0)
    S = P[:3, :3] - mass * np.outer(centre, centre)
    return np.trace(S) * np.eye(3) - S


def quaternion(R: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix, w >= 0."""
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True)
    return np.where(np.abs(q) < 1e-15, 0.0, q)
