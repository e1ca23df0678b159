"""The contract of a barrier, and the guard that keeps every barrier finite at the bound.

A barrier turns the tube around the reference into three functions of one joint's position, written
for all n joints at once: its Lyapunov function V1, its slope s = dV1/dq, and the virtual velocity
alpha that makes s alpha + dV1/dt negative.  The backstepping law (`controllers.Backstepping`) needs
nothing else.

**At the bound.**  s has a pole at the bound and the wrong sign beyond it.  A joint that crosses the
bound would be pushed outward, and NaN would spread through the batch and its gradient.  Barriers
are therefore evaluated at a guarded error (`guarded_error`), which is e1 itself for
|xi| <= 1 - guard and stays at the edge of that range beyond it.  There the slope is constant,
large, finite and directed inward, V1 continues along its tangent, and both have finite derivatives
everywhere.  A virtual velocity that is a nonlinear function of the error is evaluated at the
guarded error, too, and continues with gain k1, so that it still leads back inside.

**Claims.**  `decay_rate` and `xi_bound` state the properties of V1 that certificates use.  A
barrier without them makes no claim.  `error_over_slope` is for laws that put a barrier on
velocities (`controllers.BarrierBackstepping`).
"""

from __future__ import annotations

import abc
import math
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.families import Part, attribute
from iblf_jax.world.bounds import Tube

GUARD = 1e-3
"""Default distance from the bound, in xi, at which the guard takes over."""


class Barrier(Part):
    """The contract of a barrier.  All arrays are (n,), one number a joint, and joints do
    not mix.

    A barrier without a claim answers None.
    """

    guard: float
    """A static field: the law is exact for |xi| <= 1 - guard; -infinity for a barrier that needs no
    guard."""
    uses_o: ClassVar[bool] = True
    """Whether `virtual_velocity` uses `o`."""
    value_unit: ClassVar[str] = "1"
    """The unit of V1 where the error is a position, "1" or "rad^2"."""
    exact_decay: ClassVar[bool] = False
    """Whether the claim of `decay_rate` is an equality."""
    ratio_jumps: ClassVar[bool] = True
    """Whether e/s is discontinuous at e = 0 if k_l != k_u."""

    @attribute
    def slope_derivatives(self) -> float:
        """How many continuous derivatives the slope has at e1 = 0."""
        return math.inf

    @abc.abstractmethod
    def value(self, tube: Tube, q: jax.Array) -> jax.Array:
        """V1 of each joint at position q [rad]."""

    @abc.abstractmethod
    def slope(self, tube: Tube, q: jax.Array) -> jax.Array:
        """The slope s = dV1/dq of each joint, (n,)."""

    def virtual_velocity(
        self, tube: Tube, q: jax.Array, k1: jax.Array, o: jax.Array | None
    ) -> jax.Array:
        """The virtual velocity alpha of each joint [rad/s] for the gains k1 [1/s], o [1/s^2]; that
        of the paper, under which every V1 decreases that is a function of xi,

            alpha = q_d' - (k1 + kappa) e1                                                     (3.5)
            kappa = sqrt((k_u'/k_u)^2 + (k_l'/k_l)^2 + o).                  (3.7), root restored

        With the root, kappa + k'/k >= 0 on both sides for every o > 0, which is what the proof
        needs.
        """
        motion = (tube.dk_u / tube.k_u) ** 2 + (tube.dk_l / tube.k_l) ** 2
        kappa = jnp.sqrt(motion + checks.given(o))
        return tube.dq_d - (k1 + kappa) * (q - tube.q_d)

    def decay_rate(self, k1: jax.Array) -> jax.Array | None:
        """The claim of step one: rate_i [1/s] with V1_i' <= -rate_i V1_i where e2 = 0 and no guard
        is active.
        """
        return None

    def xi_bound(self, V: jax.Array, tube: Tube) -> jax.Array | None:
        """The claim on the bounds: b_i with |xi_i| <= b_i wherever V1_i <= V.

        Args:
          V: level of the Lyapunov function, () or (n,), >= 0.
          tube: the tube at that time; for several barriers the level at which a bound is reached
            depends on its width.
        """
        return None

    def error_over_slope(self, tube: Tube, q: jax.Array) -> jax.Array | None:
        """The ratio e1/s, finite at e1 = 0, (n,); None for a barrier whose slope is of a higher
        order there, which cannot bound velocities.
        """
        return None

    def error_at(self, V: jax.Array, tube: Tube, above: jax.Array) -> jax.Array | None:
        """The error e1 at which V1 = V on one side of the tube, inside the bound whatever the guard
        is, (n,) [rad]; None if it is not known in closed form.

        Args:
          V: value of V1, () or (n,), >= 0.
          tube: the tube at that time.
          above: whether the side is the upper one, e1 >= 0, () or (n,) bool.
        """
        return None


def has_ratio(barrier: Barrier) -> bool:
    """Whether a barrier states the ratio e/s, which laws need above the first level."""
    zero, one = jnp.zeros(1), jnp.ones(1)
    tube = Tube(zero, zero, -one, one, zero, zero)
    return barrier.error_over_slope(tube, zero) is not None


