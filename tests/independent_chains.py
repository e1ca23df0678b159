"""Barrier backstepping of plants in strict-feedback form, without JAX and without the package: a
second opinion.

The plants are x_i' = f_i + G_i x_{i+1} + d_i, i = 1..r, with x_{r+1} = u.  The law is

    alpha_i = G_i^-1 [a_i - c_i s_i - (e_i/(w_i s_i)) G_{i-1}^T (w_{i-1} s_{i-1}) - f_i - d_hat_i],

with e_i = x_i - alpha_{i-1}, alpha_0 = x_d and u = alpha_r.  alpha_{i-1}' is the derivative along
the model's flow x_j' = f_j + G_j x_{j+1} + d_hat_j with d_hat held.  It comes from arithmetic on
truncated power series in time, which is exact up to rounding.

`CASES` holds four closed loops.  `python tests/independent_chains.py` writes their
`tests/data/chains_reference.npz`:

    <case>.points.t, x, d_hat, beta, alpha, u, V       at 20 random states, from 50 digits
    <case>.run.t, x, d_hat, beta, alpha, u, V          along the closed loop, by DOP853

Shapes, with T times: x, d_hat and alpha are (T, r, n), where alpha_r = u; beta is (T, r-1, n) and
present for the dynamic surface only; u is (T, n); V = sum w_i V_i is (T,).
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import mpmath
import numpy as np
from scipy.integrate import solve_ivp

FILE = Path(__file__).parent / "data" / "chains_reference.npz"
HALF_PI = math.pi / 2


# --- Power series ---------------------------------------------------------------------------------


class Series:
    """A truncated power series in time, c[0] + c[1] h + c[2] h^2 + ...

    The coefficients are real, complex, or numbers of mpmath.  An operation on two series keeps the
    terms that both have; a plain number is a series without an end.
    """

    __array_ufunc__ = None
    __slots__ = ("c",)

    def __init__(self, coefficients):
        self.c = list(coefficients)

    def rate(self):
        """The derivative in time, which has one term less."""
        return Series([k * self.c[k] for k in range(1, len(self.c))])

    def integral(self, start):
        """The integral over time that begins at `start`; it has one term more."""
        return Series([start, *(c / (k + 1) for k, c in enumerate(self.c))])

    def __add__(self, other):
        if isinstance(other, Series):
            return Series([a + b for a, b in zip(self.c, other.c, strict=False)])
        return Series([self.c[0] + other, *self.c[1:]])

    def __neg__(self):
        return Series([-a for a in self.c])

    def __sub__(self, other):
        return self + (-other)

    def __rsub__(self, other):
        return (-self) + other

    def __mul__(self, other):
        if not isinstance(other, Series):
            return Series([a * other for a in self.c])
        a, b = self.c, other.c
        return Series([_product_term(a, b, k) for k in range(min(len(a), len(b)))])

    def __truediv__(self, other):
        if not isinstance(other, Series):
            return Series([a / other for a in self.c])
        quotient = []
        for k in range(min(len(self.c), len(other.c))):
            known = sum(quotient[j] * other.c[k - j] for j in range(k))
            quotient.append((self.c[k] - known) / other.c[0])
        return Series(quotient)

    def __rtruediv__(self, other):
        return Series([other] + [0.0] * (len(self.c) - 1)) / self

    __radd__ = __add__
    __rmul__ = __mul__


def _product_term(a, b, k):
    """Coefficient k of a product of two series."""
    total = a[0] * b[k]
    for j in range(1, k + 1):
        total = total + a[j] * b[k - j]
    return total


def clock(t, terms):
    """Time as a series around t."""
    return Series([t, 1.0, *([0.0] * (terms - 2))][:terms])


def _elementary(name, x):
    """An elementary function of a real, a complex or an mpmath number."""
    if isinstance(x, mpmath.mpf):
        return getattr(mpmath, name)(x)
    return getattr(cmath if isinstance(x, complex) else math, name)(x)


def sin_cos(x):
    """sin x and cos x, from (sin x)' = x' cos x and (cos x)' = -x' sin x."""
    if not isinstance(x, Series):
        return _elementary("sin", x), _elementary("cos", x)
    sines, cosines = [_elementary("sin", x.c[0])], [_elementary("cos", x.c[0])]
    for k in range(1, len(x.c)):
        known = [(j * x.c[j], sines[k - j], cosines[k - j]) for j in range(1, k + 1)]
        sines.append(sum(v * c for v, _, c in known) / k)
        cosines.append(-sum(v * s for v, s, _ in known) / k)
    return Series(sines), Series(cosines)


def sin(x):
    return sin_cos(x)[0]


def cos(x):
    return sin_cos(x)[1]


def exp(x):
    """e^x, from (e^x)' = x' e^x."""
    if not isinstance(x, Series):
        return _elementary("exp", x)
    result = [_elementary("exp", x.c[0])]
    for k in range(1, len(x.c)):
        result.append(sum(j * x.c[j] * result[k - j] for j in range(1, k + 1)) / k)
    return Series(result)


def log(x):
    """ln x, the integral of x'/x."""
    if not isinstance(x, Series):
        return _elementary("log", x)
    start = _elementary("log", x.c[0])
    return (x.rate() / x).integral(start) if len(x.c) > 1 else Series([start])


