"""The same loop in NumPy and SciPy, from the corrected law."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

TOLERANCE = 1e-6


def rate(t, x):
    """The derivative of the speed and of the acceleration."""
    r = x[1] + 8 * (x[0] - 0.1)
    psi = 2 * np.pi * np.exp(-7 * t) + 0.8
    u = -36 / np.pi * np.arctan(np.pi / 36 * np.tan(np.pi * r / (2 * psi)))
    return [x[1], -102 * x[0] - 20.1 * x[1] + 100 * u]


def compare() -> float:
    """The largest difference of the states."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(run, rate, every=20, rtol=1e-11, atol=1e-13)
