"""Rigid bodies in space, many at a time: rotations, inertias and the motion of a chain, in plain elementwise products.

A *pseudo-inertia* is the symmetric 4 x 4 matrix of a body's moments about the origin of a frame,

    P = [[Sigma, h], [h^T, m]],   Sigma = int r r^T dm,   h = m c,   rotational inertia J = tr(Sigma) 1 - Sigma.

It adds up over bodies, and moves to another frame as H P H^T with H = [[R, p], [0, 1]]: no parallel-axis rules.  A motion is a pair
(w, v): angular velocity, and velocity of the body's point at the origin of the world.  Products are written as sums because a call into
a matrix library costs more than the arithmetic (see `iblf_jax.linalg`), and because what is compiled as one function must hold none.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Motion(NamedTuple):
    """Velocities or accelerations of m bodies (or, alike, the directions that m joints allow)."""

    w: jax.Array
    """Angular, (m, 3)."""
    v: jax.Array
    """Of the point at the world's origin, (m, 3)."""


class Wrench(NamedTuple):
    """Momenta of m bodies, or forces on them."""

    n: jax.Array
    """About the world's origin, (m, 3)."""
    f: jax.Array
    """Linear, (m, 3)."""


class Inertia(NamedTuple):
    """Moments of m bodies in the world's frame: the blocks of their pseudo-inertias."""

    second: jax.Array
    """Sigma, (m, 3, 3) [kg m^2]."""
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


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross products along the last axis, (..., 3)."""
    return jnp.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )


def skew(a: jax.Array) -> jax.Array:
    """The matrix of a x, (..., 3, 3)."""
    zero = jnp.zeros_like(a[..., 0])
    rows = [[zero, -a[..., 2], a[..., 1]], [a[..., 2], zero, -a[..., 0]], [-a[..., 1], a[..., 0], zero]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def unit(vector: jax.Array) -> jax.Array:
    """The vector divided by its length, (..., k)."""
    return vector / jnp.sqrt(jnp.sum(vector**2, axis=-1, keepdims=True))


def rotation(quaternion: jax.Array) -> jax.Array:
    """Rotation matrices of quaternions (w, x, y, z) of any length but zero, (..., 4) -> (..., 3, 3)."""
    q = unit(quaternion)
    w, xyz = q[..., 0, None, None], q[..., 1:]
    outer = xyz[..., :, None] * xyz[..., None, :]
    square = jnp.sum(xyz**2, axis=-1)[..., None, None]
    return (w**2 - square) * jnp.eye(3, dtype=q.dtype) + 2.0 * (outer + w * skew(xyz))


def pseudo_inertia(mass: jax.Array, centre: jax.Array, inertia: jax.Array) -> jax.Array:
    """Pseudo-inertias, (..., 4, 4), from masses (...), centres (..., 3) and inertias about these, (..., 6): xx yy zz xy xz yz."""
    xx, yy, zz, xy, xz, yz = (inertia[..., i] for i in range(6))
    J = jnp.stack([jnp.stack([xx, xy, xz], -1), jnp.stack([xy, yy, yz], -1), jnp.stack([xz, yz, zz], -1)], axis=-2)
    half_trace = 0.5 * (xx + yy + zz)[..., None, None]
    first = mass[..., None] * centre
    second = half_trace * jnp.eye(3, dtype=J.dtype) - J + first[..., :, None] * centre[..., None, :]
    top = jnp.concatenate([second, first[..., None]], axis=-1)
    return jnp.concatenate([top, jnp.concatenate([first, mass[..., None]], axis=-1)[..., None, :]], axis=-2)


def placement(R: jax.Array, p: jax.Array) -> jax.Array:
    """[R, p], (..., 3, 4): the upper rows of H."""
    return jnp.concatenate([R, p[..., None]], axis=-1)


def moved(H: jax.Array, P: jax.Array) -> Inertia:
    """Pseudo-inertias P, (..., 4, 4), of bodies whose frames are at H, (..., 3, 4), seen from the world."""
    HP = product(H, P)
    return Inertia(product(HP, jnp.swapaxes(H, -1, -2)), HP[..., 3], P[..., 3, 3:])


def momentum(body: Inertia, motion: Motion) -> Wrench:
    """Inertia times motion: n = J w + h x v,  f = m v + w x h."""
    trace = body.second[..., 0, 0] + body.second[..., 1, 1] + body.second[..., 2, 2]
    turning = trace[..., None] * motion.w - apply(body.second, motion.w)
    return Wrench(turning + cross(body.first, motion.v), body.mass * motion.v + cross(motion.w, body.first))


def along(motion: Motion, other: Motion) -> Motion:
    """The rate of `other` when it is carried along by `motion`: (w x w', w x v' + v x w')."""
    return Motion(cross(motion.w, other.w), cross(motion.w, other.v) + cross(motion.v, other.w))


def along_wrench(motion: Motion, wrench: Wrench) -> Wrench:
    """The rate of a wrench that is carried along by `motion`: (w x n + v x f, w x f)."""
    return Wrench(cross(motion.w, wrench.n) + cross(motion.v, wrench.f), cross(motion.w, wrench.f))
