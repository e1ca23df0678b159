"""A planar chain of n revolute links, from its energies alone.

In absolute link angles theta_i = q_1 + ... + q_i the mass matrix is H_ij = A_ij cos(theta_i -
theta_j) + I_i delta_ij, where A collects the masses: link k moves with every link before it, at its
full length l_i, and with itself at lc_k,

    A_ij = sum_k m_k a_ki a_kj,    a_ki = l_i for i < k, lc_k for i = k, 0 beyond,

and M = S^T H S with theta = S q.  U = g sum_k m_k sum_i a_ki sin theta_i.  C and G come by
automatic differentiation. For n = 2 this is the closed form of `TwoLink`, which the tests hold it
to.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.linalg import inner, matmul, matvec
from iblf_jax.core.optional import attributes
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.robots._base import broadcast_fields, from_energy, planar_skeleton


@component
@from_energy
class PlanarChain:
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

    def _lever_arms(self) -> tuple[jax.Array, jax.Array]:
        """Masses (n + 1,) and lever arms a_ki (n + 1, n): the links, then the payload as a mass at
        the tip.
        """
        before = np.tril(np.ones((self.n + 1, self.n)), -1)
        own = np.eye(self.n + 1, self.n)
        arms = (
            jnp.asarray(before, self.length.dtype) * self.length
            + jnp.asarray(own, self.length.dtype) * self.centre
        )
        masses = jnp.concatenate([self.mass, jnp.atleast_1d(self.payload)])
        return masses, arms

    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q), (n, n) [kg m^2]."""
        masses, arms = self._lever_arms()
        A = matmul(arms.T, masses[:, None] * arms)
        theta = jnp.cumsum(q)
        c, s = jnp.cos(theta), jnp.sin(theta)
        H = A * (c[:, None] * c[None, :] + s[:, None] * s[None, :]) + jnp.diag(self.inertia)
        S = jnp.asarray(np.tril(np.ones((self.n, self.n))), H.dtype)
        return matmul(S.T, matmul(H, S))

    def potential(self, q: jax.Array) -> jax.Array:
        """U(q), () [J]."""
        masses, arms = self._lever_arms()
        return self.g * inner(matvec(arms.T, masses), jnp.sin(jnp.cumsum(q)))

    def tip(self, q: jax.Array) -> jax.Array:
        """Position of the tip, (2,) [m]."""
        return self.skeleton(q)[-1]

    def skeleton(self, q: jax.Array) -> jax.Array:
        """Base, joints and tip, (n + 1, 2) [m]."""
        return planar_skeleton(self.length, q)
