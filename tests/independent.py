"""The paper's closed loop in NumPy, written from the equations and from nothing of the package: a
second opinion.

Two-link arm, sinusoidal reference and bounds, the disturbance (4.3), the law (3.14) with either
barrier and either variant, its observer.  alpha' is derived by hand here, and by automatic
differentiation there.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

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

    def evaluate(self, t, x, since=None):
        """The rate of (q, q', eta), and what the package records.

        Of the steps, those count that have appeared at the time `since`; t if not given.
        """
        q, v, eta = x[:2], x[2:4], x[4:]
        M, C, G, dM_dq2 = self.arm(q)
        xd, dxd, ddxd = sine(*self.reference)(t)
        lo, dlo, ddlo = sine(*self.lower)(t)
        up, dup, ddup = sine(*self.upper)(t)
        kl, dkl, ddkl, ku, dku, ddku = (
            xd - lo,
            dxd - dlo,
            ddxd - ddlo,
            up - xd,
            dup - dxd,
            ddup - ddxd,
        )
        e1 = q - xd
        ru, rl = dku / ku, dkl / kl
        kappa = np.sqrt(ru**2 + rl**2 + self.o)
        dkappa = (ru * (ddku / ku - ru**2) + rl * (ddkl / kl - rl**2)) / kappa
        gain = self.k1 + kappa
        alpha, dalpha = dxd - gain * e1, ddxd - dkappa * e1 - gain * (v - dxd)
        k = np.where(e1 > 0, ku, kl)
        xi = e1 / k
        if self.p is None:
            slope, V1 = 2 * e1 / (k**2 - e1**2), -np.log(1 - xi**2)
        else:
            m = 2 * self.p
            slope, V1 = e1 ** (m - 1) / (k**m - e1**m), -np.log(1 - xi**m) / m
        e2 = v - alpha
        f_hat = eta + self.kf * (M @ v)
        tau = (
            C(v) @ (alpha if self.corrected else v) + G + M @ dalpha - f_hat - self.K2 * e2 - slope
        )
        f = M @ sine(*self.force_a)(t)[0] + C(v) @ sine(*self.force_b)(t)[0]
        f = f + sum(
            (
                np.asarray(size)
                for time, size in self.steps
                if time <= (t if since is None else since)
            ),
            np.zeros(2),
        )
        ddq = np.linalg.solve(M, tau + f - C(v) @ v - G)
        known = (
            tau - C(v) @ v - G + self.kf * (M @ v) + (dM_dq2 * v[1] @ v if self.corrected else 0.0)
        )
        deta = -self.kf * eta - self.kf * known
        V = V1.sum() + 0.5 * e2 @ M @ e2 + 0.5 * (f - f_hat) @ (f - f_hat)
        return np.concatenate([v, ddq, deta]), {
            "tau": tau,
            "e1": e1,
            "e2": e2,
            "xi": xi,
            "V": V,
            "f": f,
            "f_hat": f_hat,
            "alpha": alpha,
        }

    def solve(self, times, rtol=1e-11):
        """The run at these times, by DOP853: name -> (T, ...)."""
        x0 = np.concatenate([self.q0, self.dq0, np.zeros(2)])
        span = (0.0, float(times[-1]))
        solution = solve_ivp(
            lambda t, x: self.evaluate(t, x)[0],
            span,
            x0,
            "DOP853",
            t_eval=times,
            rtol=rtol,
            atol=0.01 * rtol,
        )
        outputs = [self.evaluate(t, x)[1] for t, x in zip(times, solution.y.T, strict=True)]
        return {
            "q": solution.y[:2].T,
            "dq": solution.y[2:4].T,
            **{k: np.array([o[k] for o in outputs]) for k in outputs[0]},
        }

    def end(self, duration, rtol=1e-12):
        """The state at the end of a run whose integration is split where a step appears."""
        x = np.concatenate([self.q0, self.dq0, np.zeros(2)])
        cuts = [0.0, *sorted({time for time, _ in self.steps if 0.0 < time < duration}), duration]
        for a, b in itertools.pairwise(cuts):
            found = solve_ivp(
                lambda t, x, a=a: self.evaluate(t, x, since=a)[0],
                (a, b),
                x,
                "DOP853",
                rtol=rtol,
                atol=0.01 * rtol,
            )
            x = found.y[:, -1]
        return x
