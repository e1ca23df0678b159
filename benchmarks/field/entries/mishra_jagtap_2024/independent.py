"""The same loop in NumPy and SciPy, from the corrected law."""

from pathlib import Path

import numpy as np
from entry import execute
from scipy.integrate import solve_ivp

TOLERANCE = 1e-6


def rate(t, x):
    """The derivative of the speed and of the acceleration."""
    r = x[1] + 8 * (x[0] - 0.1)
    psi = 2 * np.pi * np.exp(-7 * t) + 0.8
    u = -36 / np.pi * np.arctan(np.pi / 36 * np.tan(np.pi * r / (2 * psi)))
    return [x[1], -102 * x[0] - 20.1 * x[1] + 100 * u]


def compare():
    """The largest difference of the states."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    t, x = np.asarray(run.t)[::20], np.asarray(run.x)[::20, :, 0]
    found = solve_ivp(rate, (0.0, t[-1]), x[0], "DOP853", t_eval=t, rtol=1e-11, atol=1e-13).y.T
    return float(np.abs(found - x).max())
