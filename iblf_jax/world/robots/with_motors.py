"""A robot with the inertia and the damping of the motors at its joints."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.time import as_at, jump_times_of
from iblf_jax.world.robots._base import (
    Robot,
    energy_gradient,
    friction_torque,
    inverse_dynamics,
    momentum,
    robot_member,
)


@component
class WithMotors:
    """(M(q) + diag(J)) q" + C(q, q') q' + G(q) = tau - D q' + friction of the robot.

    Each motor turns with its joint.  Gyroscopic torques of the rotors are neglected, so that C and
    G are those of the robot.  As the friction of any robot, the damping acts on a plant only; law
    and observer do not know it.

    Args:
      robot: the links, any of `iblf_jax.robots`, without the inertia of the motors.
      inertia: J of each motor, referred to the side of the joint, () or (n,) [kg m^2], >= 0.
      damping: D of each motor, referred to the side of the joint, () or (n,) [N m s/rad], >= 0; 0
        if not given.

    Source: M. W. Spong, ASME J. Dynamic Systems, Measurement, and Control 109 (1987) 310-319, in
      the limit of rigid joints.
    """

    robot: Robot
    inertia: Leaf = leaf("kg m^2", sign="nonnegative")
    damping: Leaf = leaf("N m s/rad", sign="nonnegative", default=0.0)

    def check(self) -> None:
        """Raises ValueError for something that is no robot."""
        checks.conforms(
            "WithMotors.robot", self.robot, Robot, "iblf_jax.robots has them.", ("skeleton",)
        )

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.robot.n

    @property
    def payload(self) -> Any:
        """The payload of the robot."""
        return self.robot.payload  # type: ignore[attr-defined]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints of the robot."""
        return robot_member(self.robot, "joints")  # type: ignore[no-any-return]

    @property
    def kinds(self) -> Any:
        """Kinds of the joints of the robot."""
        return robot_member(self.robot, "kinds")

    @property
    def limits(self) -> Any:
        """Limits of the joints of the robot."""
        return robot_member(self.robot, "limits")

    @property
    def speed(self) -> Any:
        """Largest speeds of the joints of the robot."""
        return robot_member(self.robot, "speed")

    @property
    def effort(self) -> Any:
        """Largest torques of the joints of the robot."""
        return robot_member(self.robot, "effort")

    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q) + diag(J), (n, n) [kg m^2]."""
        one = jnp.eye(self.n, dtype=q.dtype)
        return self.robot.mass_matrix(q) + self.inertia * one

    def coriolis(self, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        """C(q, v) u of the robot, (n,) [N m]."""
        return self.robot.coriolis(q, v, u)

    def energy_gradient(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """dT/dq of the robot, (n,) [N m]; the inertia of the motors does not depend on q."""
        return energy_gradient(self.robot, q, v)

    def momentum(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """M(q) v + J v, (n,) [N m s]."""
        return momentum(self.robot, q, v) + self.inertia * v

    def inverse_dynamics(
        self, q: jax.Array, v: jax.Array, u: jax.Array, acceleration: jax.Array
    ) -> jax.Array:
        """The torque on the robot, and J acceleration, (n,) [N m]."""
        torque = inverse_dynamics(self.robot, q, v, u, acceleration)
        return torque + self.inertia * acceleration

    def gravity(self, q: jax.Array) -> jax.Array:
        """G(q) of the robot, (n,) [N m]."""
        return self.robot.gravity(q)

    def potential(self, q: jax.Array) -> jax.Array:
        """U(q) of the robot, () [J]."""
        return self.robot.potential(q)

    def tip(self, q: jax.Array) -> jax.Array:
        """Position of the tip of the robot, (2,) or (3,) [m]."""
        return self.robot.tip(q)

    def jacobian(self, q: jax.Array) -> jax.Array:
        """D tip / dq of the robot, (2, n) or (3, n) [m/rad]."""
        return self.robot.jacobian(q)

    def skeleton(self, q: jax.Array) -> jax.Array:
        """Positions of the base, each joint and the tip of the robot [m]."""
        return self.robot.skeleton(q)

    def friction_torque(self, dq: jax.Array) -> jax.Array:
        """The friction of the robot, and -D q', (n,) [N m]."""
        return friction_torque(self.robot, dq) - self.damping * dq

    def at(self, t: jax.Array) -> WithMotors:
        """The robot as it is at time t [s], with the motors."""
        return dataclasses.replace(self, robot=as_at(self.robot, t))

    def jump_times(self) -> jax.Array:
        """The times at which the robot jumps, (m,) [s]."""
        return jump_times_of("robot", self.robot)
