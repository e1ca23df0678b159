"""The rate of V_w of a rigid arm whose plant is not the model.

The law is the corrected variant of `controllers.Backstepping`, the observer is `Momentum`:

    tau = C0 alpha + G0 + M0 alpha' - f_hat - K2 e2 - w s,   f_tilde' = f' - kf f_tilde
    V_w = sum_i w_i V1_i + 1/2 e2^T M0 e2 + w_f/2 |f_tilde|^2

With (2.1) the motion does not depend on the parameters p of the plant:

    M0 e2' = -C0 e2 - K2 e2 - w s + f_tilde,   q" = alpha' + e2'                              (P.1)
    V_w' = -D - e2^T K2 e2 + e2 . f_tilde - w_f f_tilde^T kf f_tilde + w_f f_tilde . f'       (P.2)

D is the dissipation of the barriers, -(w V1)' at e2 = 0.  The parameters enter through f.  With

    Z(p; t, q, v, a) = M a + C v + G - friction - disturbance      of the plant,
    f = M0 q" + C0 q' + G0 - Z(p) = d0 - (Z(p) - Z(p0)),

where p0 are the model's parameters and d0 is friction and disturbance at p0.  The jerk is
j = j0 + M0^-1 f', with j0 that of f' = 0, and Z is affine in a.  With W = dZ/dt along (q', q", j0)

    f' = d0' - dW - dM M0^-1 f',   dW = W(p) - W(p0),   dM = M(p) - M0                        (P.3)

f' is affine in f_tilde, because q" and j0 are.

**Scaled errors.**  A barrier has no length of its own: its functions of e1 and of the tube are
homogeneous in them.  They are evaluated at xi = e1/k in a tube whose width on the side of e1 is 1
(`scaled_tube`), and

    alpha - q_d' = k A,   s = k^(d-1) S,   V1 = k^d V,   d = 2 for a V1 in rad^2 and 0 for one in 1
    e1' = k A + e2,   xi' = A - xi k'/k + e2/k

Over a box, the width k of the tube then occurs once in each of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control import controllers
from iblf_jax.core.linalg import inner, matvec
from iblf_jax.proofs.forms import along, degree, enclosed
from iblf_jax.proofs.matrices import inverse
from iblf_jax.world.bounds import Bounds, Tube
from iblf_jax.world.disturbances import Disturbance
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot
from iblf_jax.world.robots._base import friction_torque


class ArmParts(NamedTuple):
    """The parts of a scenario on which V_w' depends; a pytree."""

    model: Robot
    plant: Robot
    """The model, with the uncertain parameters at any value."""
    disturbance: Disturbance
    law: controllers.Backstepping
    """Its barrier has no guard."""
    kf: jax.Array
    """Gain of the observer, (n,) [1/s]; of a sampled one, that of a period."""
    reference: Reference
    bounds: Bounds
    guard: jax.Array
    """Guard of the law's barrier, () [1]."""
    period: jax.Array | None = None
    """Of the samples, () [s]; None for a continuous loop."""
    innovation_gain: jax.Array | None = None
    """Of a sampled observer the gain of what the model does not explain of the momentum's change
    in a period, (n,) [1/s]; None where it is kf."""
    measurement_error: jax.Array | None = None
    """Bound of the errors of the positions that samples read, (n,) [rad]; None for exact ones."""
    delay: jax.Array | None = None
    """The longest delay of a command, () [s]; None without one."""
    torque_limits: jax.Array | None = None
    """Least and greatest torque, (2, n) [N m], where a torque of the law may be beyond them; None
    where none is."""
    is_at_numbers: bool | None = None
    """True in functions of points, which need no enclosures; None in those of boxes."""


class Errors(NamedTuple):
    """Time and errors of the loop: they determine its state, but for f_tilde."""

    t: jax.Array
    """() [s]."""
    xi: jax.Array
    """e1/k, with k the width of the tube on the side of e1, (n,) [1]."""
    e2: jax.Array
    """q' - alpha, (n,) [rad/s]."""


class Kinematics(NamedTuple):
    """The motion of the joints at one instant."""

    t: jax.Array
    q: jax.Array
    v: jax.Array
    a: jax.Array
    """Acceleration, (n,) [rad/s^2]."""


class Course(NamedTuple):
    """The reference and its distances from the bounds at one time, (n,) each [rad]."""

    q_d: jax.Array
    k_l: jax.Array
    k_u: jax.Array


def course(parts: ArmParts, t: jax.Array) -> Course:
    """Reference and tube, with narrow enclosures over intervals of time, also of their
    derivatives.
    """

    def at(t: jax.Array) -> Course:
        q_d = parts.reference.position(t)
        lower, upper = parts.bounds.lower.at(t, q_d), parts.bounds.upper.at(t, q_d)
        return Course(q_d, q_d - lower, upper - q_d)

    if parts.is_at_numbers:
        # Most of the time that the program takes to compile is that of the enclosures.
        return at(t)
    return enclosed(at, smoothness(parts.reference, parts.bounds))(t)


