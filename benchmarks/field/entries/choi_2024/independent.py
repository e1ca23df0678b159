"""The loop with a numerical minimum of the programme, step by step, without the package."""

from pathlib import Path

import numpy as np
from entry import execute
from scipy.optimize import minimize


def force(p, v):
    """The minimum of the programme, by sequential quadratic programming."""
    P = np.array([[np.sqrt(3.0), 1.0], [1.0, np.sqrt(3.0)]])
    e = np.stack([p - [10.0, 0.0], v])
    V = np.sum(e * (P @ e))
    slope = 2.0 * P @ e
    r = p - [5.0, 2.0]
    h, dh = r @ r - 4.0, 2.0 * r @ v

    def excess(u):
        return slope[0] @ v + slope[1] @ u + 0.7 * V

    def cost(u):
        return 2.5 * u @ u + 0.5 * max(excess(u), 0.0) ** 2

    def gradient(u):
        return 5.0 * u + max(excess(u), 0.0) * slope[1]

    rule = {"type": "ineq", "fun": lambda u: 2.0 * v @ v + 2.0 * r @ u + 4.0 * dh + 3.0 * h}
    rule["jac"] = lambda u: 2.0 * r
    box = [(-7.0, 7.0)] * 2
    options = {"ftol": 1e-15, "maxiter": 200}
    found = minimize(cost, np.zeros(2), jac=gradient, bounds=box, constraints=rule, options=options)
    return found.x


def compare() -> float:
    """The largest difference of positions and velocities up to 6 s, [m] and [m/s]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    p, v, largest = np.array([0.0, 4.1]), np.zeros(2), 0.0
    for state in np.asarray(run.x)[:300]:
        largest = max(largest, np.abs(state - np.stack([p, v])).max())
        u = force(p, v)
        p, v = p + 0.02 * v + 0.0002 * u, v + 0.02 * u
    return float(largest)