# --- Small matrices, as lists of rows -------------------------------------------------------------


def times(matrix, vector):
    return [sum(a * b for a, b in zip(row, vector, strict=True)) for row in matrix]


def transpose(matrix):
    return [list(column) for column in zip(*matrix, strict=True)]


def solve(matrix, vector):
    """The solution of a linear system of one or two equations, by Cramer's rule."""
    if len(vector) == 1:
        return [vector[0] / matrix[0][0]]
    (a, b), (c, d) = matrix
    det = a * d - b * c
    return [(d * vector[0] - b * vector[1]) / det, (a * vector[1] - c * vector[0]) / det]


# --- Signals --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sine:
    """offset + amplitude sin(frequency t + phase), each field one number per component."""

    offset: tuple
    amplitude: tuple
    frequency: tuple
    phase: tuple

    def at(self, t, reference=None):
        """The values at a time or a series of time."""
        rows = zip(self.offset, self.amplitude, self.frequency, self.phase, strict=True)
        return [a + b * sin(c * t + d) for a, b, c, d in rows]


@dataclass(frozen=True)
class Funnel:
    """The reference plus (initial - final) exp(-rate t) + final, with signed distances."""

    initial: tuple
    final: tuple
    rate: tuple

    def at(self, t, reference):
        """The values at a time or a series of time."""
        rows = zip(reference, self.initial, self.final, self.rate, strict=True)
        return [r + (a - b) * exp(-c * t) + b for r, a, b, c in rows]


# --- Barriers -------------------------------------------------------------------------------------


class Tube(NamedTuple):
    """One component of a level: its error, the motion of alpha, and the distances to its bounds."""

    e: Any
    dalpha: Any
    k_l: Any
    k_u: Any
    dk_l: Any
    dk_u: Any


class Terms(NamedTuple):
    """What a barrier supplies to the law and to the claim."""

    V: Any
    s: Any
    a: Any
    decay: Any
    ratio: Any
    """e/s; None for a barrier that is used on level 1 only."""


def mapping(tube, k):
    """V = 1/2 z^2, z = e k_l k_u / ((k_l + e)(k_u - e))."""
    e, dalpha, k_l, k_u, dk_l, dk_u = tube
    room = (k_l + e) * (k_u - e)
    z_over_e = k_l * k_u / room
    z = e * z_over_e
    z_e = k_l * k_u * (k_l * k_u + e * e) / (room * room)
    z_t = z * e * (dk_l / (k_l * (k_l + e)) - dk_u / (k_u * (k_u - e)))
    a = dalpha - (k * z + z_t) / z_e
    return Terms(0.5 * z * z, z * z_e, a, k * z * z, 1.0 / (z_over_e * z_e))


def prescribed_performance(tube, k):
    """V = 1/2 eps^2, eps = 1/2 ln[(k_l + e) k_u / ((k_u - e) k_l)]."""
    e, dalpha, k_l, k_u, dk_l, dk_u = tube
    eps = 0.5 * log((k_l + e) * k_u / ((k_u - e) * k_l))
    eps_e = 0.5 * (1.0 / (k_l + e) + 1.0 / (k_u - e))
    eps_l = 0.5 * (1.0 / (k_l + e) - 1.0 / k_l)
    eps_u = 0.5 * (1.0 / k_u - 1.0 / (k_u - e))
    a = dalpha - (k * eps + eps_l * dk_l + eps_u * dk_u) / eps_e
    return Terms(0.5 * eps * eps, eps * eps_e, a, k * eps * eps, None)