def smoothness(reference: Reference, bounds: Bounds) -> float:
    """The number of continuous derivatives of reference and bounds in time."""
    parts = (reference, bounds.lower, bounds.upper)
    return float(min(part.continuous_derivatives for part in parts))


class Side(NamedTuple):
    """The tube on the side of an error, (n,) each."""

    k: jax.Array
    """Its width [rad]."""
    width_rate: jax.Array
    """k'/k [1/s]."""
    scaled: Tube
    """The tube in the frame of the reference, divided by k."""


def side_of(parts: ArmParts, t: jax.Array, xi: jax.Array) -> Side:
    """The tube on the sides on which errors with the sign of `xi` are."""
    now, rate = jax.jvp(lambda t: course(parts, t), (t,), (jnp.ones_like(t),))
    above = xi > 0
    k = jnp.where(above, now.k_u, now.k_l)
    dk = jnp.where(above, rate.k_u, rate.k_l)
    other_k = jnp.where(above, now.k_l, now.k_u)
    other_dk = jnp.where(above, rate.k_l, rate.k_u)
    one, zero = jnp.ones_like(k), jnp.zeros_like(k)
    # Widths and their rates of the scaled tube, on this side and on the other one.
    width_rate = dk / k
    other_width = other_k / k
    other_rate = other_dk / k
    scaled = Tube(
        q_d=zero,
        dq_d=zero,
        lower=-jnp.where(above, other_width, one),
        upper=jnp.where(above, one, other_width),
        dlower=-jnp.where(above, other_rate, width_rate),
        dupper=jnp.where(above, width_rate, other_rate),
    )
    return Side(k, width_rate, scaled)


def scaled_alpha(parts: ArmParts, t: jax.Array, xi: jax.Array) -> jax.Array:
    """A = (alpha - q_d')/k, (n,) [1/s]."""
    law = parts.law
    return law.barrier.virtual_velocity(side_of(parts, t, xi).scaled, xi, law.k1, law.o)


def relative_alpha(parts: ArmParts, t: jax.Array, xi: jax.Array) -> jax.Array:
    """The difference alpha - q_d', (n,) [rad/s]."""
    return side_of(parts, t, xi).k * scaled_alpha(parts, t, xi)


def slope(parts: ArmParts, t: jax.Array, xi: jax.Array) -> jax.Array:
    """The weighted slope w s, (n,) [N m]."""
    law, side = parts.law, side_of(parts, t, xi)
    scaled = law.weight * law.barrier.slope(side.scaled, xi)
    return scaled * side.k if degree(law.barrier) == 2 else scaled / side.k


def weighted_barrier(parts: ArmParts, t: jax.Array, xi: jax.Array) -> jax.Array:
    """The weighted barrier w V1, (n,) [N m rad]."""
    law, side = parts.law, side_of(parts, t, xi)
    return law.weight * law.barrier.value(side.scaled, xi) * side.k ** degree(law.barrier)


def error_at(parts: ArmParts, t: jax.Array, energy: jax.Array, sign: jax.Array) -> jax.Array:
    """The xi with the sign of `sign` at which w V1 = energy, (n,) [1]."""
    law, side = parts.law, side_of(parts, t, sign)
    value = energy / (law.weight * side.k ** degree(law.barrier))
    return law.barrier.error_at(value, side.scaled, sign > 0)  # type: ignore[return-value]


def xi_rate(parts: ArmParts, at: Errors) -> jax.Array:
    """The rate xi' = A - xi k'/k + e2/k, (n,) [1/s]."""
    side = side_of(parts, at.t, at.xi)
    return scaled_alpha(parts, at.t, at.xi) - side.width_rate * at.xi + at.e2 / side.k


def velocity(parts: ArmParts, at: Errors) -> jax.Array:
    """q', (n,) [rad/s]."""
    return reference_rate(parts, at.t) + (relative_alpha(parts, at.t, at.xi) + at.e2)


def reference(parts: ArmParts, t: jax.Array) -> jax.Array:
    """q_d, (n,) [rad]."""
    return course(parts, t).q_d


def reference_rate(parts: ArmParts, t: jax.Array) -> jax.Array:
    """q_d', (n,) [rad/s]."""
    return along(lambda t: reference(parts, t), (t,), (jnp.ones_like(t),))


def position(parts: ArmParts, at: Errors) -> jax.Array:
    """q, (n,) [rad]."""
    return reference(parts, at.t) + side_of(parts, at.t, at.xi).k * at.xi


def coupling_force(parts: ArmParts, at: Errors) -> jax.Array:
    """-C0 e2 - w s, (n,) [N m]."""
    q, v = position(parts, at), velocity(parts, at)
    return -parts.model.coriolis(q, v, at.e2) - slope(parts, at.t, at.xi)


