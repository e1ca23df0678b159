"""The same loops in NumPy and SciPy, from the printed law, with derivatives by complex steps."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

TOLERANCE = 1e-6


def barrier(z, y, k):
    """The published rho at z != 0."""
    return k / (2 * z) * np.log((k + z + y) * (k - y) / ((k - z - y) * (k + y)))


def alpha(t, x1):
    """alpha_1."""
    y, dy = 0.2 * np.sin(2.5 * t), 0.5 * np.cos(2.5 * t)
    z = x1 - y
    return -0.1 * x1**2 - 5 * z + dy * (1 - x1**2) * barrier(z, y, 1.0)


def motion(t, x1, x2, rate):
    """The derivative of (x1, x2) under the published input, with what takes the place of
    alpha_1'.
    """
    first, z1 = alpha(t, x1), x1 - 0.2 * np.sin(2.5 * t)
    z2, room = x2 - first, 2.5**2 - x2**2
    moved = rate * barrier(z2, first, 2.5) * room / 2.5**2
    exchange = room * z1 / ((1 - x1**2) * 2.5**2)
    u = (0.2 * x1 - 0.1 * x1 * x2 - 5 * z2 + moved - exchange) / (1 + x1**2)
    return [0.1 * x1**2 + x2, 0.1 * x1 * x2 - 0.2 * x1 + (1 + x1**2) * u]


def with_exact_derivatives(t, x):
    """The derivative of (x1, x2)."""
    x1, x2 = x
    step = 1e-30
    rate = alpha(t + 1j * step, x1 + 1j * step * (0.1 * x1**2 + x2)).imag / step
    return motion(t, x1, x2, rate)


def with_filter(t, x):
    """The derivative of (x1, x2, beta)."""
    x1, x2, beta = x
    rate = (alpha(t, x1) - beta) / 0.02
    return [*motion(t, x1, x2, rate), rate]


LOOPS = {
    "exact derivatives": (with_exact_derivatives, [0.5, 2.0], 1.5),
    "filter of the model": (with_filter, [0.5, 2.0, 0.0], 0.9),
}
"""Run -> derivative, start, and end: the published rho divides by z, which passes 0."""


def compare() -> float:
    """The largest difference of the states, of both laws."""
    runs = execute(Path(__file__).parent).runs
    tolerances = {"rtol": 1e-10, "atol": 1e-12}
    return max(
        largest_difference(runs[name], rate, x0=x0, end=end, every=50, **tolerances)
        for name, (rate, x0, end) in LOOPS.items()
    )
