"""The same loop in NumPy and SciPy, from the printed law."""

from pathlib import Path

import numpy as np
from entry import execute, largest_difference

TOLERANCE = 1e-4
BOUNDS = ((20.0, 30.0), (150.0, 180.0))


def mapped(x, H, L):
    """The mapped state, and its derivative by x."""
    zeta = 0.5 * H * x / (H - x) + 0.5 * L * x / (L + x)
    return zeta, 0.5 * H**2 / (H - x) ** 2 + 0.5 * L**2 / (L + x) ** 2


def rate(t, y):
    """The derivative of (x1, x2, x3) and of both filters."""
    x1, x2, x3, beta1, beta2 = y
    mu, x_d, dx_d, decay = (
        1 / (1.55 - t) ** 2,
        3 * np.sin(0.5 * t),
        1.5 * np.cos(0.5 * t),
        np.exp(-t),
    )
    H, L = 18 * decay + 10, 20 * decay + 10
    zeta1, f1 = mapped(x1, H, L)
    target, f_d = mapped(x_d, H, L)
    (zeta2, f2), (zeta3, f3) = mapped(x2, *BOUNDS[0]), mapped(x3, *BOUNDS[1])

    def by_time(x):
        return 9 * decay * x**2 / (H - x) ** 2 - 10 * decay * x**2 / (L + x) ** 2

    z1, z2, z3 = zeta1 - target, zeta2 - beta1, zeta3 - beta2
    moved = by_time(x1) - f_d * dx_d - by_time(x_d)
    alpha1 = -z1 * (f1 * (x2 - zeta2) ** 2 / 32 + f1 + mu * moved**2 / (32 * f1) + 0.1 * mu / f1)
    alpha2 = -z2 * (f2 * (x3 - zeta3) ** 2 / 32 + f2 + (1 / 0.09 + 0.1 * mu) / f2) - f1 / f2 * z1
    u = -z3 * (1 / 0.09 + 10 * mu) / f3 - f2 / f3 * z2
    return [x2, x3, u, (alpha1 - beta1) / 0.3, (alpha2 - beta2) / 0.3]


def compare() -> float:
    """The largest difference of the states."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    x, beta = np.ravel(run.x[0]), np.zeros(2)
    for _ in range(2):  # the second filter begins at alpha_2, which depends on the first
        beta = beta + 0.3 * np.array(rate(0.0, [*x, *beta])[3:])
    x0 = [*x, *beta]
    tolerances = {"rtol": 1e-11, "atol": 1e-12}
    return largest_difference(run, rate, x0=x0, every=200, method="LSODA", **tolerances)
