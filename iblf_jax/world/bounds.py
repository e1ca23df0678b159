"""Bounds on joint positions, k_lc(t) < q < k_uc(t), and the tube that they form around the
reference.  Bounds on joint velocities, and on the levels of a plant in strict-feedback form, have
the same form: `Scenario.bounds` has those of x_1, x_2, ...  The units rad and rad/s are those of
a robot; the bounds of another plant have the unit of their level.

Each side is a component: constant, sinusoidal, or a funnel that shrinks onto the reference.  The
law uses the bounds of the error

    k_l = q_d - k_lc > 0,   k_u = k_uc - q_d > 0,   -k_l < e1 < k_u,    (paper, below Assumption 2)

and with their rates.  `tube_at` computes them by automatic differentiation and returns them as a
`Tube`.
"""

from __future__ import annotations

import abc
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.core.families import attribute
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.time import Timed
from iblf_jax.core.units import POSITION
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot
from iblf_jax.world.robots._base import has_mass_matrix


class Side(Timed):
    """The contract of one side of the bounds."""

    @attribute
    def continuous_derivatives(self) -> float:
        """The number of its continuous derivatives in time and in q_d; a law for a plant of order r
        needs r - i + 1 of them on level i.
        """
        return math.inf

    @abc.abstractmethod
    def at(self, t: jax.Array, q_d: jax.Array) -> jax.Array:
        """The bound on q at time t [s], (n,) [rad]; a bound may depend on the reference q_d at t,
        (n,) [rad].

        A bound on q' is in rad/s and receives q_d' in place of q_d.
        """


@component
class Constant(Side):
    """The bound is `value`, for all time.

    Args:
      value: the bound, () or (n,) [rad].
    """

    value: Leaf = leaf(POSITION)

    def at(self, t: jax.Array, q_d: jax.Array) -> jax.Array:
        """The bound, (n,) [rad]."""
        return jnp.broadcast_to(self.value, q_d.shape)


@component
class Sinusoid(Side):
    """The bound is offset + amplitude sin(frequency t + phase).

    Args:
      offset: middle of its motion, () or (n,) [rad].
      amplitude: half of its range, () or (n,) [rad].
      frequency: angular frequency, () or (n,) [rad/s]; 1 if not given.
      phase: phase at t = 0, () or (n,) [rad]; 0 if not given.

    Source: Zhang & Yan 2024, section 4 (k_lc and k_uc).
    """

    offset: Leaf = leaf(POSITION)
    amplitude: Leaf = leaf(POSITION)
    frequency: Leaf = leaf("rad/s", default=1.0)
    phase: Leaf = leaf("rad", default=0.0)

    def at(self, t: jax.Array, q_d: jax.Array) -> jax.Array:
        """The bound, (n,) [rad]."""
        return jnp.broadcast_to(
            self.offset + self.amplitude * jnp.sin(self.frequency * t + self.phase), q_d.shape
        )


@component
class Funnel(Side):
    """A bound at a distance r(t) = (initial - final) exp(-rate t) + final from the reference.

    `initial` and `final` are signed: positive for an upper side (bound = q_d + r), negative for a
    lower one.  A constant bound d on the error has the sides Funnel(-d, -d, 0.0) and
    Funnel(d, d, 0.0).

    Args:
      initial: distance from the reference at t = 0, () or (n,) [rad].
      final: distance that it shrinks to, () or (n,) [rad].
      rate: how fast it shrinks, () or (n,) [1/s], >= 0.

    Source: F. Chen, D. V. Dimarogonas, IEEE Trans. Control Networks Syst. 8 (2021) 450-461.
    """

    initial: Leaf = leaf(POSITION)
    final: Leaf = leaf(POSITION)
    rate: Leaf = leaf("1/s", sign="nonnegative")

    def at(self, t: jax.Array, q_d: jax.Array) -> jax.Array:
        """The bound, (n,) [rad]."""
        return q_d + (self.initial - self.final) * jnp.exp(-self.rate * t) + self.final


