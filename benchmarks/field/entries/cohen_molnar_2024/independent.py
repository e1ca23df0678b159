"""The corrected loop of `example.py` with NumPy and SciPy only."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

TOLERANCE = 1e-3  # of the angles up to 4 s; the gradient of the barrier is by differences here


def model(q, v):
    """M, and C q' + G, of the pendulum whose angle is measured from the horizontal."""
    s, c = np.sin(q[1]), np.cos(q[1])
    M = 2.0 * np.array([[3.0 + 2.0 * c, 1.0 + c], [1.0 + c, 1.0]])
    outer = np.cos(q[0] + q[1])
    C = 2.0 * s * np.array([-(2.0 * v[0] + v[1]) * v[1], v[0] ** 2])
    return M, C + 2.0 * 9.8 * np.array([2.0 * np.cos(q[0]) + outer, outer])


def barrier(x):
    """The barrier function h."""
    q, v = x[:2], x[2:]
    tip = np.cos(q[0]) + np.cos(q[0] + q[1])
    slope = 2.0 * tip * np.array([np.sin(q[0]) + np.sin(q[0] + q[1]), np.sin(q[0] + q[1])])
    h0 = 2.25 - tip**2
    k0 = 0.1 * np.logaddexp(0.0, -h0 / (0.1 * (slope @ slope + 1e-12))) * slope
    return h0 - 0.05 * (v - k0) @ model(q, v)[0] @ (v - k0)


def rates(t, x):
    """The closed loop."""
    M, bias = model(x[:2], x[2:])
    slope = np.array([(barrier(x + d) - barrier(x - d)) / 2e-6 for d in 1e-6 * np.eye(4)])
    b = slope[2:] @ np.linalg.inv(M)
    nominal = -1.2 * x[2:]
    a = slope[:2] @ x[2:] + b @ (nominal - bias) + 5.0 * barrier(x)
    u = nominal + max(0.0, -a / (b @ b + 1e-12)) * b
    return np.concatenate([x[2:], np.linalg.solve(M, u - bias)])


def compare() -> float:
    """The largest difference of the states up to 4 s."""
    run = execute(Path(__file__).parent).runs["corrected"]
    return largest_difference(
        run, rates, x0=[np.pi / 2 + 0.1, 0, 0, 0], end=4.0, method="RK45", atol=1e-10
    )
