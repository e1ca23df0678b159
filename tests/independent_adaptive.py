"""Adaptive laws in NumPy, written from the equations and from nothing of the package.

The two-link arm has torques that are linear in (m1, m2, payload), with the regressor written out by
hand; alpha' and the rates of all weights are derived by hand.  The bounds and the reference are
those of the paper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import solve_ivp
from scipy.stats import qmc

LENGTH, CENTRE, INERTIA, G = (0.35, 0.31), (0.175, 0.155), (0.06125, 0.02042125), 9.81


def two(x):
    return np.asarray(x, float) * np.ones(2)


@dataclass
class Tracking:
    """Reference, bounds and virtual velocity, kappa included."""

    k1: np.ndarray = field(default_factory=lambda: two(2.0))
    K2: np.ndarray = field(default_factory=lambda: two(20.0))
    o: float = 0.1

    def at(self, t, q, v):
        """alpha, alpha', e1, the bound k of its side."""
        s, c = math.sin(t), math.cos(t)
        xd = np.array([0.5 + 0.14 * s, 0.5 + 0.14 * c])
        dxd, ddxd = 0.14 * np.array([c, -s]), -0.14 * np.array([s, c])
        # both bounds are 0.14 (cos t, sin t) and a constant
        moving = 0.14 * np.array([c, s])
        dmoving, ddmoving = 0.14 * np.array([-s, c]), -moving
        kl, ku = xd - 0.2 - moving, 0.9 + moving - xd
        dkl, ddkl = dxd - dmoving, ddxd - ddmoving
        dku, ddku = -dkl, -ddkl
        e = q - xd
        a, b = dku / ku, dkl / kl
        kappa = np.sqrt(a * a + b * b + self.o)
        dkappa = (a * (ddku / ku - a * a) + b * (ddkl / kl - b * b)) / kappa
        alpha = dxd - (self.k1 + kappa) * e
        dalpha = ddxd - dkappa * e - (self.k1 + kappa) * (v - dxd)
        return alpha, dalpha, e, np.where(e > 0, ku, kl)


def regressor(q, v, u, a):
    """Y0 and Y, with M a + C(q, v) u + G = Y0 + Y (m1, m2, payload)."""
    (l1, l2), (c1, c2) = LENGTH, CENTRE
    cos2, sin2 = math.cos(q[1]), math.sin(q[1])
    g1, g12 = G * math.cos(q[0]), G * math.cos(q[0] + q[1])
    of_p1 = np.array([a[0], 0.0])
    of_p2 = np.array([a[0] + a[1], a[0] + a[1]])
    first = 2 * cos2 * a[0] + cos2 * a[1] - sin2 * (v[1] * u[0] + (v[0] + v[1]) * u[1])
    of_p3 = np.array([first, cos2 * a[0] + sin2 * v[0] * u[0]])
    of_p4, of_p5 = np.array([g1, 0.0]), np.array([g12, g12])
    P = np.stack([of_p1, of_p2, of_p3, of_p4, of_p5], axis=1)
    lumped = np.array(
        [
            [c1**2, l1**2, l1**2],
            [0.0, c2**2, l2**2],
            [0.0, l1 * c2, l1 * l2],
            [c1, l1, l1],
            [0.0, c2, l2],
        ]
    )
    Y0 = P @ np.array([INERTIA[0], INERTIA[1], 0.0, 0.0, 0.0])
    return Y0, P @ lumped


def acceleration(theta, q, v, tau):
    """q" of the arm with (m1, m2, payload) = theta under a torque."""
    zero = np.zeros(2)
    Y0, Y = regressor(q, v, v, zero)
    rest = tau - Y0 - Y @ theta
    columns = []
    for i in range(2):
        unit = np.eye(2)[i]
        B0, B = regressor(q, zero, zero, unit)
        N0, N = regressor(q, zero, zero, zero)
        columns.append(B0 + B @ theta - N0 - N @ theta)
    return np.linalg.solve(np.stack(columns, axis=1), rest)


def projected(theta, rate, lower, upper, band):
    room = np.where(rate > 0, upper - theta, theta - lower) / band
    return rate * np.minimum(np.maximum(room, 0.0), 1.0)


@dataclass
class AdaptiveArm(Tracking):
    """Integral barrier, adapting (m1, m2, payload)."""

    true: np.ndarray = None
    start: np.ndarray = None
    Gamma: np.ndarray = None
    sigma: np.ndarray = None
    lower: np.ndarray = None
    upper: np.ndarray = None
    band: np.ndarray = None

    def rate(self, t, x):
        q, v, theta = x[:2], x[2:4], x[4:]
        alpha, dalpha, e, k = self.at(t, q, v)
        Y0, Y = regressor(q, v, alpha, dalpha)
        e2 = v - alpha
        tau = Y0 + Y @ theta - self.K2 * e2 - 2 * e / (k**2 - e**2)
        push = -self.Gamma * (Y.T @ e2 + self.sigma * (theta - self.start))
        dtheta = projected(theta, push, self.lower, self.upper, self.band)
        return np.concatenate([v, acceleration(self.true, q, v, tau), dtheta])


