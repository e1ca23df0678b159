"""The contract of a robot, and the methods that follow from its energies.

    M(q) q" + C(q, q') q' + G(q) = tau + f                                                  (2.1)

The mass matrix M(q) and the potential U(q) define a robot: G = dU/dq, and C follows from the
Christoffel symbols,

    C(q, v) u = 1/2 [ (dM/dq . v) u + (dM/dq . u) v - d/dq (u^T M v) ],

which makes M' - 2 C skew-symmetric, the property that the proofs of all laws here rest on.
`from_energy` adds these methods to a class that has the energies; a class with closed forms
(`TwoLink`) or a recursion writes its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes, has_members
from iblf_jax.core.disk_cache import keep_programs
from iblf_jax.core.linalg import inner, matvec
from iblf_jax.core.optional import OptionalMembers
from iblf_jax.core.time import as_at

T = TypeVar("T")


class Robot(Protocol):
    """The contract of a robot with n joints.  All methods are pure functions of one configuration,
    in SI units.

    A member is a component (`iblf_jax.component`) whose inertial parameters are leaves; `payload`
    [kg], a point mass at the tip, is one of them in every member, so that any robot can carry what
    its model does not know.

    A member may have further methods (`robot_member` holds their defaults).  `at(t)` returns the
    robot as it is at time t [s], for one that changes during a run; `jump_times()`, (m,) [s], are
    the times at which it jumps, where steps of a run are divided.  `friction_torque(dq)`, (n,)
    [N m], is the friction of its joints.  These belong to the plant only: law and observer do not
    know them, and (2.1) has them in f.  `energy_gradient(q, v)`, `momentum(q, v)` and
    `inverse_dynamics(q, v, u, acceleration)` replace the general formulas of the functions of
    these names where a member has shorter ones, such as sums along a chain.  A class may name its
    `geometry_fields`, a tuple of fields whose zeros, ones and equal numbers may be compiled in
    (`engine.structural_constants`).
    """

    @property
    def n(self) -> int:
        """Number of joints."""
        ...

    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q), symmetric positive definite, (n, n) [kg m^2]."""
        ...

    def coriolis(self, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        """C(q, v) u, (n,) [N m], with M' - 2 C skew-symmetric; v and u are (n,) [rad/s]."""
        ...

    def gravity(self, q: jax.Array) -> jax.Array:
        """G(q) = dU/dq, (n,) [N m]."""
        ...

    def potential(self, q: jax.Array) -> jax.Array:
        """U(q), () [J]."""
        ...

    def tip(self, q: jax.Array) -> jax.Array:
        """Position of the tip, (2,) or (3,) [m]."""
        ...

    def jacobian(self, q: jax.Array) -> jax.Array:
        """D tip / dq, (2, n) or (3, n) [m/rad]."""
        ...

    def skeleton(self, q: jax.Array) -> jax.Array:
        """Positions of the base, each joint and the tip, (n + 1, 2) or (n + 1, 3) [m]; for
        drawings.
        """
        ...


robot_member = OptionalMembers(
    joints=(),
    kinds=None,
    limits=None,
    speed=None,
    effort=None,
    skeleton=None,
    geometry_fields=(),
    friction_torque=jnp.zeros_like,
    energy_gradient=None,
    momentum=None,
    inverse_dynamics=None,
)
"""Reads optional members of a robot: those that `Robot` describes, and the names, kinds and limits
of joints that a robot from a file has."""


def at_time(robot: T, t: jax.Array) -> T:
    """The robot as it is at time t [s]: itself, unless it has a method `at`."""
    _is_robot(robot)
    return as_at(robot, t)


@jax.jit
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
    (dq,) = checks.vectors(dq=dq)
    return robot_member(robot, "friction_torque")(dq)  # type: ignore[no-any-return]


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
    _, M_along_v = jax.jvp(mass_matrix, (q,), (v,))
    _, M_along_u = jax.jvp(mass_matrix, (q,), (u,))
    energy_gradient = jax.grad(lambda x: inner(u, matvec(mass_matrix(x), v)))(q)
    return 0.5 * (matvec(M_along_v, u) + matvec(M_along_u, v) - energy_gradient)


def joint_names(robot: Any, n: int) -> tuple[str, ...]:
    """Names of the n joints of a robot: its `joints`, else "joint 0", "joint 1", ..."""
    n = checks.positive_integer("n", n, least=0, most=checks.MAX_JOINTS)
    names = tuple(map(str, robot_member(robot, "joints")))
    if len(names) == n:
        return names
    return tuple(f"joint {i}" for i in range(n))


def mass_matrix_rate(robot: Robot, q: jax.Array, dq: jax.Array) -> jax.Array:
    """M'(q) = dM/dq . q', (n, n) [kg m^2/s], by jvp."""
    _is_robot(robot)
    q, dq = checks.vectors(robot.n, q=q, dq=dq)
    return jax.jvp(robot.mass_matrix, (q,), (dq,))[1]


def _is_robot(robot: Any) -> None:
    checks.offers("robot", robot, ("n", "mass_matrix"), "a robot, as iblf_jax.robots.Robot")


def energy_gradient(robot: Robot, q: jax.Array, v: jax.Array) -> jax.Array:
    """dT/dq with T = 1/2 v^T M(q) v, (n,) [N m]: C(q, v)^T v = M' v - C(q, v) v, by the robot's own
    method if it has one.
    """
    _is_robot(robot)
    q, v = checks.vectors(robot.n, q=q, v=v)
    own_method = robot_member(robot, "energy_gradient")
    if own_method is not None:
        return own_method(q, v)  # type: ignore[no-any-return]
    return matvec(mass_matrix_rate(robot, q, v), v) - robot.coriolis(q, v, v)


def momentum(robot: Robot, q: jax.Array, v: jax.Array) -> jax.Array:
    """M(q) v, (n,) [N m s], by the robot's own method if it has one."""
    _is_robot(robot)
    q, v = checks.vectors(robot.n, q=q, v=v)
    own_method = robot_member(robot, "momentum")
    if own_method is not None:
        return own_method(q, v)  # type: ignore[no-any-return]
    return matvec(robot.mass_matrix(q), v)


def inverse_dynamics(
    robot: Robot, q: jax.Array, v: jax.Array, u: jax.Array, acceleration: jax.Array
) -> jax.Array:
    """C(q, v) u + G + M acceleration, (n,) [N m], by the robot's own method if it has one."""
    _is_robot(robot)
    is_velocity = u is v
    q, v, u, acceleration = checks.vectors(robot.n, q=q, v=v, u=u, acceleration=acceleration)
    if is_velocity:  # a robot may have a shorter form for one object
        u = v
    own_method = robot_member(robot, "inverse_dynamics")
    if own_method is not None:
        return own_method(q, v, u, acceleration)  # type: ignore[no-any-return]
    coriolis, gravity = robot.coriolis(q, v, u), robot.gravity(q)
    return coriolis + gravity + matvec(robot.mass_matrix(q), acceleration)


def from_energy(cls: type[T]) -> type[T]:
    """Class decorator: adds `coriolis`, `gravity` and `jacobian` to a robot that has `mass_matrix`,
    `potential`, `tip`.

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
    missing = [
        source
        for method, source in sources.items()
        if not has_members(cls, method) and not has_members(cls, source)
    ]
    if missing:
        raise checks.fail(
            "from_energy",
            cls,
            "a class with mass_matrix(q), potential(q) and tip(q)",
            f"It lacks {', '.join(missing)}.",
        )

    def coriolis(self, q, v, u):
        """C(q, v) u, (n,) [N m], from M(q) by automatic differentiation."""
        return coriolis_from_mass_matrix(self.mass_matrix, q, v, u)

    def gravity(self, q):
        """G(q) = dU/dq, (n,) [N m], by automatic differentiation."""
        return jax.grad(self.potential)(q)

    def jacobian(self, q):
        """D tip / dq [m/rad], by automatic differentiation."""
        return jax.jacfwd(self.tip)(q)

    for method in (coriolis, gravity, jacobian):
        if not has_members(cls, method.__name__):
            setattr(cls, method.__name__, method)
    return cls


def planar_skeleton(lengths: jax.Array, q: jax.Array) -> jax.Array:
    """Base, joints and tip of a planar chain with relative joint angles, (n + 1, 2) [m]."""
    angles = jnp.cumsum(q)
    steps = lengths[:, None] * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    return jnp.concatenate([jnp.zeros((1, 2), steps.dtype), jnp.cumsum(steps, axis=0)])


def broadcast_fields(robot: Any, names: Iterable[str], shape: tuple[int, ...]) -> None:
    """Repeats the scalars among some fields of a robot; raises ValueError for any other shape."""
    for name, value in attributes(robot, names).items():
        if value.ndim == 0:
            object.__setattr__(robot, name, jnp.broadcast_to(value, shape))
        else:
            checks.shape_is(f"{type(robot).__name__}.{name}", value, shape)
