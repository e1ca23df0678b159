"""The load of an arm: a rigid body at its tip, from the start or from a given time on.

A load that is picked up is at rest relative to the gripper when it is gripped, so there is no
impulse and q' does not jump.  The gripper takes over its weight within `rise` seconds, by the share

    s(t) = x^3 (10 - 15 x + 6 x^2),   x = (t - start) / rise, clipped to [0, 1],

and the arm moves as one with the mass s m and the inertia s I at each instant: M(q; s) q" + C(q,
q'; s) q' + G(q; s) = tau + f.  So f is differentiable (Assumption 1).  The law's model does not
depend on time: only the plant can have a load with a `start`.
"""

from __future__ import annotations

import copy

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.time import no_times
from iblf_jax.world.robots.spatial import pseudo_inertia


@component
class Payload:
    """A rigid body that is fixed to the tip's frame; nothing by default.

    Args:
      mass: mass of the load, () [kg], >= 0; 0 if not given.
      centre: its centre of mass in the tip's frame, (3,) [m]; the tip if not given.
      inertia: about its centre, along the tip's axes, (6,): xx, yy, zz, xy, xz, yz [kg m^2]; 0 if
        not given.
      start: time at which it is picked up, () [s]; present from the start if not given.
      rise: time in which the gripper takes over its weight, () [s], > 0; 0.1 if not given.
    """

    mass: Leaf = leaf("kg", sign="nonnegative", shape="scalar", default=0.0)
    centre: Leaf = leaf("m", shape="any", default=(0.0, 0.0, 0.0))
    inertia: Leaf = leaf("kg m^2", shape="any", default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    start: Leaf = leaf("s", shape="scalar", default=None)
    rise: Leaf = leaf("s", sign="positive", shape="scalar", default=0.1)

    def check(self) -> None:
        """Raises ValueError if centre or inertia have another shape."""
        checks.shape_is("Payload.centre", self.centre, (3,))
        checks.shape_is("Payload.inertia", self.inertia, (6,))

    def share(self, t: jax.Array) -> jax.Array:
        """s(t), the share of the load that the gripper carries, () [1]."""
        x = jnp.clip((t - self.start) / self.rise, 0.0, 1.0)
        return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)

    def at(self, t: jax.Array) -> Payload:
        """The load at time t [s]: itself if it has no start, else s(t) of its mass and inertia,
        without a start.
        """
        if self.start is None:
            return self
        share, now = self.share(t), copy.copy(self)
        for name, value in (
            ("mass", share * self.mass),
            ("inertia", share * self.inertia),
            ("start", None),
        ):
            object.__setattr__(now, name, value)
        return now

    def jump_times(self) -> jax.Array:
        """Times at which the share begins to rise and reaches 1, (2,) [s]; none for a load without
        a start.

        The third derivative of the share jumps there.  For a step longer than `rise`, the load
        itself jumps.
        """
        if self.start is None:
            return no_times()
        return jnp.stack([self.start, self.start + self.rise])

    def moments(self) -> jax.Array:
        """Its pseudo-inertia about the tip's origin, (4, 4); zero for a load with a start, whose
        inertia is that of `at(t)`.
        """
        P = pseudo_inertia(self.mass, self.centre, self.inertia)
        if self.start is None:
            return P
        return jnp.zeros_like(P)
