"""Reference trajectories q_d(t).

A reference gives the desired position of each joint, `position(t)`; its velocity and acceleration
follow by automatic differentiation.  A reference must therefore be smooth: the law needs q_d' and
q_d", and its derivative alpha' is continuous only if q_d" is.
"""

from __future__ import annotations

import abc
import math
import numbers
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.caches import memoised
from iblf_jax.core.families import attribute
from iblf_jax.core.linalg import matvec
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.time import Timed, jump_times_of
from iblf_jax.core.units import POSITION


class Reference(Timed):
    """The contract of a reference.  Its `jump_times` are those of q_d, q_d' and q_d"."""

    @attribute
    def continuous_derivatives(self) -> float:
        """The number of continuous derivatives; a law for a plant of order r needs r of them."""
        return math.inf

    @abc.abstractmethod
    def position(self, t: jax.Array) -> jax.Array:
        """q_d(t), (n,) [rad], twice differentiable in t [s]."""


@component
class Sinusoid(Reference):
    """q_d = offset + amplitude sin(frequency t + phase), joint by joint.              (4.2)

    Args:
      offset: middle of the motion, () or (n,) [rad].
      amplitude: half of its range, () or (n,) [rad].
      frequency: angular frequency, () or (n,) [rad/s]; 1 if not given.
      phase: phase at t = 0, () or (n,) [rad]; 0 if not given.

    Source: Zhang & Yan 2024, equation (4.2).
    """

    offset: Leaf = leaf(POSITION)
    amplitude: Leaf = leaf(POSITION)
    frequency: Leaf = leaf("rad/s", default=1.0)
    phase: Leaf = leaf("rad", default=0.0)

    def position(self, t: jax.Array) -> jax.Array:
        """q_d(t), (n,) [rad]."""
        return self.offset + self.amplitude * jnp.sin(self.frequency * t + self.phase)


@component
class Quintic(Reference):
    """Minimum-jerk motion from `start` to `end` in `duration`, at rest before and after.

        q_d = start + (end - start) (10 s^3 - 15 s^4 + 6 s^5),   s = clip(t / duration, 0, 1)

    Velocity and acceleration vanish at both ends.

    Args:
      start: initial position, () or (n,) [rad].
      end: final position, () or (n,) [rad].
      duration: duration of the motion, () [s], > 0.

    Source: T. Flash, N. Hogan, J. Neuroscience 5 (1985) 1688-1703.
    """

    start: Leaf = leaf(POSITION)
    end: Leaf = leaf(POSITION)
    duration: Leaf = leaf("s", sign="positive", shape="scalar")
    continuous_derivatives: ClassVar[int] = 2

    def position(self, t: jax.Array) -> jax.Array:
        """q_d(t), (n,) [rad]."""
        s = jnp.clip(t / self.duration, 0.0, 1.0)
        return self.start + (self.end - self.start) * (s**3 * (10.0 + s * (6.0 * s - 15.0)))


@component
class SmoothStep(Reference):
    """A motion from `start` to `end` with m continuous derivatives, at rest before and after.

        q_d = start + (end - start) s^(m+1) sum_{k=0}^{m} (m+k)!/(m! k!) (1 - s)^k
        s = clip(t / duration, 0, 1)

    The polynomial has the degree 2 m + 1.  The derivatives of the orders 1 to m vanish at both
    ends; m = 2 is `Quintic`.  A law for a plant of order r needs m >= r.

    Args:
      start: initial position, () or (n,) [rad].
      end: final position, () or (n,) [rad].
      duration: duration of the motion, () [s], > 0.
      derivatives: m, the number of continuous derivatives, 1 to 12; 4 if not given.

    Source: D. S. Ebert, F. K. Musgrave, D. Peachey, K. Perlin, S. Worley, Texturing and Modeling: A
      Procedural Approach, 2003 (smoothstep); the general degree follows from Hermite interpolation.
    """

    start: Leaf = leaf(POSITION)
    end: Leaf = leaf(POSITION)
    duration: Leaf = leaf("s", sign="positive", shape="scalar")
    derivatives: int = static(default=4)

    def check(self) -> None:
        """Raises ValueError for a number of derivatives that is no whole number from 1 to 12."""
        checks.positive_integer("SmoothStep.derivatives", self.derivatives, most=MOST_STEP)

    @property
    def continuous_derivatives(self) -> int:
        """Number of continuous derivatives."""
        return self.derivatives

    def position(self, t: jax.Array) -> jax.Array:
        """q_d(t), (n,) [rad]."""
        m = self.derivatives
        s = jnp.clip(t / self.duration, 0.0, 1.0)
        rest = 1.0 - s
        total = jnp.zeros_like(s)
        for k in reversed(range(m + 1)):
            total = total * rest + float(math.comb(m + k, k))
        return self.start + (self.end - self.start) * (s ** (m + 1) * total)


