"""Loops with a limited input and an auxiliary state, and loops with an event trigger, without JAX
and without the package: a second opinion.

`limited_arm` is the paper's arm under the corrected law with the auxiliary state lambda,

    lambda' = -k lambda + M^-1 (sat(tau) - tau),   z = q' - alpha - lambda,
    tau = C (alpha + lambda) + G + M (alpha' - k lambda) - f_hat - K2 z - s,

and `limited_chain` a plant of any order r, whose last level has z = x_r - alpha_{r-1} - lambda and
x_r - lambda in the place of x_r in its tube.  `triggered_chain` holds the input of the law until it
differs by more than delta |u_held| + m from it.
"""

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
    control = chains.law(case, t, x, d_hat, shift=(aux, -k * aux))
    u = control.alpha[-1]
    applied = np.clip(u, -limit, limit)
    return u, applied, -k * aux + case.gain(case.order - 1, t, x) @ (applied - u), control


def compensated(z, v, delta, m_bar, epsilon):
    """The command of Xing et al. 2017 for the input v, component by component."""
    first = v * np.tanh(z * v / epsilon)
    second = m_bar * np.tanh(z * m_bar / epsilon)
    return -(1.0 + delta) * (first + second)


def triggered_chain(case, period, delta, m, count, adjust=None):
    """`count` periods of a chain without an estimate under the event trigger with delta and m;
    `adjust` changes the command by the input and by G_r^T w_r s_r.

    Returns the states at the checks, (count + 1, r, n), the commands held, (count, n), and the
    numbers of the checks at which one was sent.
    """
    x, held, sent = np.array(case.x0), None, []
    states, commands = [x], []
    for index in range(count):
        t = index * period
        control = chains.law(case, t, x, np.zeros_like(x))
        u = control.alpha[-1]
        if adjust is not None:
            z = case.gain(case.order - 1, t, x).T @ (np.array(case.w[-1]) * control.s[-1])
            u = adjust(z, u)
        if held is None or np.any(np.abs(u - held) > delta * np.abs(held) + m):
            held = u
            sent.append(index)

        def rate(t, y, held=held):
            return chains.flow(case, t, y.reshape(case.order, case.n), held).ravel()

        found = solve_ivp(rate, (t, t + period), np.ravel(x), "DOP853", rtol=1e-11, atol=1e-13)
        x = found.y[:, -1].reshape(case.order, case.n)
        states.append(x)
        commands.append(held)
    return np.array(states), np.array(commands), sent


def intervals(sent, period):
    return [period * (b - a) for a, b in itertools.pairwise(sent)]
