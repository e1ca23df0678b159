"""The same loop in NumPy and SciPy, from the printed numbers."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

END = 2.9
"""s; the disturbance jumps at 3 s."""
TOLERANCE = 1e-7


def rate(t, x):
    """The derivative of (q, q')."""
    q, v = x[:2], x[2:]
    b, s = 2.0 * 0.5 * 0.2 * np.cos(q[1]), 2.0 * 0.5 * 0.2 * np.sin(q[1])
    a2 = 0.81 + 2.0 * 0.2**2
    M = np.array([[0.96 + 3.2 * 0.25**2 + 2.0 * 0.5**2 + a2 + 2 * b, a2 + b], [a2 + b, a2]])
    outer = 2.0 * 0.2 * 9.81 * np.cos(q[0] + q[1])
    G = np.array([(3.2 * 0.25 + 2.0 * 0.5) * 9.81 * np.cos(q[0]) + outer, outer])
    C = np.array([-s * v[1] * (2 * v[0] + v[1]), s * v[0] ** 2])
    e = q - np.pi / 2 - np.pi / 6 * np.array([np.sin(t), -np.cos(t)])
    de = v - np.pi / 6 * np.array([np.cos(t), np.sin(t)])
    rho = (30.0 - 0.035) * np.exp(-1.5 * t) + 0.035
    xi = (de + 2 * e) / rho
    tau = -2 * 6.0 * np.log((1 + xi) / (1 - xi)) / ((1 - xi**2) * rho)
    d = np.array([3 * np.sin(t), 2 * np.cos(t)]) - v
    return np.concatenate([v, np.linalg.solve(M, tau + d - C - G)])


def compare() -> float:
    """The largest difference of the positions [rad]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(run, rate, end=END, components=2)
