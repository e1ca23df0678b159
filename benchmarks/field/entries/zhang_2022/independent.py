"""The same loop in NumPy and SciPy, from the printed numbers, while the disturbance acts."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

START, END = 6.0, 6.9
TOLERANCE = 1e-7


def rate(t, x):
    """The derivative of (q, q')."""
    q, v, gain, w = x[:3], x[3:], np.array([0.5, 0.8, 0.2]), 2 * np.pi / 5
    c2, c3, c23 = np.cos([q[1], q[2], q[1] + q[2]])
    s2, s3, s23 = np.sin([q[1], q[2], q[1] + q[2]])
    m22, m23 = 0.4398 + 0.05618 * c3, 0.1788 + 0.02809 * c3
    m12, m13 = m22 + 0.04047 * c23 + 0.1742 * c2, m23 + 0.04047 * c23
    m11 = 1.0425 + 0.08094 * c23 + 0.3484 * c2 + 0.05618 * c3
    M = np.array([[m11, m12, m13], [m12, m22, m23], [m13, m23, 0.1788]])
    a, b, c = v
    inner, middle, outer = 0.1742 * s2, 0.04047 * s23, 0.02809 * s3
    by_outer = outer * c * (2 * a + 2 * b + c)
    N = np.array(
        [
            -inner * b * (2 * a + b) - middle * (b + c) * (2 * a + b + c) - by_outer,
            (inner + middle) * a**2 - by_outer,
            middle * a**2 + outer * (a + b) ** 2,
        ]
    )
    r = gain * (np.cos(w * t + 1) + 1)
    dr = -gain * w * np.sin(w * t + 1)
    ddr = -gain * w**2 * np.cos(w * t + 1)
    tau = M @ (ddr - 48 * (v - dr) - 1500 * (q - r)) + N
    return np.concatenate([v, np.linalg.solve(M, tau + np.array([0.15, 0.18, 0.12]) - N)])


def compare() -> float:
    """The largest difference of the positions [rad]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(run, rate, start=START, end=END, components=3)