@component
class Bounds:
    """A lower and an upper side, each of any kind: `Bounds(lower=Constant(0.1), upper=Sinusoid(0.9,
    0.14))`.

    On positions in rad, on velocities in rad/s, on a level of another plant in its unit.

    Args:
      lower: the lower side, any `Side`.
      upper: the upper side, any `Side`.
    """

    lower: Side
    upper: Side

    def check(self) -> None:
        """Raises ValueError if a side does not fit `Side`."""
        remedy = "A constant bound is iblf_jax.bounds.Constant(value)."
        checks.conforms("Bounds.lower", self.lower, Side, remedy)
        checks.conforms("Bounds.upper", self.upper, Side, remedy)


def _distance(name: str, value: ArrayLike, n: int, sign: str | None) -> jax.Array:
    """A user's argument as one number, or one number per joint."""
    array = checks.as_floats(name, value)
    checks.check_values(name, array, sign)
    if array.shape not in ((), (n,)):
        raise checks.fail(name, value, f"one number, or {n} (one a joint)")
    return array


def _checked_limits(
    robot: Robot, member: str, limits: Any, what: str, unlimited: Any
) -> tuple[Any, Any]:
    """The limits that a robot declares, and the value for joints without limits."""
    if limits is None:
        expected, remedy = f"a robot with {what} limits, such as an Arm", "Give bounds of your own."
        raise checks.fail("robot", type(robot).__name__, expected, remedy)
    if unlimited is not None:
        return limits, _distance("unlimited", unlimited, robot.n, "positive")
    if checks.is_concrete(limits) and not np.all(np.isfinite(limits)):
        remedy = "Say what to use where there is none, such as unlimited=6.3."
        raise checks.fail(f"robot.{member}", limits, "limits on every joint", remedy)
    return limits, 0.0


def from_limits(robot: Robot, *, margin: float = 0.0, unlimited: float | None = None) -> Bounds:
    """Constant bounds at a robot's joint limits.

        lower + margin < q < upper - margin

    Args:
      robot: a robot with `limits`, such as `iblf_jax.robots.Arm`.
      margin: distance that is kept from the limits [rad].
      unlimited: bounds of joints without limits, -unlimited and unlimited [rad].

    Raises:
      ValueError: a robot without `limits`, or with joints that have none and no `unlimited`; a
        margin that leaves nothing.
    """
    stated = robot.limits if has_mass_matrix(robot) else None
    limits, replacement = _checked_limits(robot, "limits", stated, "joint", unlimited)
    margins = _distance("margin", margin, robot.n, None)
    lower = jnp.where(jnp.isfinite(limits[0]), limits[0] + margins, -replacement)
    upper = jnp.where(jnp.isfinite(limits[1]), limits[1] - margins, replacement)
    if checks.is_concrete((lower, upper)) and not np.all(np.asarray(lower) < np.asarray(upper)):
        expected = "a margin that leaves room between the limits"
        narrowest = float(np.min(np.diff(limits, axis=0)))
        raise checks.fail("margin", margin, expected, f"The narrowest range is {narrowest:g} rad.")
    return Bounds(lower=Constant(lower), upper=Constant(upper))


def from_speed_limits(
    robot: Robot, *, share: float = 1.0, unlimited: float | None = None
) -> Bounds:
    """Constant bounds on the velocities at a share of a robot's largest joint speeds, for the
    second level.

        -share speed < q' < share speed

    Args:
      robot: a robot with `speed`, such as `iblf_jax.robots.Arm`.
      share: fraction of the largest speeds, > 0 [1].
      unlimited: largest speed of joints that have none [rad/s].

    Raises:
      ValueError: a robot without `speed`, or with joints that have no limit and no `unlimited`; a
        share that is not positive.
    """
    stated = robot.speed if has_mass_matrix(robot) else None
    speed, replacement = _checked_limits(robot, "speed", stated, "speed", unlimited)
    share = checks.positive_number("share", share, "1")
    limit = share * jnp.where(jnp.isfinite(speed), speed, replacement)
    return Bounds(lower=Constant(-limit), upper=Constant(limit))


