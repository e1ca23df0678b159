"""The distance and the speed of this entry with a numerical minimum, without the package."""

from pathlib import Path

import numpy as np
from entry import execute
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

G3 = 0.3 * 9.81


def acceleration(x):
    """The acceleration under the programme."""
    z, v = x
    resistance = (0.1 + 5.0 * v + 0.25 * v**2) / 1650.0
    per_speed = 1.8 + (v - 14.0) / G3
    B = z - 1.8 * v - (14.0 - v) ** 2 / (2.0 * G3)
    highest = min(G3, (14.0 - v + 5.0 * B) / per_speed + resistance)

    def cost(w):
        excess = 2.0 * (v - 24.0) * (w - resistance) + 5.0 * (v - 24.0) ** 2
        return w**2 + 0.01 * max(excess, 0.0) ** 2

    found = minimize_scalar(
        cost, bounds=(-G3, highest), method="bounded", options={"xatol": 1e-10}
    ).x
    ends = [found, highest, -G3]
    return min(ends, key=cost) - resistance


def compare() -> float:
    """The largest difference of z [m] and v [m/s]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    t, x = np.asarray(run.t), np.asarray(run.x[..., 0])
    options = {"max_step": 0.02, "rtol": 1e-8, "atol": 1e-9}
    found = solve_ivp(
        lambda t, x: [14.0 - x[1], acceleration(x)],
        (0.0, 15.0),
        [100.0, 20.0],
        "RK45",
        t,
        **options,
    )
    own = np.stack([100.0 + 14.0 * t - x[:, 0], x[:, 1]])
    return float(np.abs(own - found.y).max())
