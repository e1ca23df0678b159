"""The corrected loop of `example.py` with NumPy and SciPy only."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

TOLERANCE = 1e-3  # of the velocities, where they come within 0.002 rad/s of a limit
Q = np.array([[-np.pi / 4, -np.pi / 2], [np.pi / 2, np.pi / 2]])
V = np.array([[-np.pi / 2, -np.pi / 2], [np.pi / 2, np.pi]])
K1, K2, K3 = np.array([22.0, 505.0]), np.array([20.0, 50.0]), np.array([10.0, 5.0])
AMPLITUDE, RATE = np.array([np.pi / 4 - 0.09, 0.09 - np.pi / 2]), np.array([1.9, 0.9])


def rates(t, x):
    """The closed loop."""
    q, v = x[:2], x[2:]
    phase = RATE * t + np.array([0.0, np.pi / 2])
    q_d = np.array([np.pi / 4, 0.0]) + AMPLITUDE * np.sin(phase)
    dq_d, ddq_d = AMPLITUDE * RATE * np.cos(phase), -AMPLITUDE * RATE**2 * np.sin(phase)
    q_m, half, v_m, span = (
        Q.mean(axis=0),
        np.ptp(Q, axis=0) / 2,
        V.mean(axis=0),
        np.ptp(V, axis=0) / 2,
    )
    a, b = np.clip(q, Q[0] + 1e-3, Q[1] - 1e-3), np.clip(v, V[0] + 1e-3, V[1] - 1e-3)
    z, z_d, s = (a - q_m) / half, (q_d - q_m) / half, (b - v_m) / span
    J, J_d, J_s = half * (1.0 - z**2), half * (1.0 - z_d**2), span * (1.0 - s**2)
    y = (J / J_d * dq_d - v_m) / span
    dy = -2.0 * z * b / J_d * dq_d + J / J_d**2 * 2.0 * z_d * dq_d * dq_d + J / J_d * ddq_d
    factor = 1.0 + np.abs(y) ** 15
    y_r = y / factor ** (1.0 / 15.0)
    ds_r = dy / span * factor ** (-16.0 / 15.0) / (1.0 - y_r**2)
    u = ds_r - K1 / K2 * span / J * (s - y_r) - K2 * (np.arctanh(z) - np.arctanh(z_d))
    u = J_s * u - K3 * (np.arctanh(s) - np.arctanh(y_r))

    def matrices(q, v):
        c, s = 0.13125 * np.cos(q[1]), 0.13125 * np.sin(q[1])
        p2 = 1.5 * 0.35**2 / 3.0
        M = np.array([[2.0 * 0.25 / 3.0 + 0.375 + p2 + 2.0 * c, p2 + c], [p2 + c, p2]])
        C = s * np.array([-(2.0 * v[0] + v[1]) * v[1], v[0] ** 2])
        outer = 0.2625 * np.cos(q[0] + q[1])
        return M, C + 9.81 * np.array([1.25 * np.cos(q[0]) + outer, outer])

    known, bias = matrices(a, b)
    true, true_bias = matrices(q, v)
    return np.concatenate([v, np.linalg.solve(true, known @ u + bias - true_bias)])


def compare() -> float:
    """The largest difference of the states."""
    run = execute(Path(__file__).parent).runs["corrected"]
    return largest_difference(run, rates, x0=np.zeros(4), method="Radau", rtol=1e-8, atol=1e-10)
