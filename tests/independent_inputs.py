"""Loops with a limited input and an auxiliary state, and loops with an event trigger, without JAX
and without the package: a second opinion.

`limited_arm` is the paper's arm under the corrected law with the auxiliary state lambda,

    lambda' = -k lambda + M^-1 (sat(tau) - tau),   z = q' - alpha - lambda,
    tau = C (alpha + lambda) + G + M (alpha' - k lambda) - f_hat - K2 z - s,

and `limited_chain` a plant of any order r, whose last level has z = x_r - alpha_{r-1} - lambda and
x_r - lambda in the place of x_r in its tube.  `triggered_chain` holds the input of the law until it
differs by more than delta |u_held| + m from it.
"""

from __future__ import annotations

import itertools

import independent_chains as chains
import numpy as np
from independent import Loop
from scipy.integrate import solve_ivp


def limited_arm(loop: Loop, limit, k, t, y):
    """The rate of y = (q, q', eta, lambda), and the torque and V2 there."""
    q, v, eta, aux = np.split(np.asarray(y, float), 4)
    M, C, G, dM_dq2 = loop.arm(q)
    e1, side, alpha, dalpha = loop.virtual(t, q, v)
    centre, centre_rate = alpha + aux, dalpha - k * aux
    z = v - centre
    slope = 2 * e1 / (side**2 - e1**2)
    f_hat = eta + loop.kf * (M @ v)
    tau = C(v) @ centre + G + M @ centre_rate - f_hat - loop.K2 * z - slope
    applied = np.minimum(np.maximum(tau, -limit), limit)
    f, inverse = loop.disturbance(t, q, v), np.linalg.inv(M)
    ddq = inverse @ (applied + f - C(v) @ v - G)
    dM = dM_dq2 * v[1]
    deta = -loop.kf * (f_hat + applied - C(v) @ v - G + dM @ v)
    daux = -k * aux + inverse @ (applied - tau)
    V1 = -np.log(1 - (e1 / side) ** 2)
    V = V1.sum() + 0.5 * z @ M @ z + 0.5 * (f - f_hat) @ (f - f_hat)
    return np.concatenate([v, ddq, deta, daux]), {"tau": applied, "V": V}


def limited_chain(case, limit, k, t, x, d_hat, aux):
    """The input, its limited value, and lambda' of a chain; rows of x are the levels."""
    shift = ([float(a) for a in aux], [-k * float(a) for a in aux])
    control = chains.law(case, t, x, d_hat, shift=shift)
    u = np.array(control.alpha[-1], float)
    applied = np.clip(u, -limit, limit)
    gain = np.array(case.gain(case.order - 1, t, x), float)
    return u, applied, -k * np.asarray(aux) + gain @ (applied - u), control


def fires(u, held, delta, m):
    """Whether a command is sent: one component is beyond its threshold."""
    return bool(np.any(np.abs(u - held) > delta * np.abs(held) + m))


def compensated(z, v, delta, m_bar, epsilon):
    """The command of Xing et al. 2017 for the input v, component by component."""
    first = v * np.tanh(z * v / epsilon)
    second = m_bar * np.tanh(z * m_bar / epsilon)
    return -(1.0 + delta) * (first + second)


def triggered_chain(case, period, delta, m, count, adjust=None):
    """`count` periods of a chain without an estimate under the event trigger.

    Args:
      case: an `independent_chains.Case`.
      period: between two checks [s].
      delta, m: of the trigger.
      count: number of periods.
      adjust: function of the input and of G_r^T w_r s_r that changes the command.

    Returns:
      States at the checks, (count + 1, r, n); commands held, (count, n); numbers of the checks at
      which one was sent.
    """
    nothing = [[0.0] * case.n for _ in range(case.order)]
    x, held, sent = [list(row) for row in case.x0], None, []
    states, commands = [np.array(x, float)], []
    for index in range(count):
        t = index * period
        control = chains.law(case, t, x, nothing)
        u = np.array(control.alpha[-1], float)
        if adjust is not None:
            gain = np.array(case.gain(case.order - 1, t, x), float)
            z = gain.T @ (np.array(case.w[-1]) * np.array(control.s[-1], float))
            u = adjust(z, u)
        if held is None or fires(u, held, delta, m):
            held = u
            sent.append(index)

        def rate(t, y, held=held):
            rows = y.reshape(case.order, case.n).tolist()
            return np.array(chains.flow(case, t, rows, held.tolist()), float).ravel()

        found = solve_ivp(rate, (t, t + period), np.ravel(x), "DOP853", rtol=1e-11, atol=1e-13)
        x = found.y[:, -1].reshape(case.order, case.n).tolist()
        states.append(np.array(x))
        commands.append(held)
    return np.array(states), np.array(commands), sent


def intervals(sent, period):
    """The times between consecutive events [s]."""
    return [period * (b - a) for a, b in itertools.pairwise(sent)]
