"""The contract of a barrier, and the guard that keeps every barrier finite at the wall.

A barrier turns the tube around the reference into three functions of one joint's position, written for all n joints at once:
its Lyapunov function V1, its slope s = dV1/dq, and the virtual velocity alpha that makes s alpha + dV1/dt negative.  The
backstepping law (`controllers.Backstepping`) needs nothing else.

**At the wall.**  s has a pole at the bound and the wrong sign beyond it: a step too far and the law pushes outward, NaN spreads
through the batch and its gradient.  So barriers evaluate at a guarded error (`guarded_error`), which is e1 itself for
|xi| <= 1 - guard and stays at the edge of that range beyond.  There the slope is constant, large, finite and directed inward,
V1 goes on along its tangent, and both have finite derivatives everywhere.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp

from iblf_jax import checks
from iblf_jax.bounds import Tube
from iblf_jax.pytree import Leaf

GUARD = 1e-3
"""Default distance from the wall, in xi, at which the guard takes over."""


class Barrier(Protocol):
    """What the package asks of a barrier.  All arrays are (n,), one number a joint, and joints do not mix."""

    @property
    def guard(self) -> float:
        """A static field: the law is exact for |xi| <= 1 - guard."""
        ...

    @property
    def uses_o(self) -> bool:
        """A class attribute: whether `virtual_velocity` uses `o`."""
        ...

    def value(self, tube: Tube, q: jax.Array) -> jax.Array:
        """V1 of each joint at position q [rad]."""
        ...

    def slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """S = dV1/dq of each joint."""
        ...

    def virtual_velocity(self, tube: Tube, q: jax.Array, k1: jax.Array, o: jax.Array | None) -> jax.Array:
        """Alpha of each joint [rad/s], given the gains k1 [1/s] and o [1/s^2]."""
        ...


def check_guard(owner: str, guard: float) -> None:
    """Raises ValueError unless 0 < guard < 1."""
    if not 0.0 < checks.positive_number(f"{owner}.guard", guard, "1") < 1.0:
        raise checks.fail(
            f"{owner}.guard", guard, "a number between 0 and 1", f"It is a distance from the wall in xi; the default is {GUARD:g}."
        )


class GuardedError(NamedTuple):
    """The error at which a barrier is evaluated, and the side of the tube that it is on."""

    e: jax.Array
    """e1 inside the guard, the edge of the guarded range beyond it [rad]."""
    beyond: jax.Array
    """e1 - e: zero inside the guard [rad]."""
    k: jax.Array
    """k_u where e1 > 0, k_l elsewhere [rad].                                                                     (3.15)"""
    dk: jax.Array
    """Its rate [rad/s]."""


def guarded_error(tube: Tube, q: jax.Array, guard: float) -> GuardedError:
    """The error e1 = q - q_d held inside (1 - guard) of its bound.

    Args:
      tube: reference and bounds at this time.
      q: positions, (n,) [rad].
      guard: distance from the wall in xi, static.
    """
    e1 = q - tube.q_d
    above = e1 > 0
    k = jnp.where(above, tube.k_u, tube.k_l)
    dk = jnp.where(above, tube.dk_u, tube.dk_l)
    edge = (1.0 - guard) * k
    e = jnp.where(jnp.abs(e1) <= edge, e1, jnp.where(above, edge, -edge))
    return GuardedError(e, e1 - e, k, dk)


def guard_is_active(tube: Tube, q: jax.Array, guard: float) -> jax.Array:
    """Whether each joint is so near its wall that the guard holds the slope, (n,) bool."""
    return jnp.abs(tube.xi(q)) > 1.0 - guard


def bound_motion_gain(tube: Tube, o: jax.Array) -> jax.Array:
    """Kappa = sqrt((k_u'/k_u)^2 + (k_l'/k_l)^2 + o), (n,) [1/s].                          (3.7), root restored

    With the root, kappa + k'/k >= 0 on both sides for every o > 0, which is what the proof needs.
    """
    return jnp.sqrt((tube.dk_u / tube.k_u) ** 2 + (tube.dk_l / tube.k_l) ** 2 + o)


def paper_virtual_velocity(tube: Tube, q: jax.Array, k1: jax.Array, o: Leaf) -> jax.Array:
    """Alpha = q_d' - (k1 + kappa(t)) e1, (n,) [rad/s]; shared by the integral and the logarithmic barrier.     (3.5)"""
    return tube.dq_d - (k1 + bound_motion_gain(tube, o)) * (q - tube.q_d)
