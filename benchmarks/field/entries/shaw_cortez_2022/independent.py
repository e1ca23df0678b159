"""The same loop in NumPy and SciPy, from the printed numbers; the filter by active conditions."""

import itertools
from pathlib import Path

import numpy as np
from entry import execute, largest_difference

END = 4.5
TOLERANCE = 1e-7


def nearest(u, G, h):
    """The x of least |x - u| with G x <= h, for two numbers: by its active conditions, none, one or
    two.
    """
    for count in range(3):
        for active in itertools.combinations(range(len(h)), count):
            A = G[list(active)]
            if np.linalg.matrix_rank(A) < count:
                continue
            multipliers = np.zeros(0)
            if count:
                multipliers = np.linalg.solve(A @ A.T, A @ u - h[list(active)])
            x = u - A.T @ multipliers
            if np.all(multipliers >= 0) and np.all(G @ x <= h + 1e-9 * (1 + np.abs(h))):
                return x
    raise AssertionError("no torque meets all conditions")


def rate(t, x):
    """The derivative of (q, q')."""
    q, v = x[:2], x[2:]
    b, s = 0.5 * np.cos(q[1]), 0.5 * np.sin(q[1])
    a2 = 1 / 12 + 0.25
    M = np.array([[1 / 12 + 0.5 + 0.25 + 1.0 + a2 + 2 * b, a2 + b], [a2 + b, a2]])
    C = np.array([-s * v[1] * (2 * v[0] + v[1]), s * v[0] ** 2])
    amplitude, w = np.array([np.pi / 2 + 1.9, np.pi / 6 + 2.1]), 1.3
    r = amplitude * np.sin(w * t) + [0, 2 * np.pi / 3]
    dr = amplitude * w * np.cos(w * t)
    ddr = -amplitude * w**2 * np.sin(w * t)
    u = M @ (ddr - 5 * (v - dr) - 5 * (q - r)) + C
    gamma, nu, eta, inverse = 0.8906, 10.0, 0.5, np.linalg.inv(M)
    drift, rows, room = -inverse @ C, [], []
    for sign, side in ((1, [np.pi / 2, 5 * np.pi / 6]), (-1, [-np.pi / 2, np.pi / 2])):
        h, dh = sign * (np.array(side) - q), -sign * v
        z = dh + gamma * np.arctan(h)  # z' = -sign q" + gamma h'/(1 + h^2), and z' + nu z^3 >= eta
        rows.append(sign * inverse)
        room.append(gamma * dh / (1 + h**2) + nu * z**3 - eta - sign * drift)
    limits = np.array([18.0, 10.0])
    G = np.concatenate([*rows, np.eye(2), -np.eye(2)])
    tau = nearest(u, G, np.concatenate([*room, limits, limits]))
    return np.concatenate([v, np.linalg.solve(M, tau - C - 0.001 * v)])


def compare() -> float:
    """The largest difference of the positions [rad]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    # The torque of a filter has kinks, where a method of a high order gains and loses nothing.
    return largest_difference(run, rate, end=END, components=2)
