"""The vehicle of this entry with all nine neurons of the program, without the package."""

from pathlib import Path

import numpy as np
from entry import execute
from scipy.integrate import solve_ivp

M = np.array([50.5, 84.36, 17.21])
B = np.array([[1 / 50.5, 1 / 50.5], [0.26 / 17.21, -0.26 / 17.21]])
TINY = 1e-12


def wrapped(angle):
    """The angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def part(e, width):
    """The printed expression of the guidance law."""
    z = np.pi * (e + TINY) ** 2 / (2 * width**2)
    return width**2 / (np.pi * (e + TINY)) * np.sin(z) * np.cos(z)


def desired(t, x, theta, heading):
    """The desired (u, r), theta' and the rate of the filtered heading."""
    u, v, _, north, east, psi = x
    U, beta, path = np.hypot(u, v), np.arctan2(v, u), np.pi / 2
    a, b, rate = 3 * np.exp(-0.05 * t) + 0.8, 3 * np.exp(-0.05 * t) + 0.5, -0.15 * np.exp(-0.05 * t)
    x_e, y_e, speed = east - theta, 10 - north, 0.3 - 0.5 * (theta - 1.5 - 0.3 * t)
    q, f = rate / b * np.hypot(0.3, v), part(y_e, b)
    gain = (q**2 * f * y_e + q * np.sqrt(5 * (1 - q**2 * y_e**2) + f**2)) / (1 - q**2 * y_e**2)
    u_c = speed - np.sqrt((rate / a) ** 2 + 2) * x_e - 2 * part(x_e, a)
    u_c += 2 * u * np.sin((psi - path) / 2) ** 2 + v * np.sin(psi - path)
    psi_c = path - beta - np.arctan2(f + gain * y_e, 5.0)
    turn = -wrapped(heading - psi_c) / 0.1
    z, g = wrapped(psi - psi_c) + TINY, psi_c - path + beta
    rho = (np.cos(g) * np.sin(z) + np.sin(g) * (np.cos(z) - 1)) / z
    push = y_e / np.cos(np.pi * y_e**2 / (2 * b**2)) ** 2 * U * rho
    return np.array([u_c, -5 * wrapped(psi - heading) + turn - push]), speed, turn


def rate(t, z):
    """The rates of the vehicle, theta, the filters, the auxiliary state and the weights."""
    x, theta, heading, filtered, extra, W = (
        z[:6],
        z[6],
        z[7],
        z[8:10],
        z[10:12],
        z[12:].reshape(9, 2),
    )
    wanted, speed, turn = desired(t, x, theta, heading)
    slope = (wanted - filtered) / 0.1
    u, v, r, _, _, psi = x
    phi = np.full(9, np.exp(-(u * u + v * v + r * r) / 4))
    e, A = np.array([u, r]) - wanted - extra, np.array([1.0, 0.5])
    T = np.linalg.solve(B, slope - A * extra - W.T @ phi - np.array([4.0, 2.0]) * e)
    smooth = np.where(T > 0, 113.6775 * np.tanh(T / 113.6775), 55 * np.tanh(T / 55))
    right, left = np.clip(T, -55.0, 113.6775)
    waves = np.sin(0.08 * t) * np.cos(0.15 * t), np.cos(0.08 * t) * np.sin(0.15 * t)
    du = M[1] * v * r - 151.57 * u + 5 * waves[0] + 5 + right + left
    dv = -M[0] * u * r - 132.5 * v + 3 * waves[1] + 3
    dr = (M[0] - M[1]) * u * v - 34.56 * r + 5 * waves[1] + 5 + 0.26 * (right - left)
    s, c = np.sin(psi), np.cos(psi)
    motion = [du / M[0], dv / M[1], dr / M[2], u * c - v * s, u * s + v * c, r, speed, turn]
    weights = phi[:, None] * e - 0.005 * W
    return np.concatenate([motion, slope, -A * extra - B @ (T - smooth), weights.ravel()])


def compare() -> float:
    """The largest difference of positions [m, rad] and speeds [m/s, rad/s] in the first 20 s."""
    run = next(iter(execute(Path(__file__).parent).runs.values()))
    early = np.asarray(run.t) <= 20.0
    t, own = np.asarray(run.t)[early], np.asarray(run.x)[early]
    x = np.array([0.1, 0.1, 0.1, 10.0, 0.0, -np.pi / 6])
    heading = x[5]
    for _ in range(3):  # the filter of the heading begins at its input, for which its rate is 0
        heading += 0.1 * desired(0.0, x, 0.1, heading)[2]
    start = np.concatenate([x, [0.1, heading], desired(0.0, x, 0.1, heading)[0], np.zeros(20)])
    found = solve_ivp(rate, (0.0, 20.0), start, "LSODA", t, rtol=1e-9, atol=1e-10, max_step=0.05).y
    ours = np.concatenate([own[:, 1], own[:, 0]], axis=1)
    return float(np.abs(ours - found[:6].T).max())
