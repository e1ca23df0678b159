"""The peer of `constraints.py`: a nonlinear model-predictive law by CasADi and IPOPT for the
two-link arm, offline.

Multiple shooting over HORIZON periods, one Runge-Kutta step a period, the estimated uncertain term
held.  Positions, velocities and the tip's wall are kept by constraints with a dear slack, so that
there always is an answer; torques are free.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

PERIOD, HORIZON = 0.02, 15
"""s; periods."""
SLACK = 1e4
"""Price of a slack in the units of the cost."""
ROOM = (0.005, 0.03, 0.002)
"""What is kept from bounds of positions [rad] and velocities [rad/s] and from the wall [m], as
between the periods nothing is looked at."""


class Mpc:
    """The law: torque(q, q', f_hat, reference, lower, upper, speeds) of one period, warm-started by
    the last answer.
    """

    def __init__(self, robot, wall: float) -> None:
        """`robot`: a TwoLink of the package, whose numbers it takes; `wall`: largest x of the tip
        [m].
        """
        numbers = {
            name: np.asarray(getattr(robot, name), float)
            for name in ("mass", "length", "centre", "inertia", "g")
        }
        rate, tip = _arm(**numbers)
        n = HORIZON
        x, u, s = ca.SX.sym("x", 4, n + 1), ca.SX.sym("u", 2, n), ca.SX.sym("s", n)
        start, f = ca.SX.sym("start", 4), ca.SX.sym("f", 2)
        q_d, dq_d, lower, upper, slow, fast = (
            ca.SX.sym(name, 2, n + 1) for name in ("q_d", "dq_d", "lower", "upper", "slow", "fast")
        )
        cost, equal, kept = 0.0, [x[:, 0] - start], []
        for k in range(n):
            equal.append(x[:, k + 1] - _step(lambda y, k=k: rate(y, u[:, k] + f), x[:, k], PERIOD))
            e, de = x[:2, k + 1] - q_d[:, k + 1], x[2:, k + 1] - dq_d[:, k + 1]
            cost += (
                100 * ca.dot(e, e)
                + 0.1 * ca.dot(de, de)
                + 1e-4 * ca.dot(u[:, k], u[:, k])
                + SLACK * s[k]
            )
            q, dq = x[:2, k + 1], x[2:, k + 1]
            over = [
                lower[:, k + 1] - q + ROOM[0],
                q - upper[:, k + 1] + ROOM[0],
                tip(q)[0] - wall + ROOM[2],
            ]
            over += [slow[:, k + 1] - dq + ROOM[1], dq - fast[:, k + 1] + ROOM[1]]
            kept += [row - s[k] for row in over]
        unknown = ca.vertcat(ca.vec(x), ca.vec(u), s)
        parameters = ca.vertcat(start, f, *map(ca.vec, (q_d, dq_d, lower, upper, slow, fast)))
        g = ca.vertcat(*equal, *kept)
        quiet = {
            "print_time": False,
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "max_iter": 60,
                "warm_start_init_point": "yes",
                "mu_init": 1e-3,
            },
        }
        self.solve: Callable = ca.nlpsol(
            "mpc", "ipopt", {"x": unknown, "p": parameters, "f": cost, "g": g}, quiet
        )
        rows = int(sum(x.numel() for x in equal))
        self.limits = {
            "lbg": [0.0] * rows + [-np.inf] * (g.numel() - rows),
            "ubg": [0.0] * g.numel(),
        }
        self.limits |= {"lbx": [-np.inf] * (unknown.numel() - n) + [0.0] * n}
        self.guess: np.ndarray | None = None

    def torque(self, q, dq, f_hat, *ahead: np.ndarray) -> np.ndarray:
        """The torque [N m] of the next period; `ahead`: q_d, q_d', lower, upper and speeds,
        (HORIZON + 1, 2) each, from now on.
        """
        start = np.concatenate([q, dq])
        if self.guess is None:
            self.guess = np.concatenate([np.tile(start, HORIZON + 1), np.zeros(3 * HORIZON)])
        parameters = np.concatenate([start, f_hat, *(x.ravel() for x in ahead)])
        self.guess = np.asarray(self.solve(x0=self.guess, p=parameters, **self.limits)["x"]).ravel()
        return self.guess[4 * (HORIZON + 1) : 4 * (HORIZON + 1) + 2]


def _arm(mass, length, centre, inertia, g):
    """The rate of (q, q') under a torque, and the tip, as functions of CasADi's."""
    p1 = mass[0] * centre[0] ** 2 + mass[1] * length[0] ** 2 + inertia[0]
    p2, p3 = mass[1] * centre[1] ** 2 + inertia[1], mass[1] * length[0] * centre[1]
    p4, p5 = mass[0] * centre[0] + mass[1] * length[0], mass[1] * centre[1]

    def rate(x, tau):
        c, s, v = ca.cos(x[1]), p3 * ca.sin(x[1]), x[2:]
        a, b = p1 + p2 + 2 * p3 * c, p2 + p3 * c
        outer = p5 * g * ca.cos(x[0] + x[1])
        first = tau[0] + s * (2 * v[0] * v[1] + v[1] ** 2) - p4 * g * ca.cos(x[0]) - outer
        second = tau[1] - s * v[0] ** 2 - outer
        det = a * p2 - b * b
        return ca.vertcat(v, (p2 * first - b * second) / det, (a * second - b * first) / det)

    def tip(q):
        return ca.vertcat(
            *(length[0] * f(q[0]) + length[1] * f(q[0] + q[1]) for f in (ca.cos, ca.sin))
        )

    return rate, tip


def _step(rate, x, h):
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))
