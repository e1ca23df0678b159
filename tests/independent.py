"""The paper's closed loop in NumPy, written from the equations and from nothing of the package: a
second opinion.

Two-link arm, sinusoidal reference and bounds, the disturbance (4.3), the law (3.14) with either
barrier and either variant, its observer.  alpha' is derived by hand here, and by automatic
differentiation there.  Programs of other laws take the arm, the bounds and alpha from here.
"""

import itertools
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp


def sine(offset, amplitude, frequency, phase):
    """A sinusoid with its first and second rate, t -> (3, n)."""
    offset, amplitude, frequency, phase = (
        np.asarray(x, float) * np.ones(2) for x in (offset, amplitude, frequency, phase)
    )

    def at(t):
        s, c = np.sin(frequency * t + phase), np.cos(frequency * t + phase)
        return offset + amplitude * s, amplitude * frequency * c, -amplitude * frequency**2 * s

    return at


class Virtual(NamedTuple):
    """e1, its bound k on the side that it is on, alpha and alpha'."""

    e1: np.ndarray
    k: np.ndarray
    alpha: np.ndarray
    dalpha: np.ndarray


@dataclass
class Loop:
    """Numbers of one closed loop; the defaults are the paper's."""

    mass: tuple = (2.0, 0.85)
    length: tuple = (0.35, 0.31)
    centre: tuple = (0.175, 0.155)
    inertia: tuple = (0.06125, 0.02042125)
    g: float = 9.81
    k1: np.ndarray = field(default_factory=lambda: np.full(2, 2.0))
    o: np.ndarray = field(default_factory=lambda: np.full(2, 0.1))
    K2: np.ndarray = field(default_factory=lambda: np.full(2, 20.0))
    kf: np.ndarray = field(default_factory=lambda: np.full(2, 20.0))
    p: int | None = None
    """Exponent of the logarithmic barrier; None for the integral one."""
    corrected: bool = False
    q0: tuple = (0.8, 0.8)
    dq0: tuple = (0.0, 0.0)
    reference: tuple = (0.5, 0.14, 1.0, (0.0, np.pi / 2))
    lower: tuple = (0.2, 0.14, 1.0, (np.pi / 2, 0.0))
    upper: tuple = (0.9, 0.14, 1.0, (np.pi / 2, 0.0))
    force_a: tuple = (0.0, 0.3, 1.0, (0.0, np.pi / 2))
    force_b: tuple = (0.0, 0.3, 0.5, (np.pi / 2, 0.0))
    steps: tuple = ()
    """Torques that appear at a time: pairs of time and size."""

    def arm(self, q):
        """M, the function (v, u) -> C(q, v) u, and G."""
        (m1, m2), (l1, _), (c1, c2), (i1, i2) = self.mass, self.length, self.centre, self.inertia
        p1, p2, p3 = m1 * c1**2 + m2 * l1**2 + i1, m2 * c2**2 + i2, m2 * l1 * c2
        cos2, sin2 = np.cos(q[1]), np.sin(q[1])
        M = np.array([[p1 + p2 + 2 * p3 * cos2, p2 + p3 * cos2], [p2 + p3 * cos2, p2]])

        def C(v):
            return p3 * sin2 * np.array([[-v[1], -(v[0] + v[1])], [v[0], 0.0]])

        outer = m2 * c2 * self.g * np.cos(q[0] + q[1])
        G = np.array([(m1 * c1 + m2 * l1) * self.g * np.cos(q[0]) + outer, outer])
        dM = -p3 * sin2 * np.array([[2.0, 1.0], [1.0, 0.0]])
        return M, C, G, dM

    def inverse_dynamics(self, q, v, acceleration):
        """M q" + C v + G."""
        M, C, G, _ = self.arm(q)
        return M @ acceleration + C(v) @ v + G

    def acceleration(self, q, v, tau):
        """q" under a torque."""
        M, C, G, _ = self.arm(q)
        return np.linalg.solve(M, tau - C(v) @ v - G)

    def disturbance(self, t, q, v):
        """(4.3), which the law does not know."""
        M, C, _, _ = self.arm(q)
        return M @ sine(*self.force_a)(t)[0] + C(v) @ sine(*self.force_b)(t)[0]

    def virtual(self, t, q, v) -> Virtual:
        """The virtual velocity of the paper's barriers, kappa included."""
        (xd, dxd, ddxd), (lo, dlo, ddlo), (up, dup, ddup) = (
            sine(*x)(t) for x in (self.reference, self.lower, self.upper)
        )
        kl, dkl, ddkl = xd - lo, dxd - dlo, ddxd - ddlo
        ku, dku, ddku = up - xd, dup - dxd, ddup - ddxd
        e1, ru, rl = q - xd, dku / ku, dkl / kl
        kappa = np.sqrt(ru**2 + rl**2 + self.o)
        dkappa = (ru * (ddku / ku - ru**2) + rl * (ddkl / kl - rl**2)) / kappa
        gain = self.k1 + kappa
        dalpha = ddxd - dkappa * e1 - gain * (v - dxd)
        return Virtual(e1, np.where(e1 > 0, ku, kl), dxd - gain * e1, dalpha)

    def evaluate(self, t, x, since=None):
        """The rate of (q, q', eta), and what the package records.

        Of the steps, those count that have appeared at the time `since`; t if not given.
        """
        q, v, eta = x[:2], x[2:4], x[4:]
        M, C, G, dM_dq2 = self.arm(q)
        e1, k, alpha, dalpha = self.virtual(t, q, v)
        xi = e1 / k
        if self.p is None:
            slope, V1 = 2 * e1 / (k**2 - e1**2), -np.log(1 - xi**2)
        else:
            m = 2 * self.p
            slope, V1 = e1 ** (m - 1) / (k**m - e1**m), -np.log(1 - xi**m) / m
        e2 = v - alpha
        f_hat = eta + self.kf * (M @ v)
        moving = alpha if self.corrected else v
        tau = C(v) @ moving + G + M @ dalpha - f_hat - self.K2 * e2 - slope
        appeared = t if since is None else since
        f = self.disturbance(t, q, v)
        f = f + sum((np.asarray(x) for time, x in self.steps if time <= appeared), np.zeros(2))
        ddq = self.acceleration(q, v, tau + f)
        rate = dM_dq2 * v[1] @ v if self.corrected else 0.0
        known = tau - C(v) @ v - G + self.kf * (M @ v) + rate
        deta = -self.kf * eta - self.kf * known
        V = V1.sum() + 0.5 * e2 @ M @ e2 + 0.5 * (f - f_hat) @ (f - f_hat)
        recorded = {"tau": tau, "e1": e1, "e2": e2, "xi": xi, "V": V, "f": f}
        return np.concatenate([v, ddq, deta]), recorded | {"f_hat": f_hat, "alpha": alpha}

    def solve(self, times, rtol=1e-11):
        """The run at these times, by DOP853: name -> (T, ...)."""
        start = np.concatenate([self.q0, self.dq0, np.zeros(2)])
        how = {"method": "DOP853", "t_eval": times, "rtol": rtol, "atol": 0.01 * rtol}
        span = (0.0, float(times[-1]))
        y = solve_ivp(lambda t, x: self.evaluate(t, x)[0], span, start, **how).y
        outputs = [self.evaluate(t, x)[1] for t, x in zip(times, y.T, strict=True)]
        found = {name: np.array([x[name] for x in outputs]) for name in outputs[0]}
        return {"q": y[:2].T, "dq": y[2:4].T, **found}

    def end(self, duration, rtol=1e-12):
        """The state at the end of a run whose integration is split where a step appears."""
        x = np.concatenate([self.q0, self.dq0, np.zeros(2)])
        cuts = [0.0, *sorted({time for time, _ in self.steps if 0.0 < time < duration}), duration]
        for a, b in itertools.pairwise(cuts):
            how = {"method": "DOP853", "rtol": rtol, "atol": 0.01 * rtol}
            x = solve_ivp(lambda t, x, a=a: self.evaluate(t, x, since=a)[0], (a, b), x, **how)
            x = x.y[:, -1]
        return x
