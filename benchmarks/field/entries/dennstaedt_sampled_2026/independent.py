"""The motion of this entry from the state equations of both bodies, without the package."""

import itertools
import runpy
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

C = np.sqrt(0.5)
MU1, MU2 = 1.0 / 4.0, 2.0 / 4.0  # m1/mu and m2/mu with mu = m2 (m1 + m2 sin^2) = 4


def rate(t, x, u):
    """The car z, and the mass s on its ramp."""
    _, dz, s, ds = x
    F = s + ds
    return [dz, MU2 * C * F + MU2 * u, ds, -(MU1 + MU2) * F - MU2 * C * u]


def input_of(t, x, beta):
    """The input of the period that begins at t."""
    y, dy = x[0] + C * x[2], x[1] + C * x[3]
    e1 = (y - 0.4 * np.sin(np.pi * t / 2)) / 0.15
    e2 = (dy - 0.2 * np.pi * np.cos(np.pi * t / 2)) / 0.15 + e1 / (1 - e1**2)
    return -beta / e2 if abs(e2) >= 0.75 else 0.0


def compare() -> float:
    """The largest difference of y [m] and y' [m/s] at the samples."""
    names = runpy.run_path(str(Path(__file__).with_name("example.py")))
    run = next(iter(names["runs"].values()))
    y, dy, s = -0.0925, 0.2 * np.pi, 0.0925 / C
    ds = -0.0925 / C - dy / C  # w = s' + y' cos/sin^2, and 1/C = cos/sin^2
    x = np.array([y - C * s, dy - C * ds, s, ds])
    times = np.arange(311) / 310
    found = [x]
    for start, end in itertools.pairwise(times):
        u = input_of(start, x, names["beta"])
        x = solve_ivp(rate, (start, end), x, args=(u,), rtol=1e-10, atol=1e-12).y[:, -1]
        found.append(x)
    found = np.array(found)
    own = np.stack([np.interp(times, run.t, part[:, 0]) for part in (run.q, run.dq)])
    theirs = np.stack([found[:, 0] + C * found[:, 2], found[:, 1] + C * found[:, 3]])
    return float(np.abs(own - theirs).max())
