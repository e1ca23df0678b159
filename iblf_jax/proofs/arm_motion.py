"""The rate of V_w of a rigid arm whose plant is not the model.

The law is the corrected reading of `controllers.Backstepping`, the observer is `Momentum`:

    tau = C0 alpha + G0 + M0 alpha' - f_hat - K2 e2 - w s,   f_tilde' = f' - kf f_tilde
    V_w = sum_i w_i V1_i + 1/2 e2^T M0 e2 + w_f/2 |f_tilde|^2

With (2.1) the motion does not depend on the parameters p of the plant:

    M0 e2' = -C0 e2 - K2 e2 - w s + f_tilde,   q" = alpha' + e2'                              (P.1)
    V_w' = -decay - e2^T K2 e2 + e2 . f_tilde - w_f f_tilde^T kf f_tilde + w_f f_tilde . f'   (P.2)

decay is -(w V1)' at e2 = 0.  The parameters enter through f alone.  With

    Z(p; t, q, v, a) = M a + C v + G - friction - disturbance      of the plant,
    f = M0 q" + C0 q' + G0 - Z(p) = d0 - (Z(p) - Z(p0)),

where p0 are the model's parameters and d0 is friction and disturbance at p0.  The jerk is
j = j0 + M0^-1 f', with j0 that of f' = 0, and Z is affine in a.  With W = dZ/dt along (q', q", j0)

    f' = d0' - dW - dM M0^-1 f',   dW = W(p) - W(p0),   dM = M(p) - M0                        (P.3)

f' is affine in f_tilde, because q" and j0 are.

Errors are written in the frame of the reference (`relative_tube`), so that e1' = alpha - q_d' + e2
has no difference of nearly equal numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import inner, matvec
from iblf_jax.proofs.matrices import solve
from iblf_jax.world.bounds import Bounds, Tube, tube_at
from iblf_jax.world.disturbances import Disturbance
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot
from iblf_jax.world.robots._base import friction_torque


class ArmParts(NamedTuple):
    """The parts of a scenario on which V_w' depends; a pytree."""

    model: Robot
    plant: Robot
    """With the parameters of `Uncertainty` at any value."""
    disturbance: Disturbance
    law: Any
    """`controllers.Backstepping` whose barrier has no guard."""
    kf: jax.Array
    """Gain of the observer, (n,) [1/s]."""
    reference: Reference
    bounds: Bounds


class Errors(NamedTuple):
    """Time and errors of the loop: they determine its state, but for f_tilde."""

    t: jax.Array
    """() [s]."""
    e1: jax.Array
    """q - q_d, (n,) [rad]."""
    e2: jax.Array
    """q' - alpha, (n,) [rad/s]."""


class Kinematics(NamedTuple):
    """The motion of the joints at one instant."""

    t: jax.Array
    q: jax.Array
    v: jax.Array
    a: jax.Array
    """Acceleration, (n,) [rad/s^2]."""


def relative_tube(parts: ArmParts, t: jax.Array) -> Tube:
    """The tube in the frame of the reference: q_d = 0, q_d' = 0, bounds -k_l and k_u."""
    tube = tube_at(parts.reference, parts.bounds, t, acceleration=False)
    zero = jnp.zeros_like(tube.q_d)
    lower, upper = tube.lower - tube.q_d, tube.upper - tube.q_d
    return Tube(zero, zero, lower, upper, tube.dlower - tube.dq_d, tube.dupper - tube.dq_d)


def relative_alpha(parts: ArmParts, t: jax.Array, e1: jax.Array) -> jax.Array:
    """Alpha - q_d', (n,) [rad/s]."""
    law = parts.law
    return law.barrier.virtual_velocity(relative_tube(parts, t), e1, law.k1, law.o)


def along(function: Callable, point: tuple, rates: tuple) -> Any:
    """The derivative of a function along rates of its arguments."""
    return jax.jvp(function, point, rates)[1]


def error_rate(parts: ArmParts, at: Errors) -> jax.Array:
    """e1' = alpha - q_d' + e2, (n,) [rad/s]."""
    return relative_alpha(parts, at.t, at.e1) + at.e2


def velocity(parts: ArmParts, at: Errors) -> jax.Array:
    """q', (n,) [rad/s]."""
    return reference_rate(parts, at.t) + error_rate(parts, at)


def reference_rate(parts: ArmParts, t: jax.Array) -> jax.Array:
    """q_d', (n,) [rad/s]."""
    return along(parts.reference.position, (t,), (jnp.ones_like(t),))


def position(parts: ArmParts, at: Errors) -> jax.Array:
    """q, (n,) [rad]."""
    return parts.reference.position(at.t) + at.e1