def quadratic(tube, k):
    """V = 1/2 e^2, for a level without bounds."""
    e, dalpha = tube.e, tube.dalpha
    return Terms(0.5 * e * e, e, dalpha - k * e, k * e * e, 1.0)


# --- The law --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """One closed loop.  Rows of k, w and x0 are the levels, columns the n components."""

    order: int
    n: int
    drift: Callable
    """(i, t, x) -> f_{i+1}, n numbers or series; i counts from 0."""
    gain: Callable
    """(i, t, x) -> G_{i+1}, n rows of n."""
    disturbance: Callable
    """(t, x) -> d, r rows of n numbers."""
    reference: Sine
    bounds: tuple
    """One pair of lower and upper side a level, or None."""
    barriers: tuple
    k: tuple
    w: tuple
    c: tuple
    """One number a level."""
    kappa: tuple
    """Gains of the observers, one number a level."""
    x0: tuple
    filter: tuple | None = None
    """mu_1 .. mu_{r-1} of the dynamic surface; None for exact derivatives."""
    decays: tuple | None = None
    """One a level, with which the gain of a level is k + gain(t, V); None for constant gains."""


def model_rate(case, i, t, x, d_hat):
    """f_i + G_i x_{i+1} + d_hat_i, without the last level."""
    flow = times(case.gain(i, t, x), x[i + 1])
    return [f + g + d for f, g, d in zip(case.drift(i, t, x), flow, d_hat[i], strict=True)]


def model_series(case, t, x, d_hat, levels):
    """The first states as series along the model's flow: level i has `levels` - i + 1 terms."""
    series = [[Series([value]) for value in row] for row in x]
    for terms in range(1, levels):
        now = clock(t, terms)
        rates = [model_rate(case, i, now, series, d_hat) for i in range(levels - terms)]
        for i, rate in enumerate(rates):
            series[i] = [p.integral(start) for p, start in zip(rate, x[i], strict=True)]
    return series


def tubes_of(x, alpha, dalpha, sides):
    """The tubes of one level's components; `sides` holds (lower, lower', upper, upper')."""
    if sides is None:
        return [Tube(q - a, da, *[None] * 4) for q, a, da in zip(x, alpha, dalpha, strict=True)]
    return [
        Tube(q - a, da, a - low, up - a, da - dlow, dup - da)
        for q, a, da, low, dlow, up, dup in zip(x, alpha, dalpha, *sides, strict=True)
    ]


def level(case, i, t, x, d_hat, tubes, below):
    """alpha_{i+1} and the terms of its barriers; `below` are those of the level below."""
    barrier = case.barriers[i]
    gains = case.k[i]
    if case.decays is not None:
        values = [barrier(tube, k).V for tube, k in zip(tubes, gains, strict=True)]
        gains = [k + case.decays[i].gain(t, V) for k, V in zip(gains, values, strict=True)]
    terms = [barrier(tube, k) for tube, k in zip(tubes, gains, strict=True)]
    wanted = [p.a - case.c[i] * p.s for p in terms]
    if below is not None:
        weighted = [w * p.s for w, p in zip(case.w[i - 1], below, strict=True)]
        exchange = times(transpose(case.gain(i - 1, t, x)), weighted)
        wanted = [
            a - p.ratio / w * g
            for a, p, w, g in zip(wanted, terms, case.w[i], exchange, strict=True)
        ]
    known = [f + d for f, d in zip(case.drift(i, t, x), d_hat[i], strict=True)]
    rest = [a - b for a, b in zip(wanted, known, strict=True)]
    return solve(case.gain(i, t, x), rest), terms


class Control(NamedTuple):
    """The law at one state; lists over the levels, then over the components."""

    alpha: list
    V: Any
    """sum w_i V_i."""
    s: list
    decay: Any
    """sum w_i decay_i + sum c_i w_i s_i^2."""


def sides_of(case, i, now, reference):
    """Lower and upper side of a level with their rates, as `tubes_of` wants them."""
    if case.bounds[i] is None:
        return None
    lower, upper = (side.at(now, reference) for side in case.bounds[i])
    return lower, [p.rate() for p in lower], upper, [p.rate() for p in upper]


