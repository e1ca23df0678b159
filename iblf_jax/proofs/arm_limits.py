"""Upper bounds of V_w' of a rigid arm whose limits of the torque may be active.

Plant and observer receive tau = sat(u) of the law's torque u(X).  V_w is that of u(X), as in
`arm_held`, so that it has no kink.  With D = sat(u) - u, and L = 0 because the observer receives
tau, (H.3) is

    V_w' = (rate without limits) + e2^T A D + w_f f_tilde^T A (F M0^-1 + kf K) A D            (L.1)

The last term is of the order of the errors of the parameters, and D is enclosed for it over the
box.  The one before it is not: a limit cuts the torque that reduces e2.  With c = A^T e2 and (T.2)
it is at most the largest sum of P_i over a set of joints.  Such a sum is affine in f_tilde, so that
(B.1) bounds V_w' for each set, with the best direction of f_tilde of all terms together: the
f_tilde that raises the torque beyond its limit is not the one that raises e2.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import matvec
from iblf_jax.proofs.arm_bound import (
    Constants,
    arm_errors,
    bounds_from,
    coordinates,
    corners,
    dissipation_bound,
    is_inside_guard,
    mismatch,
)
from iblf_jax.proofs.arm_held import (
    cut_differences,
    first_terms,
    mass_error,
    mismatch_slope,
    with_powers,
)
from iblf_jax.proofs.arm_torque import law_torque, power_of_cut, values_of
from iblf_jax.proofs.uncertainty import Places


def limited_bound(places: Places, n: int, x: jax.Array, constants: Constants) -> jax.Array:
    """An upper bound of V_w' over the box x, (1,) [N m rad/s]; infinite where the barrier's guard
    may be active.
    """
    limits = constants.parts.torque_limits
    assert limits is not None
    at = coordinates(x, n, places.coordinates)
    point = arm_errors(constants, at)
    e2 = point.errors.e2
    vertices = corners(mismatch(constants, places, point.errors, at.z), at.z)
    losses = dissipation_bound(constants, point)
    error = mass_error(constants, places, point.errors, at.z)
    F = mismatch_slope(constants, places, point.errors, at.z)
    torque = law_torque(constants, places, point.errors, at.z)
    commands = values_of(torque, point.b)
    first = cut_differences(constants.parts, commands)
    # e2^T A D is that of the powers.
    of_errors = first_terms(constants, jnp.zeros_like(e2), error, F, first)
    power = power_of_cut(matvec(error.ratio.T, e2), torque, commands, limits)
    none = jax.tree.map(jnp.zeros_like, power)
    bounds = [
        jnp.min(bounds_from(constants, point, losses, vertices, added))
        for added in with_powers(of_errors, none, power)
    ]
    bound = functools.reduce(jnp.maximum, bounds)
    return jnp.where(is_inside_guard(constants, point), bound, jnp.inf)[None]