@dataclass
class Approximator(Tracking):
    """Logarithmic barrier; spans of the inputs 0.5, 1, 3 around 0.5."""

    mass: np.ndarray = None
    Gamma: np.ndarray = None
    sigma: np.ndarray = None

    def inputs(self, q, v, alpha, dalpha):
        return np.concatenate([(q - 0.5) / 0.5, v, alpha, dalpha / 3.0])

    def parts(self, t, x):
        q, v = x[:2], x[2:4]
        alpha, dalpha, e, k = self.at(t, q, v)
        e2 = v - alpha
        return q, v, e2, -self.K2 * e2 - e / (k**2 - e**2), self.inputs(q, v, alpha, dalpha)


def sobol(count, dimensions):
    order = math.ceil(math.log2(count))
    points = qmc.Sobol(dimensions, scramble=False).random_base2(order)[:count]
    return 2 * (points + 0.5**order / 2) - 1


@dataclass
class Fuzzy(Approximator):
    """Rules with Gaussian membership of every input, product inference, weighted mean."""

    nodes: int = 5
    width: float = 2.0

    def rate(self, t, x):
        q, v, e2, tau, z = self.parts(t, x)
        W = x[4:].reshape(self.nodes, 2)
        fired = np.array(
            [
                math.prod(
                    math.exp(-(((a - b) / self.width) ** 2)) for a, b in zip(z, c, strict=True)
                )
                for c in sobol(self.nodes, 8)
            ]
        )
        share = fired / sum(fired)
        dW = np.array([[-self.Gamma[i] * (s * e2[i] + self.sigma[i] * w[i]) for i in range(2)]
                       for s, w in zip(share, W, strict=True)])  # fmt: skip
        return np.concatenate([v, acceleration(self.mass, q, v, tau + share @ W), dW.ravel()])


@dataclass
class HiddenLayer(Approximator):
    """tanh nodes, both layers adapt; x holds W row by row, then V row by row."""

    nodes: int = 3
    Gamma_h: float = 0.7
    sigma_h: float = 0.2

    def rate(self, t, x):
        q, v, e2, tau, z = self.parts(t, x)
        z = np.append(z, 1.0)
        W = x[4 : 4 + 2 * self.nodes].reshape(self.nodes, 2)
        V = x[4 + 2 * self.nodes :].reshape(9, self.nodes)
        V0 = sobol(self.nodes, 9).T
        y = V.T @ z
        phi = np.tanh(y)
        D = np.diag(1 / np.cosh(y) ** 2)
        dW = -(np.outer(phi - D @ y, e2) + W * self.sigma) * self.Gamma
        dV = -self.Gamma_h * (np.outer(z, D @ W @ e2) + self.sigma_h * (V - V0))
        acceleration_ = acceleration(self.mass, q, v, tau + W.T @ phi)
        return np.concatenate([v, acceleration_, dW.ravel(), dV.ravel()])


@dataclass
class AdaptivePendulum:
    """x1' = x2, D x2' = x3 - B x2 - N sin x1, M x3' = u - H x3 - Km x2, quadratic barriers, and H
    and Km that adapt; the reference is sin(1.5 t)."""

    D: float
    B: float
    N: float
    M: float
    H: float
    Km: float
    k: np.ndarray
    w: np.ndarray
    start: np.ndarray
    Gamma: np.ndarray
    sigma: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    band: np.ndarray

    def rate(self, t, x):
        x1, x2, x3 = x[:3]
        theta = x[3:]
        (k1, k2, k3), (w1, w2, w3) = self.k, self.w
        s, c = math.sin(1.5 * t), math.cos(1.5 * t)
        xd, dxd, ddxd, dddxd = s, 1.5 * c, -2.25 * s, -3.375 * c
        dx2 = (x3 - self.B * x2 - self.N * math.sin(x1)) / self.D
        e1 = x1 - xd
        alpha1 = dxd - k1 * e1
        dalpha1 = ddxd - k1 * (x2 - dxd)
        ddalpha1 = dddxd - k1 * (dx2 - ddxd)
        e2 = x2 - alpha1
        pull = dalpha1 - k2 * e2 - w1 / w2 * e1
        dpull = ddalpha1 - k2 * (dx2 - dalpha1) - w1 / w2 * (x2 - dxd)
        alpha2 = self.D * pull + self.B * x2 + self.N * math.sin(x1)
        dalpha2 = self.D * dpull + self.B * dx2 + self.N * math.cos(x1) * x2
        e3 = x3 - alpha2
        wanted = dalpha2 - k3 * e3 - w2 / w3 * e2 / self.D
        u = self.M * wanted + theta[0] * x3 + theta[1] * x2
        push = -self.Gamma * (
            np.array([x3, x2]) * w3 * e3 / self.M + self.sigma * (theta - self.start)
        )
        dtheta = projected(theta, push, self.lower, self.upper, self.band)
        dx3 = (u - self.H * x3 - self.Km * x2) / self.M
        return np.concatenate([[x2, dx2, dx3], dtheta])


def end(program, x, duration):
    """The state at the end of a run, by DOP853."""
    found = solve_ivp(program.rate, (0.0, duration), x, "DOP853", rtol=1e-12, atol=1e-13)
    return found.y[:, -1]
