"""A robot with the inertia and the damping of the motors at its joints."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.time import jump_times_of
from iblf_jax.world.robots._base import Limits, Robot


@component
class WithMotors(Robot):
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
        checks.conforms("WithMotors.robot", self.robot, Robot, "iblf_jax.robots has them.")

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
        return self.robot.joints

    @property
    def kinds(self) -> tuple[str, ...] | None:
        """Kinds of the joints of the robot."""
        return self.robot.kinds

    @property
    def limits(self) -> Limits | None:
        """Limits of the joints of the robot."""
        return self.robot.limits

    @property
    def speed(self) -> jax.Array | None:
        """Largest speeds of the joints of the robot."""
        return self.robot.speed

    @property
    def effort(self) -> jax.Array | None:
        """Largest torques of the joints of the robot."""
        return self.robot.effort

    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q) + diag(J), (n, n) [kg m^2]."""
        one = jnp.eye(self.n, dtype=q.dtype)
        return self.robot.mass_matrix(q) + self.inertia * one

    def coriolis(self, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        """C(q, v) u of the robot, (n,) [N m]."""
        return self.robot.coriolis(q, v, u)

    def energy_gradient(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """dT/dq of the robot, (n,) [N m]; the inertia of the motors does not depend on q."""
        return self.robot.energy_gradient(q, v)

    def momentum(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """M(q) v + J v, (n,) [N m s]."""
        return self.robot.momentum(q, v) + self.inertia * v

    def inverse_dynamics(
        self, q: jax.Array, v: jax.Array, u: jax.Array, acceleration: jax.Array
    ) -> jax.Array:
        """The torque on the robot, and J acceleration, (n,) [N m]."""
        torque = self.robot.inverse_dynamics(q, v, u, acceleration)
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

    def skeleton(self, q: jax.Array) -> jax.Array | None:
        """Positions of the base, each joint and the tip of the robot [m]."""
        return self.robot.skeleton(q)

    def friction_torque(self, dq: jax.Array) -> jax.Array:
        """The friction of the robot, and -D q', (n,) [N m]."""
        return self.robot.friction_torque(dq) - self.damping * dq

    def at(self, t: jax.Array) -> WithMotors:
        """The robot as it is at time t [s], with the motors."""
        return dataclasses.replace(self, robot=self.robot.at(t))

    def jump_times(self) -> jax.Array:
        """The times at which the robot jumps, (m,) [s]."""
        return jump_times_of("robot", self.robot)
