"""The scenarios of iblf_jax that describe the closed loops of `independent_chains`."""

from __future__ import annotations

import independent_chains as other
import jax
import jax.numpy as jnp

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, disturbances, plants, references

BARRIERS = {
    other.mapping: barriers.TransformedError,
    other.quadratic: barriers.Quadratic,
    other.prescribed_performance: barriers.PrescribedPerformance,
}


def _side(side):
    """A side of the independent program in the package's terms."""
    kind = bounds.Sinusoid if isinstance(side, other.Sine) else bounds.Funnel
    return kind(**vars(side))


def bounds_of(case: other.Case) -> tuple:
    """The bounds of a case of the independent program in the package's terms."""
    return tuple(pair and ij.Bounds(*map(_side, pair)) for pair in case.bounds)


def _table_drift(t, x):
    z = jnp.concatenate([jnp.stack([jnp.ones_like(t), t]), x.reshape(-1)])
    return other.DRIFT_SIZE * jnp.sin(jnp.sum(other.DRIFT_WAVE * z, axis=-1))


def _table_gain(t, x):
    z = jnp.concatenate([jnp.stack([jnp.ones_like(t), t]), x.reshape(-1)])
    waves = jnp.sin(jnp.sum(other.GAIN_WAVE * z, axis=-1))
    return other.GAIN_CENTRE + other.GAIN_SIZE * waves


@ij.component
class Pendulum:
    """x1' = x2,  D x2' = x3 - B x2 - N sin x1,  M x3' = u - H x3 - Km x2."""

    D: ij.Leaf = ij.leaf("kg m^2", shape="scalar", sign="positive")
    B: ij.Leaf = ij.leaf("N m s/rad", shape="scalar")
    N: ij.Leaf = ij.leaf("N m", shape="scalar")
    M: ij.Leaf = ij.leaf("s", shape="scalar", sign="positive")
    H: ij.Leaf = ij.leaf("1", shape="scalar")
    Km: ij.Leaf = ij.leaf("N m s/rad", shape="scalar")
    n = 1
    order = 3

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f_1, f_2, f_3."""
        second = -(self.B * x[1] + self.N * jnp.sin(x[0])) / self.D
        third = -(self.H * x[2] + self.Km * x[1]) / self.M
        return jnp.stack([jnp.zeros_like(x[0]), second, third])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """G_1, G_2, G_3, diagonal."""
        return jnp.stack([jnp.ones(()), 1.0 / self.D, 1.0 / self.M])[:, None]


def pendulum() -> Pendulum:
    """The pendulum with a motor of the independent program."""
    return Pendulum(D=other.D, B=other.B, N=other.N, M=other.M, H=other.H, Km=other.KM)


PLANTS = {
    "coupled": lambda: plants.StrictFeedback(_table_drift, _table_gain, n=2, order=3),
    "flexible": lambda: plants.FlexibleJoint(
        ij.robots.TwoLink(other.MASS, other.LENGTH, other.CENTRE, other.INERTIA),
        stiffness=other.STIFFNESS,
        motor_inertia=other.MOTOR_INERTIA,
        motor_damping=other.MOTOR_DAMPING,
    ),
    "pendulum": pendulum,
    "surface": lambda: PLANTS["coupled"](),
}


def _sinusoids(rows):
    return disturbances.Sinusoids(**rows)


def _disturbance(name: str):
    if name == "flexible":
        return _sinusoids(vars(other.JOINT_TORQUE))
    if name == "pendulum":
        rows = vars(other.PENDULUM_DISTURBANCE)
        parts = [_sinusoids({key: [value[i]] for key, value in rows.items()}) for i in (0, 1)]
        return disturbances.Levels((None, *parts))
    rows = other.COUPLED_DISTURBANCE
    levels = ({key: value[i] for key, value in rows.items()} for i in range(3))
    return disturbances.Levels(tuple(_sinusoids(level) for level in levels))


@jax.jit
def commands(scenario: ij.Scenario, points: dict[str, jax.Array]) -> controllers.Command:
    """What a law commands at points of the independent program."""

    def at(point):
        state = point.get("beta", ())
        t, x, d_hat = (point[name] for name in ("t", "x", "d_hat"))
        return scenario.controller.command(t, x, d_hat, scenario.context, state)[0]

    return jax.vmap(at)(points)


def scenario(name: str, **parts) -> ij.Scenario:
    """The scenario of a case, with other parts replaced."""
    case = other.CASES[name]
    law = controllers.BarrierBackstepping(
        k=case.k,
        barriers=tuple(BARRIERS[barrier]() for barrier in case.barriers),
        c=case.c,
        weights=case.w,
        filter=case.filter,
    )
    given = {
        "plant": PLANTS[name](),
        "reference": references.Sinusoid(**vars(case.reference)),
        "bounds": bounds_of(case),
        "controller": law,
        "disturbance": _disturbance(name),
        "initial": ij.Initial(x=case.x0),
    }
    return ij.Scenario(**(given | parts))
