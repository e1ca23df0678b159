"""The motion of this entry with the textbook's double pendulum, without the package."""

import runpy
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp


def inertia(q):
    """M(q) for rods of 1 m and masses of 2 kg."""
    c = np.cos(q[1])
    return 2.0 * np.array([[3.0 + 2.0 * c, 1.0 + c], [1.0 + c, 1.0]])


def forces(q, v):
    """C(q, v) v + G(q): m1 = m2 = 2 kg, l1 = l2 = 1 m, g = 9.8 m/s^2."""
    s, s1, s12 = np.sin(q[1]), np.sin(q[0]), np.sin(q[0] + q[1])
    coriolis = 2.0 * s * np.array([-(2.0 * v[0] + v[1]) * v[1], v[0] ** 2])
    return coriolis + 19.6 * np.array([2.0 * s1 + s12, s12])


def barrier(x):
    """h(q, v)."""
    q, v = x[:2], x[2:]
    tip = np.sin(q[0]) + np.sin(q[0] + q[1])
    outer = np.cos(q[0] + q[1])
    h0, slope = 2.25 - tip**2, -2.0 * tip * np.array([np.cos(q[0]) + outer, outer])
    e = v - 0.1 * np.logaddexp(0.0, -h0 / (0.1 * slope @ slope)) * slope
    return h0 - 0.05 * e @ inertia(q) @ e


def rate(t, x):
    """The pendulum under the filter, with dh/dx from central differences."""
    q, v = x[:2], x[2:]
    slope = np.array([barrier(x + d) - barrier(x - d) for d in 1e-6 * np.eye(4)]) / 2e-6
    inverse = np.linalg.inv(inertia(q))
    desired = -1.2 * v
    a = slope[:2] @ v + slope[2:] @ inverse @ (desired - forces(q, v)) + 5.0 * barrier(x)
    b = inverse @ slope[2:]
    tau = desired + max(0.0, -a / (b @ b)) * b if b @ b > 0.0 else desired
    return np.concatenate([v, inverse @ (tau - forces(q, v))])


def compare() -> float:
    """The largest difference of q [rad] and q' [rad/s] in the first 5 s."""
    run = next(iter(runpy.run_path(str(Path(__file__).with_name("example.py")))["runs"].values()))
    early = np.asarray(run.t) <= 5.0
    start = [np.pi + 0.1, 0.0, 0.0, 0.0]
    t = np.asarray(run.t)[early]
    found = solve_ivp(rate, (0.0, 5.0), start, "LSODA", t, rtol=1e-9, atol=1e-10)
    own = np.concatenate([np.asarray(run.q), np.asarray(run.dq)], axis=1)[early]
    return float(np.abs(own - found.y.T).max())
