"""The planar two-link arm with revolute joints, in closed form: the robot of the paper's
simulation.

    p1 = m1 lc1^2 + m2 l1^2 + I1,   p2 = m2 lc2^2 + I2,   p3 = m2 l1 lc2,   p4 = m1 lc1 + m2 l1,
    p5 = m2 lc2 M = [[p1 + p2 + 2 p3 cos q2, p2 + p3 cos q2], [p2 + p3 cos q2, p2]]
    C = [[-p3 q2' sin q2, -p3 (q1' + q2') sin q2], [p3 q1' sin q2, 0]]
    G = [p4 g cos q1 + p5 g cos(q1 + q2), p5 g cos(q1 + q2)]

q1 is measured from the horizontal, q2 from the first link.  A point mass m at the tip adds m l1^2
to p1, m l2^2 to p2, m l1 l2 to p3, m l1 to p4 and m l2 to p5.  (Some papers print p4 with lc2 in
place of lc1; that is a slip.)
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.robots._base import Robot, broadcast_fields, planar_skeleton


class LumpedParameters(NamedTuple):
    """The five numbers through which masses and lengths enter: p1, p2, p3 [kg m^2], p4, p5 [kg
    m].
    """

    p1: jax.Array
    p2: jax.Array
    p3: jax.Array
    p4: jax.Array
    p5: jax.Array


@component
class TwoLink(Robot):
    """Planar two-link arm; all its parameters are leaves.

    Args:
      mass: mass of each link, () or (n,), n = 2 links, [kg], > 0.
      length: length of each link, () or (n,) [m], > 0.
      centre: distance of each link's centre of mass from its joint, () or (n,) [m], >= 0.
      inertia: moment of inertia of each link about its centre of mass, () or (n,) [kg m^2], >= 0.
      g: acceleration of gravity, () [m/s^2]; 9.81 if not given.
      payload: point mass at the tip, () [kg], >= 0; 0 if not given.

    Source: Zhang & Yan 2024, section 4, which refers to others for the matrices; see the head of
      this module.
    """

    mass: Leaf = leaf("kg", sign="positive")
    length: Leaf = leaf("m", sign="positive")
    centre: Leaf = leaf("m", sign="nonnegative")
    inertia: Leaf = leaf("kg m^2", sign="nonnegative")
    g: Leaf = leaf("m/s^2", shape="scalar", default=9.81)
    payload: Leaf = leaf("kg", sign="nonnegative", shape="scalar", default=0.0)

    def check(self) -> None:
        """Broadcasts scalars to the two links; raises ValueError for any other number of links."""
        broadcast_fields(self, ("mass", "length", "centre", "inertia"), (2,))

    @property
    def n(self) -> int:
        """Number of joints, 2."""
        return 2

    @partial(jax.jit, inline=True)  # so that it is traced once for all that is made of it
    def lumped(self) -> LumpedParameters:
        """p1 ... p5 (head of this module), the payload included."""
        m1, m2 = self.mass[0], self.mass[1]
        l1, l2 = self.length[0], self.length[1]
        lc1, lc2 = self.centre[0], self.centre[1]
        return LumpedParameters(
            p1=m1 * lc1**2 + (m2 + self.payload) * l1**2 + self.inertia[0],
            p2=m2 * lc2**2 + self.payload * l2**2 + self.inertia[1],
            p3=m2 * l1 * lc2 + self.payload * l1 * l2,
            p4=m1 * lc1 + (m2 + self.payload) * l1,
            p5=m2 * lc2 + self.payload * l2,
        )

    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q), (2, 2) [kg m^2]."""
        p = self.lumped()
        coupling = p.p3 * jnp.cos(q[1])
        off = p.p2 + coupling
        return jnp.stack([jnp.stack([p.p1 + off + coupling, off]), jnp.stack([off, p.p2])])

    def coriolis(self, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        """C(q, v) u, (2,) [N m]."""
        c = self.lumped().p3 * jnp.sin(q[1])
        return jnp.stack([-c * (v[1] * u[0] + (v[0] + v[1]) * u[1]), c * v[0] * u[0]])

    def gravity(self, q: jax.Array) -> jax.Array:
        """G(q), (2,) [N m]."""
        p, c1 = self.lumped(), jnp.cos(q[0])
        # cos(q1 + q2): M and C need cos q2 and sin q2 too, and a third angle costs more than two
        # products.
        outer = p.p5 * self.g * (c1 * jnp.cos(q[1]) - jnp.sin(q[0]) * jnp.sin(q[1]))
        return jnp.stack([p.p4 * self.g * c1 + outer, outer])

    def potential(self, q: jax.Array) -> jax.Array:
        """U(q) = p4 g sin q1 + p5 g sin(q1 + q2), () [J]."""
        p = self.lumped()
        return self.g * (p.p4 * jnp.sin(q[0]) + p.p5 * jnp.sin(q[0] + q[1]))

    def tip(self, q: jax.Array) -> jax.Array:
        """Position of the tip, (2,) [m]."""
        return self.skeleton(q)[-1]

    def jacobian(self, q: jax.Array) -> jax.Array:
        """D tip / dq, (2, 2) [m/rad]."""
        l1, l2 = self.length[0], self.length[1]
        s1, c1 = l1 * jnp.sin(q[0]), l1 * jnp.cos(q[0])
        s12, c12 = l2 * jnp.sin(q[0] + q[1]), l2 * jnp.cos(q[0] + q[1])
        return jnp.stack([jnp.stack([-s1 - s12, -s12]), jnp.stack([c1 + c12, c12])])

    def skeleton(self, q: jax.Array) -> jax.Array:
        """Base, elbow and tip, (3, 2) [m]."""
        return planar_skeleton(self.length, q)