def shifted(tubes, shift):
    """The tubes of the last level with lambda and its assumed rate in the error only."""
    values, rates = shift
    return [
        tube._replace(e=tube.e - value, dalpha=tube.dalpha + rate)
        for tube, value, rate in zip(tubes, values, rates, strict=True)
    ]


def law(case, t, x, d_hat, beta=None, levels=None, shift=None):
    """alpha_1 .. alpha_levels and the Lyapunov function of these levels; all of them if not given.

    `shift` is the auxiliary state lambda of a limited input and -k lambda, n numbers each, which
    the last error x_r - alpha_{r-1} - lambda contains.  The results are numbers of the kind of the
    arguments.
    """
    levels = case.order if levels is None else levels
    now = clock(t, levels + 1)
    if case.filter is None:
        states = model_series(case, t, x, d_hat, levels)
    else:
        states = [[Series([value]) for value in row] for row in x]
    reference = case.reference.at(now)
    alpha, dalpha, terms = reference, [p.rate() for p in reference], None
    alphas, slopes, V, decay = [], [], 0.0, 0.0
    for i in range(levels):
        tubes = tubes_of(states[i], alpha, dalpha, sides_of(case, i, now, reference))
        if shift is not None and i == case.order - 1:
            tubes = shifted(tubes, shift)
        alpha, terms = level(case, i, now, states, d_hat, tubes, terms)
        alphas.append([p.c[0] for p in alpha])
        slopes.append([p.s.c[0] for p in terms])
        for w, p in zip(case.w[i], terms, strict=True):
            V = V + w * p.V.c[0]
            decay = decay + w * (p.decay.c[0] + case.c[i] * p.s.c[0] * p.s.c[0])
        if i == levels - 1:
            break
        if case.filter is None:
            dalpha = [p.rate() for p in alpha]
        else:
            alpha = [Series([b]) for b in beta[i]]
            dalpha = [Series([r]) for r in filter_rate(case, i, alphas[i], beta[i])]
    return Control(alphas, V, slopes, decay)


def filter_rate(case, i, alpha, beta):
    """beta' = (alpha - beta)/mu of the dynamic surface."""
    return [(a - b) / case.filter[i] for a, b in zip(alpha, beta, strict=True)]


def filter_start(case, t, x, d_hat):
    """The filters' outputs at the virtual controls of the law without filters."""
    return law(replace(case, filter=None), t, x, d_hat).alpha[:-1]


# --- The closed loop ------------------------------------------------------------------------------


def unpack(case, y):
    """x, eta and beta from the state of the loop; beta is empty without filters."""
    rows = [y[j : j + case.n] for j in range(0, len(y), case.n)]
    return rows[: case.order], rows[case.order : 2 * case.order], rows[2 * case.order :]


def estimates(case, x, eta):
    """d_hat_j = eta_j + kappa_j x_j."""
    return [
        [p + kappa * q for p, q in zip(rows, values, strict=True)]
        for rows, values, kappa in zip(eta, x, case.kappa, strict=True)
    ]


def flow(case, t, x, u):
    """f_i + G_i x_{i+1} of every level."""
    zero = [[0.0] * case.n] * case.order
    chain = [*x, u]
    return [model_rate(case, i, t, chain, zero) for i in range(case.order)]


def add(a, b, scale=1.0):
    """a + scale b, for rows of numbers."""
    return [
        [p + scale * q for p, q in zip(rows, others, strict=True)]
        for rows, others in zip(a, b, strict=True)
    ]


def loop_rate(case, t, y):
    """The rate of (x, eta, beta)."""
    x, eta, beta = unpack(case, y)
    d_hat = estimates(case, x, eta)
    alpha = law(case, t, x, d_hat, beta).alpha
    known = flow(case, t, x, alpha[-1])
    dx = add(known, case.disturbance(t, x))
    deta = [
        [-kappa * (p + d) for p, d in zip(rows, estimate, strict=True)]
        for rows, estimate, kappa in zip(known, d_hat, case.kappa, strict=True)
    ]
    dbeta = [filter_rate(case, i, alpha[i], b) for i, b in enumerate(beta)]
    return [v for row in dx + deta + dbeta for v in row]


