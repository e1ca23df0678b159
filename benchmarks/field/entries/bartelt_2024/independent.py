"""The same loop in NumPy and SciPy, from the printed numbers."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

END = 4.0
TOLERANCE = 1e-7


def rate(t, x):
    """The derivative of (q, q')."""
    q, v = x[:2], x[2:]
    m1, m2, length, c1, c2, i1, i2, g = 23.902, 5.88, 0.45, 0.091, 0.048, 1.266, 0.093, 9.81
    b, s = m2 * length * c2 * np.cos(q[1]), m2 * length * c2 * np.sin(q[1])
    a2 = i2 + m2 * c2**2
    M = np.array([[i1 + m1 * c1**2 + m2 * length**2 + a2 + 2 * b, a2 + b], [a2 + b, a2]])
    outer = m2 * c2 * g * np.cos(q[0] + q[1])
    G = np.array([(m1 * c1 + m2 * length) * g * np.cos(q[0]) + outer, outer])
    C = np.array([-s * v[1] * (2 * v[0] + v[1]), s * v[0] ** 2])
    e = q - np.array([np.sin(t) - np.pi / 2, np.cos(t)])
    de = v - np.array([np.cos(t), -np.sin(t)])
    p12 = np.sqrt(2 * 0.503)
    p22 = np.sqrt(0.503 * (2 + 2 * p12))
    end = 0.05 / p22 / np.sqrt(2)
    rho = (1.5 - end) * np.exp(-0.5 * t) + end
    xi = (de + p12 / p22 * e) / rho
    tau = -np.log((1 + xi) / (1 - xi)) / ((1 - xi**2) * rho)
    return np.concatenate([v, np.linalg.solve(M, tau + 2 * np.sin(4 * t) - C - G)])


def compare() -> float:
    """The largest difference of the positions [rad]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(run, rate, end=END, components=2)
