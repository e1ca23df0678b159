"""JAX primitives that say how an interval is evaluated; on numbers, each is the identity.

A function that is enclosed over boxes (`enclosure`) may use them where the natural extension to
intervals is too wide. Derivatives and batches pass through them to the first argument.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.kernels.primitives import new_primitive, with_axis_first


def _primitive(name: str) -> Any:
    """An elementwise primitive whose value is its first argument."""

    def first(x, *others):
        return x

    def jvp(primals, tangents):
        return primitive.bind(*primals), tangents[0]

    def batch(arguments, axes):
        return primitive.bind(*with_axis_first(arguments, axes)), 0

    primitive = new_primitive(name, first, shapes=first, jvp=jvp, batch=batch)
    return primitive


_UPPER = _primitive("upper")
_LOWER = _primitive("lower")
_HULL = _primitive("hull")
_WITH_SIGN = _primitive("with_sign")
_MEET = _primitive("meet")


def _of_one_shape(*arrays: jax.Array | float) -> list[jax.Array]:
    """The arrays with one shape and one floating-point type."""
    dtype = jnp.result_type(float, *arrays)
    return list(jnp.broadcast_arrays(*(jnp.asarray(x, dtype) for x in arrays)))


def upper(x: jax.Array | float) -> jax.Array:
    """x; on intervals [a, b] -> [b, b]."""
    return _UPPER.bind(*_of_one_shape(x))


def lower(x: jax.Array | float) -> jax.Array:
    """x; on intervals [a, b] -> [a, a]."""
    return _LOWER.bind(*_of_one_shape(x))


def hull(x: jax.Array | float, y: jax.Array | float) -> jax.Array:
    """x; on intervals the smallest interval that contains x and y."""
    return _HULL.bind(*_of_one_shape(x, y))


def meet(x: jax.Array | float, y: jax.Array | float) -> jax.Array:
    """x; on intervals the numbers that x and y have in common, of two enclosures of one number."""
    return _MEET.bind(*_of_one_shape(x, y))


def with_sign(x: jax.Array | float, sign: jax.Array | float) -> jax.Array:
    """x; on intervals, comparisons of the result with the literal 0 are decided by `sign`.

    An interval that touches 0 would otherwise select both cases of `jnp.where(x > 0, ...)`. The
    caller states that the side x >= 0 (`sign` 1) or x <= 0 (`sign` -1) is evaluated, with the value
    at x = 0 by continuity.

    Args:
      x: a number.
      sign: 1 or -1.
    """
    return _WITH_SIGN.bind(*_of_one_shape(x, sign))