def start(case):
    """(x, eta, beta) at t = 0, with d_hat = 0 and beta = alpha."""
    x = [list(row) for row in case.x0]
    eta = [[-kappa * q for q in row] for row, kappa in zip(x, case.kappa, strict=True)]
    beta = []
    if case.filter is not None:
        beta = filter_start(case, 0.0, x, [[0.0] * case.n] * case.order)
    return [v for row in x + eta + beta for v in row]


def integrate(case, times, y, rtol=1e-11):
    """The loop's states at these times from state y at the first of them, (T, ...)."""
    span = float(times[0]), float(times[-1])
    how = {"method": "DOP853", "t_eval": times, "rtol": rtol, "atol": 0.01 * rtol}
    found = solve_ivp(lambda t, y: loop_rate(case, float(t), y.tolist()), span, y, **how)
    if not found.success:
        raise RuntimeError(found.message)
    return found.y.T


def record(case, times, states):
    """What the reference file stores of these states of the loop: name -> (T, ...)."""
    rows = []
    for t, y in zip(times, states, strict=True):
        x, eta, beta = unpack(case, [float(v) for v in y])
        rows.append(entry(case, float(t), x, estimates(case, x, eta), beta))
    return collect(case, rows)


def entry(case, t, x, d_hat, beta):
    """What the reference file stores of one state."""
    control = law(case, t, x, d_hat, beta)
    values = {"t": t, "x": x, "d_hat": d_hat, "alpha": control.alpha}
    return {**values, "beta": beta, "u": control.alpha[-1], "V": control.V}


def collect(case, rows):
    """Arrays of the entries; beta only where there are filters."""
    names = [name for name in rows[0] if name != "beta" or case.filter is not None]
    return {name: np.array([row[name] for row in rows], dtype=float) for name in names}


def run(case, duration=4.0, step=0.01):
    times = np.round(np.arange(round(duration / step) + 1) * step, 12)
    return record(case, times, integrate(case, times, start(case)))


# --- Random states --------------------------------------------------------------------------------


def random_states(case, spread, noise, count=20, seed=1):
    """States (t, x, d_hat, beta) with every alpha well inside its bounds, drawn from below.

    Errors of levels without bounds are up to `spread`; d_hat of a level is up to `noise`.
    """
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        t = float(rng.uniform(0.0, 4.0))
        d_hat = [(size * rng.uniform(-1.0, 1.0, case.n)).tolist() for size in noise]
        state = random_state(case, rng, t, d_hat, spread)
        if state is not None:
            found.append((t, state[0], d_hat, state[1]))
    return found


def random_state(case, rng, t, d_hat, spread):
    """x and beta at this time, or None if a virtual control came near its bounds."""
    x, beta = [], []
    reference = case.reference.at(t)
    centre = reference
    for i in range(case.order):
        draw = rng.uniform(-1.0, 1.0, case.n).tolist()
        if case.bounds[i] is None:
            x.append([a + spread[i] * b for a, b in zip(centre, draw, strict=True)])
        else:
            lower, upper = (side.at(t, reference) for side in case.bounds[i])
            room = zip(lower, centre, upper, strict=True)
            if any(min(a - low, up - a) < 0.15 * (up - low) for low, a, up in room):
                return None
            x.append(
                [
                    a + 0.7 * b * ((up - a) if b > 0 else (a - low))
                    for low, a, up, b in zip(lower, centre, upper, draw, strict=True)
                ]
            )
        if i < case.order - 1:
            centre = law(case, t, x, d_hat, beta, levels=i + 1).alpha[i]
            if case.filter is not None:
                lag = rng.uniform(-0.1, 0.1, case.n).tolist()
                centre = [a + b for a, b in zip(centre, lag, strict=True)]
                beta.append(centre)
    return x, beta


def exact(values):
    """The same rows in numbers of mpmath."""
    return [[mpmath.mpf(v) for v in row] for row in values]


def points(case, spread, noise):
    """The law at random states, evaluated with 50 digits."""
    rows = []
    with mpmath.workdps(50):
        for t, x, d_hat, beta in random_states(case, spread, noise):
            rows.append(entry(case, mpmath.mpf(t), exact(x), exact(d_hat), exact(beta)))
    return collect(case, rows)


# --- Case 1: coupled gains, and case 4: the same plant with a dynamic surface ---------------------

