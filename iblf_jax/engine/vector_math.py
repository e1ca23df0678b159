"""sin and cos as polynomials, for XLA on CPU, whose own are scalar calls there.

Range reduction after W. J. Cody, W. Waite, Software Manual for the Elementary Functions, 1980: pi/2
in parts so short that their products with the quadrant are exact.  Coefficients: S. Moshier,
Cephes.  Errors, measured by the tests: below 2 ulp, or 1e-7 (float32) and 1e-16 (float64) absolute,
  for |x| up to LIMIT; a run whose argument is beyond it has XLA's own value.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

LIMIT = {np.dtype(np.float32): 1e5, np.dtype(np.float64): 1.6e6}
"""|x| up to which the polynomials hold."""
_PARTS = {
    np.dtype(np.float32): (
        1.5703125,
        0.0004825592041015625,
        1.2665987014770508e-06,
        9.920935184482005e-10,
    ),
    np.dtype(np.float64): (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21),
}
_SIN = {
    np.dtype(np.float32): (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1),
    np.dtype(np.float64): (
        1.58962301576546568060e-10,
        -2.50507477628578072866e-8,
        2.75573136213857245213e-6,
        -1.98412698295895385996e-4,
        8.33333333332211858878e-3,
        -1.66666666666666307295e-1,
    ),
}
_COS = {
    np.dtype(np.float32): (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2),
    np.dtype(np.float64): (
        -1.13585365213876817300e-11,
        2.08757008419747316778e-9,
        -2.75573141792967388112e-7,
        2.48015872888517045348e-5,
        -1.38888888888730564116e-3,
        4.16666666666665929218e-2,
    ),
}


def _polynomial(z, coefficients):
    total = jnp.full_like(z, coefficients[0])
    for c in coefficients[1:]:
        total = total * z + c
    return total


def _parts(x: jax.Array):
    """Sin and cos of x - k pi/2, and the quadrant k."""
    dtype = np.dtype(x.dtype)
    k = lax.round(x * (2 / np.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    r = x
    for part in _PARTS[dtype]:
        r = r - k * part
    z = r * r
    return (
        r + r * z * _polynomial(z, _SIN[dtype]),
        1.0 - 0.5 * z + z * z * _polynomial(z, _COS[dtype]),
        lax.convert_element_type(k, np.int32),
    )


def _quadrant(s, c, k):
    y = lax.select(k & 1 != 0, c, s)
    return lax.select(k & 2 != 0, -y, y)


# Traced once for every shape: a step has dozens of them.
@partial(jax.jit, static_argnames="op", inline=True)
def _near(x: jax.Array, op: str) -> jax.Array:
    s, c, k = _parts(x)
    return _quadrant(s, c, k if op == "sin" else k + 1)


XLA_OWN = {"sin": lax.sin, "cos": lax.cos}
"""XLA's own, right for every argument."""


def sines(ops: Sequence[str], xs: Sequence[jax.Array]) -> Sequence[jax.Array]:
    """op(x) for each pair, of arrays of one shape.

    One branch for all, which is seldom taken: each costs XLA's compiler more than a sine does.
    """
    near = [_near(x, op) for op, x in zip(ops, xs, strict=True)]
    is_far = [lax.abs(x) > LIMIT[np.dtype(x.dtype)] for x in xs]
    far = reduce(lax.bitwise_or, is_far)

    def beyond(xs, is_far, near):
        return [
            lax.select(far, XLA_OWN[op](x), y)
            for op, x, far, y in zip(ops, xs, is_far, near, strict=True)
        ]

    return lax.cond(
        lax.reduce_or(far, tuple(range(far.ndim))),
        beyond,
        lambda xs, is_far, near: near,
        list(xs),
        is_far,
        near,
    )
