"""Position, velocity, acceleration and torque of a log at chosen times, by polynomials through the
samples around them.

    q(t_c + s) ~ sum_i a_i s^i, i <= 3, least squares over |s| <= half, weight (1 - (s / half)^2)^2;
    tau likewise, i <= 1

A torque that is held from t_k on stands for the middle of its step.  Times need not be regular.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iblf_jax.identification.log import Log

HALF = 0.05
"""[s]; at 500 Hz an acceleration is then known to 500 1/s^2 times the noise of a position, and a
motion of 2 Hz to a hundredth."""
LEAST = 7
"""Samples in a polynomial."""
NODES = 1500
"""Times at which a log is looked at, at most."""


class Smoothed(NamedTuple):
    """P times of all logs."""

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    dtau: np.ndarray
    noise: np.ndarray
    """Standard deviation of what the polynomials leave of the positions, (n,)."""
    measured: np.ndarray
    """q' as logged, (P, n); NaN where it was not."""


def around(
    log: Log, stretch: slice, centre: float, held: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients of the positions (4, n) and of the torques (2, n) at a time, and the residuals
    of the positions (m, n).
    """
    t = log.t[stretch]
    half = max(HALF, 0.5 * LEAST * log.step)
    first, last = np.searchsorted(t, [centre - half, centre + half])
    first, last = min(first, max(len(t) - LEAST, 0)), max(last, LEAST)
    s = t[first:last] - centre
    reach = max(half, 1.01 * float(np.max(np.abs(s))))
    weight = (1.0 - (s / reach) ** 2)[:, None]
    powers = s[:, None] ** np.arange(4)
    q, tau = log.q[stretch][first:last], log.tau[stretch][first:last]
    size = half ** np.arange(4)
    a = np.linalg.lstsq(weight * powers / size, weight * q, rcond=None)[0] / size[:, None]
    shifted = s + (0.5 * log.step if held else 0.0)
    b = np.linalg.lstsq(weight * shifted[:, None] ** np.arange(2), weight * tau, rcond=None)[0]
    return a, b, q - powers @ a


def smoothed(logs: list[Log], held: bool) -> Smoothed:
    """The motion at some times of all logs."""
    spacing = max(sum(log.t[-1] - log.t[0] for log in logs) / NODES, logs[0].step)
    rows, left = [], []
    for log in logs:
        for stretch in log.stretches:
            t = log.t[stretch]
            if len(t) < 2 * LEAST:
                continue
            for centre in np.arange(t[0] + HALF, t[-1] - HALF, spacing):
                a, b, rest = around(log, stretch, centre, held)
                near = int(np.argmin(np.abs(t - centre)))
                dq = np.full(a.shape[1], np.nan) if log.dq is None else log.dq[stretch][near]
                rows.append((np.full(1, centre), a[0], a[1], 2.0 * a[2], b[0], b[1], dq))
                left.append(np.mean(rest**2, axis=0) * len(rest) / max(len(rest) - 4, 1))
    t, q, dq, ddq, tau, dtau, measured = (np.array(column) for column in zip(*rows, strict=True))
    return Smoothed(t[:, 0], q, dq, ddq, tau, dtau, np.sqrt(np.median(left, axis=0)), measured)
