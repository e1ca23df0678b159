"""The printed law and observer in NumPy and SciPy; the derivative of alpha by a complex step."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

END = 5.0
TOLERANCE = 1e-7
WAVE = np.array([0.0, np.pi / 2])
"""Phases of the reference; those of the bounds are in the opposite order."""


def reference(t):
    """q_d, q_d' and q_d''."""
    return (
        0.5 + 0.14 * np.sin(t + WAVE),
        0.14 * np.cos(t + WAVE),
        -0.14 * np.sin(t + WAVE),
    )


def widths(t):
    """k_u, k_l and their derivatives."""
    q_d, dq_d, _ = reference(t)
    side, moved = 0.14 * np.sin(t + WAVE[::-1]), 0.14 * np.cos(t + WAVE[::-1])
    return 0.9 + side - q_d, q_d - 0.2 - side, moved - dq_d, dq_d - moved


def alpha(t, q):
    """(3.5) to (3.7)."""
    q_d, dq_d, _ = reference(t)
    upper, lower, d_upper, d_lower = widths(t)
    kappa = np.sqrt((d_upper / upper) ** 2 + (d_lower / lower) ** 2 + 0.1)
    return dq_d - (2.0 + kappa) * (q - q_d)


def matrices(q, v):
    """M0, C0 of a velocity v, and G0."""
    (m1, m2), (l1, c1, c2) = (2.0, 0.85), (0.35, 0.175, 0.155)
    i1, i2 = m1 * l1**2 / 4, m2 * 0.31**2 / 4
    b, s = m2 * l1 * c2 * np.cos(q[1]), m2 * l1 * c2 * np.sin(q[1])
    a2 = i2 + m2 * c2**2
    M = np.array([[i1 + m1 * c1**2 + m2 * l1**2 + a2 + 2 * b, a2 + b], [a2 + b, a2]])
    C = np.array([[-s * v[1], -s * (v[0] + v[1])], [s * v[0], 0.0]])
    outer = m2 * c2 * 9.81 * np.cos(q[0] + q[1])
    return M, C, np.array([(m1 * c1 + m2 * l1) * 9.81 * np.cos(q[0]) + outer, outer])


def rate(t, x):
    """The derivative of (q, q', eta)."""
    q, v, eta = x[:2], x[2:4], x[4:]
    M, C, G = matrices(q, v)
    step = 1e-30
    e1, e2 = q - reference(t)[0], v - alpha(t, q)
    alpha_rate = alpha(t + 1j * step, q + 1j * step * v).imag / step
    upper, lower, _, _ = widths(t)
    k = np.where(e1 > 0, upper, lower)
    slope = 2 * e1 / (k**2 - e1**2)
    estimate = eta + 20.0 * M @ v
    tau = C @ v + G + M @ alpha_rate - estimate - 20.0 * e2 - slope
    f = M @ (0.3 * np.sin(t + WAVE)) + C @ (0.3 * np.sin(0.5 * t + WAVE[::-1]))
    eta_rate = -20.0 * (estimate + tau - C @ v - G)
    return np.concatenate([v, np.linalg.solve(M, tau + f - C @ v - G), eta_rate])


def compare() -> float:
    """The largest difference of the positions [rad]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(run, rate, x0=[0.8, 0.8, 0, 0, 0, 0], end=END, every=20, components=2)
