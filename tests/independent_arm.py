"""A planar arm of two links in plain NumPy, by Lagrange's equations: a second opinion.

Angles are absolute for the first link and relative for the second one, the first measured from the
horizontal; gravity points down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TwoLinkArm:
    """Masses [kg], lengths and distances of the centres of mass [m], inertias [kg m^2]."""

    mass: tuple[float, float]
    length: tuple[float, float]
    centre: tuple[float, float]
    inertia: tuple[float, float]
    g: float = 9.81

    def mass_matrix(self, q):
        """M, (2, 2)."""
        (m1, m2), l1 = self.mass, self.length[0]
        c1, c2 = self.centre
        second = self.inertia[1] + m2 * c2**2
        coupled = m2 * l1 * c2 * np.cos(q[1])
        first = self.inertia[0] + m1 * c1**2 + m2 * l1**2 + second + 2.0 * coupled
        return np.array([[first, second + coupled], [second + coupled, second]])

    def bias(self, q, v):
        """C(q, v) v + G, (2,)."""
        (m1, m2), l1 = self.mass, self.length[0]
        c1, c2 = self.centre
        h = m2 * l1 * c2 * np.sin(q[1])
        coriolis = np.array([-h * v[1] * (2.0 * v[0] + v[1]), h * v[0] ** 2])
        tip = m2 * c2 * np.cos(q[0] + q[1])
        gravity = self.g * np.array([(m1 * c1 + m2 * l1) * np.cos(q[0]) + tip, tip])
        return coriolis + gravity

    def acceleration(self, q, v, tau):
        """q", (2,)."""
        return np.linalg.solve(self.mass_matrix(q), tau - self.bias(q, v))

    def inverse_dynamics(self, q, v, acceleration):
        """M q" + C v + G, (2,)."""
        return self.mass_matrix(q) @ acceleration + self.bias(q, v)
