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

    The coefficients are arrays of one shape, of real, complex or mpmath's numbers.  An operation on
    two series keeps the terms that both have; an array is a series without an end.
    """

    __array_ufunc__ = None

    def __init__(self, coefficients):
        self.c = np.asarray(coefficients)

    def rate(self):
        """The derivative in time, which has one term less."""
        return Series([k * self.c[k] for k in range(1, len(self.c))])

    def integral(self, start):
        """The integral over time that begins at `start`; it has one term more."""
        return Series([start, *(c / (k + 1) for k, c in enumerate(self.c))])

    def sum(self, axis):
        return Series(self.c.sum(axis))

    @property
    def T(self):
        return Series(np.swapaxes(self.c, -1, -2))

    def __len__(self):
        return self.c.shape[1]

    def __getitem__(self, i):
        return Series(self.c[:, i])

    def _terms(self, other):
        """The coefficients of an operand."""
        if isinstance(other, Series):
            return other.c
        return [other, *[0.0 * other] * (len(self.c) - 1)]

    def __add__(self, other):
        return Series([a + b for a, b in zip(self.c, self._terms(other), strict=False)])

    def __neg__(self):
        return Series(-self.c)

    def __sub__(self, other):
        return self + (-other)

    def __rsub__(self, other):
        return (-self) + other

    def __mul__(self, other):
        a, b = self.c, self._terms(other)
        shorter = range(min(len(a), len(b)))
        return Series([sum(a[j] * b[k - j] for j in range(k + 1)) for k in shorter])

    def __truediv__(self, other):
        quotient, b = [], self._terms(other)
        for k, a in enumerate(self.c[: len(b)]):
            quotient.append((a - sum(quotient[j] * b[k - j] for j in range(k))) / b[0])
        return Series(quotient)

    def __rtruediv__(self, other):
        return Series(self._terms(other)) / self

    __radd__ = __add__
    __rmul__ = __mul__


def stack(parts):
    """The array of numbers, or the series, of nested lists of these."""
    parts = [stack(x) if isinstance(x, list) else x for x in parts]
    if not isinstance(parts[0], Series):
        return np.array(parts)
    terms = min(len(x.c) for x in parts)
    return Series(np.stack([x.c[:terms] for x in parts], axis=1))


def clock(t, terms):
    """Time as a series around t."""
    return Series([t, 1.0, *([0.0] * (terms - 2))][:terms])


def _elementary(name, x):
    """An elementary function of real, complex or mpmath's numbers."""
    if np.asarray(x).dtype == object:
        return np.frompyfunc(getattr(mpmath, name), 1, 1)(x)
    return getattr(np, name)(x)


def sin_cos(x):
    """sin x and cos x, from (sin x)' = x' cos x and (cos x)' = -x' sin x."""
    if not isinstance(x, Series):
        return _elementary("sin", x), _elementary("cos", x)
    sines, cosines = [_elementary("sin", x.c[0])], [_elementary("cos", x.c[0])]
    for k in range(1, len(x.c)):
        sines.append(sum(j * x.c[j] * cosines[k - j] for j in range(1, k + 1)) / k)
        cosines.append(-sum(j * x.c[j] * sines[k - j] for j in range(1, k + 1)) / k)
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
    return (x.rate() / x).integral(_elementary("log", x.c[0]))


def times(matrix, vector):
    return (matrix * vector).sum(-1)


def solve(matrix, vector):
    """The solution of a linear system of one or two equations, by Cramer's rule."""
    if len(matrix) == 1:
        return vector / matrix[0]
    (a, b), (c, d) = matrix
    return stack([d * vector[0] - b * vector[1], a * vector[1] - c * vector[0]]) / (a * d - b * c)


# --- Signals --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sine:
    """offset + amplitude sin(frequency t + phase), each field a number, or one per component."""

    offset: tuple | float
    amplitude: tuple | float
    frequency: tuple | float
    phase: tuple | float

    def at(self, t, reference=None):
        offset, amplitude, frequency, phase = map(np.array, vars(self).values())
        return offset + amplitude * sin(frequency * t + phase)


@dataclass(frozen=True)
class Funnel:
    """The reference plus (initial - final) exp(-rate t) + final, with signed distances."""

    initial: float
    final: float
    rate: float

    def at(self, t, reference):
        initial, final, rate = map(np.array, vars(self).values())
        return reference + (initial - final) * exp(-rate * t) + final


