"""The same loop in NumPy and SciPy, from the printed law, with derivatives by complex steps."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

END = 3.0
TOLERANCE = 1e-6


def alpha(t, x1):
    """alpha_1, with its limit at z1 = 0."""
    z = x1 - 0.2 - 0.3 * np.sin(t)
    xi = np.pi * z / 0.12
    ratio = 0.12 / np.pi * np.cos(xi) ** 3 / np.sinc(xi / np.pi)
    return -0.1 * x1**2 - 2 * z * ratio + 0.3 * np.cos(t)


def rate(t, x):
    """The derivative of (x1, x2)."""
    x1, x2 = x
    xi = np.pi * (x1 - 0.2 - 0.3 * np.sin(t)) / 0.12
    step = 1e-30
    dx1 = 0.1 * x1**2 + x2
    alpha_rate = alpha(t + 1j * step, x1 + 1j * step * dx1).imag / step
    z2 = x2 - alpha(t, x1)
    exchange = np.sin(xi) / np.cos(xi) ** 3
    u = (0.2 * x1 - 0.1 * x1 * x2 + alpha_rate - 2 * z2 - exchange) / (1 + x1**2)
    return [dx1, 0.1 * x1 * x2 - 0.2 * x1 + (1 + x1**2) * u]


def compare() -> float:
    """The largest difference of the states."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(run, rate, end=END, every=50, rtol=1e-10, atol=1e-12)
