"""The same loop in NumPy and SciPy, from the printed law."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

TOLERANCE = 1e-6


def rate(t, x):
    """The derivative of (x1, x2)."""
    xi = (6 * x[0] + x[1]) / (9.99 * np.exp(-0.5 * t) + 0.01)
    u = -5 * np.log((1 + xi) / (1 - xi))
    return [x[1], -2 * (x[0] ** 2 - 1) * x[1] - x[0] + 1 + (2 + np.sin(x[0] * x[1])) * u]


def compare() -> float:
    """The largest difference of the states."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(run, rate, every=100, method="LSODA", rtol=1e-11, atol=1e-13)