@component
class WaypointSpline(Reference):
    """The quintic spline through waypoints, at rest at both ends and constant beyond them; of a
    higher degree for more derivatives.

    With d = `derivatives` the spline has the degree 2 d + 1.  It has 2 d continuous derivatives
    between the ends, and its derivatives of the orders 1 to d vanish at them, so that d derivatives
    are continuous.  A law for a plant of order r needs d >= r.  The spline is linear in the
    waypoints, q_d(t) = sum_j B_j(t) waypoints_j, so they are leaves: sweep them or differentiate by
    them.

    Args:
      times: strictly increasing times of the waypoints, a tuple of m numbers [s].
      waypoints: one row per time, (m, n) [rad].
      derivatives: number of continuous derivatives, 1 to 6; 2 if not given.

    Source: C. de Boor, A Practical Guide to Splines, 1978 (basis computed by SciPy's
      `make_interp_spline`).
    """

    times: tuple[float, ...] = static()
    waypoints: Leaf = leaf(POSITION, shape="any")
    derivatives: int = static(default=2)

    def check(self) -> None:
        """Raises ValueError for times that do not increase or do not match the waypoints, or a
        number of derivatives that is no whole number from 1 to 6.
        """
        checks.positive_integer("WaypointSpline.derivatives", self.derivatives, most=MOST_SPLINE)
        try:
            times = np.asarray(self.times, float)
        except (TypeError, ValueError, OverflowError):
            times = np.zeros(0)
        if (
            times.ndim != 1
            or times.size < 2
            or not np.all(np.isfinite(times))
            or not np.all(np.diff(times) > 0)
        ):
            raise checks.fail(
                "WaypointSpline.times", self.times, "at least two strictly increasing times [s]"
            )
        if self.waypoints.ndim != 2 or self.waypoints.shape[0] != times.size:
            raise checks.fail(
                "WaypointSpline.waypoints",
                self.waypoints,
                f"shape ({times.size}, n)",
                "Give one row a time.",
            )

    @property
    def continuous_derivatives(self) -> int:
        """Number of continuous derivatives."""
        return self.derivatives

    def position(self, t: jax.Array) -> jax.Array:
        """q_d(t), (n,) [rad]."""
        knots, coefficients = _cardinal_splines(self.times, self.derivatives)
        dtype = self.waypoints.dtype
        t = jnp.clip(t, self.times[0], self.times[-1])
        piece = jnp.sum(t >= jnp.asarray(knots[1:-1], t.dtype))
        x = t - jnp.asarray(knots, t.dtype)[piece]
        basis = jnp.zeros(len(self.times), dtype)
        for power in jnp.asarray(coefficients, dtype)[:, piece]:
            basis = basis * x + power
        return matvec(self.waypoints.T, basis)


@component
class Ellipse(Reference):
    """A motion on an ellipse in the plane with the heading along its tangent, for a vessel.

        north = centre_1 + axes_1 cos(frequency t),   east = centre_2 + axes_2 sin(frequency t)
        heading = frequency t + pi/2 + atan((axes_1 - axes_2) s c / (axes_1 s^2 + axes_2 c^2))

    with s = sin(frequency t) and c = cos(frequency t).  The motion turns from north to east; the
    heading grows by 2 pi a revolution, so that bounds on it follow the reference (`bounds.Funnel`).
    All derivatives are continuous.

    Args:
      axes: half lengths of the axes to the north and to the east, (2,) [m], > 0.
      frequency: angular frequency of the motion, () [rad/s], > 0.
      centre: of the ellipse, (2,) [m]; the origin if not given.

    Source: this package.
    """

    axes: Leaf = leaf("m", sign="positive", shape="any")
    frequency: Leaf = leaf("rad/s", sign="positive", shape="scalar")
    centre: Leaf = leaf("m", shape="any", default=(0.0, 0.0))

    def check(self) -> None:
        """Raises ValueError for axes or a centre that are not two numbers."""
        checks.shape_is("Ellipse.axes", self.axes, (2,))
        checks.shape_is("Ellipse.centre", self.centre, (2,))

    def position(self, t: jax.Array) -> jax.Array:
        """North, east and heading, (3,) [m, m, rad]."""
        angle = self.frequency * t
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        a, b = self.axes
        turned = (a - b) * sine * cosine / (a * sine**2 + b * cosine**2)
        heading = angle + 0.5 * math.pi + jnp.arctan(turned)
        north, east = self.centre[0] + a * cosine, self.centre[1] + b * sine
        return jnp.stack([north, east, heading])


