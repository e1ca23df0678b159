"""The same loop in NumPy and SciPy, from the printed law."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

END = 5.0
"""s, compared of the 10 s of the run."""
TOLERANCE = 1e-6


def rate(t, x):
    """The derivative of (x1, x2)."""
    x1, x2 = x
    z1, dz1 = x1 - np.sin(t), x2 - np.cos(t)
    room = 0.51**2 - z1**2
    z2 = x2 + room * 10 * z1 - np.cos(t)
    alpha_rate = 20 * dz1 * z1**2 - room * 10 * dz1 - np.sin(t)
    u = (25 * x2 + alpha_rate - 10 * z2 - z1 / room) / 133
    return [x2, -25 * x2 + 133 * u]


def compare() -> float:
    """The largest difference of the states."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(run, rate, end=END, every=50, rtol=1e-10, atol=1e-12)
