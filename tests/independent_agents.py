"""Leader and followers without JAX and without the package: a second opinion.

Four pendulums, (I + m c^2) p" + m g c cos p = u, measure

    e_i = sum_j a_ij (p_i - p_j) + b_i (p_i - x_0)

inside the funnels |e_i| < K(t), K = (K_0 - K_inf) exp(-r t) + K_inf.  With z = e K^2/(K^2 - e^2),

    z_e = K^2 (K^2 + e^2)/(K^2 - e^2)^2,   z_K = -2 e^3 K/(K^2 - e^2)^2,
    a = b x_0' - (k_1 z + z_K K')/z_e,   s = z z_e.

The law that knows the graph takes alpha = H^-1 a and, with alpha' along y' = H v,

    u = (I + m c^2)(alpha' - k_2 (v - alpha) - H^T (w_1 s)/w_2) + m g c cos p.

The distributed law takes alpha_i = (a_i + sum_j a_ij v_j)/(d_i + b_i), the filters
mu beta' = alpha - beta, and beta and (d_i + b_i) in the place of alpha and H^T.  The derivative
alpha' is the imaginary part of one complex step, which is exact to rounding.
"""

import numpy as np

ADJACENCY = np.array([[0, 0, 0.5, 0], [1, 0, 0, 0], [0, 0.8, 0, 0.3], [0, 0, 1.2, 0]], float)
LEADER = np.array([1.0, 0.0, 0.0, 0.4])
H = np.diag(ADJACENCY.sum(axis=1) + LEADER) - ADJACENCY
DEGREES = np.diag(H).copy()
MASS = np.array([1.0, 1.3, 0.8, 1.1])
LENGTH = np.array([0.4, 0.5, 0.45, 0.35])
CENTRE = np.array([0.2, 0.25, 0.3, 0.15])
INERTIA = np.array([0.02, 0.03, 0.01, 0.015])
G = 9.81
OFFSET, AMPLITUDE, FREQUENCY = 0.2, 0.3, 1.1
WIDE, NARROW, RATE = 0.6, 0.15, 0.8
K1 = np.array([2.0, 1.5, 2.5, 2.2])
K2 = np.array([20.0, 18.0, 25.0, 22.0])
W1 = np.array([1.0, 0.7, 1.2, 0.4])
W2 = np.array([0.9, 1.1, 1.0, 1.3])
MU = np.array([0.02, 0.03, 0.025, 0.015])
P0 = np.array([0.2, 0.3, 0.1, 0.25])
M = INERTIA + MASS * CENTRE**2


def gravity(p):
    return MASS * G * CENTRE * np.cos(p)


def first_level(t, y):
    """The virtual velocities a and the slopes s; t and y may be complex."""
    x_0 = OFFSET + AMPLITUDE * np.sin(FREQUENCY * t)
    dx_0 = AMPLITUDE * FREQUENCY * np.cos(FREQUENCY * t)
    decaying = (WIDE - NARROW) * np.exp(-RATE * t)
    K, dK = decaying + NARROW, -RATE * decaying
    e = y - LEADER * x_0
    room = K**2 - e**2
    z, z_e = e * K**2 / room, K**2 * (K**2 + e**2) / room**2
    z_K = -2 * e**3 * K / room**2
    return LEADER * dx_0 - (K1 * z + z_K * dK) / z_e, z * z_e


def input_with_graph(t, y, v):
    """u of the law that knows the graph."""
    h = 1e-30

    def alpha(t, y):
        return np.linalg.solve(H, first_level(t, y)[0])

    dalpha = alpha(t + 1j * h, y + 1j * h * (H @ v)).imag / h
    rate = dalpha - K2 * (v - alpha(t, y)) - H.T @ (W1 * first_level(t, y)[1]) / W2
    return M * rate + gravity(np.linalg.solve(H, y))


def distributed_input(t, y, v, beta):
    """u and beta' of the distributed law."""
    a, s = first_level(t, y)
    dbeta = ((a + ADJACENCY @ v) / DEGREES - beta) / MU
    rate = dbeta - K2 * (v - beta) - DEGREES * W1 * s / W2
    return M * rate + gravity(np.linalg.solve(H, y)), dbeta


def field(t, state, distributed):
    """The rate of (y, v), or of (y, v, beta)."""
    y, v = state[:4], state[4:8]
    if distributed:
        u, dbeta = distributed_input(t, y, v, state[8:])
    else:
        u, dbeta = input_with_graph(t, y, v), np.zeros(0)
    acceleration = (u - gravity(np.linalg.solve(H, y))) / M
    return np.concatenate([H @ v, acceleration, dbeta])
