"""A robot whose motors drive its joints through springs: a plant of order 4."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.linalg import solve_spd
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.time import jump_times_of
from iblf_jax.world.plants._base import EXCHANGE_RATE, Plant
from iblf_jax.world.plants.rigid import (
    diagonal_inertia,
    inverse_mass_matrix,
    robot_acceleration,
)
from iblf_jax.world.robots import Robot, WithMotors, inverse_dynamics


@component
class FlexibleJoint(Plant):
    """M(q) q" + C(q, q') q' + G(q) = K (theta - q),   J theta" + D theta' + K (theta - q) = u.

    The levels are q, q', theta and theta'; u is the torque of the motors.  All quantities of the
    motors are referred to the side of the joints.

    Args:
      robot: the links, any of `iblf_jax.robots`, without the inertia of the motors.
      stiffness: K of each joint, () or (n,) [N m/rad], > 0.
      motor_inertia: J of each motor, () or (n,) [kg m^2], > 0.
      motor_damping: D of each motor, () or (n,) [N m s/rad], >= 0; 0 if not given.

    A law of robots commands the torque of the motors directly.  Its model is `rigid()`, with the
    inertia of the motors, or `rigid(motors=False)`, the links alone; for the latter a scenario
    warns.

    Source: M. W. Spong, ASME J. Dynamic Systems, Measurement, and Control 109 (1987) 310-319.
    """

    robot: Robot
    stiffness: Leaf = leaf("N m/rad", sign="positive")
    motor_inertia: Leaf = leaf("kg m^2", sign="positive")
    motor_damping: Leaf = leaf("N m s/rad", sign="nonnegative", default=0.0)
    order: ClassVar[int] = 4
    known_structure = True
    units: ClassVar[tuple[str, ...]] = ("rad", "rad/s", "rad", "rad/s", "N m")
    level_names: ClassVar[tuple[str, ...]] = (
        "position",
        "velocity",
        "motor position",
        "motor velocity",
    )
    input_name: ClassVar[str] = "motor torque"

    def check(self) -> None:
        """Raises ValueError for something that is no robot."""
        checks.conforms("FlexibleJoint.robot", self.robot, Robot, "iblf_jax.robots has them.")

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.robot.n

    def rigid(self, *, motors: bool = True) -> Robot:
        """The robot with rigid joints, to which this plant tends for a large stiffness: the model
        of a law of robots.

        Args:
          motors: whether its inertia contains that of the motors, M + diag(J), and its friction
            their damping; otherwise it is the links alone.
        """
        if not motors:
            return self.robot
        return WithMotors(self.robot, inertia=self.motor_inertia, damping=self.motor_damping)

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f, (4, n): 0, -M^-1 (C q' + G + K q), 0, -J^-1 (D theta' + K (theta - q))."""
        zero = jnp.zeros_like(x[0])
        return jnp.stack([self.level_rate(i, t, x, zero, 0.0) for i in (1, 2, 3, 4)])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """G, (4, n, n): 1, M^-1 K, 1, J^-1."""
        one = jnp.eye(self.n, dtype=x.dtype)
        elastic = inverse_mass_matrix(self.robot, x[0]) * self.stiffness
        return jnp.stack([one, elastic, one, one / self.motor_inertia])

    def level_rate(
        self, level: int, t: jax.Array, x: jax.Array, above: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_i', (n,) [rad/s, rad/s^2]."""
        if level in (1, 3):
            return above
        if level == 2:
            elastic = self.stiffness * (above - x[0])
            return robot_acceleration(self.robot, x[0], x[1], elastic + torque)
        return (above - self._motor_load(x)) / self.motor_inertia

    def level_input(
        self, level: int, t: jax.Array, x: jax.Array, rate: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_{i+1}, or u for i = 4, (n,), for which x_i' is `rate`."""
        if level in (1, 3):
            return rate
        if level == 2:
            # One array for both velocities: robots then compute their products once.
            q, dq = x[0], x[1]
            needed = inverse_dynamics(self.robot, q, dq, dq, rate) - torque
            return q + needed / self.stiffness
        return self.motor_inertia * rate + self._motor_load(x)

    def transposed_gain(self, level: int, t: jax.Array, x: jax.Array, s: jax.Array) -> jax.Array:
        """G_i^T s, (n,)."""
        if level in (1, 3):
            return s
        if level == 2:
            return self.stiffness * solve_spd(self.robot.mass_matrix(x[0]), s)
        return s / self.motor_inertia

    def _motor_load(self, x: jax.Array) -> jax.Array:
        """D theta' + K (theta - q), (n,) [N m]."""
        return self.motor_damping * x[3] + self.stiffness * (x[2] - x[0])

    def joint_torque(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """K (theta - q), (n,) [N m]."""
        return self.stiffness * (x[2] - x[0])

    def steady_levels(self, q: jax.Array, dq: jax.Array) -> jax.Array:
        """The static equilibrium of the springs, theta = q + K^-1 G(q), and theta' = q', (2, n)."""
        return jnp.stack([q + self.robot.gravity(q) / self.stiffness, dq])

    def steady_input(self, q: jax.Array) -> jax.Array:
        """G(q), (n,) [N m]."""
        return self.robot.gravity(q)

    def weights(self, x: jax.Array) -> jax.Array:
        """The scales (10 1/s^2) M, M, K and J of the energy, (4, n), with the diagonal of M(q)."""
        M = diagonal_inertia(self.robot, x[0])
        one = jnp.ones_like(M)
        return jnp.stack([EXCHANGE_RATE * M, M, self.stiffness * one, self.motor_inertia * one])

    def at(self, t: jax.Array) -> FlexibleJoint:
        """The plant at time t [s], with the robot as it is then."""
        return dataclasses.replace(self, robot=self.robot.at(t))

    def jump_times(self) -> jax.Array:
        """The times at which the robot jumps, (m,) [s]."""
        return jump_times_of("robot", self.robot)
