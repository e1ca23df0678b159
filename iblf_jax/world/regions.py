"""Regions in which points of the robot must stay: half-spaces and spheres, for its tip or the
origin of any joint.

With x(q) the point in the base's frame and h the region's `level`, positive inside and 0 at the
boundary,

    h' = dh/dq q',   h" = dh/dq q" + c,   c = d/ds (dh/dq q')(q + s q') at s = 0
    [m/s], [m/s^2]

so conditions on h" are linear in the accelerations: `along` gives h, h', dh/dq and c.  Every run
records the `distance` to the boundary as its margin; a `controllers.SafetyFilter` keeps h >= 0.
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.families import Part
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.world.robots import Robot, joint_names

TIP = "tip"
KEEPS = ("inside", "outside")


class Region(Part):
    """The contract of a region: a component with a static field that names the point of the
    robot.
    """

    point: str | int
    """ "tip", or the name or number of a joint, for the origin of this joint."""

    @abc.abstractmethod
    def distance(self, x: jax.Array) -> jax.Array:
        """Distance of a point (2,) or (3,) [m] to the boundary, () [m]: positive inside,
        negative outside.
        """

    @abc.abstractmethod
    def level(self, x: jax.Array) -> jax.Array:
        """A function, () [m], that is twice differentiable inside; it has the sign of the distance
        and, at the boundary, its slope.
        """


@component
class HalfSpace(Region):
    """The half-space  n . x >= offset,  n = normal/|normal|:  h = n . x - offset.

    Args:
      normal: direction from the boundary into the allowed half-space, (2,) or (3,) as the robot's
        points [1]; its length does not matter.
      offset: distance of the boundary from the base's origin along the normal, () [m]; 0 if not
        given.
      point: "tip", or the name or number of a joint, for its origin; "tip" if not given.

    Source: textbook.
    """

    normal: Leaf = leaf("1", shape="any")
    offset: Leaf = leaf("m", shape="scalar", default=0.0)
    point: str | int = static(default=TIP)

    def check(self) -> None:
        """Raises ValueError for a normal without a direction."""
        _is_point("HalfSpace.normal", self.normal)
        if checks.is_concrete(self.normal) and not float(jnp.max(jnp.abs(self.normal))) > 0:
            expected = "a direction, of a length above 0"
            raise checks.fail("HalfSpace.normal", self.normal, expected, "Such as [0, 0, 1]: up.")

    def distance(self, x: jax.Array) -> jax.Array:
        """The distance n . x - offset, n = normal/|normal|, () [m]."""
        return jnp.sum(self.normal * x) / jnp.sqrt(jnp.sum(self.normal**2)) - self.offset

    def level(self, x: jax.Array) -> jax.Array:
        """The distance."""
        return self.distance(x)


@component
class Sphere(Region):
    """The inside or outside of a sphere, or of a circle in the plane.

    Distance and level are |x - centre| - radius outside.  Inside, where the distance radius - |x -
    centre| has an edge at the centre, the level is (radius^2 - |x - centre|^2)/(2 radius).

    Args:
      centre: in the base's frame, (2,) or (3,) as the robot's points [m].
      radius: its radius, () [m], > 0.
      keep: "inside" or "outside"; "outside" if not given.
      point: "tip", or the name or number of a joint, for its origin; "tip" if not given.

    Source: textbook.
    """

    centre: Leaf = leaf("m", shape="any")
    radius: Leaf = leaf("m", sign="positive", shape="scalar")
    keep: str = static(default="outside")
    point: str | int = static(default=TIP)

    def check(self) -> None:
        """Raises ValueError for a centre that is not a point, or an unknown `keep`."""
        _is_point("Sphere.centre", self.centre)
        checks.one_of("Sphere.keep", self.keep, KEEPS)

    def distance(self, x: jax.Array) -> jax.Array:
        """|x - centre| - radius outside, radius - |x - centre| inside, () [m]."""
        square = jnp.sum((x - self.centre) ** 2)
        length = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        if self.keep == "outside":
            return length - self.radius
        return -(length - self.radius)

    def level(self, x: jax.Array) -> jax.Array:
        """The distance outside, (radius^2 - |x - centre|^2)/(2 radius) inside, () [m]."""
        if self.keep == "outside":
            return self.distance(x)
        return 0.5 * (self.radius - jnp.sum((x - self.centre) ** 2) / self.radius)


def _is_point(name: str, value: jax.Array) -> None:
    if jnp.shape(value) not in ((2,), (3,)):
        expected = "two numbers in the plane, or three in space"
        raise checks.fail(name, value, expected, f"Its shape is {jnp.shape(value)}.")


def row_of(robot: Robot, point: str | int) -> int:
    """The row of the robot's skeleton that holds a region's point; ValueError for an unknown
    joint.
    """
    names = joint_names(robot, robot.n)
    if point == TIP and TIP not in names:
        return robot.n
    if isinstance(point, str) and point in names:
        return names.index(point)
    if isinstance(point, int) and not isinstance(point, bool) and 0 <= point < robot.n:
        return point
    raise checks.fail("point", point, f'"tip", a joint ({", ".join(names)}) or its number, from 0')


def position_of(robot: Robot, point: str | int, q: jax.Array) -> jax.Array:
    """Position of a region's point at q, (2,) or (3,) [m]."""
    row = row_of(robot, point)
    if row == robot.n:
        return robot.tip(q)
    points: Any = robot.skeleton(q)
    return points[row]  # type: ignore[no-any-return]


def margins(regions: tuple[Region, ...], robot: Robot, q: jax.Array) -> jax.Array:
    """Distance of every region's point to the boundary, (m,) [m] for m regions."""
    return jnp.stack([region.distance(position_of(robot, region.point, q)) for region in regions])


def in_words(region: Region, robot: Robot) -> str:
    """The point of a region in messages: the tip, or the origin of a joint."""
    row = row_of(robot, region.point)
    return f"the {TIP}" if row == robot.n else f"the origin of {joint_names(robot, robot.n)[row]}"


class Along(NamedTuple):
    """The levels of m regions along a motion: h" = slope q" + bend."""

    level: jax.Array
    """h, (m,) [m]."""
    rate: jax.Array
    """h', (m,) [m/s]."""
    slope: jax.Array
    """dh/dq, (m, n) [m/rad]."""
    bend: jax.Array
    """c, (m,) [m/s^2]."""


def along(regions: tuple[Region, ...], robot: Robot, q: jax.Array, dq: jax.Array) -> Along:
    """The levels of all regions as the robot moves through q [rad] at dq [rad/s], (n,) each; by
    forward mode.
    """

    def levels(q):
        return jnp.stack([region.level(position_of(robot, region.point, q)) for region in regions])

    def rates(q):
        return jax.jvp(levels, (q,), (dq,))

    (level, rate), (_, bend) = jax.jvp(rates, (q,), (dq,))
    return Along(level, rate, jax.jacfwd(levels)(q), bend)


MEMBERS = {"half_space": HalfSpace, "sphere": Sphere}
"""Every region by the name that a scenario file gives it."""
