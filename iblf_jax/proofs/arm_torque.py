"""Bounds of the torque of the law over boxes of the set {V_w <= c} of a rigid arm.

The torque is the one that the true plant needs for the motion, Z of `arm_motion`, of which the
acceleration a is affine in f_tilde.  With (U.1), the sizes z_k - r_k and b = |f_tilde|,

    tau = tau0 + sum_k (z_k - r_k) Z_k(p*) + (I + sum_k (z_k - r_k) M_k(p*) M0^-1) f_tilde    (T.1)
    tau0 = M0 alpha' + C0 alpha + G0 - K2 e2 - w s - d0

where Z_k and M_k are derivatives along coordinate k at f_tilde = 0, and d0 is friction and
disturbance at the model's parameters.  The best direction of f_tilde adds b times the length of a
row of the matrix.

**Limits.**  A torque tau = sat(u) of the law's torque u adds c . D to V_w' (`arm_limits`), with D =
sat(u) - u and a vector c.  Where u_i is above its limit, D_i < 0 adds to it for c_i < 0 alone, and
the reverse below the limit, so that

    c_i D_i <= max(0, P_i),
    P_i = max(-c_i, 0) (u_i - highest_i) + max(c_i, 0) (lowest_i - u_i)                       (T.2)

is an equality where it is positive.  P_i is affine in f_tilde.

**Coordinates.**  Those of `arm_bound` on V_w = c share^2, with a further one, share in [0, 1],
behind the parameters: they cover the whole set, not its boundary alone.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import matmul, matvec
from iblf_jax.kernels import hull, lower, upper
from iblf_jax.proofs.arm_bound import (
    Affine,
    Constants,
    arm_errors,
    coordinates,
    differences,
    is_inside_guard,
    mass_along,
    with_plant,
)
from iblf_jax.proofs.arm_motion import (
    Errors,
    alpha_rate,
    external_torque,
    inverse_mass,
    kinematics,
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
    torque = law_torque(constants, places, point.errors, at.z)
    middle, reach = torque.value, point.b * row_lengths(torque.slope)
    above = middle + reach - highest
    below = lowest - (middle - reach)
    excess = jnp.max(jnp.maximum(above, below) / (highest - lowest))
    inside = is_inside_guard(constants, point)
    return jnp.where(inside, excess, jnp.inf)[None]


def law_torque(constants: Constants, places: Places, at: Errors, z: jax.Array) -> Affine:
    """The torque (T.1) as a function of f_tilde [N m]."""
    parts = constants.parts
    n = at.xi.shape[-1]
    now = kinematics(parts, at, jnp.zeros(n))
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
    return Affine(torque, factor)


def row_lengths(matrix: jax.Array) -> jax.Array:
    """The length of each row of an (n, n) matrix, (n,)."""
    return jnp.stack([norm(matrix[i]) for i in range(len(matrix))])


def values_of(torque: Affine, b: jax.Array) -> jax.Array:
    """The torque for all f_tilde of the length b, (n,) [N m]."""
    reach = b * row_lengths(torque.slope)
    return torque.value + hull(reach, -reach)


def cut(torque: jax.Array, limits: jax.Array) -> jax.Array:
    """D = sat(u) - u, (n,) [N m].

    Args:
      torque: u, (n,) [N m].
      limits: least and greatest torque, (2, n) [N m].
    """
    lowest, highest = limits
    return jnp.minimum(highest - torque, 0.0) + jnp.maximum(lowest - torque, 0.0)


def power_of_cut(c: jax.Array, torque: Affine, values: jax.Array, limits: jax.Array) -> Affine:
    """P of (T.2) as a function of f_tilde, (n,) [N m rad/s].

    Args:
      c: (n,) [rad/s].
      torque: u as a function of f_tilde.
      values: the commands that are cut, (n,) [N m]; where none is beyond a limit, P is 0.
      limits: least and greatest torque, (2, n) [N m].
    """
    lowest, highest = limits
    above = jnp.where(upper(values) <= highest, 0.0, jnp.maximum(-c, 0.0))
    below = jnp.where(lower(values) >= lowest, 0.0, jnp.maximum(c, 0.0))
    value = above * (torque.value - highest) + below * (lowest - torque.value)
    return Affine(value, (above - below)[:, None] * torque.slope)
