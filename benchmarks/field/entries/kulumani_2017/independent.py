"""The loop with the rotation matrix as its state, by SciPy and without the package; its angles are
computed for the comparison only.
"""

from pathlib import Path

import numpy as np
from entry import execute
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

INERTIA = np.array(
    [
        [5.571050413e-3, 6.176577e-5, -2.502846e-5],
        [6.176577e-5, 5.57574605e-3, 1.00676e-5],
        [-2.502846e-5, 1.00676e-5, 1.050537595e-2],
    ]
)
WEIGHTS = np.diag([0.9, 1.0, 1.1])
CONES = (
    ((0.174, -0.934, -0.034), 40.0),
    ((0.4, 0.7071, 0.7071), 40.0),
    ((-0.853, 0.436, -0.286), 40.0),
    ((-0.122, -0.140, -0.983), 20.0),
)
SENSOR = np.array([1.0, 0.0, 0.0])


def hat(v):
    """The matrix of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rate(t, z):
    """The rates of R, of the angular velocity and of the estimate."""
    R, w, estimate = z[:9].reshape(3, 3), z[9:12], z[12:]
    attract = 0.5 * np.trace(WEIGHTS @ (np.eye(3) - R))
    skew = 0.5 * (WEIGHTS @ R - R.T @ WEIGHTS)
    avoid, push = 1.0, np.zeros(3)
    for axis, angle in CONES:
        v, cosine = np.array(axis) / np.linalg.norm(axis), np.cos(np.radians(angle))
        along = SENSOR @ R.T @ v
        avoid -= np.log((cosine - along) / (1.0 + cosine)) / 15.0
        push += hat(R.T @ v) @ SENSOR / (15.0 * (along - cosine))
    e = np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) * avoid + attract * push
    # The term w x J w of the law cancels that of the body.
    turn = np.linalg.solve(INERTIA, -0.4 * e - 0.296 * w - estimate + 0.2)
    return np.concatenate([(R @ hat(w)).ravel(), turn, 0.5 * (w + e)])


def compare() -> float:
    """The largest difference of the entries of R [1] and of the angular velocity [rad/s]."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    t, x = np.asarray(run.t), np.asarray(run.x)
    R = Rotation.from_euler("xyz", x[:, 0]).as_matrix()
    c, s = np.cos(np.radians(225.0)), np.sin(np.radians(225.0))
    start = np.concatenate([[c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0], np.zeros(6)])
    found = solve_ivp(rate, (0.0, t[-1]), start, "LSODA", t, rtol=1e-10, atol=1e-12).y.T
    of_R = np.abs(R - found[:, :9].reshape(-1, 3, 3)).max()
    of_velocity = np.abs(x[:, 1] - found[:, 9:12]).max()
    return float(max(of_R, of_velocity))
