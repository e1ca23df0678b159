"""Restoring forces of a vessel: what the position adds to its equation of motion."""

from __future__ import annotations

import abc

import jax
import jax.numpy as jnp

from iblf_jax.core.families import Part
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import Unit


class Restoring(Part):
    """The contract of a restoring force, g(eta) in M nu' + C(nu) nu + D(nu) nu + g(eta) = u."""

    @abc.abstractmethod
    def forces(self, eta: jax.Array) -> jax.Array:
        """g(eta) in the axes of the body, (3,) [N, N, N m].

        Args:
          eta: north [m], east [m] and heading [rad], (3,).
        """


@component
class Mooring(Restoring):
    """g(eta) = R(psi)^T diag(stiffness) (eta - position), of mooring lines or a positioner.

    The forces have the potential 1/2 sum stiffness_i (eta - position)_i^2.  The heading is not
    taken modulo 2 pi.

    Args:
      stiffness: in north, east and heading, (n,) = (3,) [N/m], >= 0; in heading [N m/rad].
      position: where the force is 0, (n,) = (3,) [m], the heading in rad; 0 if not given.

    Source: T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011,
      chapter 6.
    """

    stiffness: Leaf = leaf("N/m", sign="nonnegative")
    position: Leaf = leaf("m", default=0.0)

    def leaf_units(self) -> dict[str, Unit]:
        """The units of the three components."""
        return {"stiffness": ("N/m", "N/m", "N m/rad"), "position": ("m", "m", "rad")}

    def forces(self, eta: jax.Array) -> jax.Array:
        """g(eta), (3,)."""
        north, east, moment = self.stiffness * (eta - self.position)
        sine, cosine = jnp.sin(eta[2]), jnp.cos(eta[2])
        surge = cosine * north + sine * east
        sway = cosine * east - sine * north
        return jnp.stack([surge, sway, moment])