LEVELS, WIDTH = 3, 2


def spread_numbers(shape, seed):
    """Numbers in [-1, 1] with two decimals, by multiples of the golden ratio."""
    steps = (seed + np.arange(math.prod(shape))) * 0.5 * (math.sqrt(5.0) - 1.0)
    return np.round(2.0 * (steps % 1.0) - 1.0, 2).reshape(shape)


def only_known_levels(wave):
    """Sets to zero what level i must not depend on: x_{i+1} and above."""
    wave = wave.copy()
    for i in range(LEVELS):
        wave[i, ..., 2 + WIDTH * (i + 1) :] = 0.0
    return wave


# With z = (1, t, x_1, x_2, x_3), 8 numbers: f_i = DRIFT_SIZE_i * sin(DRIFT_WAVE_i z), component by
# component, and G_i = GAIN_CENTRE_i + GAIN_SIZE_i * sin(GAIN_WAVE_i z), entry by entry.
DRIFT_SIZE = np.array([[0.3, -0.2], [0.8, 0.6], [1.5, -1.2]])
DRIFT_WAVE = only_known_levels(spread_numbers((LEVELS, WIDTH, 8), seed=3))
GAIN_CENTRE = np.array(
    [[[1.4, 0.3], [-0.2, 1.2]], [[1.1, -0.25], [0.3, 1.3]], [[1.5, 0.2], [0.4, 1.2]]]
)
GAIN_SIZE = np.array(
    [[[0.3, 0.2], [0.15, 0.25]], [[0.2, 0.3], [0.2, 0.2]], [[0.3, 0.2], [0.3, 0.25]]]
)
GAIN_WAVE = only_known_levels(spread_numbers((LEVELS, WIDTH, WIDTH, 8), seed=101))
DRIFT_LISTS = DRIFT_SIZE.tolist(), DRIFT_WAVE.tolist()
GAIN_LISTS = GAIN_CENTRE.tolist(), GAIN_SIZE.tolist(), GAIN_WAVE.tolist()
COUPLED_DISTURBANCE = {
    "amplitude": ((0.05, 0.04), (0.3, 0.25), (0.8, 0.6)),
    "frequency": ((1.3, 0.7), (2.1, 1.6), (0.9, 2.7)),
    "phase": ((0.0, 0.4), (1.0, 0.2), (0.7, 2.0)),
}


