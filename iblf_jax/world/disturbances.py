"""Disturbances: generalised torques that act on the plant and that the law does not know.

    M q" + C q' + G = tau + (disturbance)          for the simulated plant

The observer estimates the lumped uncertain term of (2.1),

    f = M0 q" + C0 q' + G0 - tau,

evaluated along the run with the *model*.  It equals the disturbance here when the plant is the
model; if the plant has other masses, a payload or friction, f holds those as well.  f must be
differentiable (Assumption 1), so a discontinuous disturbance declares its `jump_times`.

On a plant in strict-feedback form, `Levels` has a disturbance for each level, in the unit of the
level per second.  A disturbance that is not inside `Levels` is a torque on the robot inside the
plant; on a plant without a robot it is added to the input u, in the unit of u.
"""

from __future__ import annotations

import abc
from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.linalg import matvec
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.time import Timed, joined, jump_times_of, no_times
from iblf_jax.core.units import TORQUE, VELOCITY, PlantUnit
from iblf_jax.world import plants
from iblf_jax.world.robots import Robot, momentum


class Disturbance(Timed):
    """The contract of a disturbance.  Its torque acts on a robot, or on the robot inside a plant in
    strict-feedback form; on a plant without a robot it is added to the input.
    """

    @abc.abstractmethod
    def torque(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, plant: Robot, model: Robot
    ) -> jax.Array:
        """Generalised torque on the plant, (n,) [N m].

        Args:
          t: time, () [s].
          q, dq: position [rad] and velocity [rad/s], (n,).
          plant, model: robots as they are, of other plants the robot inside them, and plants
            without a robot as they are.
        """

    @abc.abstractmethod
    def jump_times(self) -> jax.Array:
        """Times at which `torque` is discontinuous, (m,) [s]; empty if it never is.

        Steps of a run are divided at these times; an undeclared jump reduces the accuracy.  The
        number of times is fixed.  The times are computed from leaves with jnp, may differ between
        runs, and have derivatives.
        """

    def rates(self, t: jax.Array, x: jax.Array, plant: Any, model: Any) -> jax.Array | None:
        """D_1 ... d_r of (S.1), (r, n), which are added to x' of a plant in strict-feedback form;
        None if there is nothing to add.  It receives plant and model as the scenario has them.
        """
        return None


def _never(disturbance: object) -> jax.Array:
    """No jump times: the torque is continuous."""
    return no_times()


@component
class Nothing(Disturbance):
    """No disturbance."""

    def torque(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, plant: Robot, model: Robot
    ) -> jax.Array:
        """Zero, (n,) [N m]."""
        return jnp.zeros_like(q)

    jump_times = _never


@component
class ModelShaped(Disturbance):
    """The paper's uncertain term, shaped by the model's own matrices.                       (4.3)

        f = M0(q) a(t) + C0(q, q') b(t)
        a = acceleration_amplitude sin(acceleration_frequency t + acceleration_phase + phase)
        b = velocity_amplitude sin(velocity_frequency t + velocity_phase + phase)

    `phase` shifts both signals: a Monte-Carlo study can vary this parameter only.

    Args:
      acceleration_amplitude: amplitude of a, () or (n,) [rad/s^2].
      acceleration_frequency: angular frequency of a, () or (n,) [rad/s].
      acceleration_phase: phase of a at t = 0, () or (n,) [rad].
      velocity_amplitude: amplitude of b, () or (n,) [rad/s].
      velocity_frequency: angular frequency of b, () or (n,) [rad/s].
      velocity_phase: phase of b at t = 0, () or (n,) [rad].
      phase: shift of both signals, () [rad]; 0 if not given.

    Source: Zhang & Yan 2024, (4.3).
    """

    acceleration_amplitude: Leaf = leaf("rad/s^2")
    acceleration_frequency: Leaf = leaf("rad/s")
    acceleration_phase: Leaf = leaf("rad")
    velocity_amplitude: Leaf = leaf("rad/s")
    velocity_frequency: Leaf = leaf("rad/s")
    velocity_phase: Leaf = leaf("rad")
    phase: Leaf = leaf("rad", shape="scalar", default=0.0)

    def torque(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, plant: Robot, model: Robot
    ) -> jax.Array:
        """f(t, q, q'), (n,) [N m]."""
        a = self.acceleration_amplitude * jnp.sin(
            self.acceleration_frequency * t + self.acceleration_phase + self.phase
        )
        b = self.velocity_amplitude * jnp.sin(
            self.velocity_frequency * t + self.velocity_phase + self.phase
        )
        return momentum(model, q, a) + model.coriolis(q, dq, b)

    jump_times = _never


