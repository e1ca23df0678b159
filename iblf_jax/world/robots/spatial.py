"""Rigid bodies in space, many at a time: rotations, inertias and the motion of a chain, in plain
elementwise products.

A *motion* is (..., 2, 3): the angular velocity w, and the velocity v of the body's point at the
origin of the world.  A *wrench* (a force, or a momentum) is (..., 2, 3) as well: its moment n about
the origin of the world, and f.

A *pseudo-inertia* is the symmetric 4 x 4 matrix of a body's moments about the origin of a frame,

    P = [[Sigma, h], [h^T, m]],   Sigma = int r r^T dm,   h = m c,
    rotational inertia J = tr(Sigma) 1 - Sigma.

It adds up over bodies, and moves to another frame as H P H^T with H = [[R, p], [0, 1]]: no
parallel-axis rules.

Products are written as sums: a call into a matrix library costs more than the arithmetic
(`core.linalg`), and a step that is compiled as one function must not contain such a call.  Few
operations on complete arrays compile faster than many on their entries.  An entry that is known to
be zero is selected or concatenated as a zero, not multiplied by zero, so that a scalar program
drops it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Inertia(NamedTuple):
    """Moments of m bodies in the world's frame."""

    rotational: jax.Array
    """J about the world's origin, (m, 3, 3) [kg m^2]."""
    first: jax.Array
    """h, (m, 3) [kg m]."""
    mass: jax.Array
    """(m, 1) [kg]."""


def apply(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Matrices times vectors, (..., m, n) and (..., n) -> (..., m)."""
    return jnp.sum(matrix * vector[..., None, :], axis=-1)


def product(left: jax.Array, right: jax.Array) -> jax.Array:
    """Matrices times matrices, (..., m, k) and (..., k, n) -> (..., m, n)."""
    return jnp.sum(left[..., :, :, None] * right[..., None, :, :], axis=-2)


def _next(a: jax.Array) -> jax.Array:
    return jnp.concatenate([a[..., 1:], a[..., :1]], axis=-1)


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross products along the last axis, (..., 3)."""
    return _next(a * _next(b) - _next(a) * b)


def unit(vector: jax.Array) -> jax.Array:
    """The vector divided by its length, (..., k)."""
    return vector / jnp.sqrt(jnp.sum(vector**2, axis=-1, keepdims=True))


def rotation(quaternion: jax.Array) -> jax.Array:
    """Rotation matrices of quaternions (w, x, y, z) of any length but zero, (..., 4) -> (..., 3,
    3).
    """
    q = unit(quaternion)
    w, v, one = q[..., :1, None], q[..., 1:], jnp.eye(3, dtype=q.dtype)
    # Square by square, so that equal ones cancel: a right angle has zeros on the diagonal.
    signs = np.array([[1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]], q.dtype)
    diagonal = jnp.sum(signs * (q**2)[..., None, :], axis=-1)
    above = 2.0 * (v[..., :, None] * v[..., None, :] + w * cross(one, v[..., None, :]))
    return jnp.where(np.eye(3, dtype=bool), diagonal[..., None], above)


def pseudo_inertia(mass: jax.Array, centre: jax.Array, inertia: jax.Array) -> jax.Array:
    """Pseudo-inertias, (..., 4, 4), from masses (...), centres (..., 3) and inertias about these,
    (..., 6): xx yy zz xy xz yz.
    """
    full = inertia[..., np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])]
    half_trace = 0.5 * jnp.sum(inertia[..., :3], axis=-1)[..., None, None]
    first = mass[..., None] * centre
    second = (
        half_trace * jnp.eye(3, dtype=full.dtype)
        - full
        + first[..., :, None] * centre[..., None, :]
    )
    below = jnp.concatenate([first, mass[..., None]], axis=-1)
    return jnp.concatenate(
        [jnp.concatenate([second, first[..., None]], axis=-1), below[..., None, :]], axis=-2
    )


def placement(R: jax.Array, p: jax.Array) -> jax.Array:
    """[R, p], (..., 3, 4): the upper rows of H."""
    return jnp.concatenate([R, p[..., None]], axis=-1)


def joined(outer: jax.Array, inner: jax.Array) -> jax.Array:
    """Composition of placements, (..., 3, 4): `inner` is given in the frame placed by `outer`."""
    return product(outer[..., :3], inner) + placement(jnp.zeros_like(outer[..., :3]), outer[..., 3])


def chained(steps: jax.Array) -> jax.Array:
    """Row i: the composition of steps 0 to i, (n, 3, 4), by a parallel scan of log2 n rounds."""
    reach = 1
    while reach < steps.shape[0]:
        steps = jnp.concatenate([steps[:reach], joined(steps[:-reach], steps[reach:])])
        reach *= 2
    return steps


def moved(H: jax.Array, P: jax.Array) -> jax.Array:
    """Upper rows of the pseudo-inertia H P H^T, (..., 3, 4), of bodies whose frames are at H, (...,
    3, 4).
    """
    HP = product(H, P)
    return placement(product(HP, jnp.swapaxes(H, -1, -2)), HP[..., 3])


def inertia(upper: jax.Array, mass: jax.Array) -> Inertia:
    """Spatial inertias from the upper rows of pseudo-inertias, (m, 3, 4), and masses, (m, 1)."""
    second, diagonal = upper[..., :3], np.eye(3, dtype=bool)
    trace = jnp.sum(jnp.where(diagonal, second, jnp.zeros_like(second)), axis=(-1, -2))
    return Inertia(
        jnp.where(diagonal, trace[..., None, None], jnp.zeros_like(second)) - second,
        upper[..., 3],
        mass,
    )


def momentum(body: Inertia, motion: jax.Array) -> jax.Array:
    """Inertia times motion, (..., m, 2, 3): n = J w + h x v,  f = m v - h x w."""
    w, v = motion[..., 0, :], motion[..., 1, :]
    straight = jnp.stack([apply(body.rotational, w), body.mass * v], axis=-2)
    return straight + cross(body.first[..., None, :], jnp.stack([v, -w], axis=-2))


def motion_cross(motion: jax.Array, other: jax.Array) -> jax.Array:
    """Cross product of two motions, (w x w', w x v' + v x w'): the rate of `other` when it moves
    with `motion`.
    """
    lever = cross(motion[..., 1:, :], other[..., :1, :])
    return cross(motion[..., :1, :], other) + jnp.concatenate(
        [jnp.zeros_like(lever), lever], axis=-2
    )


def wrench_cross(motion: jax.Array, wrench: jax.Array) -> jax.Array:
    """Cross product of a motion and a wrench, (w x n + v x f, w x f): the rate of a wrench that
    moves with `motion`.
    """
    lever = cross(motion[..., 1:, :], wrench[..., 1:, :])
    return cross(motion[..., :1, :], wrench) + jnp.concatenate(
        [lever, jnp.zeros_like(lever)], axis=-2
    )
