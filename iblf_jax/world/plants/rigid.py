"""A rigid robot as a plant of order 2."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.linalg import inner, solve_spd
from iblf_jax.core.pytree import component
from iblf_jax.core.time import jump_times_of
from iblf_jax.world.plants._base import Notation, Plant, component_names, components_in_words
from iblf_jax.world.robots import Robot, inverse_dynamics, momentum


@component
class Rigid(Plant):
    """q' = x_2,   M(q) x_2' + C(q, x_2) x_2 + G(q) = u,   x = (q, q').

    A scenario takes robots as they are; this class gives a robot the methods of a plant.

    Args:
      robot: any of `iblf_jax.robots`.

    Source: Zhang & Yan 2024, (2.1).
    """

    robot: Robot
    order: ClassVar[int] = 2
    known_structure = True
    units: ClassVar[tuple[str, ...]] = ("rad", "rad/s", "N m")
    level_names: ClassVar[tuple[str, ...]] = ("position", "velocity")
    input_name: ClassVar[str] = "torque"

    def check(self) -> None:
        """Raises ValueError for something that is no robot."""
        checks.conforms("Rigid.robot", self.robot, Robot, "iblf_jax.robots has them.")

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.robot.n

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f, (2, n): 0 and -M^-1 (C q' + G)."""
        zero = jnp.zeros_like(x[0])
        return jnp.stack([zero, self.level_rate(2, t, x, zero, 0.0)])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """G, (2, n, n): 1 and M^-1."""
        return jnp.stack([jnp.eye(self.n, dtype=x.dtype), inverse_mass_matrix(self.robot, x[0])])

    def level_rate(
        self, level: int, t: jax.Array, x: jax.Array, above: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_i', (n,) [rad/s, rad/s^2]."""
        if level == 1:
            return above
        return robot_acceleration(self.robot, x[0], x[1], above + torque)

    def level_input(
        self, level: int, t: jax.Array, x: jax.Array, rate: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """The velocity, or the torque, (n,), for which x_i' is `rate`."""
        if level == 1:
            return rate
        # One array for both velocities: robots then compute their products once.
        q, dq = x[0], x[1]
        return inverse_dynamics(self.robot, q, dq, dq, rate) - torque

    def transposed_gain(self, level: int, t: jax.Array, x: jax.Array, s: jax.Array) -> jax.Array:
        """G_i^T s, (n,)."""
        if level == 1:
            return s
        return solve_spd(self.robot.mass_matrix(x[0]), s)

    def joint_torque(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """The input itself, (n,) [N m]."""
        return u

    def steady_levels(self, q: jax.Array, dq: jax.Array) -> jax.Array:
        """There are no levels above the second, (0, n)."""
        return jnp.zeros((0, self.n), q.dtype)

    def steady_input(self, q: jax.Array) -> jax.Array:
        """G(q), (n,) [N m]."""
        return self.robot.gravity(q)

    def at(self, t: jax.Array) -> Rigid:
        """The plant at time t [s], with the robot as it is then."""
        return dataclasses.replace(self, robot=self.robot.at(t))

    def jump_times(self) -> jax.Array:
        """The times at which the robot jumps, (m,) [s]."""
        return jump_times_of("robot", self.robot)


@component
class RobotPlant(Rigid):
    """A `Rigid` whose uncertain term is the torque f, (n,), instead of rates, (2, n).  The loop
    wraps robots in it.

    Args:
      robot: any of `iblf_jax.robots`.

    Source: Zhang & Yan 2024, (2.1), (3.12).
    """

    is_robot = True
    reference_levels: ClassVar[int] = 2
    loses_input: ClassVar[bool] = False
    uncertain_levels: ClassVar[tuple[int, ...]] = ()

    @property
    def notation(self) -> Notation:
        """That of the paper."""
        return RobotNotation(self)

    @property
    def estimate_shape(self) -> tuple[int, ...]:
        """The shape of an estimate of the torque f of (2.1), (n,)."""
        return (self.n,)

    def uncertain(self, t: jax.Array, x: jax.Array, rate: jax.Array, u: jax.Array) -> jax.Array:
        """The torque f of (2.1), (n,) [N m]."""
        q, dq = x[0], x[1]
        return inverse_dynamics(self.robot, q, dq, dq, rate[1]) - u

    def as_uncertain(self, x: jax.Array, estimate: jax.Array) -> jax.Array:
        """An estimate as the torque f_hat, (n,) [N m]: M d_hat_2."""
        if estimate.ndim == 1:
            return estimate
        return momentum(self.robot, x[0], estimate[1])

    def energy_of_errors(self, x: jax.Array, e2: jax.Array | None, error: jax.Array) -> jax.Array:
        """1/2 e2^T M e2 + 1/2 f_tilde^T f_tilde, ().                                      (3.12)"""
        if e2 is None:
            return 0.5 * inner(error, error)
        return 0.5 * (inner(e2, momentum(self.robot, x[0], e2)) + inner(error, error))


class RobotNotation(Notation):
    """The notation of the paper: q and q' of joints, and tau.

    Args:
      plant: a `RobotPlant`.
    """

    symbols: ClassVar[tuple[str, str]] = ("q", r"\dot q")
    reference: ClassVar[str] = "q_d"
    input: ClassVar[str] = r"\tau"
    alpha: ClassVar[str] = "virtual velocity"
    difference: ClassVar[str] = "rad/s"

    def __init__(self, plant: Plant) -> None:
        super().__init__(plant)
        self.levels = ()
        self.portrait = "Phase portrait of the positions"
        self.input_column = "tau"
        self.effort_column = "above gravity"
        self.effort = "torque above gravity"
        self.effort_formula = "torque above gravity, sqrt(mean |tau - G0(q)|^2)"

    def component(self, level: int, index: int) -> str:
        """A joint, such as "elbow"."""
        return component_names(self.plant)[index]

    def left_bounds(self, level: int, index: int) -> str:
        """That a joint left its bounds."""
        joint = components_in_words(self.plant)[index].removeprefix("joint ")
        return f"Joint {joint} left its {('bounds', 'velocity bounds')[level - 1]}"


def robot_acceleration(robot: Robot, q: jax.Array, dq: jax.Array, torque: jax.Array) -> jax.Array:
    """M^-1 (torque - C q' - G), (n,) [rad/s^2]."""
    rest = torque - robot.coriolis(q, dq, dq) - robot.gravity(q)
    return solve_spd(robot.mass_matrix(q), rest)


def inverse_mass_matrix(robot: Robot, q: jax.Array) -> jax.Array:
    """M^-1, (n, n) [1/(kg m^2)]."""
    M = robot.mass_matrix(q)
    columns = [solve_spd(M, column) for column in jnp.eye(robot.n, dtype=M.dtype)]
    return jnp.stack(columns, axis=-1)


def diagonal_inertia(robot: Robot, q: jax.Array) -> jax.Array:
    """The diagonal of M(q), (n,) [kg m^2]."""
    M = robot.mass_matrix(q)
    return jnp.stack([M[i, i] for i in range(robot.n)])
