"""The program without the package: each quadratic programme by a numerical minimum, and the exact
motion under the force that is held.
"""

from pathlib import Path

import numpy as np
from entry import execute
from scipy.optimize import minimize

TOLERANCE = 1e-4
G = 9.81


def acceleration(z, v, braking):
    """u/mass of the printed programme, in a = u/mass and delta; a first guess is feasible."""
    b = z - 1.8 * v - 0.5 * (13.89 - v) ** 2 / braking
    per_speed = 1.8 - (13.89 - v) / braking
    highest = min((13.89 - v + b) / per_speed, 0.4 * G)
    excess = 10.0 * (v - 30.0) ** 2
    slope = 2.0 * (v - 30.0)
    start = [highest, slope * highest + excess + 1.0]
    found = minimize(
        lambda y: y @ y,
        start,
        jac=lambda y: 2.0 * y,
        method="SLSQP",
        bounds=[(None, highest), (None, None)],
        constraints={
            "type": "ineq",
            "fun": lambda y: y[1] - slope * y[0] - excess,
            "jac": lambda y: np.array([-slope, 1.0]),
        },
        options={"ftol": 1e-13, "maxiter": 200},
    )
    return found.x[0]


def states(braking):
    """Position and speed at 0, 0.1, ... 30 s."""
    x, v, rows = 0.0, 20.0, []
    for i in range(301):
        rows.append((x, v))
        a = acceleration(100.0 + 1.389 * i - x, v, braking)
        x, v = x + 0.1 * v + 0.005 * a, v + 0.1 * a
    return np.array(rows)


def compare():
    """The largest difference of position [m] and speed [m/s], of both modes."""
    runs = execute(Path(__file__).parent).runs
    found = []
    for run, braking in zip(runs.values(), (0.4 * G, 1e9), strict=True):
        found.append(np.abs(np.asarray(run.x[::50, :, 0]) - states(braking)).max())
    return float(max(found))