# --- Barriers -------------------------------------------------------------------------------------


class Tube(NamedTuple):
    """One level: its error, the motion of alpha, and the distances to its bounds."""

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
    return Terms(0.5 * z * z, z * z_e, dalpha - (k * z + z_t) / z_e, 1.0 / (z_over_e * z_e))


def prescribed_performance(tube, k):
    """V = 1/2 eps^2, eps = 1/2 ln[(k_l + e) k_u / ((k_u - e) k_l)]."""
    e, dalpha, k_l, k_u, dk_l, dk_u = tube
    eps = 0.5 * log((k_l + e) * k_u / ((k_u - e) * k_l))
    eps_e = 0.5 * (1.0 / (k_l + e) + 1.0 / (k_u - e))
    eps_l = 0.5 * (1.0 / (k_l + e) - 1.0 / k_l)
    eps_u = 0.5 * (1.0 / k_u - 1.0 / (k_u - e))
    a = dalpha - (k * eps + eps_l * dk_l + eps_u * dk_u) / eps_e
    return Terms(0.5 * eps * eps, eps * eps_e, a, None)


def quadratic(tube, k):
    """V = 1/2 e^2, for a level without bounds."""
    return Terms(0.5 * tube.e * tube.e, tube.e, tube.dalpha - k * tube.e, 1.0)


# --- The law --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """One closed loop.  Entries of k, w and x0 are the levels, and n numbers each, or one."""

    order: int
    n: int
    drift: Callable
    """(i, t, x) -> f_{i+1}, n numbers or a series of them; i counts from 0."""
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
    return case.drift(i, t, x) + times(case.gain(i, t, x), x[i + 1]) + d_hat[i]


def model_series(case, t, x, d_hat, levels):
    """The first states as series along the model's flow: level i has `levels` - i + 1 terms."""
    series = [Series([row]) for row in x]
    for terms in range(1, levels):
        now = clock(t, terms)
        rates = [model_rate(case, i, now, series, d_hat) for i in range(levels - terms)]
        series[: len(rates)] = [p.integral(row) for p, row in zip(rates, x, strict=False)]
    return series


def tube_of(x, alpha, dalpha, sides):
    """The tube of a level; `sides` are the lower and the upper one, or None."""
    if sides is None:
        return Tube(x - alpha, dalpha, *[None] * 4)
    low, up = sides
    return Tube(x - alpha, dalpha, alpha - low, up - alpha, dalpha - low.rate(), up.rate() - dalpha)


def level(case, i, t, x, d_hat, tube, below):
    """alpha_{i+1} and the terms of its barrier; `below` are those of the level below."""
    barrier, k = case.barriers[i], np.array(case.k[i])
    if case.decays is not None:
        k = k + case.decays[i].gain(t, barrier(tube, k).V)
    terms = barrier(tube, k)
    wanted = terms.a - case.c[i] * terms.s
    if below is not None:
        exchange = times(case.gain(i - 1, t, x).T, np.array(case.w[i - 1]) * below.s)
        wanted = wanted - terms.ratio / np.array(case.w[i]) * exchange
    return solve(case.gain(i, t, x), wanted - (case.drift(i, t, x) + d_hat[i])), terms


class Control(NamedTuple):
    """The law at one state; lists over the levels of arrays of the components."""

    alpha: list
    V: Any
    """sum w_i V_i."""
    s: list


