"""The loop of `example.py` with NumPy and SciPy only."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

TOLERANCE = 1e-3  # of velocities of up to 0.2 rad/s, which oscillate at 17 Hz


def rates(t, x):
    """The closed loop."""
    w, b = 0.5 * np.pi, 0.005
    q, v = x[:2], x[2:]
    q_d, dq_d, ddq_d = 0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)
    d = 1.5 * (1.0 - np.exp(-0.28 * t)) * np.sin(w * t)
    e = q - q_d
    alpha = dq_d - (b**2 - e @ e) * 5.0 * e
    s, c = 0.56 * np.sin(q[1]), 0.56 * np.cos(q[1])
    M = np.array([[2.0 * 0.64 + 0.49 + 2.0 * c, 0.49 + c], [0.49 + c, 0.49]])
    C = np.array([[-s * v[1], -s * (v[0] + v[1])], [s * v[0], 0.0]])
    outer = 0.7 * np.cos(q[0] + q[1])
    G = 9.8 * np.array([1.6 * np.cos(q[0]) + outer, outer])
    u = C @ alpha + G + M @ [ddq_d, ddq_d] + d - e / (b**2 - e**2) - 5.0 * (v - alpha)
    tau = np.maximum(u - 2.5, 0.0) + np.minimum(u + 4.5, 0.0)
    return np.concatenate([v, np.linalg.solve(M, tau - C @ v - G - d)])


def compare() -> float:
    """The largest difference of the states in the first period of the reference."""
    run = execute(Path(__file__).parent).runs["published"]
    return largest_difference(run, rates, x0=np.zeros(4), end=4.0, method="LSODA", atol=1e-12)
