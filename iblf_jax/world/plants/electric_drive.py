"""A robot whose joints are driven by direct-current motors: a plant of order 3."""

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
from iblf_jax.world.robots import Robot, inverse_dynamics


@component
class ElectricDrive(Plant):
    """M(q) q" + C(q, q') q' + G(q) = Kt i,   L i' = u - R i - Kb q'.

    The levels are q, q' and the currents i; u is the voltage.  All quantities of the motors are
    referred to the side of the joints.

    Args:
      robot: any of `iblf_jax.robots`, with the inertia of the motors.
      torque_constant: Kt of each motor, () or (n,) [N m/A], > 0.
      inductance: L of each motor, () or (n,) [H], > 0.
      resistance: R of each motor, () or (n,) [ohm], > 0.
      back_emf: Kb of each motor, () or (n,) [V s/rad], >= 0.

    Source: D. M. Dawson, J. Hu, T. C. Burg, Nonlinear Control of Electric Machinery, 1998.
    """

    robot: Robot
    torque_constant: Leaf = leaf("N m/A", sign="positive")
    inductance: Leaf = leaf("H", sign="positive")
    resistance: Leaf = leaf("ohm", sign="positive")
    back_emf: Leaf = leaf("V s/rad", sign="nonnegative")
    order: ClassVar[int] = 3
    known_structure = True
    units: ClassVar[tuple[str, ...]] = ("rad", "rad/s", "A", "V")
    level_names: ClassVar[tuple[str, ...]] = ("position", "velocity", "current")
    input_name: ClassVar[str] = "voltage"

    def check(self) -> None:
        """Raises ValueError for something that is no robot."""
        checks.conforms("ElectricDrive.robot", self.robot, Robot, "iblf_jax.robots has them.")

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.robot.n

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f, (3, n): 0, -M^-1 (C q' + G), -L^-1 (R i + Kb q')."""
        zero = jnp.zeros_like(x[0])
        return jnp.stack([self.level_rate(i, t, x, zero, 0.0) for i in (1, 2, 3)])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """G, (3, n, n): 1, M^-1 Kt, L^-1."""
        one = jnp.eye(self.n, dtype=x.dtype)
        driven = inverse_mass_matrix(self.robot, x[0]) * self.torque_constant
        return jnp.stack([one, driven, one / self.inductance])

    def level_rate(
        self, level: int, t: jax.Array, x: jax.Array, above: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_i', (n,) [rad/s, rad/s^2, A/s]."""
        if level == 1:
            return above
        if level == 2:
            driven = self.torque_constant * above
            return robot_acceleration(self.robot, x[0], x[1], driven + torque)
        return (above - self.voltage(x[2], x[1])) / self.inductance

    def level_input(
        self, level: int, t: jax.Array, x: jax.Array, rate: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_{i+1}, or u for i = 3, (n,), for which x_i' is `rate`."""
        if level == 1:
            return rate
        if level == 2:
            # One array for both velocities: robots then compute their products once.
            q, dq = x[0], x[1]
            needed = inverse_dynamics(self.robot, q, dq, dq, rate) - torque
            return needed / self.torque_constant
        return self.inductance * rate + self.voltage(x[2], x[1])

    def transposed_gain(self, level: int, t: jax.Array, x: jax.Array, s: jax.Array) -> jax.Array:
        """G_i^T s, (n,)."""
        if level == 1:
            return s
        if level == 2:
            return self.torque_constant * solve_spd(self.robot.mass_matrix(x[0]), s)
        return s / self.inductance

    def voltage(self, current: jax.Array, dq: jax.Array) -> jax.Array:
        """R i + Kb q', (n,) [V]: the voltage that keeps a current [A] at the speed q' [rad/s]."""
        return self.resistance * current + self.back_emf * dq

    def joint_torque(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Kt i, (n,) [N m]."""
        return self.torque_constant * x[2]

    def steady_levels(self, q: jax.Array, dq: jax.Array) -> jax.Array:
        """The current that holds gravity, Kt^-1 G(q), (1, n) [A]."""
        return (self.robot.gravity(q) / self.torque_constant)[None]

    def steady_input(self, q: jax.Array) -> jax.Array:
        """R Kt^-1 G(q), (n,) [V]."""
        current = self.steady_levels(q, jnp.zeros_like(q))[0]
        return self.voltage(current, jnp.zeros_like(q))

    def weights(self, x: jax.Array) -> jax.Array:
        """(10 1/s^2) M, M and Kt^2/(M 10 1/s^2), (3, n), with the diagonal of M(q).

        The energy of the inductance, L, is not used: the law cancels the inductance, and its loop
        does not depend on it.  With this weight levels 2 and 3 exchange energy at the frequency of
        levels 1 and 2.
        """
        M = diagonal_inertia(self.robot, x[0])
        return jnp.stack([EXCHANGE_RATE * M, M, self.torque_constant**2 / (EXCHANGE_RATE * M)])

    def at(self, t: jax.Array) -> ElectricDrive:
        """The plant at time t [s], with the robot as it is then."""
        return dataclasses.replace(self, robot=self.robot.at(t))

    def jump_times(self) -> jax.Array:
        """The times at which the robot jumps, (m,) [s]."""
        return jump_times_of("robot", self.robot)