def law(case, t, x, d_hat, beta=None, levels=None, shift=None):
    """alpha_1 .. alpha_levels and the Lyapunov function of these levels; all of them if not given.

    `shift` is the auxiliary state lambda of a limited input and -k lambda, n numbers each, which
    the last error x_r - alpha_{r-1} - lambda contains.  The results are numbers of the kind of the
    arguments.
    """
    levels = case.order if levels is None else levels
    now, d_hat = clock(t, levels + 1), np.array(d_hat)
    # The filters take the derivatives of the virtual controls: the states need no rates.
    states = model_series(case, t, x, d_hat, levels if case.filter is None else 1)
    reference = case.reference.at(now)
    alpha, dalpha, terms = reference, reference.rate(), None
    alphas, slopes, V = [], [], 0.0
    for i in range(levels):
        sides = case.bounds[i] and [side.at(now, reference) for side in case.bounds[i]]
        tube = tube_of(states[i], alpha, dalpha, sides)
        if shift is not None and i == case.order - 1:
            tube = tube._replace(e=tube.e - shift[0], dalpha=tube.dalpha + shift[1])
        alpha, terms = level(case, i, now, states, d_hat, tube, terms)
        alphas.append(alpha.c[0])
        slopes.append(terms.s.c[0])
        V = V + (np.array(case.w[i]) * terms.V.c[0]).sum()
        if i == levels - 1:
            break
        if case.filter is None:
            dalpha = alpha.rate()
        else:
            alpha, dalpha = Series([beta[i]]), Series([filter_rate(case, i, alphas[i], beta[i])])
    return Control(alphas, V, slopes)


def filter_rate(case, i, alpha, beta):
    """beta' = (alpha - beta)/mu of the dynamic surface."""
    return (alpha - beta) / case.filter[i]


# --- The closed loop ------------------------------------------------------------------------------


def unpack(case, y):
    """x, d_hat_j = eta_j + kappa_j x_j and beta from the state of the loop; beta is empty without
    filters."""
    x, eta, beta = np.split(y.reshape(-1, case.n), [case.order, 2 * case.order])
    return x, eta + np.array(case.kappa)[:, None] * x, beta


def flow(case, t, x, u):
    """f_i + G_i x_{i+1} of every level."""
    chain, zero = [Series([row]) for row in (*x, u)], np.zeros(case.order)
    return np.array([model_rate(case, i, t, chain, zero).c[0] for i in range(case.order)])


def loop_rate(case, t, y):
    x, d_hat, beta = unpack(case, y)
    alpha = law(case, t, x, d_hat, beta).alpha
    known = flow(case, t, x, alpha[-1])
    deta = -np.array(case.kappa)[:, None] * (known + d_hat)
    dbeta = [filter_rate(case, i, alpha[i], b) for i, b in enumerate(beta)]
    return np.concatenate([known + case.disturbance(t, x), deta, dbeta], axis=None)


def start(case):
    """(x, eta, beta) at t = 0, with d_hat = 0 and beta = alpha of the law without filters."""
    x = np.array(case.x0)
    exact_law = law(replace(case, filter=None), 0.0, x, np.zeros_like(x))
    beta = [] if case.filter is None else exact_law.alpha[:-1]
    return np.concatenate([x, -np.array(case.kappa)[:, None] * x, beta], axis=None)


def record(case, states):
    """What the reference file stores of states (t, x, d_hat, beta): name -> (T, ...)."""
    controls = [law(case, *state) for state in states]
    arrays = dict(zip(("t", "x", "d_hat", "beta"), zip(*states, strict=True), strict=True))
    arrays |= {"alpha": [c.alpha for c in controls], "V": [c.V for c in controls]}
    arrays["u"] = [c.alpha[-1] for c in controls]
    names = arrays.keys() - ({"beta"} if case.filter is None else ())
    return {name: np.array(arrays[name], dtype=float) for name in names}


def run(case, duration=4.0, step=0.01, rtol=1e-11):
    """What the reference file stores along the loop."""
    times = np.round(np.arange(round(duration / step) + 1) * step, 12)
    how = {"method": "DOP853", "t_eval": times, "rtol": rtol, "atol": 0.01 * rtol}
    found = solve_ivp(lambda t, y: loop_rate(case, t, y), (0.0, times[-1]), start(case), **how)
    if not found.success:
        raise RuntimeError(found.message)
    states = zip(times, found.y.T, strict=True)
    return record(case, [(t, *unpack(case, y)) for t, y in states])


# --- Random states --------------------------------------------------------------------------------


def random_states(case, spread, noise, count=20, seed=1):
    """States (t, x, d_hat, beta) with every alpha well inside its bounds, drawn from below.

    Errors of levels without bounds are up to `spread`; d_hat of a level is up to `noise`.
    """
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        t = float(rng.uniform(0.0, 4.0))
        d_hat = [size * rng.uniform(-1.0, 1.0, case.n) for size in noise]
        state = random_state(case, rng, t, d_hat, spread)
        if state is not None:
            found.append((t, state[0], d_hat, state[1]))
    return found


