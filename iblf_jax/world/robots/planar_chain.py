"""A planar chain of n revolute links.

With the absolute link angles phi_i = q_1 + ... + q_i, the unit vectors e_i = (cos phi_i, sin phi_i)
along the links and E_i = (-sin phi_i, cos phi_i) across them, the mass matrix of these angles is

    H_ij = l_i b_j E_i . E_j  for i < j,    H_ii = d_i

    b_i = m_i lc_i + l_i (m_{i+1} + ... + m_n + payload)
    d_i = m_i lc_i^2 + l_i^2 (m_{i+1} + ... + m_n + payload) + I_i

and M = S^T H S with phi = S q.  An entry above the diagonal is a product of one factor of each
link, so that sums along the chain give M v, C v and the inverse dynamics in O(n) operations, with
w = S v as the angular velocities:

    (H a + C)_i = d_i a_i - l_i E_i . sum_{j>i} b_j x_j - b_i E_i . sum_{j<i} l_j x_j,
    x_j = e_j w_j^2 - E_j a_j

    U = g sum_i b_i sin phi_i

M itself takes O(n^2): with W_j = b_j e_j + ... + b_n e_n, M_ij - M_{i+1,j} = l_i e_i . W_j for
i < j, and M_jj - M_{j+1,j+1} = d_j + 2 l_j e_j . W_{j+1}.  For n = 2 this is the closed form of
`TwoLink`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes
from iblf_jax.core.linalg import inner, sums_from, sums_to, symmetric
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.robots._base import Robot, broadcast_fields, planar_skeleton


class Lumped(NamedTuple):
    """The numbers of a chain on which its motion depends (head of this module), (n,) each."""

    length: jax.Array
    """l [m]."""
    first: jax.Array
    """b [kg m]."""
    second: jax.Array
    """d [kg m^2]."""

    def across(self, direction: jax.Array, x: jax.Array) -> jax.Array:
        """l_i y_i . sum_{j>i} b_j x_j + b_i y_i . sum_{j<i} l_j x_j, (n,), of vectors (2, n).

        Args:
          direction: y.
          x: the vectors in the sums.
        """
        beyond = sums_from((self.first * x)[:, 1:], axis=1)
        before = sums_to((self.length * x)[:, :-1], axis=1)
        outer = self.length[:-1] * jnp.sum(direction[:, :-1] * beyond, axis=0)
        inner = self.first[1:] * jnp.sum(direction[:, 1:] * before, axis=0)
        none = jnp.zeros((1,), x.dtype)
        return jnp.concatenate([outer, none]) + jnp.concatenate([none, inner])


def _along_and_across(q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The unit vectors e and E of the links, (2, n) each."""
    phi = sums_to(q)
    c, s = jnp.cos(phi), jnp.sin(phi)
    return jnp.stack([c, s]), jnp.stack([-s, c])


@component
class PlanarChain(Robot):
    """Planar arm with n revolute links; all its parameters are leaves.

    Args:
      mass: mass of each link, () or (n,) [kg], > 0.
      length: length of each link, () or (n,) [m], > 0.
      centre: distance of each link's centre of mass from its joint, () or (n,) [m], >= 0.
      inertia: moment of inertia of each link about its centre of mass, () or (n,) [kg m^2], >= 0.
      g: acceleration of gravity, () [m/s^2]; 9.81 if not given.
      payload: point mass at the tip, () [kg], >= 0; 0 if not given.

    Source: Lagrange's equations (head of this module).
    """

    mass: Leaf = leaf("kg", sign="positive")
    length: Leaf = leaf("m", sign="positive")
    centre: Leaf = leaf("m", sign="nonnegative")
    inertia: Leaf = leaf("kg m^2", sign="nonnegative")
    g: Leaf = leaf("m/s^2", shape="scalar", default=9.81)
    payload: Leaf = leaf("kg", sign="nonnegative", shape="scalar", default=0.0)

    def check(self) -> None:
        """Broadcasts scalars to the links; raises ValueError if the fields disagree about their
        number.
        """
        names = ("mass", "length", "centre", "inertia")
        shapes = [x.shape for x in attributes(self, names).values() if x.ndim == 1]
        if not shapes:
            raise checks.fail(
                "PlanarChain.mass",
                self.mass,
                "one number a link, (n,)",
                "One field must say how many links.",
            )
        if shapes[0] == (0,):
            raise checks.fail("PlanarChain.mass", self.mass, "at least one link")
        broadcast_fields(self, names, shapes[0])

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.mass.shape[-1]

    def _lumped(self) -> Lumped:
        """l, b and d of the links."""
        masses = jnp.concatenate([self.mass[1:], jnp.atleast_1d(self.payload)])
        beyond = sums_from(masses)
        first = self.mass * self.centre
        second = first * self.centre + self.inertia + self.length**2 * beyond
        return Lumped(self.length, first + self.length * beyond, second)

    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q), (n, n) [kg m^2]."""
        lumped, (e, _) = self._lumped(), _along_and_across(q)
        along, beyond = lumped.length * e, sums_from(lumped.first * e, axis=1)
        # Row i, column j: l_i e_i . W_j.
        products = jnp.sum(along[:, :, None] * beyond[:, None, :], axis=0)
        differences = jnp.where(np.triu(np.ones((self.n, self.n), bool), 1), products, 0.0)
        next_joint = jnp.sum(along[:, :-1] * beyond[:, 1:], axis=0)
        twice = jnp.concatenate([2.0 * next_joint, jnp.zeros((1,), q.dtype)])
        diagonal = sums_from(lumped.second + twice)
        on_diagonal = np.eye(self.n, dtype=bool)
        return symmetric(sums_from(jnp.where(on_diagonal, diagonal, differences)))

    def coriolis(self, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        """C(q, v) u, (n,) [N m], with the C of the Christoffel symbols."""
        e, E = _along_and_across(q)
        return -sums_from(self._lumped().across(E, sums_to(v) * sums_to(u) * e))

    def inverse_dynamics(
        self, q: jax.Array, v: jax.Array, u: jax.Array, acceleration: jax.Array
    ) -> jax.Array:
        """C(q, v) u + G + M acceleration, (n,) [N m], without M."""
        lumped, a = self._lumped(), sums_to(acceleration)
        e, E = _along_and_across(q)
        weight = self.g * lumped.first * e[0]
        opposite = sums_to(v) * sums_to(u) * e - a * E
        return sums_from(lumped.second * a - lumped.across(E, opposite) + weight)

    def momentum(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """M(q) v, (n,) [N m s], without M."""
        lumped, w = self._lumped(), sums_to(v)
        e = _along_and_across(q)[0]
        return sums_from(lumped.second * w + lumped.across(e, w * e))

    def energy_gradient(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """dT/dq with T = 1/2 v^T M v, (n,) [N m]."""
        w, (e, E) = sums_to(v), _along_and_across(q)
        return sums_from(w * self._lumped().across(E, w * e))

    def gravity(self, q: jax.Array) -> jax.Array:
        """G(q), (n,) [N m]."""
        return sums_from(self.g * self._lumped().first * jnp.cos(sums_to(q)))

    def potential(self, q: jax.Array) -> jax.Array:
        """U(q), () [J]."""
        return self.g * inner(self._lumped().first, jnp.sin(sums_to(q)))

    def tip(self, q: jax.Array) -> jax.Array:
        """Position of the tip, (2,) [m]."""
        return self.skeleton(q)[-1]

    def skeleton(self, q: jax.Array) -> jax.Array:
        """Base, joints and tip, (n + 1, 2) [m]."""
        return planar_skeleton(self.length, q)
