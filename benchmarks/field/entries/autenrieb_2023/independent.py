"""The loop of the corrected law, step by step in NumPy."""

from pathlib import Path

import numpy as np
from entry import execute

G3 = 0.3 * 9.81


def force_over_mass(z, v):
    """u/mass of the quadratic programme, by its two variables."""
    resistance = (0.1 + 5.0 * v + 0.25 * v**2) / 1650.0
    h = z - 1.8 * v - (14.0 - v) ** 2 / (2.0 * G3)
    a = 2.0 * (v - 24.0)
    # Least w^2 + 10 delta^2 with a (w - resistance) <= delta.
    w = 10.0 * a**2 * resistance / (1.0 + 10.0 * a**2)
    if -a * resistance <= 0.0:
        w = 0.0
    ahead = 1.8 + (v - 14.0) / G3
    w = min(w, resistance + (14.0 - v + 0.1 * h) / ahead)
    return np.clip(w, -G3, G3) - resistance


def compare() -> float:
    """The largest difference of z [m] and v [m/s]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    t, x = np.asarray(run.t), np.asarray(run.x[..., 0])
    z, v, largest = 100.0, 20.0, 0.0
    for time, state in zip(t, x, strict=True):
        own = (100.0 + 14.0 * time - state[0], state[1])
        largest = max(largest, abs(own[0] - z), abs(own[1] - v))
        acceleration = force_over_mass(z, v)
        z, v = z + 0.02 * (14.0 - v), v + 0.02 * acceleration
    return float(largest)