def random_state(case, rng, t, d_hat, spread):
    """x and beta at this time, or None if a virtual control came near its bounds."""
    x, beta = [], []
    reference = centre = case.reference.at(t)
    for i in range(case.order):
        draw = rng.uniform(-1.0, 1.0, case.n)
        if case.bounds[i] is None:
            x.append(centre + spread[i] * draw)
        else:
            lower, upper = (side.at(t, reference) for side in case.bounds[i])
            below, above = centre - lower, upper - centre
            if np.any(np.minimum(below, above) < 0.15 * (upper - lower)):
                return None
            x.append(centre + 0.7 * draw * np.where(draw > 0, above, below))
        if i < case.order - 1:
            centre = law(case, t, x, d_hat, beta, levels=i + 1).alpha[i]
            if case.filter is not None:
                centre = centre + rng.uniform(-0.1, 0.1, case.n)
                beta.append(centre)
    return x, beta


exact = np.vectorize(mpmath.mpf, otypes=[object])
"""The same numbers in those of mpmath."""


def points(case, spread, noise):
    """The law at random states, evaluated with 50 digits."""
    with mpmath.workdps(50):
        states = random_states(case, spread, noise)
        return record(case, [(mpmath.mpf(t), *map(exact, rest)) for t, *rest in states])


# --- Case 1: coupled gains, and case 4: the same plant with a dynamic surface ---------------------

LEVELS, WIDTH = 3, 2


def spread_numbers(shape, seed):
    """Numbers in [-1, 1] with two decimals, by multiples of the golden ratio."""
    steps = (seed + np.arange(math.prod(shape))) * 0.5 * (math.sqrt(5.0) - 1.0)
    return np.round(2.0 * (steps % 1.0) - 1.0, 2).reshape(shape)


def only_known_levels(wave):
    """Sets to zero what level i must not depend on: x_{i+1} and above."""
    is_known = np.arange(8) < 2 + WIDTH * np.arange(1, LEVELS + 1)[:, None]
    return wave * np.expand_dims(is_known, tuple(range(1, wave.ndim - 1)))


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
COUPLED_DISTURBANCE = {
    "amplitude": ((0.05, 0.04), (0.3, 0.25), (0.8, 0.6)),
    "frequency": ((1.3, 0.7), (2.1, 1.6), (0.9, 2.7)),
    "phase": ((0.0, 0.4), (1.0, 0.2), (0.7, 2.0)),
}


def waves(wave, i, t, x):
    """sin of rows of coefficients times (1, t, x_1 .. x_{i+1})."""
    phase = wave[..., 0] + wave[..., 1] * t
    for j in range(i + 1):
        phase = phase + times(wave[..., 2 + WIDTH * j : 2 + WIDTH * (j + 1)], x[j])
    return sin(phase)


def table_drift(i, t, x):
    return DRIFT_SIZE[i] * waves(DRIFT_WAVE[i], i, t, x)


def table_gain(i, t, x):
    return GAIN_CENTRE[i] + GAIN_SIZE[i] * waves(GAIN_WAVE[i], i, t, x)


def table_disturbance(t, x):
    """Sinusoids on every level and component."""
    amplitude, frequency, phase = map(np.array, COUPLED_DISTURBANCE.values())
    return amplitude * sin(frequency * t + phase)


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
JOINT_TORQUE = Sine(0.0, (0.5, 0.3), (1.0, 1.7), (0.0, HALF_PI))
"""The disturbance, a torque on the links [N m]."""
P1 = MASS[0] * CENTRE[0] ** 2 + MASS[1] * LENGTH[0] ** 2 + INERTIA[0]
P2 = MASS[1] * CENTRE[1] ** 2 + INERTIA[1]
P3 = MASS[1] * LENGTH[0] * CENTRE[1]
P4 = MASS[0] * CENTRE[0] + MASS[1] * LENGTH[0]
P5 = MASS[1] * CENTRE[1]


def arm_inertia(q):
    c = cos(q[1])
    coupling = P2 + P3 * c
    return stack([[P1 + P2 + 2.0 * P3 * c, coupling], [coupling, P2 + 0.0 * c]])


def arm_gravity(q):
    outer = P5 * GRAVITY * cos(q[0] + q[1])
    return stack([P4 * GRAVITY * cos(q[0]) + outer, outer])


