"""The contract of a robot, and the methods that follow from its energies.

    M(q) q" + C(q, q') q' + G(q) = tau + f                                                  (2.1)

The mass matrix M(q) and the potential U(q) define a robot: G = dU/dq, and C follows from the
Christoffel symbols,

    C(q, v) u = 1/2 [ (dM/dq . v) u + (dM/dq . u) v - d/dq (u^T M v) ],

which makes M' - 2 C skew-symmetric, the property that the proofs of all laws here rest on.
`Robot` has these methods for a class that has the energies; a class with closed forms (`TwoLink`)
or a recursion writes its own.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, NamedTuple, Self, TypeGuard, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks, notices, programs
from iblf_jax.core.attributes import attributes, has_members
from iblf_jax.core.disk_cache import keep_programs
from iblf_jax.core.families import adopt, attribute
from iblf_jax.core.linalg import inner, matvec, solve_spd
from iblf_jax.core.time import TimeVarying

T = TypeVar("T")
R = TypeVar("R", bound="Robot")


class Limits(NamedTuple):
    """Ranges of the joints, (n,) each [rad or m]; infinite where a joint has none."""

    lower: jax.Array
    upper: jax.Array


MOST_TURNS = 2
"""Turns to one side that hardly any robot makes; as degrees, the numbers beyond them up to
`MOST_TURNS` turns are common limits.  Larger ones mean "no limit" in files of robots."""


def warn_of_degrees(names: Sequence[str], lower: ArrayLike, upper: ArrayLike) -> None:
    """Warns of ranges whose numbers seem to be degrees: an end is beyond two turns in rad, and
    within two turns in degrees.

        4 pi < |end| <= 720

    Args:
      names: the components in words, such as "joint elbow", (n,).
      lower, upper: the ends of their ranges, (n,); infinite where they are no angles in rad.
    """
    ends = np.stack([np.asarray(lower, float), np.asarray(upper, float)], axis=-1)
    suspect = (np.abs(ends) > MOST_TURNS * 2 * math.pi) & (np.abs(ends) <= MOST_TURNS * 360)
    found = np.flatnonzero(np.any(suspect, axis=-1)).tolist()
    if not found:
        return
    first, *others = found
    low, high = ends[first]
    also = f" The same is true of {', '.join(names[i] for i in others)}." if others else ""
    notices.warn(
        f"{names[first]}: the range from {low:g} to {high:g} rad seems to be in degrees, as it"
        f" extends beyond {MOST_TURNS} turns. Limits and bounds of angles are in rad: write"
        f" {math.radians(low):.4g} and {math.radians(high):.4g} (numpy.deg2rad converts).{also}"
    )


class Dynamics(TimeVarying):
    """The base of robots and of plants in strict-feedback form."""

    mode_draws: ClassVar[int] = 0
    """How many pairs of random numbers give the modes of a run."""
    is_robot: ClassVar[bool] = False
    """Whether it is a robot, as a scenario takes it or as its `RobotPlant`: its levels are q and
    q', and its uncertain term is a torque."""

    @attribute
    @abc.abstractmethod
    def n(self) -> int:
        """Number of joints, or numbers per level."""

    @attribute
    def nominal(self) -> Any:
        """The plant whose parameters do not change, for one with modes; it is the default model."""
        return self

    def with_path(self, uniforms: jax.Array) -> Self:
        """The plant with the modes of a run, from `mode_draws` pairs of random numbers."""
        return self

    def switching(self, end: jax.Array) -> dict[str, jax.Array]:
        """Results about the modes of a run that ends at this time [s], by name."""
        return {}

    def has_complete_path(self, end: jax.Array) -> jax.Array:
        """Whether all switches until this time [s] are known, () bool."""
        return end >= 0