@component
class Leader(Reference):
    """y_d = b kron x_0 + offset: a leader's motion as the reference of `plants.Agents`.

    y_d is the position of the agents relative to their neighbours when each follows the leader,
    (H kron I)(1 x_0 + delta) = b kron x_0 + (H kron I) delta, because H 1 = b.
    `plants.Agents.reference` makes it.

    Args:
      motion: x_0(t), any of `iblf_jax.references`, of m components.
      weights: b_i with which each agent measures its position relative to the leader, N numbers,
        >= 0.
      components: m, the number of components of an agent.
      offset: (H kron I) delta of a formation, () or (n,) [rad], with n = N m, in the unit of the
        positions; 0 if not given.

    Source: F. L. Lewis, H. Zhang, K. Hengster-Movric, A. Das, Cooperative Control of Multi-Agent
      Systems, 2014, chapter 3.
    """

    motion: Reference
    weights: tuple[float, ...] = static()
    components: int = static()
    offset: Leaf = leaf(POSITION, default=0.0)

    def check(self) -> None:
        """Raises ValueError for a motion that is no reference, or weights or components that are
        not valid.
        """
        checks.conforms("Leader.motion", self.motion, Reference, "iblf_jax.references has them.")
        checks.positive_integer("Leader.components", self.components, most=checks.MAX_JOINTS)
        is_tuple = isinstance(self.weights, tuple) and len(self.weights) > 0
        if not is_tuple or not all(map(_is_weight, self.weights)):
            expected = "a tuple of finite numbers >= 0, one for each agent"
            raise checks.fail("Leader.weights", self.weights, expected)

    @property
    def own_joints(self) -> dict[str, int]:
        """The number of components for which the leaves of the motion are given."""
        return {"motion": self.components}

    @property
    def continuous_derivatives(self) -> float:
        """Number of continuous derivatives, those of the motion."""
        return self.motion.continuous_derivatives

    def position(self, t: jax.Array) -> jax.Array:
        """y_d(t), (N m,), in the unit of the positions."""
        x_0 = jnp.broadcast_to(self.motion.position(t), (self.components,))
        followed = [weight * x_0 if weight else jnp.zeros_like(x_0) for weight in self.weights]
        return jnp.concatenate(followed) + self.offset

    def jump_times(self) -> jax.Array:
        """The times at which the motion jumps, (k,) [s]."""
        return jump_times_of("motion", self.motion)


def _is_weight(value: object) -> bool:
    """Whether a value is a finite number >= 0."""
    return isinstance(value, numbers.Real) and 0.0 <= float(value) < math.inf


@memoised(32)
def _cardinal_splines(times: tuple[float, ...], derivatives: int) -> tuple[np.ndarray, np.ndarray]:
    """Breakpoints (p + 1,) and coefficients (2 derivatives + 2, p, m), highest power first, of the
    splines that are 1 at one waypoint.
    """
    from scipy.interpolate import PPoly, make_interp_spline

    degree = 2 * derivatives + 1
    rest = [(i, np.zeros(len(times))) for i in range(1, derivatives + 1)]
    spline = make_interp_spline(
        np.asarray(times, float), np.eye(len(times)), k=degree, bc_type=(rest, rest)
    )
    breakpoints = np.unique(spline.t)
    if degree > FITPACK_DEGREE:
        rates = [spline(breakpoints[:-1], nu=i) for i in range(degree + 1)]
        terms = [rate / math.factorial(i) for i, rate in enumerate(rates)]
        return breakpoints, np.stack(terms[::-1])
    pieces = [PPoly.from_spline((spline.t, spline.c[:, j], degree)) for j in range(len(times))]
    starts = np.flatnonzero(np.diff(pieces[0].x) > 0)
    return breakpoints, np.stack([piece.c[:, starts] for piece in pieces], axis=-1)


FITPACK_DEGREE = 5
"""Largest degree for which FITPACK, which `PPoly.from_spline` calls, is defined; it overruns its
memory at the degree 9."""

MOST_STEP, MOST_SPLINE = 12, 6
"""Largest numbers of continuous derivatives: the order of a plant is at most 12, and a spline of a
higher degree than 13 is computed inaccurately."""

MEMBERS = {
    "sinusoid": Sinusoid,
    "quintic": Quintic,
    "smooth_step": SmoothStep,
    "waypoint_spline": WaypointSpline,
    "ellipse": Ellipse,
    "leader": Leader,
}
"""Every reference by the name that a scenario file gives it."""
