"""The loop of `example.py` that uses positions only, with NumPy and SciPy only."""

import runpy
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

P1, P2, P3, P4, P5, P6 = 8.77, 0.51, 0.76, 0.62, 74.48, 6.174
KP, KD, K0, K1, A = np.array([80.0, 100.0]), np.array([33.0, 10.0]), 45.0, 40.0, 0.03


def rates(t, x):
    """The closed loop, with the angles of the program."""
    q, v, filtered = x[:2], x[2:4], x[4:]
    q_d, dq_d = np.full(2, np.sin(np.pi * t)), np.full(2, np.pi * np.cos(np.pi * t))
    s, c = P2 * np.sin(q[1]), P2 * np.cos(q[1])
    M = np.array([[P1 + 2.0 * c, P3 + c], [P3 + c, P4]])
    outer = P6 * np.sin(q[0] + q[1])
    G = np.array([P5 * np.sin(q[0]) + outer, outer])

    def coriolis(v):
        return s * np.array([-(2.0 * v[0] + v[1]) * v[1], v[0] ** 2])

    e = q - q_d
    r = filtered - K0 * e
    u = -(np.pi**2) * M @ q_d + coriolis(dq_d) + G + KD * r - KP * np.tanh(e)
    acceleration = np.linalg.solve(M, u - coriolis(v) - G)
    return np.concatenate([v, acceleration, -A * K0 * np.tanh(e) - (A * K0 + K1) * r])


def compare():
    """The largest difference of the states."""
    names = runpy.run_path(str(Path(__file__).with_name("example.py")))
    run = names["runs"]["positions only"]
    t = np.asarray(run.t)
    start = [3.0, -2.0, 0.0, 0.0, 3.0 * K0, -2.0 * K0]
    found = solve_ivp(rates, (0.0, t[-1]), start, t_eval=t, rtol=1e-9, atol=1e-11).y.T
    q = np.asarray(run.q) + np.array([np.pi / 2, 0.0])
    return float(np.abs(found[:, :4] - np.concatenate([q, run.dq], axis=1)).max())


if __name__ == "__main__":
    print(compare())