class Robot(Dynamics):
    """The contract of a robot with n joints.  All methods are pure functions of one configuration,
    in SI units.

    A member is a component (`iblf_jax.component`) whose inertial parameters are leaves; `payload`
    [kg], a point mass at the tip, is one of them in every member, so that any robot can carry what
    its model does not know.

    Friction and changes with time (`friction_torque`, `at`, `jump_times`) belong to the plant only:
    law and observer do not know them, and (2.1) has them in f.
    """

    is_robot = True
    geometry_fields: ClassVar[tuple[str, ...]] = ()
    """Fields whose zeros, ones and equal numbers may be compiled in
    (`engine.structural_constants`)."""

    @attribute
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, (n,); () without names."""
        return ()

    @attribute
    def kinds(self) -> tuple[str, ...] | None:
        """Kinds of the joints, "revolute" or "prismatic", (n,); None if all are revolute."""
        return None

    @attribute
    def limits(self) -> Limits | None:
        """The joints' ranges; None if the robot states none."""
        return None

    @attribute
    def speed(self) -> jax.Array | None:
        """Largest speeds of the joints, (n,) [rad/s]; None if the robot states none."""
        return None

    @attribute
    def effort(self) -> jax.Array | None:
        """Largest torques of the joints, (n,) [N m]; None if the robot states none."""
        return None

    @abc.abstractmethod
    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q), symmetric positive definite, (n, n) [kg m^2]."""

    def coriolis(self, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        """C(q, v) u, (n,) [N m], with M' - 2 C skew-symmetric; v and u are (n,) [rad/s]."""
        return coriolis_from_mass_matrix(self.mass_matrix, q, v, u)

    def gravity(self, q: jax.Array) -> jax.Array:
        """G(q) = dU/dq, (n,) [N m]."""
        return jax.grad(self.potential)(q)

    @abc.abstractmethod
    def potential(self, q: jax.Array) -> jax.Array:
        """U(q), () [J]."""

    @abc.abstractmethod
    def tip(self, q: jax.Array) -> jax.Array:
        """Position of the tip, (2,) or (3,) [m]."""

    def jacobian(self, q: jax.Array) -> jax.Array:
        """D tip / dq, (2, n) or (3, n) [m/rad]."""
        return jax.jacfwd(self.tip)(q)

    def skeleton(self, q: jax.Array) -> jax.Array | None:
        """Positions of the base, each joint and the tip, (n + 1, 2) or (n + 1, 3) [m], for
        drawings; None for a robot that is not drawn.
        """
        return None

    def friction_torque(self, dq: jax.Array) -> jax.Array:
        """Friction torque of the joints, (n,) [N m], opposite to q'."""
        return jnp.zeros_like(dq)

    def energy_gradient(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """dT/dq with T = 1/2 v^T M(q) v, (n,) [N m]: C(q, v)^T v = M' v - C(q, v) v."""
        return matvec(mass_matrix_rate(self, q, v), v) - self.coriolis(q, v, v)

    def momentum(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """M(q) v, (n,) [N m s]."""
        return matvec(self.mass_matrix(q), v)

    def inverse_dynamics(
        self, q: jax.Array, v: jax.Array, u: jax.Array, acceleration: jax.Array
    ) -> jax.Array:
        """C(q, v) u + G + M acceleration, (n,) [N m]."""
        coriolis, gravity = self.coriolis(q, v, u), self.gravity(q)
        return coriolis + gravity + matvec(self.mass_matrix(q), acceleration)


def has_mass_matrix(part: object) -> TypeGuard[Robot]:
    """Whether an object has a mass matrix.  A class without the base class is adopted."""
    if isinstance(part, type) or not has_members(part, "n", "mass_matrix"):
        return False
    adopt(type(part), Robot)
    return True


def _check_robot(robot: Any) -> None:
    if not has_mass_matrix(robot):
        checks.offers("robot", robot, ("n", "mass_matrix"), "a robot, as iblf_jax.robots.Robot")


def at_time(robot: R, t: jax.Array) -> R:
    """The robot as it is at time t [s]."""
    _check_robot(robot)
    return robot.at(t)


@programs.jit(options=programs.SHORTEST_TO_COMPILE)
def _mass_matrix(robot: Robot, q: jax.Array) -> jax.Array:
    return robot.mass_matrix(q)


def mass_matrix_at(robot: Robot, q: jax.Array) -> jax.Array:
    """M(q), (n, n) [kg m^2], compiled once for all robots of one structure: for many joints, this
    takes seconds.
    """
    keep_programs()
    if checks.is_concrete((robot, q)):
        robot = jax.tree.map(
            lambda x: np.asarray(x, q.dtype), robot
        )  # a number's weak type would compile it again
    return _mass_matrix(robot, q)


def friction_torque(robot: Robot, dq: jax.Array) -> jax.Array:
    """Friction torque of the joints, (n,) [N m], opposite to q'; zero unless the robot has a method
    of this name.
    """
    _check_robot(robot)
    (dq,) = checks.vectors(dq=dq)
    return robot.friction_torque(dq)


def coriolis_from_mass_matrix(mass_matrix, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
    """C(q, v) u from M(q) by automatic differentiation, with the Christoffel symbols (head of this
    module).

    Args:
      mass_matrix: function q -> M(q), (n, n) [kg m^2].
      q, v, u: (n,) configuration [rad] and two velocities [rad/s].

    Returns:
      (n,) [N m].

    Raises:
      ValueError: something that is no function, or no vectors of one length.
    """
    if not callable(mass_matrix):
        raise checks.fail(
            "mass_matrix",
            mass_matrix,
            "a function q -> M(q)",
            "Such as robot.mass_matrix, without brackets.",
        )
    q, v, u = checks.vectors(q=q, v=v, u=u)
    try:
        _, M_along_v = jax.jvp(mass_matrix, (q,), (v,))
    except TypeError as error:
        expected = "a function q -> M(q) of JAX arrays"
        raise checks.fail("mass_matrix", mass_matrix, expected, str(error)) from error
    _, M_along_u = jax.jvp(mass_matrix, (q,), (u,))
    energy_gradient = jax.grad(lambda x: inner(u, matvec(mass_matrix(x), v)))(q)
    return 0.5 * (matvec(M_along_v, u) + matvec(M_along_u, v) - energy_gradient)


def joint_names(robot: Robot, n: int) -> tuple[str, ...]:
    """Names of the n joints of a robot: its `joints`, else "joint 0", "joint 1", ..."""
    n = checks.positive_integer("n", n, least=0, most=checks.MAX_JOINTS)
    if has_mass_matrix(robot) and len(robot.joints) == n:
        return tuple(map(str, robot.joints))
    return tuple(f"joint {i}" for i in range(n))


def mass_matrix_rate(robot: Robot, q: jax.Array, dq: jax.Array) -> jax.Array:
    """M'(q) = dM/dq . q', (n, n) [kg m^2/s], by jvp."""
    _check_robot(robot)
    q, dq = checks.vectors(robot.n, q=q, dq=dq)
    return jax.jvp(robot.mass_matrix, (q,), (dq,))[1]


def energy_gradient(robot: Robot, q: jax.Array, v: jax.Array) -> jax.Array:
    """dT/dq with T = 1/2 v^T M(q) v, (n,) [N m]: C(q, v)^T v = M' v - C(q, v) v, by the robot's own
    method if it has one.
    """
    _check_robot(robot)
    q, v = checks.vectors(robot.n, q=q, v=v)
    return robot.energy_gradient(q, v)


def momentum(robot: Robot, q: jax.Array, v: jax.Array) -> jax.Array:
    """M(q) v, (n,) [N m s], by the robot's own method if it has one."""
    _check_robot(robot)
    q, v = checks.vectors(robot.n, q=q, v=v)
    return robot.momentum(q, v)


def inverse_dynamics(
    robot: Robot, q: jax.Array, v: jax.Array, u: jax.Array, acceleration: jax.Array
) -> jax.Array:
    """C(q, v) u + G + M acceleration, (n,) [N m], by the robot's own method if it has one."""
    _check_robot(robot)
    is_velocity = u is v
    q, v, u, acceleration = checks.vectors(robot.n, q=q, v=v, u=u, acceleration=acceleration)
    if is_velocity:  # a robot may have a shorter form for one object
        u = v
    return robot.inverse_dynamics(q, v, u, acceleration)


def forward_dynamics(robot: Robot, q: jax.Array, v: jax.Array, torque: jax.Array) -> jax.Array:
    """The acceleration M^-1 (torque - C v - G) under all torques on the joints, (n,) [rad/s^2]."""
    rest = torque - robot.coriolis(q, v, v) - robot.gravity(q)
    return solve_spd(robot.mass_matrix(q), rest)


def from_energy(cls: type[T]) -> type[T]:
    """Class decorator: adds `coriolis`, `gravity` and `jacobian` to a robot that has `mass_matrix`,
    `potential`, `tip`, as `Robot` does for the classes that inherit from it.

    Methods that the class already has are kept.  Apply it below `component`:

        @ij.component
        @ij.robots.from_energy
        class MyArm: ...

    Raises:
      ValueError: something that is no class, or a class that lacks the source of a method.
    """
    sources = {"coriolis": "mass_matrix", "gravity": "potential", "jacobian": "tip"}
    if not isinstance(cls, type):
        raise checks.fail(
            "from_energy", cls, "a class", "Write @iblf_jax.robots.from_energy above it."
        )
    derived = [method for method in sources if not has_members(cls, method)]
    missing = [sources[method] for method in derived if not has_members(cls, sources[method])]
    if missing:
        raise checks.fail(
            "from_energy",
            cls,
            "a class with mass_matrix(q), potential(q) and tip(q)",
            f"It lacks {', '.join(missing)}.",
        )
    for method in derived:
        setattr(cls, method, vars(Robot)[method])
    return cls


def planar_skeleton(lengths: jax.Array, q: jax.Array) -> jax.Array:
    """Base, joints and tip of a planar chain with relative joint angles, (n + 1, 2) [m]."""
    angles = jnp.cumsum(q)
    steps = lengths[:, None] * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    return jnp.concatenate([jnp.zeros((1, 2), steps.dtype), jnp.cumsum(steps, axis=0)])


def broadcast_fields(robot: object, names: Iterable[str], shape: tuple[int, ...]) -> None:
    """Repeats the scalars among some fields of a robot; raises ValueError for any other shape."""
    for name, value in attributes(robot, names).items():
        if value.ndim == 0:
            object.__setattr__(robot, name, jnp.broadcast_to(value, shape))
        else:
            checks.shape_is(f"{type(robot).__name__}.{name}", value, shape)
