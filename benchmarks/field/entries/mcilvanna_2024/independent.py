"""The same loop in NumPy and SciPy, from the printed logarithmic law."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

TOLERANCE = 1e-6


def rate(t, x):
    """The derivative of (x1, x2)."""
    x1, x2 = x
    w = 0.4 * np.pi
    dx_d, ddx_d = 1 + w * np.cos(w * t), -(w**2) * np.sin(w * t)
    z1, g1 = x1 - t - np.sin(w * t) - 0.1, 5 * np.cos(x1) + 2 * x1
    dx1 = 2 + g1 * x2
    room = 0.105**2 - z1**2
    top = -2 - 10 * room * z1 + dx_d
    top_rate = -10 * (room - 2 * z1**2) * (dx1 - dx_d) + ddx_d
    alpha_rate = (top_rate - top / g1 * (2 - 5 * np.sin(x1)) * dx1) / g1
    return [dx1, alpha_rate - 10 * (x2 - top / g1) - g1 * z1 / room]


def compare() -> float:
    """The largest difference of the states."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    # The loop is stiff: explicit methods need a thousand times as many evaluations.
    return largest_difference(run, rate, every=50, method="LSODA", rtol=1e-11, atol=1e-13)
