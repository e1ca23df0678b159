"""The distance and the speed of this entry from the published equations, without the package."""

import runpy
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp


def rate(t, x):
    """D', v' and v_L' under the filter, with V(D) >= 0."""
    D, v, v_L = x
    a_L = np.interp(t, [3.0, 4.0, 4.5, 5.5], [0.0, -10.0, -10.0, 0.0])
    V = np.clip(0.6 * (D - 5.0), 0.0, 15.0)
    desired = 0.4 * (V - v) + 0.3 * (min(v_L, 15.0) - v)
    safe = 0.6 * (v_L - v) + 0.6 * (D - 1.0) - v
    return [v_L - v, min(desired, safe), a_L]


def compare() -> float:
    """The largest difference of D [m] and v [m/s]."""
    names = runpy.run_path(str(Path(__file__).with_name("example.py")))
    run = next(iter(names["runs"].values()))
    t, q, dq = (np.asarray(part) for part in (run.t, run.q[:, 0], run.dq[:, 0]))
    options = {"max_step": 0.01, "rtol": 1e-9, "atol": 1e-10}
    found = solve_ivp(rate, (0.0, 20.0), [30.0, 15.0, 15.0], "RK45", t, **options)
    own = np.stack([np.asarray(names["leader"](t)[0]) - q, dq])
    return float(np.abs(own - found.y[:2]).max())
