"""Position, velocity, acceleration and torque of a log, by local polynomials.

    q(t_c + s) ~ sum_i a_i s^i, i <= 3, least squares over |s| <= half,
    weight (1 - (s / half)^2)^2;  tau likewise, i <= 1

A torque that is constant from t_k on is assigned to the middle of its step.  Times need not be
regular.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iblf_jax.identification.log import Log

HALF_WIDTH = 0.05
"""[s]; at 500 Hz the standard deviation of an acceleration is then 500 1/s^2 times that of a
position, and a motion of 2 Hz is accurate to 1 %."""
MIN_SAMPLES = 7
"""Samples of a polynomial, at least."""
MAX_TIMES = 1500
"""Times at which a log is evaluated, at most."""


class SmoothedMotion(NamedTuple):
    """The motion and the torque at P times of all logs."""

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    dtau: np.ndarray
    noise: np.ndarray
    """Standard deviation of the positions about the polynomials, (n,)."""
    measured: np.ndarray
    """q' as logged, (P, n); NaN without logged velocities."""


def local_polynomial(
    log: Log, segment: slice, centre: float, hold: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients of the positions (4, n) and of the torques (2, n) at a time, and the residuals
    of the positions (m, n).
    """
    t = log.t[segment]
    half = max(HALF_WIDTH, 0.5 * MIN_SAMPLES * log.step)
    first, last = np.searchsorted(t, [centre - half, centre + half])
    first, last = min(first, max(len(t) - MIN_SAMPLES, 0)), max(last, MIN_SAMPLES)
    s = t[first:last] - centre
    reach = max(half, 1.01 * float(np.max(np.abs(s))))
    weight = (1.0 - (s / reach) ** 2)[:, None]
    powers = s[:, None] ** np.arange(4)
    q, tau = log.q[segment][first:last], log.tau[segment][first:last]
    size = half ** np.arange(4)
    a = np.linalg.lstsq(weight * powers / size, weight * q, rcond=None)[0] / size[:, None]
    shifted = s + (0.5 * log.step if hold else 0.0)
    b = np.linalg.lstsq(weight * shifted[:, None] ** np.arange(2), weight * tau, rcond=None)[0]
    return a, b, q - powers @ a


def smooth_logs(logs: list[Log], hold: bool) -> SmoothedMotion:
    """The motion at some times of all logs."""
    spacing = max(sum(log.t[-1] - log.t[0] for log in logs) / MAX_TIMES, logs[0].step)
    rows, variances = [], []
    for log in logs:
        for segment in log.segments:
            t = log.t[segment]
            if len(t) < 2 * MIN_SAMPLES:
                continue
            for centre in np.arange(t[0] + HALF_WIDTH, t[-1] - HALF_WIDTH, spacing):
                a, b, residuals = local_polynomial(log, segment, centre, hold)
                near = int(np.argmin(np.abs(t - centre)))
                dq = np.full(a.shape[1], np.nan) if log.dq is None else log.dq[segment][near]
                rows.append((np.full(1, centre), a[0], a[1], 2.0 * a[2], b[0], b[1], dq))
                freedom = max(len(residuals) - 4, 1)
                variances.append(np.mean(residuals**2, axis=0) * len(residuals) / freedom)
    t, q, dq, ddq, tau, dtau, measured = (np.array(column) for column in zip(*rows, strict=True))
    return SmoothedMotion(
        t[:, 0], q, dq, ddq, tau, dtau, np.sqrt(np.median(variances, axis=0)), measured
    )
