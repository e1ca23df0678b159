"""Small scenarios of plants in strict-feedback form: a motor-driven pendulum of order 3, and a body
in the plane whose components have different units.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from iblf_jax.bounds import Bounds, Constant

import iblf_jax as ij

WITH_MAPPING = (ij.barriers.TransformedError(),) * 3


def _pendulum_drift(t: jax.Array, x: jax.Array) -> jax.Array:
    torque = -2.0 * x[1] - 10.0 * jnp.sin(x[0])
    return jnp.stack([jnp.zeros_like(x[0]), torque, -10.0 * x[2] - 0.2 * x[1]])


def _pendulum_gain(t: jax.Array, x: jax.Array) -> jax.Array:
    one = jnp.ones_like(x[0])
    return jnp.stack([one, one, 5.0 * one])


PENDULUM = ij.plants.StrictFeedback(
    drift=_pendulum_drift,
    gain=_pendulum_gain,
    n=1,
    order=3,
    units=("rad", "rad/s", "A", "V"),
    level_names=("angle", "speed", "current"),
    component_names=("pendulum",),
)


def symmetric(size: Any) -> Bounds:
    return Bounds(lower=Constant(-jnp.asarray(size)), upper=Constant(size))


ANGLES = symmetric(1.0)
"""Bounds of the first level of `pendulum`."""


def pendulum(**parts: Any) -> ij.Scenario:
    """It follows a sinusoid, with bounds and barriers on all levels; parts replace its own."""
    disturbance = ij.disturbances.Sinusoids(amplitude=0.3, frequency=1.0)
    own: dict[str, Any] = {
        "plant": PENDULUM,
        "reference": ij.references.Sinusoid(offset=0.0, amplitude=0.5),
        "bounds": (ANGLES, symmetric(3.0), symmetric(20.0)),
        "controller": ij.controllers.BarrierBackstepping(
            k=(3.0, 10.0, 30.0), barriers=WITH_MAPPING
        ),
        "initial": ij.Initial(x=[[0.3], [0.0], [0.0]]),
        "disturbance": ij.disturbances.Levels((None, disturbance)),
    }
    return ij.Scenario(**own | parts)


@ij.component
class Body:
    """pose' = R(heading) velocity,   mass velocity' = force - 0.5 mass velocity."""

    mass: ij.Leaf = ij.leaf("kg", sign="positive")
    n: ClassVar[int] = 3
    order: ClassVar[int] = 2
    units: ClassVar[tuple] = (("m", "m", "rad"), ("m/s", "m/s", "rad/s"), ("N", "N", "N m"))
    level_names: ClassVar[tuple] = ("pose", "velocity")
    component_names: ClassVar[tuple] = ("north", "east", "heading")
    input_name: ClassVar[str] = "force"

    def rotation(self, x1: jax.Array) -> jax.Array:
        c, s = jnp.cos(x1[2]), jnp.sin(x1[2])
        return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        return jnp.stack([jnp.zeros_like(x[0]), -0.5 * x[1]])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        return jnp.stack([self.rotation(x[0]), jnp.diag(1.0 / self.mass)])

    def outline(self, x1: jax.Array) -> jax.Array:
        """Corners of a triangle that points to the heading, (3, 2) [m]."""
        corners = jnp.array([[0.6, 0.0], [-0.4, 0.3], [-0.4, -0.3]])
        return x1[:2] + corners @ self.rotation(x1)[:2, :2].T


def body(**parts: Any) -> ij.Scenario:
    own: dict[str, Any] = {
        "plant": Body(mass=[20.0, 20.0, 3.0]),
        "reference": ij.references.Sinusoid(
            offset=[0.0, 0.0, 0.5], amplitude=[4.0, 2.0, 0.6], frequency=0.2, phase=[0.0, 1.5, 0.3]
        ),
        "bounds": symmetric([6.0, 6.0, 2.0]),
        "controller": ij.controllers.BarrierBackstepping(k=(1.0, 3.0)),
        "initial": ij.Initial(q=[0.5, 1.0, 0.2]),
    }
    return ij.Scenario(**own | parts)
