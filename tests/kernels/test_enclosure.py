"""Enclosures over boxes contain the exact values, which mpmath computes with 60 digits."""

from __future__ import annotations

import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from iblf_jax.kernels import enclosure
from iblf_jax.kernels.enclosure import enclose

mpmath.mp.dps = 60

UNARY = {
    "neg": (lambda x: -x, lambda x: -x, -math.inf),
    "abs": (jnp.abs, abs, -math.inf),
    "square": (lambda x: x * x, lambda x: x * x, -math.inf),
    "cube": (lambda x: x**3, lambda x: x**3, -math.inf),
    "fourth": (lambda x: x**4, lambda x: x**4, -math.inf),
    "sqrt": (jnp.sqrt, mpmath.sqrt, 0.0),
    "rsqrt": (jax.lax.rsqrt, lambda x: 1 / mpmath.sqrt(x), 0.0),
    "sin": (jnp.sin, mpmath.sin, -math.inf),
    "cos": (jnp.cos, mpmath.cos, -math.inf),
    "tan": (jnp.tan, mpmath.tan, -math.inf),
    "exp": (jnp.exp, mpmath.exp, -math.inf),
    "expm1": (jnp.expm1, mpmath.expm1, -math.inf),
    "log": (jnp.log, mpmath.log, 0.0),
    "log1p": (jnp.log1p, mpmath.log1p, -1.0),
    "atan": (jnp.arctan, mpmath.atan, -math.inf),
    "sinh": (jnp.sinh, mpmath.sinh, -math.inf),
    "cosh": (jnp.cosh, mpmath.cosh, -math.inf),
    "tanh": (jnp.tanh, mpmath.tanh, -math.inf),
    "logistic": (jax.nn.sigmoid, lambda x: 1 / (1 + mpmath.exp(-x)), -math.inf),
    "power": (lambda x: x**1.7, lambda x: x ** mpmath.mpf(1.7), 0.0),
    "negative power": (lambda x: x**-2.5, lambda x: x ** mpmath.mpf(-2.5), 0.0),
    "reciprocal": (lambda x: 1 / x, lambda x: 1 / x, -math.inf),
}
"""Operation -> JAX function, exact function, infimum of its domain."""


def intervals(rng, lowest: float, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Intervals of all sizes and positions above a bound, some of them points."""
    size = 10.0 ** rng.uniform(-12, 2.5, number)
    centre = rng.choice([-1, 1], number) * 10.0 ** rng.uniform(-12, 2.5, number)
    if lowest > -math.inf:
        centre = lowest + np.abs(centre) + size
    size[:: 7] = 0
    special = np.array([0.0, -0.0, 1.0, np.pi, np.pi / 2, 3 * np.pi / 2, 1e5, 2.0**-1022, 1e-320])
    special = special[special > lowest]
    centre[: len(special)] = special
    size[: len(special)] = 0
    low = centre - size
    return np.maximum(low, np.nextafter(lowest, math.inf)), centre + size


def points(rng, low: float, high: float) -> list[float]:
    """Ends and inner points of an interval."""
    inner = low + rng.uniform(size=4) * (high - low)
    return [low, high, *np.clip(inner, low, high).tolist()]


def contains(lower: float, upper: float, value) -> bool:
    """Whether bounds contain an exact value; NaN is no bound."""
    return not (lower > value) and not (upper < value)


@pytest.mark.parametrize("name", UNARY)
def test_functions_contain_exact_values(name):
    function, exact, lowest = UNARY[name]
    rng = np.random.default_rng(len(name))
    low, high = intervals(rng, lowest, 400)
    lower, upper = enclose(lambda x, c: function(x[0]), low[:, None], high[:, None])
    for a, b, least, most in zip(low, high, lower[0], upper[0], strict=True):
        for x in points(rng, a, b):
            try:
                value = exact(mpmath.mpf(x))
            except ZeroDivisionError:
                continue
            assert contains(least, most, value), (name, a, b, x, least, most)