def wave_sum(row, t, x):
    """sin of a row of coefficients times (1, t, x_1, x_2, x_3)."""
    phase = row[0] + row[1] * t
    for j in range(2, len(row)):
        if row[j] != 0.0:
            phase = phase + row[j] * x[(j - 2) // WIDTH][(j - 2) % WIDTH]
    return sin(phase)


def table_drift(i, t, x):
    size, wave = (table[i] for table in DRIFT_LISTS)
    return [a * wave_sum(row, t, x) for a, row in zip(size, wave, strict=True)]


def table_gain(i, t, x):
    centre, size, wave = (table[i] for table in GAIN_LISTS)
    return [
        [a + b * wave_sum(row, t, x) for a, b, row in zip(*rows, strict=True)]
        for rows in zip(centre, size, wave, strict=True)
    ]


def table_disturbance(t, x):
    """Sinusoids on every level and component."""
    rows = zip(*COUPLED_DISTURBANCE.values(), strict=True)
    return [[a * sin(b * t + c) for a, b, c in zip(*row, strict=True)] for row in rows]


COUPLED = Case(
    order=LEVELS,
    n=WIDTH,
    drift=table_drift,
    gain=table_gain,
    disturbance=table_disturbance,
    reference=Sine((0.5, 0.4), (0.14, 0.2), (1.0, 0.8), (0.0, HALF_PI)),
    bounds=(
        (
            Sine((0.1, -0.2), (0.1, 0.14), (1.0, 0.8), (0.3, HALF_PI)),
            Sine((0.95, 1.0), (0.08, 0.14), (1.0, 1.2), (HALF_PI, 0.0)),
        ),
        (
            Sine((-0.8, -0.9), (0.15, 0.1), (1.1, 0.9), (0.0, 1.0)),
            Sine((0.6, 0.8), (0.1, 0.15), (0.7, 1.3), (0.5, 2.0)),
        ),
        (
            Sine((-5.0, -3.5), (0.5, 0.4), (0.9, 1.2), (0.2, 1.5)),
            Sine((3.0, 5.0), (0.4, 0.6), (1.4, 0.8), (1.1, 0.0)),
        ),
    ),
    barriers=(mapping, mapping, mapping),
    k=((1.5, 2.0), (4.0, 5.0), (10.0, 8.0)),
    w=((1.3, 0.7), (0.45, 0.6), (0.04, 0.03)),
    c=(0.1, 0.3, 0.2),
    kappa=(5.0, 10.0, 15.0),
    x0=((0.65, 0.45), (0.1, -0.2), (0.5, -0.5)),
)
SURFACE = replace(COUPLED, filter=(0.03, 0.02))


# --- Case 2: the paper's two-link arm with flexible joints ----------------------------------------

MASS, LENGTH, GRAVITY = (2.0, 0.85), (0.35, 0.31), 9.81
CENTRE = tuple(length / 2 for length in LENGTH)
INERTIA = tuple(m * length**2 / 4 for m, length in zip(MASS, LENGTH, strict=True))
STIFFNESS, MOTOR_INERTIA, MOTOR_DAMPING = 300.0, 0.02, 0.01
JOINT_TORQUE = Sine((0.0, 0.0), (0.5, 0.3), (1.0, 1.7), (0.0, HALF_PI))
"""The disturbance, a torque on the links [N m]."""

P1 = MASS[0] * CENTRE[0] ** 2 + MASS[1] * LENGTH[0] ** 2 + INERTIA[0]
P2 = MASS[1] * CENTRE[1] ** 2 + INERTIA[1]
P3 = MASS[1] * LENGTH[0] * CENTRE[1]
P4 = MASS[0] * CENTRE[0] + MASS[1] * LENGTH[0]
P5 = MASS[1] * CENTRE[1]


def arm_inertia(q):
    c = cos(q[1])
    coupling = P2 + P3 * c
    return [[P1 + P2 + 2.0 * P3 * c, coupling], [coupling, P2]]


def arm_gravity(q):
    outer = P5 * GRAVITY * cos(q[0] + q[1])
    return [P4 * GRAVITY * cos(q[0]) + outer, outer]


def arm_bias(q, v):
    """C(q, v) v + G(q)."""
    s = P3 * sin(q[1])
    coriolis = [-s * (2.0 * v[0] * v[1] + v[1] * v[1]), s * v[0] * v[0]]
    return [c + g for c, g in zip(coriolis, arm_gravity(q), strict=True)]


def joint_drift(i, t, x):
    """f of level i + 1 of (q, q', theta, theta')."""
    if i in (0, 2):
        return [0.0, 0.0]
    if i == 1:
        bias = arm_bias(x[0], x[1])
        torque = [-(b + STIFFNESS * q) for b, q in zip(bias, x[0], strict=True)]
        return solve(arm_inertia(x[0]), torque)
    rows = zip(x[0], x[2], x[3], strict=True)
    return [-(MOTOR_DAMPING * v + STIFFNESS * (th - q)) / MOTOR_INERTIA for q, th, v in rows]


def joint_gain(i, t, x):
    if i == 1:
        columns = [
            solve(arm_inertia(x[0]), column) for column in ([STIFFNESS, 0.0], [0.0, STIFFNESS])
        ]
        return transpose(columns)
    size = 1.0 if i != 3 else 1.0 / MOTOR_INERTIA
    return [[size, 0.0], [0.0, size]]


def joint_disturbance(t, x):
    """d_2 = M^-1 times the torque on the links."""
    zero = [0.0, 0.0]
    return [zero, solve(arm_inertia(x[0]), JOINT_TORQUE.at(t)), zero, zero]


ARM_START = (0.8, 0.8)
_INERTIA_0 = arm_inertia(ARM_START)
FLEXIBLE = Case(
    order=4,
    n=2,
    drift=joint_drift,
    gain=joint_gain,
    disturbance=joint_disturbance,
    reference=Sine((0.5, 0.5), (0.14, 0.14), (1.0, 1.0), (0.0, HALF_PI)),
    bounds=(
        (
            Sine((0.2, 0.2), (0.14, 0.14), (1.0, 1.0), (HALF_PI, 0.0)),
            Sine((0.9, 0.9), (0.14, 0.14), (1.0, 1.0), (HALF_PI, 0.0)),
        ),
        None,
        None,
        None,
    ),
    barriers=(mapping, quadratic, quadratic, quadratic),
    k=((3.0, 3.0), (20.0, 20.0), (60.0, 60.0), (150.0, 150.0)),
    w=(
        (10.0 * _INERTIA_0[0][0], 10.0 * _INERTIA_0[1][1]),
        (_INERTIA_0[0][0], _INERTIA_0[1][1]),
        (STIFFNESS, STIFFNESS),
        (MOTOR_INERTIA, MOTOR_INERTIA),
    ),
    c=(0.1, 0.5, 1.0, 2.0),
    kappa=(0.0, 20.0, 0.0, 20.0),
    x0=(
        ARM_START,
        (0.0, 0.0),
        tuple(q + g / STIFFNESS for q, g in zip(ARM_START, arm_gravity(ARM_START), strict=True)),
        (0.0, 0.0),
    ),
)
"""Levels 1 and 3 have no disturbance, so their d_hat stays 0 whatever their observers' gains."""


# --- Case 3: a pendulum with its motor ------------------------------------------------------------

D, B, N, M, H, KM = 1.0, 1.0, 10.0, 0.1, 1.0, 10.0
"""D x_2' = x_3 - B x_2 - N sin x_1, M x_3' = u - H x_3 - KM x_2."""
PENDULUM_DISTURBANCE = Sine((0.0, 0.0), (0.8, 5.0), (1.4, 2.3), (0.0, 0.5))
"""d_2 [rad/s^2] and d_3 [N m/s]."""


def pendulum_drift(i, t, x):
    if i == 0:
        return [0.0]
    if i == 1:
        return [-(B * x[1][0] + N * sin(x[0][0])) / D]
    return [-(H * x[2][0] + KM * x[1][0]) / M]


def pendulum_gain(i, t, x):
    return [[(1.0, 1.0 / D, 1.0 / M)[i]]]


def pendulum_disturbance(t, x):
    second, third = PENDULUM_DISTURBANCE.at(t)
    return [[0.0], [second], [third]]


PENDULUM_START = 0.75
PENDULUM = Case(
    order=3,
    n=1,
    drift=pendulum_drift,
    gain=pendulum_gain,
    disturbance=pendulum_disturbance,
    reference=Sine((0.6,), (0.3,), (1.0,), (0.0,)),
    bounds=(
        (Funnel((-0.3,), (-0.06,), (1.5,)), Funnel((0.4,), (0.08,), (1.2,))),
        (Sine((-0.7,), (0.1,), (0.8,), (0.2,)), Sine((0.55,), (0.08,), (1.1,), (1.0,))),
        (Sine((1.5,), (0.5,), (0.7,), (0.0,)), Sine((10.0,), (0.8,), (1.2,), (0.6,))),
    ),
    barriers=(prescribed_performance, mapping, mapping),
    k=((2.0,), (6.0,), (12.0,)),
    w=((0.2,), (1.0,), (0.05,)),
    c=(0.0002, 0.2, 0.3),
    kappa=(0.0, 12.0, 20.0),
    x0=((PENDULUM_START,), (0.0,), (N * math.sin(PENDULUM_START),)),
)


# --- The file -------------------------------------------------------------------------------------

CASES = {"coupled": COUPLED, "flexible": FLEXIBLE, "pendulum": PENDULUM, "surface": SURFACE}
SPREAD = {"flexible": (0.0, 0.5, 0.02, 1.0)}
"""Sizes of the errors of random states on levels without bounds."""
NOISE = {
    "coupled": (0.1, 0.3, 0.8),
    "flexible": (0.0, 2.0, 0.0, 5.0),
    "pendulum": (0.0, 0.8, 5.0),
    "surface": (0.1, 0.3, 0.8),
}
"""Sizes of d_hat at random states; 0 on levels without a disturbance."""


def reference_data():
    """Everything that the file stores: key -> array."""
    arrays = {}
    for name, case in CASES.items():
        parts = {"points": points(case, SPREAD.get(name), NOISE[name]), "run": run(case)}
        for part, values in parts.items():
            arrays.update({f"{name}.{part}.{key}": value for key, value in values.items()})
    return arrays


if __name__ == "__main__":
    np.savez_compressed(FILE, **reference_data())
