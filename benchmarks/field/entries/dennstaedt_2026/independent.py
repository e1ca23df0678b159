"""The motion of this entry from the printed normal form and law, without the package."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference


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
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(run, rate, x0=np.zeros(4), method="LSODA", rtol=1e-10, atol=1e-11)
