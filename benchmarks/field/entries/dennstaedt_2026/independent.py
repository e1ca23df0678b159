"""The motion of this entry from the printed normal form and law, without the package."""

import runpy
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp


def force(t, y, dy):
    """The printed law."""
    psi = 5.0 * np.exp(-2.0 * t) + 0.1
    e, de = (y - np.cos(t)) / psi, (dy + np.sin(t)) / psi
    w = de + e / (1.0 - e**2)
    return -w / (1.0 - w**2)


def rate(t, x):
    """The normal form in (y, y', eta)."""
    y, dy, eta1, eta2 = x
    ddy = 8 / 9 * dy - 4 * np.sqrt(2) / 9 * (2 * eta1 + eta2) + force(t, y, dy) / 9
    return [dy, ddy, eta2 + 2 * np.sqrt(2) * y, -4 * eta1 - 2 * eta2]


def compare() -> float:
    """The largest difference of y [m] and y' [m/s]."""
    run = next(iter(runpy.run_path(str(Path(__file__).with_name("example.py")))["runs"].values()))
    found = solve_ivp(rate, (0.0, 10.0), np.zeros(4), "LSODA", run.t, rtol=1e-10, atol=1e-11)
    own = np.stack([np.asarray(run.q[:, 0]), np.asarray(run.dq[:, 0])])
    return float(np.abs(own - found.y[:2]).max())
