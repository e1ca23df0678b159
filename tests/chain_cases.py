"""The scenarios of iblf_jax that describe the closed loops of `independent_chains`."""

import independent_chains as other
import jax
import jax.numpy as jnp
from loops_of_plants import MotorPendulum

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, disturbances, plants, references

BARRIERS = {
    other.mapping: barriers.TransformedError,
    other.quadratic: barriers.Quadratic,
    other.prescribed_performance: barriers.PrescribedPerformance,
}


def _side(side):
    kind = bounds.Sinusoid if isinstance(side, other.Sine) else bounds.Funnel
    return kind(**vars(side))


def bounds_of(case: other.Case) -> tuple:
    """The bounds of a case of the independent program in the package's terms."""
    return tuple(pair and ij.Bounds(*map(_side, pair)) for pair in case.bounds)


def _waves(coefficients, t, x):
    z = jnp.concatenate([jnp.stack([jnp.ones_like(t), t]), x.reshape(-1)])
    return jnp.sin(jnp.sum(coefficients * z, axis=-1))


def _table_drift(t, x):
    return other.DRIFT_SIZE * _waves(other.DRIFT_WAVE, t, x)


def _table_gain(t, x):
    return other.GAIN_CENTRE + other.GAIN_SIZE * _waves(other.GAIN_WAVE, t, x)


def pendulum() -> MotorPendulum:
    return MotorPendulum(D=other.D, B=other.B, N=other.N, M=other.M, H=other.H, Km=other.KM)


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


def _disturbance(name: str):
    if name == "flexible":
        return disturbances.Sinusoids(**vars(other.JOINT_TORQUE))
    is_pendulum = name == "pendulum"
    rows = vars(other.PENDULUM_DISTURBANCE) if is_pendulum else other.COUPLED_DISTURBANCE
    levels = [dict(zip(rows, numbers, strict=True)) for numbers in zip(*rows.values(), strict=True)]
    parts = [disturbances.Sinusoids(**level) for level in levels]
    return disturbances.Levels((None, *parts) if is_pendulum else tuple(parts))


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