def arm_bias(q, v):
    """C(q, v) v + G(q)."""
    s = P3 * sin(q[1])
    return arm_gravity(q) + stack([-s * (2.0 * v[0] * v[1] + v[1] * v[1]), s * v[0] * v[0]])


def joint_drift(i, t, x):
    """f of level i + 1 of (q, q', theta, theta')."""
    if i == 1:
        return solve(arm_inertia(x[0]), -(arm_bias(x[0], x[1]) + STIFFNESS * x[0]))
    if i == 3:
        return -(MOTOR_DAMPING * x[3] + STIFFNESS * (x[2] - x[0])) / MOTOR_INERTIA
    return np.zeros(2)


def joint_gain(i, t, x):
    """G of level i + 1; STIFFNESS M^-1 is symmetric."""
    if i == 1:
        return stack([solve(arm_inertia(x[0]), column) for column in STIFFNESS * np.eye(2)])
    return np.eye(2) if i != 3 else np.eye(2) / MOTOR_INERTIA


def joint_disturbance(t, x):
    """d_2 = M^-1 times the torque on the links."""
    zero = np.zeros(2)
    return np.array([zero, solve(arm_inertia(x[0]), JOINT_TORQUE.at(t)), zero, zero])


ARM_START = np.array([0.8, 0.8])
INERTIA_0 = np.diag(arm_inertia(ARM_START))
FLEXIBLE = Case(
    order=4,
    n=2,
    drift=joint_drift,
    gain=joint_gain,
    disturbance=joint_disturbance,
    reference=Sine(0.5, 0.14, 1.0, (0.0, HALF_PI)),
    bounds=(tuple(Sine(x, 0.14, 1.0, (HALF_PI, 0.0)) for x in (0.2, 0.9)), None, None, None),
    barriers=(mapping, quadratic, quadratic, quadratic),
    k=(3.0, 20.0, 60.0, 150.0),
    w=(10.0 * INERTIA_0, INERTIA_0, STIFFNESS, MOTOR_INERTIA),
    c=(0.1, 0.5, 1.0, 2.0),
    kappa=(0.0, 20.0, 0.0, 20.0),
    x0=(ARM_START, (0.0, 0.0), ARM_START + arm_gravity(ARM_START) / STIFFNESS, (0.0, 0.0)),
)
"""Levels 1 and 3 have no disturbance, so their d_hat stays 0 whatever their observers' gains."""


# --- Case 3: a pendulum with its motor ------------------------------------------------------------

D, B, N, M, H, KM = 1.0, 1.0, 10.0, 0.1, 1.0, 10.0
"""D x_2' = x_3 - B x_2 - N sin x_1, M x_3' = u - H x_3 - KM x_2."""
PENDULUM_DISTURBANCE = Sine((0.0, 0.0), (0.8, 5.0), (1.4, 2.3), (0.0, 0.5))
"""d_2 [rad/s^2] and d_3 [N m/s]."""


def pendulum_drift(i, t, x):
    if i == 0:
        return np.zeros(1)
    if i == 1:
        return -(B * x[1] + N * sin(x[0])) / D
    return -(H * x[2] + KM * x[1]) / M


def pendulum_gain(i, t, x):
    return np.array([[(1.0, 1.0 / D, 1.0 / M)[i]]])


def pendulum_disturbance(t, x):
    return np.array([0.0, *PENDULUM_DISTURBANCE.at(t)])[:, None]


PENDULUM_START = 0.75
PENDULUM = Case(
    order=3,
    n=1,
    drift=pendulum_drift,
    gain=pendulum_gain,
    disturbance=pendulum_disturbance,
    reference=Sine(0.6, 0.3, 1.0, 0.0),
    bounds=(
        (Funnel(-0.3, -0.06, 1.5), Funnel(0.4, 0.08, 1.2)),
        (Sine(-0.7, 0.1, 0.8, 0.2), Sine(0.55, 0.08, 1.1, 1.0)),
        (Sine(1.5, 0.5, 0.7, 0.0), Sine(10.0, 0.8, 1.2, 0.6)),
    ),
    barriers=(prescribed_performance, mapping, mapping),
    k=(2.0, 6.0, 12.0),
    w=(0.2, 1.0, 0.05),
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
