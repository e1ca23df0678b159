"""Adaptive laws in NumPy, written from the equations and from nothing of the package.

The two-link arm has torques that are linear in (m1, m2, payload), with the regressor written out by
hand, and so are the rates of all weights.  Bounds, reference and alpha are those of
`independent.Loop`.
"""

import math
from dataclasses import dataclass

import numpy as np
from independent import Loop
from scipy.stats import qmc

LENGTH, CENTRE, INERTIA, G = (0.35, 0.31), (0.175, 0.155), (0.06125, 0.02042125), 9.81


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
    of_m1, of_m2 = [c1**2, 0.0, 0.0, c1, 0.0], [l1**2, c2**2, l1 * c2, l1, c2]
    of_payload = [l1**2, l2**2, l1 * l2, l1, l2]
    lumped = np.stack([of_m1, of_m2, of_payload], axis=1)
    Y0 = P @ np.array([INERTIA[0], INERTIA[1], 0.0, 0.0, 0.0])
    return Y0, P @ lumped


def acceleration(theta, q, v, tau):
    """q" of the arm with (m1, m2, payload) = theta under a torque."""

    def torque(u, a):
        Y0, Y = regressor(q, v, u, a)
        return Y0 + Y @ theta

    zero = np.zeros(2)
    rest = torque(zero, zero)
    M = np.stack([torque(zero, unit) - rest for unit in np.eye(2)], axis=1)
    return np.linalg.solve(M, tau - torque(v, zero))


@dataclass(kw_only=True)
class Adapted:
    """Numbers that adapt between limits, with a leak to their start."""

    start: np.ndarray
    Gamma: np.ndarray
    sigma: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    band: np.ndarray

    def adaptation(self, theta, learned):
        rate = -self.Gamma * (learned + self.sigma * (theta - self.start))
        room = np.where(rate > 0, self.upper - theta, theta - self.lower) / self.band
        return rate * np.minimum(np.maximum(room, 0.0), 1.0)


@dataclass(kw_only=True)
class AdaptiveArm(Adapted):
    """Integral barrier, adapting (m1, m2, payload)."""

    loop: Loop
    true: np.ndarray

    def rate(self, t, x):
        q, v, theta = x[:2], x[2:4], x[4:]
        e, k, alpha, dalpha = self.loop.virtual(t, q, v)
        Y0, Y = regressor(q, v, alpha, dalpha)
        e2 = v - alpha
        tau = Y0 + Y @ theta - self.loop.K2 * e2 - 2 * e / (k**2 - e**2)
        dtheta = self.adaptation(theta, Y.T @ e2)
        return np.concatenate([v, acceleration(self.true, q, v, tau), dtheta])


@dataclass
class Approximator(Loop):
    """Logarithmic barrier; spans of the inputs 0.5, 1, 3 around 0.5."""

    mass: np.ndarray = None
    Gamma: np.ndarray = None
    sigma: np.ndarray = None

    def inputs(self, q, v, alpha, dalpha):
        return np.concatenate([(q - 0.5) / 0.5, v, alpha, dalpha / 3.0])

    def parts(self, t, x):
        q, v = x[:2], x[2:4]
        e, k, alpha, dalpha = self.virtual(t, q, v)
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
        distances = (z - sobol(self.nodes, 8)) / self.width
        fired = np.prod(np.exp(-(distances**2)), axis=1)
        share = fired / np.sum(fired)
        dW = -self.Gamma * (np.outer(share, e2) + self.sigma * W)
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


@dataclass(kw_only=True)
class AdaptivePendulum(Adapted):
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
        dtheta = self.adaptation(theta, np.array([x3, x2]) * w3 * e3 / self.M)
        dx3 = (u - self.H * x3 - self.Km * x2) / self.M
        return np.concatenate([[x2, dx2, dx3], dtheta])
