"""The same loop in NumPy and SciPy, from the corrected law."""

from pathlib import Path

import numpy as np
from entry import execute
from scipy.integrate import solve_ivp

TOLERANCE = 1e-5
T = 0.5 * (1 + 0.05 / 3.95)
RATE = 2 / T
B = 2 * RATE * 4 / (14 * np.pi) ** 2
GAIN, SLOPE = (2 + B) / (2 * B) + RATE / B, (1 + RATE) / 2


def rate(t, y):
    """The derivative of (x1, x2), of z and of the integral part of the estimate."""
    x1, x2, z, part = y
    w = 8 * np.pi
    factor = 1 / (T - min(t, 0.5))
    e, de = x1 - np.cos(w * t) - z, x2 + w * np.sin(w * t) + factor * z
    s = de + SLOPE * e
    push = (1 / (2 * (0.05**2 - e**2)) + 0.5 + RATE / 2) * s
    ddz = 0.0 if t < 0.5 else factor**2 * z
    own = 3 * (1 - x1**2) * x2 - 2 * x1
    u = -own - GAIN * s - part - w**2 * np.cos(w * t) + ddz - SLOPE * de - push
    v = 14 * np.pi * t
    d = 3 * np.sin(v - 1.2) - 1.5 * np.cos(2 * v + 0.98)
    d += 3.5 * np.cos(0.75 * v + 0.05) * np.exp(np.cos(5.75 * v + 0.43))
    return [x2, own + u + d, -factor * z, GAIN * push]


def compare():
    """The largest difference of the states; the integration is divided at 0.5 s."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    t, x = np.asarray(run.t)[::100], np.asarray(run.x)[::100, :, 0]
    y, largest = [5.0, -2.0, 4.0, -GAIN * (4.0 / T - 2.0)], 0.0
    for start, end in ((0.0, 0.5), (0.5, t[-1])):
        inside = (t >= start) & (t <= end + 1e-12)
        options = {"t_eval": np.clip(t[inside], start, end), "rtol": 1e-11, "atol": 1e-12}
        found = solve_ivp(rate, (start, end), y, "LSODA", **options).y
        largest = max(largest, float(np.abs(found[:2].T - x[inside]).max()))
        y = found[:, -1]
    return largest