def error_force(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> jax.Array:
    """M0 e2' of (P.1), (n,) [N m]."""
    return f_tilde + coupling_force(parts, at) - parts.law.K2 * at.e2


def inverse_mass(parts: ArmParts, at: Errors) -> jax.Array:
    """M0^-1, (n, n)."""
    return inverse(parts.model.mass_matrix(position(parts, at)))


def velocity_error_rate(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> jax.Array:
    """e2' of (P.1), (n,) [rad/s^2]."""
    return matvec(inverse_mass(parts, at), error_force(parts, at, f_tilde))


def relative_alpha_rate(parts: ArmParts, at: Errors) -> jax.Array:
    """(alpha - q_d')', (n,) [rad/s^2]."""
    rates = (jnp.ones_like(at.t), xi_rate(parts, at))
    return along(lambda t, xi: relative_alpha(parts, t, xi), (at.t, at.xi), rates)


def alpha_rate(parts: ArmParts, at: Errors) -> jax.Array:
    """alpha', (n,) [rad/s^2]."""
    second = along(lambda t: reference_rate(parts, t), (at.t,), (jnp.ones_like(at.t),))
    return second + relative_alpha_rate(parts, at)


def rates_of_errors(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> Errors:
    """The rates of t, xi and e2."""
    e2_rate = velocity_error_rate(parts, at, f_tilde)
    return Errors(jnp.ones_like(at.t), xi_rate(parts, at), e2_rate)


def kinematics(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> Kinematics:
    """The motion under the law's torque."""
    a = alpha_rate(parts, at) + velocity_error_rate(parts, at, f_tilde)
    return Kinematics(at.t, position(parts, at), velocity(parts, at), a)


class Motion(NamedTuple):
    """The motion of the joints, and its jerk j0 for f' = 0 in parts:

    j0 = alpha" + M0^-1 (slow - K2 M0^-1 force)
    """

    now: Kinematics
    alpha_jerk: jax.Array
    """alpha", (n,) [rad/s^3]."""
    slow: jax.Array
    """(-C0 e2 - w s)' - M0' e2' - kf f_tilde, (n,) [N m/s]."""
    force: jax.Array
    """M0 e2', (n,) [N m]."""


def motion(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> Motion:
    """The motion at time and errors."""
    rates = rates_of_errors(parts, at, f_tilde)
    first, second = jax.jvp(lambda at: alpha_rate(parts, at), (at,), (rates,))
    now = Kinematics(at.t, position(parts, at), velocity(parts, at), first + rates.e2)
    coupling = along(lambda at: coupling_force(parts, at), (at,), (rates,))
    mass_rate = along(parts.model.mass_matrix, (now.q,), (now.v,))
    slow = coupling - matvec(mass_rate, rates.e2) - parts.kf * f_tilde
    return Motion(now, second, slow, error_force(parts, at, f_tilde))


def jerk(parts: ArmParts, at: Errors, moved: Motion) -> jax.Array:
    """j0, (n,) [rad/s^3]."""
    M0_inverse = inverse_mass(parts, at)
    rest = moved.slow - parts.law.K2 * matvec(M0_inverse, moved.force)
    return moved.alpha_jerk + matvec(M0_inverse, rest)


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


def dissipation(parts: ArmParts, at: Errors) -> jax.Array:
    """-(w V1)' of each joint at e2 = 0, (n,) [N m rad/s]."""
    rates = (jnp.ones_like(at.t), xi_rate(parts, at._replace(e2=jnp.zeros_like(at.e2))))
    return -along(lambda t, xi: weighted_barrier(parts, t, xi), (at.t, at.xi), rates)


def mismatch_torque(parts: ArmParts, now: Kinematics) -> jax.Array:
    """The uncertain torque f = M0 q" + C0 q' + G0 - Z, (n,) [N m]."""
    model = parts.model
    inertial = matvec(model.mass_matrix(now.q), now.a) + model.coriolis(now.q, now.v, now.v)
    return inertial + model.gravity(now.q) - required_torque(parts, now)


def mismatch_rate(
    parts: ArmParts, at: Errors, f_tilde: jax.Array, extra: jax.Array | float = 0.0
) -> jax.Array:
    """The rate f' of (P.3) by exact differences, for numbers, (n,) [N m/s].

    Args:
      parts: with the true plant.
      at: time and errors.
      f_tilde: error of the observer's estimate, (n,) [N m].
      extra: rate of a further disturbance, (n,) [N m/s].
    """
    moved = motion(parts, at, f_tilde)
    now = moved.now
    rate = rate_along_motion(mismatch_torque, parts, now, jerk(parts, at, moved)) + extra
    M0, M = parts.model.mass_matrix(now.q), parts.plant.mass_matrix(now.q)
    # (I + dM M0^-1)^-1 = M0 M^-1
    return matvec(M0, matvec(inverse(M), rate))


def lyapunov_rate(
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
    return velocity_part - jnp.sum(dissipation(parts, at)) + weight * inner(f_tilde, f_tilde_rate)