@component
class Sinusoids(Disturbance):
    """Joint torques offset + amplitude sin(frequency t + phase).

    On a plant without a robot it is added to the input, and inside `Levels` to the rate of a level,
    in their units.

    Args:
      amplitude: amplitude of the torque, () or (n,) [N m].
      frequency: angular frequency, () or (n,) [rad/s].
      phase: phase at t = 0, () or (n,) [rad]; 0 if not given.
      offset: mean torque, () or (n,) [N m]; 0 if not given.
    """

    amplitude: Leaf = leaf(TORQUE)
    frequency: Leaf = leaf("rad/s")
    phase: Leaf = leaf("rad", default=0.0)
    offset: Leaf = leaf(TORQUE, default=0.0)

    def torque(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, plant: Robot, model: Robot
    ) -> jax.Array:
        """(n,) [N m]."""
        return jnp.broadcast_to(
            self.offset + self.amplitude * jnp.sin(self.frequency * t + self.phase), q.shape
        )

    jump_times = _never


@component
class Step(Disturbance):
    """A step of the joint torques: `size` from `time` on, zero before.

    Args:
      size: the torques, () or (n,) [N m].
      time: time of the step, () [s].
    """

    size: Leaf = leaf(TORQUE)
    time: Leaf = leaf("s", shape="scalar")

    def torque(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, plant: Robot, model: Robot
    ) -> jax.Array:
        """(n,) [N m]."""
        return jnp.where(t >= self.time, jnp.broadcast_to(self.size, q.shape), jnp.zeros_like(q))

    def jump_times(self) -> jax.Array:
        """`time`."""
        return jnp.atleast_1d(self.time)


@component
class TipForce(Disturbance):
    """A force that acts on the tip, +J(q)^T F(t) with F = offset + amplitude sin(frequency t +
    phase).

    (The paper's f_ext in (2.1) is the force that the tip exerts, hence its minus sign: F = -f_ext.)

    Args:
      amplitude: one number per coordinate of the tip, () or (2,) for a planar arm, (3,) in space
        [N].
      frequency: angular frequency, of the same shape or () [rad/s]; 0 if not given.
      phase: phase at t = 0, of the same shape or () [rad]; 0 if not given.
      offset: mean force, of the same shape or () [N]; 0 if not given.
    """

    amplitude: Leaf = leaf("N", shape="any")
    frequency: Leaf = leaf("rad/s", shape="any", default=0.0)
    phase: Leaf = leaf("rad", shape="any", default=0.0)
    offset: Leaf = leaf("N", shape="any", default=0.0)

    def torque(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, plant: Robot, model: Robot
    ) -> jax.Array:
        """J(q)^T F(t), (n,) [N m]."""
        J = plant.jacobian(q)
        force = self.offset + self.amplitude * jnp.sin(self.frequency * t + self.phase)
        return matvec(J.T, jnp.broadcast_to(force, (J.shape[0],)))

    jump_times = _never


@component
class Friction(Disturbance):
    """Viscous and smoothed Coulomb friction in the joints, -(viscous q' + coulomb tanh(q' /
    width)).

    Args:
      viscous: torque per speed, () or (n,) [N m s/rad], >= 0; 0 if not given.
      coulomb: torque at speeds well above the width, () or (n,) [N m], >= 0; 0 if not given.
      width: velocity over which the Coulomb part changes sign, () or (n,) [rad/s], > 0; smaller is
        sharper and stiffer; 0.05 if not given.
    """

    viscous: Leaf = leaf(PlantUnit("N m s/rad", "tau/x2"), sign="nonnegative", default=0.0)
    coulomb: Leaf = leaf(TORQUE, sign="nonnegative", default=0.0)
    width: Leaf = leaf(VELOCITY, sign="positive", default=0.05)

    def torque(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, plant: Robot, model: Robot
    ) -> jax.Array:
        """(n,) [N m]."""
        return -(self.viscous * dq + self.coulomb * jnp.tanh(dq / self.width))

    jump_times = _never