def velocity_error_rate(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> jax.Array:
    """e2' of (P.1), (n,) [rad/s^2]."""
    law, model = parts.law, parts.model
    q = position(parts, at)
    slope = law.barrier.slope(relative_tube(parts, at.t), at.e1)
    coriolis = model.coriolis(q, velocity(parts, at), at.e2)
    force = f_tilde - coriolis - law.K2 * at.e2 - law.weight * slope
    return solve(model.mass_matrix(q), force)


def acceleration(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> jax.Array:
    """q" = q_d" + (alpha - q_d')' + e2', (n,) [rad/s^2]."""
    one = jnp.ones_like(at.t)
    rates = (one, error_rate(parts, at))
    alpha_rate = along(lambda t, e1: relative_alpha(parts, t, e1), (at.t, at.e1), rates)
    reference = along(lambda t: reference_rate(parts, t), (at.t,), (one,))
    return reference + alpha_rate + velocity_error_rate(parts, at, f_tilde)


def rates_of_errors(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> Errors:
    """The rates of t, e1 and e2."""
    e2_rate = velocity_error_rate(parts, at, f_tilde)
    return Errors(jnp.ones_like(at.t), error_rate(parts, at), e2_rate)


def motion(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> tuple[Kinematics, jax.Array]:
    """The motion, and its jerk j0 for f' = 0, (n,) [rad/s^3]."""
    rates = rates_of_errors(parts, at, f_tilde)
    f_tilde_rate = -parts.kf * f_tilde
    a, jerk = jax.jvp(
        lambda at, f_tilde: acceleration(parts, at, f_tilde), (at, f_tilde), (rates, f_tilde_rate)
    )
    return Kinematics(at.t, position(parts, at), velocity(parts, at), a), jerk


def required_torque(parts: ArmParts, now: Kinematics) -> jax.Array:
    """Z = M a + C v + G - friction - disturbance of the plant, (n,) [N m]."""
    plant = parts.plant
    inertial = matvec(plant.mass_matrix(now.q), now.a) + plant.coriolis(now.q, now.v, now.v)
    return inertial + plant.gravity(now.q) - external_torque(parts, now)


def external_torque(parts: ArmParts, now: Kinematics) -> jax.Array:
    """Friction of the plant and disturbance, (n,) [N m]."""
    disturbance = parts.disturbance.torque(now.t, now.q, now.v, parts.plant, parts.model)
    return friction_torque(parts.plant, now.v) + disturbance


def rate_along_motion(
    torque: Callable, parts: ArmParts, now: Kinematics, jerk: jax.Array
) -> jax.Array:
    """The time derivative of a torque along the motion, (n,) [N m/s]."""
    rates = Kinematics(jnp.ones_like(now.t), now.v, now.a, jerk)
    return along(lambda now: torque(parts, now), (now,), (rates,))


def decay(parts: ArmParts, at: Errors) -> jax.Array:
    """-(w V1)' of each joint at e2 = 0, (n,) [N m rad/s]."""
    law = parts.law

    def value(t, e1):
        return law.weight * law.barrier.value(relative_tube(parts, t), e1)

    rates = (jnp.ones_like(at.t), relative_alpha(parts, at.t, at.e1))
    return -along(value, (at.t, at.e1), rates)


def mismatch_torque(parts: ArmParts, now: Kinematics) -> jax.Array:
    """f = M0 q" + C0 q' + G0 - Z, (n,) [N m]."""
    model = parts.model
    inertial = matvec(model.mass_matrix(now.q), now.a) + model.coriolis(now.q, now.v, now.v)
    return inertial + model.gravity(now.q) - required_torque(parts, now)


def mismatch_rate(
    parts: ArmParts, at: Errors, f_tilde: jax.Array, extra: jax.Array | float = 0.0
) -> jax.Array:
    """f' of (P.3) by exact differences, for numbers, (n,) [N m/s].

    Args:
      parts: with the true plant.
      at: time and errors.
      f_tilde: error of the observer's estimate, (n,) [N m].
      extra: rate of a further disturbance, (n,) [N m/s].
    """
    now, jerk = motion(parts, at, f_tilde)
    rate = rate_along_motion(mismatch_torque, parts, now, jerk) + extra
    M0, M = parts.model.mass_matrix(now.q), parts.plant.mass_matrix(now.q)
    # (I + dM M0^-1)^-1 = M0 M^-1
    return matvec(M0, solve(M, rate))


def level_rate(
    parts: ArmParts,
    weight: jax.Array,
    at: Errors,
    f_tilde: jax.Array,
    extra: jax.Array | float = 0.0,
) -> jax.Array:
    """V_w' of (P.2) by exact differences, for numbers, () [N m rad/s]; arguments as
    `mismatch_rate`, and w_f.
    """
    f_tilde_rate = mismatch_rate(parts, at, f_tilde, extra) - parts.kf * f_tilde
    velocity_part = inner(at.e2, f_tilde - parts.law.K2 * at.e2)
    return velocity_part - jnp.sum(decay(parts, at)) + weight * inner(f_tilde, f_tilde_rate)
