"""Functions with a removable singularity at zero, finite there with all their derivatives.

Each is a closed form away from zero and a series near it, chosen by a double `where`, so that
neither branch ever divides by zero: values and derivatives of every order are finite and accurate
  to rounding, in float32 and float64, forward and reverse.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def sinc(u: jax.Array) -> jax.Array:
    """sin(u) / u, 1 at u = 0."""
    small = jnp.abs(u) < 0.03
    near, far = jnp.where(small, u, 0.0), jnp.where(small, 1.0, u)
    square = near**2
    series = 1.0 - square / 6.0 * (
        1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))
    )
    return jnp.where(small, series, jnp.sin(far) / far)


def log_remainder(u: jax.Array) -> jax.Array:
    """h(u) = (-ln(1 - u) - u) / u^2 for u < 1; 1/2 at u = 0.

    Near zero through -ln(1 - u) = 2 artanh(v), v = u / (2 - u), whose series converges fast:
    h = 1/(2 - u) + 2 u / (2 - u)^3 (1/3 + v^2/5 + v^4/7 + ...), without cancellation.
    """
    small = jnp.abs(u) < 0.25
    near, far = jnp.where(small, u, 0.0), jnp.where(small, -1.0, u)
    rest = 2.0 - near
    square = (near / rest) ** 2
    tail = jnp.full_like(u, 1.0 / 21.0)
    for odd in range(19, 1, -2):
        tail = tail * square + 1.0 / odd
    return jnp.where(
        small, 1.0 / rest + 2.0 * near / rest**3 * tail, (-jnp.log1p(-far) - far) / far**2
    )
