"""A pendulum that a direct-current motor drives: a plant of order 3 with one number per level."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.plants._base import EXCHANGE_RATE, Plant


@component
class DrivenPendulum(Plant):
    """x1' = x2,   D x2' = x3 - B x2 - N sin x1,   M x3' = u - H x3 - Km x2.

    The levels are the angle, the angular velocity and the torque of the motor; u is its voltage.
    With the torque constant Kt, the inductance L, the resistance R and the back-emf constant Kb of
    the motor, M = L/Kt, H = R/Kt and Km = Kb.

    Args:
      D: moment of inertia of pendulum and motor, () or (n,) [kg m^2], > 0.
      B: viscous friction, () or (n,) [N m s/rad], >= 0.
      N: torque of gravity at 90 degrees, () or (n,) [N m].
      M: inductance over torque constant, () or (n,) [V s/(N m)], > 0.
      H: resistance over torque constant, () or (n,) [V/(N m)], >= 0.
      Km: back-emf constant, () or (n,) [V s/rad], >= 0.

    Source: D. M. Dawson, J. Hu, T. C. Burg, Nonlinear Control of Electric Machinery, 1998.
    """

    D: Leaf = leaf("kg m^2", sign="positive")
    B: Leaf = leaf("N m s/rad", sign="nonnegative")
    N: Leaf = leaf("N m")
    M: Leaf = leaf("V s/(N m)", sign="positive")
    H: Leaf = leaf("V/(N m)", sign="nonnegative")
    Km: Leaf = leaf("V s/rad", sign="nonnegative")
    n: ClassVar[int] = 1
    order: ClassVar[int] = 3
    known_structure = True
    units: ClassVar[tuple[str, ...]] = ("rad", "rad/s", "N m", "V")
    level_names: ClassVar[tuple[str, ...]] = ("angle", "angular velocity", "motor torque")
    input_name: ClassVar[str] = "voltage"
    component_names: ClassVar[tuple[str, ...]] = ("pendulum",)

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f, (3, 1): 0, -(B x2 + N sin x1)/D, -(H x3 + Km x2)/M."""
        return jnp.stack([jnp.zeros_like(x[0]), -self._load(x) / self.D, -self._drop(x) / self.M])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """The diagonals of G, (3, 1): 1, 1/D, 1/M."""
        one = jnp.ones_like(x[0])
        return jnp.stack([one, one / self.D, one / self.M])

    def level_input(
        self, level: int, t: jax.Array, x: jax.Array, rate: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_{i+1} for which x_i' is `rate`, (1,), linear in all parameters; there is no robot that
        `torque` could act on.
        """
        if level == 1:
            return rate
        if level == 2:
            return self.D * rate + self._load(x)
        return self.M * rate + self._drop(x)

    def _load(self, x: jax.Array) -> jax.Array:
        """Torque of friction and gravity, (1,) [N m]."""
        return self.B * x[1] + self.N * jnp.sin(x[0])

    def _drop(self, x: jax.Array) -> jax.Array:
        """Voltage of resistance and back-emf, (1,) [V]."""
        return self.H * x[2] + self.Km * x[1]

    def steady_levels(self, q: jax.Array, dq: jax.Array) -> jax.Array:
        """The torque that holds gravity, (1, 1) [N m]."""
        return (self.N * jnp.sin(q))[None]

    def steady_input(self, q: jax.Array) -> jax.Array:
        """The voltage that holds gravity, (1,) [V]."""
        return self.H * self.N * jnp.sin(q)

    def weights(self, x: jax.Array) -> jax.Array:
        """(10 1/s^2) D, D and 1/(D 10 1/s^2), (3, 1), as `ElectricDrive.weights`."""
        D = self.D * jnp.ones_like(x[0])
        return jnp.stack([EXCHANGE_RATE * D, D, 1.0 / (EXCHANGE_RATE * D)])
