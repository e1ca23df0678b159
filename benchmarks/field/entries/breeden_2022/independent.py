"""The start of this entry with the published rows of the programme, without the package."""

import itertools
from pathlib import Path

import numpy as np
from entry import execute, largest_difference

n = np.sqrt(398600e9 / 6778e3**3)
A0 = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [3 * n**2, 0, 0, 2 * n], [0, 0, -2 * n, 0]])
DOCK, SIDE = 0.082 - 20 * n - 0.002, 0.082 - 20 * n - 3e4 * n**2
DELTA = 0.12**2 / 2
WIDTHS = np.array([(DELTA - 0.072**2 / 2) / DOCK / 2, *[0.05] * 4, 0.005, 0.005])


def rows(x):
    """H and its slope in x, (7,) and (7, 4)."""

    def distance(h, slope, a, delta=0.0):
        fast = np.array([*slope[2:], *slope[:2]]) @ x + 0.001
        H = h + fast * abs(fast) / (2 * a) - delta / a
        return H, np.array([*slope[:2], *np.array(slope[:2]) * abs(fast) / a])

    pairs = [distance(x[1], (0, 1, 0, 0), DOCK, DELTA)]
    pairs += [(s * x[k] - 10.0, s * np.eye(4)[k]) for k, s in ((2, 1), (2, -1), (3, 1), (3, -1))]
    pairs += [distance(s * x[0] - 0.03, (s, 0, 0, 0), SIDE) for s in (1, -1)]
    return np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs])


def nearest(u, A, b):
    """The point nearest to u with A x <= b, among u, its projections on lines, and corners."""
    candidates = [u]
    for a, limit in zip(A, b, strict=True):
        if a @ a > 1e-14:
            candidates.append(u - a * (a @ u - limit) / (a @ a))
    for i, j in itertools.combinations(range(len(b)), 2):
        if abs(np.linalg.det(A[[i, j]])) > 1e-12:
            candidates.append(np.linalg.solve(A[[i, j]], b[[i, j]]))
    allowed = [c for c in candidates if np.all(A @ c <= b + 1e-9)]
    if not allowed:  # in a trial step of the solver, which it then repeats
        return np.clip(u, -0.082, 0.082)
    return min(allowed, key=lambda c: np.sum((c - u) ** 2))


def rate(t, x):
    """The relative motion under the published law, without disturbances."""
    H, slope = rows(x)
    G = slope[:, 2:]
    worst = np.linalg.norm(G, axis=1) * 0.002 + np.linalg.norm(slope[:, :2], axis=1) * 0.001
    b = worst * (-H / WIDTHS - 1.0) - slope @ A0 @ x
    count = 7 if H[5] <= 0 and H[6] <= 0 else 6
    wanted = b[0] * G[0] / (G[0] @ G[0]) + np.array([-0.1 * x[0], 0.0])
    A = np.concatenate([G[:count], np.eye(2), -np.eye(2)])
    u = nearest(wanted, A, np.concatenate([b[:count], np.full(4, 0.082)]))
    return A0 @ x + np.concatenate([np.zeros(2), u])


def compare() -> float:
    """The largest difference of positions [m] and speeds [m/s] in the first 60 s."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    return largest_difference(
        run, rate, end=60.0, method="RK45", max_step=0.1, rtol=1e-8, atol=1e-9
    )