def check_guard(owner: str, guard: float) -> None:
    """Raises ValueError unless 0 < guard < 1."""
    if not 0.0 < checks.positive_number(f"{owner}.guard", guard, "1") < 1.0:
        raise checks.fail(
            f"{owner}.guard",
            guard,
            "a number between 0 and 1",
            f"It is a distance from the bound in xi; the default is {GUARD:g}.",
        )


class GuardedError(NamedTuple):
    """The error at which a barrier is evaluated, and the side of the tube that it is on; each
    (n,).
    """

    e: jax.Array
    """e1 inside the guard, the edge of the guarded range beyond it [rad]."""
    beyond: jax.Array
    """e1 - e: zero inside the guard [rad]."""
    k: jax.Array
    """k_u where e1 > 0, k_l elsewhere [rad].                                         (3.15)"""
    dk: jax.Array
    """Its rate [rad/s]."""


def guarded_error(tube: Tube, q: jax.Array, guard: float) -> GuardedError:
    """The error e1 = q - q_d limited to (1 - guard) of its bound, where barriers are evaluated so
    that they are finite beyond the bound.

        e = e1 where |e1| <= (1 - guard) k, else (1 - guard) k sign(e1),   beyond = e1 - e
        k = h k_u + (1 - h) k_l,   k' = h k_u' + (1 - h) k_l'                          (2.5), (3.15)
        h = 1 if e1 > 0 else 0

    With V and s of the barrier at e, V + s beyond continues along its tangent and s stays constant:
    both are finite, with finite derivatives, at every q.

    Args:
      tube: reference and bounds at this time, a `bounds.Tube`.
      q: positions, (n,) [rad].
      guard: distance from the bound in xi, a Python number in (0, 1) [1]; `guard` of the barriers,
        1e-3 by default.  With -infinity the error is not limited.

    Returns:
      `GuardedError`: e, beyond and k, (n,) [rad], and dk, the rate of k, (n,) [rad/s].

    Raises:
      ValueError: something that is no tube, no position that fits it, or no guard.

    Source: design of this package; the sides are Zhang & Yan 2024, (3.15).
    """
    q = _in_tube(tube, q)
    unlimited = isinstance(guard, float) and guard == -np.inf
    if checks.is_concrete(guard) and not unlimited:
        check_guard("guarded_error", guard)
    e1 = q - tube.q_d
    above = e1 > 0
    k = side_width(tube, above)
    dk = jnp.where(above, tube.dk_u, tube.dk_l)
    if unlimited:
        return GuardedError(e1, jnp.zeros_like(e1), k, dk)
    edge = (1.0 - guard) * k
    e = jnp.where(jnp.abs(e1) <= edge, e1, jnp.where(above, edge, -edge))
    return GuardedError(e, e1 - e, k, dk)


def _in_tube(tube: Tube, q: jax.Array) -> jax.Array:
    """The position as an array that fits the tube."""
    if not isinstance(tube, Tube):
        raise checks.fail(
            "tube",
            tube,
            "an iblf_jax.bounds.Tube",
            "iblf_jax.bounds.tube_at(reference, bounds, t) makes one.",
        )
    q = checks.as_floats("q", q)
    try:
        np.broadcast_shapes(q.shape, jnp.shape(tube.q_d))
    except ValueError:
        raise checks.fail(
            "q", q, f"one number a joint, shape {jnp.shape(tube.q_d)}", f"Its shape is {q.shape}."
        ) from None
    return q


def guard_is_active(tube: Tube, q: jax.Array, guard: float) -> jax.Array:
    """Whether the guard limits the slope of each joint, as a law returns it in
    `Command.guard_active`.

        |xi| > 1 - guard

    Args:
      tube: reference and bounds at this time, a `bounds.Tube`.
      q: positions, (n,) [rad].
      guard: as `guarded_error`; -infinity for a barrier that needs no guard.

    Returns:
      (n,) bool.

    Raises:
      ValueError: something that is no tube, no position that fits it, or no guard.
    """
    q = _in_tube(tube, q)
    if checks.is_concrete(guard) and not (isinstance(guard, float) and guard == -np.inf):
        check_guard("guard_is_active", guard)
    return jnp.abs(tube.xi(q)) > 1.0 - guard


def side_width(tube: Tube, above: jax.Array) -> jax.Array:
    """k_u where `above`, k_l elsewhere, (n,) [rad]."""
    return jnp.where(above, tube.k_u, tube.k_l)


def xi_bound_from_errors(barrier: Barrier, V: jax.Array, tube: Tube) -> jax.Array:
    """`xi_bound` of a barrier with `error_at`: the larger |xi| on the two sides at which V1 = V,
    (n,) [1].
    """
    e_u: Any = barrier.error_at(V, tube, jnp.asarray(True))
    e_l: Any = barrier.error_at(V, tube, jnp.asarray(False))
    return jnp.maximum(e_u / tube.k_u, -e_l / tube.k_l)
