"""Rigid bodies in space, many at a time: rotations, inertias and the motion of a chain, in plain
elementwise products.

A *motion* is (..., 2, 3): the angular velocity w, and the velocity v of the body's point at the
origin of the world.  A *wrench* (a force, or a momentum) is (..., 2, 3) as well: its moment n about
the origin of the world, and f.

A *pseudo-inertia* is the symmetric 4 x 4 matrix of a body's moments about the origin of a frame,

    P = [[Sigma, h], [h^T, m]],   Sigma = int r r^T dm,   h = m c,
    rotational inertia J = tr(Sigma) 1 - Sigma.

It adds up over bodies, and moves to another frame as H P H^T with H = [[R, p], [0, 1]].

Products are written as sums: a call into a matrix library costs more than the arithmetic
(`core.linalg`), and a step that is compiled as one function must not contain such a call.  Few
operations on complete arrays compile faster than many on their entries.  An entry that is known to
be zero is selected or concatenated as a zero, not multiplied by zero, so that a scalar program
drops it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core.linalg import symmetric


class Inertia(NamedTuple):
    """Moments of m bodies in the world's frame."""

    rotational: jax.Array
    """J about the world's origin, (m, 3, 3) [kg m^2]."""
    first: jax.Array
    """h, (m, 3) [kg m]."""
    mass: jax.Array
    """(m, 1) [kg]."""


class Bodies(NamedTuple):
    """Bodies in the world's frame, each described about a point that moves with it.

    Point and rotational inertia of a link do not depend on masses: model and plant share them.
    """

    point: jax.Array
    """Position x of the point, (m, 3) [m]; of all bodies but the last it is the centre of mass."""
    mass: jax.Array
    """(m, 1) [kg]."""
    rotational: jax.Array
    """J about the point, (m, 3, 3) [kg m^2]."""
    offset: jax.Array
    """First moment s of the last body about its point, (3,) [kg m]."""


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
    """Row i: the composition of steps 0 to i, (n, 3, 4).

    One step after the other: a step has few numbers that are neither 0 nor 1, so that its product
    with a dense placement needs half the operations of a product of two dense ones.
    """
    placed = [steps[0]]
    for step in steps[1:]:
        placed.append(joined(placed[-1], step))
    return jnp.stack(placed)


def rotational_inertia(second: jax.Array) -> jax.Array:
    """J = tr(Sigma) 1 - Sigma, (..., 3, 3), from second moments Sigma."""
    diagonal, zero = np.eye(3, dtype=bool), jnp.zeros_like(second)
    trace = jnp.sum(jnp.where(diagonal, second, zero), axis=(-1, -2))
    return jnp.where(diagonal, trace[..., None, None], zero) - second


def with_last(rows: jax.Array, added: jax.Array) -> jax.Array:
    """The rows, (n, ...), with `added`, (...), added to the last one."""
    return jnp.concatenate([rows[:-1], rows[-1:] + added])


def inertia(bodies: Bodies) -> Inertia:
    """The moments of bodies about the world's origin."""
    x, offset = bodies.point, bodies.offset
    first = with_last(bodies.mass * x, offset)
    second = first[:, :, None] * x[:, None, :]
    second = symmetric(with_last(second, x[-1, :, None] * offset))
    return Inertia(bodies.rotational + rotational_inertia(second), first, bodies.mass)


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


def momenta(bodies: Bodies, motion: jax.Array) -> jax.Array:
    """Momenta of bodies, (m, 2, 3), each with its own motion, (m, 2, 3): about the point x, which
    moves with c = v + w x x, they are f = m c + w x s and J w + s x c.
    """
    w, v = motion[:, 0], motion[:, 1]
    velocity = v + cross(w, bodies.point)
    linear = with_last(bodies.mass * velocity, cross(w[-1], bodies.offset))
    angular = with_last(apply(bodies.rotational, w), cross(bodies.offset, velocity[-1]))
    return jnp.stack([angular + cross(bodies.point, linear), linear], axis=1)


def inertial_forces(
    bodies: Bodies, acceleration: jax.Array, motions: Sequence[tuple[jax.Array, jax.Array]]
) -> jax.Array:
    """Rates of the momenta of bodies, (m, 2, 3): about the point x, whose acceleration is
    a = v' + w' x x + w x c, they are f = m a + w' x s + w x (w x s) and J w' + w x J w + s x a.

    Args:
      bodies: m of them.
      acceleration: rates of their motions, (w', v'), (m, 2, 3).
      motions: pairs of motions, (m, 2, 3) each. The products of two motions are the means over the
        pairs: [(V, V)] for the force at the motion V, [(V, U), (U, V)] for the symmetric bilinear
        form of these forces.
    """
    x, s = bodies.point, bodies.offset
    turning, linear = acceleration[:, 0], acceleration[:, 1]

    def mean(product_of: Callable) -> jax.Array:
        values = [product_of(one[:, 0], other[:, 0], other[:, 1]) for one, other in motions]
        if len(values) == 1:
            return values[0]
        return 0.5 * (values[0] + values[1])

    a = linear + cross(turning, x) + mean(lambda w, u, v: cross(w, v + cross(u, x)))
    gyroscopic = mean(lambda w, u, v: cross(w, apply(bodies.rotational, u)))
    of_offset = mean(lambda w, u, v: cross(w[-1], cross(u[-1], s))) + cross(turning[-1], s)
    force = with_last(bodies.mass * a, of_offset)
    moment = with_last(apply(bodies.rotational, turning) + gyroscopic, cross(s, a[-1]))
    return jnp.stack([moment + cross(x, force), force], axis=1)
