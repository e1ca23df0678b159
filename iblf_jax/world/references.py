"""Reference trajectories q_d(t).

A reference gives the desired position of each joint, `position(t)`; its velocity and acceleration
follow by automatic differentiation.  A reference must therefore be smooth: the law needs q_d' and
q_d", and its derivative alpha' is continuous only if q_d" is.
"""

from __future__ import annotations

import math
from typing import ClassVar, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.caches import memoised
from iblf_jax.core.linalg import matvec
from iblf_jax.core.optional import OptionalMembers
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.units import POSITION


class Reference(Protocol):
    """The contract of a reference.

    A reference that is discontinuous in time also has `jump_times()`, the times (m,) [s] at which
    q_d, q_d' or q_d" jumps; steps of a run are divided there, as for disturbances.  A reference
    that is not smooth has `continuous_derivatives`, the number of its continuous derivatives; a law
    for a plant of order r needs r of them.
    """

    def position(self, t: jax.Array) -> jax.Array:
        """q_d(t), (n,) [rad], twice differentiable in t [s]."""
        ...


reference_member = OptionalMembers(continuous_derivatives=math.inf)
"""Reads optional members of a reference."""


@component
class Sinusoid:
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
class Quintic:
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
class WaypointSpline:
    """The quintic spline through waypoints, at rest at both ends and constant beyond them.

    It has four continuous derivatives between the ends, and zero velocity and acceleration at them.
    It is linear in the waypoints, q_d(t) = sum_j B_j(t) waypoints_j, so they are leaves: sweep them
    or differentiate by them.

    Args:
      times: strictly increasing times of the waypoints, a tuple of m numbers [s].
      waypoints: one row per time, (m, n) [rad].

    Source: C. de Boor, A Practical Guide to Splines, 1978 (basis computed by SciPy's
      `make_interp_spline`).
    """

    times: tuple[float, ...] = static()
    waypoints: Leaf = leaf(POSITION, shape="any")
    continuous_derivatives: ClassVar[int] = 2

    def check(self) -> None:
        """Raises ValueError for times that do not increase or do not match the waypoints."""
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

    def position(self, t: jax.Array) -> jax.Array:
        """q_d(t), (n,) [rad]."""
        knots, coefficients = _cardinal_splines(self.times)
        dtype = self.waypoints.dtype
        t = jnp.clip(t, self.times[0], self.times[-1])
        piece = jnp.sum(t >= jnp.asarray(knots[1:-1], t.dtype))
        x = t - jnp.asarray(knots, t.dtype)[piece]
        basis = jnp.zeros(len(self.times), dtype)
        for power in jnp.asarray(coefficients, dtype)[:, piece]:
            basis = basis * x + power
        return matvec(self.waypoints.T, basis)


@memoised(32)
def _cardinal_splines(times: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Breakpoints (p + 1,) and coefficients (6, p, m), highest power first, of the splines that are
    1 at one waypoint.
    """
    from scipy.interpolate import PPoly, make_interp_spline

    rest = [(1, np.zeros(len(times))), (2, np.zeros(len(times)))]
    spline = make_interp_spline(
        np.asarray(times, float), np.eye(len(times)), k=5, bc_type=(rest, rest)
    )
    pieces = [PPoly.from_spline((spline.t, spline.c[:, j], 5)) for j in range(len(times))]
    distinct = np.concatenate([[True], np.diff(pieces[0].x) > 0])
    starts = np.flatnonzero(np.diff(pieces[0].x) > 0)
    return pieces[0].x[distinct], np.stack([piece.c[:, starts] for piece in pieces], axis=-1)


MEMBERS = {"sinusoid": Sinusoid, "quintic": Quintic, "waypoint_spline": WaypointSpline}
"""Every reference by the name that a scenario file gives it."""
