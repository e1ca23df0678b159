"""The loop of `example.py` with the gains of the figures, with NumPy and SciPy only."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

J = np.array([[20.0, 1.2, 0.9], [1.2, 17.0, 1.4], [0.9, 1.4, 15.0]])


def bound(t, r0, rT):
    """The bound for T = 15 s."""
    if t >= 15.0:
        return rT
    return (r0 - rT * (1.0 + t / 15.0)) * np.exp(2.5 * t / (t - 15.0)) + rT


def rates(t, x):
    """The closed loop."""
    q, w, theta = x[:3], x[3:6], x[6]
    s = w + 1.5 * q
    near_q = (1.0 - (q / bound(t, 0.3, 0.008)) ** 2) ** -2
    near_w = (1.0 - (w / bound(t, 0.4, 0.005)) ** 2) ** -2
    u = -40.0 * q - 40.0 * w - (1.5 * near_q + 1.2 * near_w) * s
    u = np.clip(u - theta * np.clip(s / 0.01, -1.0, 1.0), -2.0, 2.0)
    d = np.array([0.05 * np.sin(t), 0.1 * np.sin(1.2 * t), 0.15 * np.sin(1.5 * t)])
    acceleration = np.linalg.solve(J, u + d - np.cross(w, J @ w))
    turning = 0.5 * (np.sqrt(1.0 - q @ q) * w + np.cross(q, w))
    growth = (np.linalg.norm(s) - 2.0 * np.exp(-0.5 * t) * theta) / 0.1
    return np.concatenate([turning, acceleration, [growth]])


def compare() -> float:
    """The largest difference of the states up to 10 s."""
    run = execute(Path(__file__).parent).runs["15 s"]
    return largest_difference(
        run,
        rates,
        x0=[0.2, -0.15, -0.25, 0, 0, 0, 0],
        end=10.0,
        method="RK45",
        rtol=1e-8,
        atol=1e-10,
        max_step=0.02,
    )