@component
class Sum(Disturbance):
    """Several disturbances at once: `Sum((Friction(0.1), Step(1.0, 5.0)))`.

    Args:
      parts: any disturbances, a tuple or a list.
    """

    parts: tuple[Disturbance, ...]

    def check(self) -> None:
        """Takes a list for a tuple; raises ValueError for a part that is not a disturbance."""
        if not isinstance(self.parts, tuple | list):
            raise checks.fail(
                "Sum.parts",
                self.parts,
                "a tuple of disturbances",
                "Put one part into brackets, Sum((part,)).",
            )
        object.__setattr__(self, "parts", tuple(self.parts))
        for i, part in enumerate(self.parts):
            checks.conforms(f"Sum.parts[{i}]", part, Disturbance)

    def torque(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, plant: Robot, model: Robot
    ) -> jax.Array:
        """The sum over the parts, (n,) [N m]."""
        total = jnp.zeros_like(q)
        for part in self.parts:
            total = total + part.torque(t, q, dq, plant, model)
        return total

    def jump_times(self) -> jax.Array:
        """The parts' jump times together, (m,) [s]."""
        return joined([jump_times_of(f"Sum.parts[{i}]", part) for i, part in enumerate(self.parts)])

    def rates(self, t: jax.Array, x: jax.Array, plant: Any, model: Any) -> jax.Array | None:
        """The sum over the parts that disturb levels, (r, n); None if none does."""
        total = None
        for part in self.parts:
            found = part.rates(t, x, plant, model)
            if found is not None:
                total = found if total is None else total + found
        return total


@component
class Levels(Disturbance):
    """d_1 ... d_r of (S.1): one disturbance for each level of the plant.

        x_i' = f_i + G_i x_{i+1} + d_i

    d_i is the `torque` of part i, which receives the first two levels as q and q', and plant and
    model as every torque does; its numbers are in the unit of level i per second.

    Args:
      parts: a disturbance for each level, or None for a level without one, a tuple or a list; fewer
        parts than levels leave the last levels undisturbed.
    """

    parts: tuple[Disturbance | None, ...]

    def check(self) -> None:
        """Takes a list for a tuple; raises ValueError for a part that is not a disturbance."""
        if not isinstance(self.parts, tuple | list):
            remedy = "Such as Levels((None, Sinusoids(0.3, 1.0)))."
            raise checks.fail("Levels.parts", self.parts, "a tuple of disturbances or None", remedy)
        object.__setattr__(self, "parts", tuple(self.parts))
        for i, part in enumerate(self.parts):
            if part is not None:
                checks.conforms(f"Levels.parts[{i}]", part, Disturbance)

    def symbols_of_part(self, field: str, index: int, symbols: Any) -> Any:
        """The units of the symbols in a part: its torque is a rate of its level."""
        rates = symbols["rates"]
        return {**symbols, "tau": rates[index] if index < len(rates) else "1"}

    def torque(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, plant: Robot, model: Robot
    ) -> jax.Array:
        """No torque, (n,) [N m]."""
        return jnp.zeros_like(q)

    def rates(self, t: jax.Array, x: jax.Array, plant: Any, model: Any) -> jax.Array:
        """d_1 ... d_r, (r, n)."""
        parts = (plants.robot_or_plant(plant), plants.robot_or_plant(model))
        rows = [
            jnp.zeros_like(x[0]) if part is None else part.torque(t, x[0], x[1], *parts)
            for part in self.parts[: len(x)]
        ]
        rows += [jnp.zeros_like(x[0])] * (len(x) - len(rows))
        return jnp.stack(rows)

    def jump_times(self) -> jax.Array:
        """The parts' jump times together, (m,) [s]."""
        found = [
            jump_times_of(f"Levels.parts[{i}]", part)
            for i, part in enumerate(self.parts)
            if part is not None
        ]
        return joined(found)


MEMBERS = {
    "nothing": Nothing,
    "model_shaped": ModelShaped,
    "sinusoids": Sinusoids,
    "step": Step,
    "tip_force": TipForce,
    "friction": Friction,
    "sum": Sum,
    "levels": Levels,
}
"""Every disturbance by the name that a scenario file gives it."""
