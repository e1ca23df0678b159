"""The corrected loop of `example.py` with NumPy and SciPy only."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

CENTRES = 5.0 * (2.0 * np.random.RandomState(5489).random_sample((1000, 8)) - 1.0)
TOLERANCE = 1e-3  # of the velocities, in the steep first millisecond of the filter
B = 0.02 / (np.sqrt(2.0) * 0.3)


def rates(t, x):
    """The closed loop; x has q, q', the filter and the estimate."""
    q, v, filtered, estimate = x[:2], x[2:4], x[4:6], x[6]
    q_d = 0.3 * np.array([np.sin(t), np.cos(t)])
    left = max(2.0 - t, 0.0) / 2.0
    beta, dbeta = (1.0 - B) * left**3 + B, -1.5 * (1.0 - B) * left**2
    e = q - q_d
    s, r = np.abs(e) / (0.3 * beta), np.abs(v) / 3.0
    h1 = 1.0 - 10.0 * s**3 + 15.0 * s**4 - 6.0 * s**5
    dh1 = -np.sign(e) * (30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4)
    h2, dh2 = 1.0 - 3.0 * r**2 + 2.0 * r**3, np.sign(v) * (6.0 * r**2 - 6.0 * r)
    mu1 = 1.0 / h1 - dh1 / 0.3 * e / (beta * h1**2)
    v1 = dh1 / 0.3 * dbeta * e**2 / (beta**2 * h1**2)
    mu2 = 1.0 / h2 - dh2 / 3.0 * v / h2**2
    z1, z2 = e / h1, v / h2 - filtered
    phi = np.max(np.abs(mu1)) ** 2 * (np.max(h2) ** 2 + q_d @ q_d) + v1 @ v1
    alpha = -(4.0 + 2.0 * phi) * z1 / (mu1 * h2)
    inputs = np.concatenate([q, q_d, h1, h2])
    size = np.linalg.norm(np.exp(-np.sum((inputs - CENTRES) ** 2, axis=1) / 9.0))
    u = -(15.0 * z2 + mu1 * h2 * z1 + 10.0 * estimate * size * z2) / mu2
    m1, m2, l1, l2, g = 2.0, 0.85, 0.35, 0.31, 9.8
    p3 = m2 * l1 * l2
    p2, c, s2 = m2 * l2**2 + 0.02042, p3 * np.cos(q[1]), p3 * np.sin(q[1])
    M = np.array([[m1 * l1**2 + m2 * l1**2 + 0.06125 + p2 + 2.0 * c, p2 + c], [p2 + c, p2]])
    C = s2 * np.array([-(2.0 * v[0] + v[1]) * v[1], v[0] ** 2])
    outer = m2 * l2 * g * np.cos(q[0] + q[1])
    G = np.array([(m1 * l1 + m2 * l1) * g * np.cos(q[0]) + outer, outer])
    d = np.array([0.1 * np.tanh(np.pi / 4.0), 0.1 * np.cos(t)])
    growth = 25.0 * size * (z2 @ z2) - 2.0 * estimate
    acceleration = np.linalg.solve(M, u - C - G - d)
    return np.concatenate([v, acceleration, (alpha - filtered) / 1e-3, [growth]])


def compare() -> float:
    """The largest difference of the states."""
    run = execute(Path(__file__).parent).runs["corrected"]
    return largest_difference(
        run, rates, x0=[0.15, 0.4, 0, 0, 0, 0, 0], method="Radau", rtol=1e-7, atol=1e-9
    )
