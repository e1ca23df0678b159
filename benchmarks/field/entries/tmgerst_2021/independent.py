"""The same loop in NumPy and SciPy, with the derivatives written out as in the program."""

from pathlib import Path

import numpy as np
from entry import execute
from scipy.integrate import solve_ivp

A, IC, G, PERIOD = 0.5, 1 / 4 + 1 / 12, 9.81, 0.01  # m2 l1 lc2, inertia, gravity, sample time
GAMMA, BETA, LIMIT = 16.0, np.pi / 10, np.array([3 * np.pi / 4, np.pi / 2])
FEEDBACK = (1e4, 1e3, 300.0, 10.0)


def mass(q):
    """M(q)."""
    b = 0.25 + IC + A * np.cos(q[1])
    return np.array([[1.25 + 0.25 + 2 * IC + 2 * A * np.cos(q[1]), b], [b, 0.25 + IC]])


def load(q, v):
    """C(q, q') q' + G(q)."""
    s, outer = A * np.sin(q[1]), 0.5 * G * np.cos(q[0] + q[1])
    first = -s * v[1] ** 2 - 2 * s * v[0] * v[1] + 1.5 * G * np.cos(q[0]) + outer
    return np.array([first, s * v[0] ** 2 + outer])


def rate(t, x, u):
    """The derivative of (q, q', theta, theta')."""
    q, v, theta, w = x.reshape(4, 2)
    return np.concatenate([v, np.linalg.solve(mass(q), theta - q - load(q, v)), w, u - theta + q])


def torque(t, x):
    """The published law, errors included."""
    q, v, theta, rate_theta = x.reshape(4, 2)
    M, n, s, c = mass(q), load(q, v), np.sin(q[1]), np.cos(q[1])
    s1, c1, s12, c12 = np.sin(q[0]), np.cos(q[0]), np.sin(q.sum()), np.cos(q.sum())
    a = np.linalg.solve(M, theta - q - n)
    shape = np.array([[2.0, 1.0], [1.0, 0.0]])
    dM = -A * s * v[1] * shape
    dC = [-c * q[1] ** 3 - 2 * s * v[1] * a[1] - 2 * c * v[0] * a[1]]
    dC[0] -= 2 * s * (a[0] * v[1] + v[0] * a[1])
    dC.append(c * v[1] * v[0] ** 2 + 2 * s * v[0] * a[0])
    outer = -0.5 * G * s12 * v.sum()
    dn = A * np.array(dC) + np.array([-1.5 * G * s1 * v[0] + outer, outer])
    j = np.linalg.solve(M, rate_theta - v - dn - dM @ a)
    ddM = -A * (c * v[1] + s * a[1]) * shape
    ddC = [s * v[1] ** 4 - 3 * c * v[1] ** 2 * a[1]]
    ddC[0] += -2 * c * v[1] ** 2 * a[1] - 2 * s * (a[1] ** 2 + v[1] * j[1])
    ddC[0] += 2 * s * v[1] * a[1] * v[0] - 2 * c * (a[0] * a[1] + v[0] * j[1])
    ddC[0] -= 2 * c * v[1] * (a[0] * v[1] + v[0] * a[1])
    ddC[0] -= 2 * s * (j[0] * v[1] + 2 * a[0] * a[1] + v[0] * j[1])
    ddC.append(-s * v[1] ** 2 * v[0] ** 2 + c * (v[1] * v[0] ** 2 + 2 * v[1] * v[0] * a[0]))
    ddC[1] += 2 * c * v[1] * v[0] * a[0] + 2 * s * (a[0] ** 2 + v[0] * j[0])
    outer = -0.5 * G * (c12 * v.sum() ** 2 + s12 * a.sum())
    inner = -1.5 * G * (c1 * v[0] ** 2 + s1 * a[0])
    ddn = A * np.array(ddC) + np.array([inner + outer, outer])
    f = -np.linalg.solve(M, M @ a + n + ddM @ a + 2 * dM @ j + ddn + a)
    b = np.pi / 15
    waves = (np.sin(b * t), np.cos(b * t), -np.sin(b * t), -np.cos(b * t), np.sin(b * t))
    r = [np.pi * b**k * wave for k, wave in enumerate(waves)]
    w = r[4] + sum(g * (one - y) for g, one, y in zip(FEEDBACK, r, (q, v, a, j), strict=False))
    drift = GAMMA**3 * v + 3 * GAMMA**2 * a + 3 * GAMMA * j
    known = GAMMA**3 * q + 3 * GAMMA**2 * v + 3 * GAMMA * a
    rows = np.concatenate([np.eye(2), -np.eye(2)])
    above = GAMMA**3 * LIMIT - known - j - BETA - drift
    below = GAMMA**3 * LIMIT + known + np.array([1.0, -1.0]) * j - BETA + drift
    # With u = M (w - f): the least |M y - M w| for rows y <= room, by the active rows.
    room, W = np.concatenate([above, below]), np.linalg.inv(M @ M)
    for active in ((), (0,), (1,), (2,), (3,), (0, 1), (0, 3), (2, 1), (2, 3)):
        E = rows[list(active)]
        factors = np.linalg.solve(E @ W @ E.T, E @ w - room[list(active)]) if active else []
        y = w - W @ E.T @ factors if active else w
        if np.all(np.array(factors) >= 0) and np.all(rows @ y <= room + 1e-9 * np.linalg.norm(w)):
            return M @ (y - f)
    raise AssertionError("no torque meets all conditions")


def compare():
    """The largest difference of angles [rad] and velocities [rad/s]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    own = np.asarray(run.x)[:: round(PERIOD / run.dt)].reshape(-1, 8)
    x, largest = own[0], 0.0
    for k, other in enumerate(own[1:]):
        u = torque(k * PERIOD, x)
        x = solve_ivp(rate, (0.0, PERIOD), x, args=(u,), rtol=1e-8, atol=1e-10).y[:, -1]
        largest = max(largest, float(np.abs(x - other).max()))
    return largest
