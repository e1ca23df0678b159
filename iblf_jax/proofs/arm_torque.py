"""Bounds of the torque of the law over boxes of the set {V_w <= c} of a rigid arm.

The torque is the one that the true plant needs for the motion, Z of `arm_motion`, of which the
acceleration a is affine in f_tilde.  With (U.1), the sizes z_k - r_k and b = |f_tilde|,

    tau = tau0 + sum_k (z_k - r_k) Z_k(p*) + (I + sum_k (z_k - r_k) M_k(p*) M0^-1) f_tilde    (T.1)
    tau0 = M0 alpha' + C0 alpha + G0 - K2 e2 - w s - d0

where Z_k and M_k are derivatives along coordinate k at f_tilde = 0, and d0 is friction and
disturbance at the model's parameters.  The best direction of f_tilde adds b times the length of a
row of the matrix.

**Coordinates.**  Those of `arm_bound` on V_w = c share^2, with a further one, share in [0, 1],
behind the parameters: they cover the whole set, not its boundary alone.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import matmul, matvec
from iblf_jax.proofs.arm_bound import (
    ArmErrors,
    Constants,
    arm_errors,
    coordinates,
    differences,
    is_inside_guard,
    mass_along,
    with_plant,
)
from iblf_jax.proofs.arm_motion import (
    alpha_rate,
    external_torque,
    inverse_mass,
    motion,
    reference_rate,
    relative_alpha,
    required_torque,
    slope,
)
from iblf_jax.proofs.forms import along
from iblf_jax.proofs.matrices import norm
from iblf_jax.proofs.uncertainty import Places


def torque_excess(
    places: Places,
    x: jax.Array,
    constants: Constants,
    lowest: jax.Array,
    highest: jax.Array,
) -> jax.Array:
    """Upper bounds of the distance by which the torque is outside an interval, over the box x, in
    parts of the interval's width, (1,) [1]; negative where every joint's torque is inside.

    Args:
      places: of the uncertain parameters.
      x: coordinates; see the head of this module.
      constants: of the problem.
      lowest, highest: ends of the interval of each joint, (n,) [N m].
    """
    n = lowest.shape[0]
    m = places.coordinates
    share = x[2 * n + 1 + m]
    at = coordinates(jnp.concatenate([x[: 2 * n + 1 + m], x[2 * n + 2 + m :]]), n, m)
    point = arm_errors(constants._replace(level=constants.level * share**2), at)
    middle, reach = _torque(constants, places, point, at.z)
    above = middle + reach - highest
    below = lowest - (middle - reach)
    excess = jnp.max(jnp.maximum(above, below) / (highest - lowest))
    inside = is_inside_guard(constants, point)
    return jnp.where(inside, excess, jnp.inf)[None]


def _torque(
    constants: Constants, places: Places, point: ArmErrors, z: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The torque at f_tilde = 0, and how far f_tilde moves it, (n,) each [N m]."""
    parts, at = constants.parts, point.errors
    n = at.xi.shape[-1]
    now = motion(parts, at, jnp.zeros(n)).now
    change = differences(constants, places, z)
    model = parts.model
    alpha = reference_rate(parts, at.t) + relative_alpha(parts, at.t, at.xi)
    inertial = matvec(model.mass_matrix(now.q), alpha_rate(parts, at))
    inertial = inertial + model.coriolis(now.q, now.v, alpha) + model.gravity(now.q)
    feedback = parts.law.K2 * at.e2 + slope(parts, at.t, at.xi)
    of_model = with_plant(parts, (model, parts.disturbance))
    torque = inertial - feedback - external_torque(of_model, now)
    M0_inverse = inverse_mass(parts, at)
    factor = jnp.eye(n)
    for size, direction in zip(change.sizes, change.directions, strict=True):
        column = along(
            lambda p: required_torque(with_plant(parts, p), now), (change.inside,), (direction,)
        )
        torque = torque + size * column
        factor = factor + size * matmul(mass_along(change.inside, direction, now.q), M0_inverse)
    return torque, point.b * jnp.stack([norm(factor[i]) for i in range(n)])