class Tube(NamedTuple):
    """Reference, bounds and their rates at one time: the inputs of a barrier besides q."""

    q_d: jax.Array
    """Reference, (n,) [rad]."""
    dq_d: jax.Array
    """Its velocity, (n,) [rad/s]."""
    lower: jax.Array
    """k_lc, (n,) [rad]."""
    upper: jax.Array
    """k_uc, (n,) [rad]."""
    dlower: jax.Array
    """Rate of k_lc, (n,) [rad/s]."""
    dupper: jax.Array
    """Rate of k_uc, (n,) [rad/s]."""
    ddq_d: jax.Array | None = None
    """Its acceleration, (n,) [rad/s^2], for laws with feedforward; None in a tube from which only
    alpha follows."""

    @property
    def k_l(self) -> jax.Array:
        """k_l = q_d - k_lc, (n,) [rad]."""
        return positive_width(self.q_d - self.lower)

    @property
    def k_u(self) -> jax.Array:
        """k_u = k_uc - q_d, (n,) [rad]."""
        return positive_width(self.upper - self.q_d)

    @property
    def dk_l(self) -> jax.Array:
        """Rate of k_l, (n,) [rad/s]."""
        return self.dq_d - self.dlower

    @property
    def dk_u(self) -> jax.Array:
        """Rate of k_u, (n,) [rad/s]."""
        return self.dupper - self.dq_d

    def xi(self, q: jax.Array) -> jax.Array:
        """The error xi = h e1/k_u + (1 - h) e1/k_l, h = 1 if e1 > 0 else 0, (n,) [1].

        (2.4), (2.5)
        """
        e1 = q - self.q_d
        return e1 / jnp.where(e1 > 0, self.k_u, self.k_l)


NARROWEST = 1e-6
"""Least distance of a feasible reference to its bounds [rad].  Smaller widths are replaced by it,
so that a run with an infeasible reference gives large numbers and a status flag instead of NaN.
Rounding decides their derivatives: a compiled one and that of single operations may differ."""


def positive_width(k: jax.Array) -> jax.Array:
    """`k` where it is wider than NARROWEST, else NARROWEST."""
    return jnp.maximum(checks.as_floats("k", k), NARROWEST)


def tube_at(
    reference: Reference, bounds: Bounds, t: jax.Array, *, acceleration: bool = True
) -> Tube:
    """Reference, bounds and their rates at time t, the rates by jvp.

        q_d, q_d', q_d",   k_lc, k_uc and their rates

    Args:
      reference, bounds: the components.
      t: time, () [s].
      acceleration: whether to compute q_d"; False where the tube is differentiated in time, so
        that a reference needs no third derivative.

    Returns:
      `Tube`; JAX does not compile ddq_d where it is not used.

    Raises:
      ValueError: an argument that is not a reference, bounds or a time.
    """
    expected = "a reference, as iblf_jax.references.Reference"
    checks.offers("reference", reference, ("position",), expected)
    expected = "bounds, as iblf_jax.bounds.Bounds(lower=..., upper=...)"
    checks.offers("bounds", bounds, ("lower", "upper"), expected)
    t = checks.as_floats("t", t)
    checks.shape_is("t", t, ())
    acceleration = checks.boolean("acceleration", acceleration)

    def values(t):
        q_d = reference.position(t)
        return q_d, bounds.lower.at(t, q_d), bounds.upper.at(t, q_d)

    def velocity(t):
        return jax.jvp(reference.position, (t,), (jnp.ones_like(t),))[1]

    (q_d, lower, upper), (dq_d, dlower, dupper) = jax.jvp(values, (t,), (jnp.ones_like(t),))
    ddq_d = jax.jvp(velocity, (t,), (jnp.ones_like(t),))[1] if acceleration else None
    return Tube(q_d, dq_d, lower, upper, dlower, dupper, ddq_d)


def bounds_at(bounds: Bounds, t: jax.Array, centre: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Lower and upper side at time t [s] around a centre, (n,) each."""
    return bounds.lower.at(t, centre), bounds.upper.at(t, centre)


def speed_limits_at(
    reference: Reference, bounds: Bounds, t: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The bounds v_l, v_u on the velocities at time t [s], (n,) each [rad/s]; a side
    that depends on the reference receives q_d'.
    """
    dq_d = jax.jvp(reference.position, (t,), (jnp.ones_like(t),))[1]
    return bounds.lower.at(t, dq_d), bounds.upper.at(t, dq_d)


MEMBERS = {"constant": Constant, "sinusoid": Sinusoid, "funnel": Funnel}
"""Every side by the name that a scenario file gives it."""
