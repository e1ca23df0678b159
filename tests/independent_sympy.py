"""The input of a law as SymPy derives it: a scalar plant of order 3, with `TransformedError` and
time-varying bounds on every level.  Each level of (S.2) is written once, and its total derivatives
are formed by the chain rule over the symbols of time, of the states and of what the level takes
from the level below."""

import functools
import itertools
from typing import NamedTuple

import numpy as np
import sympy as sp

ORDER = 3
K, WEIGHTS, C = (2.0, 5.0, 9.0), (1.0, 0.3, 0.05), (0.1, 0.2, 0.3)
OFFSETS = ((-1.6, 1.9), (-8.0, 7.0), (-90.0, 80.0))
AMPLITUDES = ((0.2, 0.1), (1.0, 1.5), (5.0, 4.0))
FREQUENCIES = ((1.0, 1.3), (0.7, 1.0), (2.0, 1.0))
STATE, ERROR = sp.symbols("x1:4"), sp.Symbol("error")


def drift_and_gain(x, cos, sin, exp):
    """f_i and G_i of the plant, with the functions of SymPy or of JAX."""
    x1, x2, x3 = x
    drift = [cos(x1) - 0.5 * exp(-(x1**2)), cos(x1 * x2), sin(x1 * x3) - x2**2]
    gain = [1 + 0.25 * x1**2, 2 + sin(x1 * x2), 1 + 0.5 * cos(x3) ** 2]
    return drift, gain


def derivatives(side, t, count):
    """offset + amplitude sin(frequency t) of a side, and its derivatives."""
    offset, amplitude, frequency = side
    orders = np.arange(count)
    values = amplitude * frequency**orders * np.sin(frequency * t + 0.5 * np.pi * orders)
    return values + np.where(orders == 0, offset, 0.0)


def sides(i):
    return zip(OFFSETS[i], AMPLITUDES[i], FREQUENCIES[i], strict=True)


class Inputs(NamedTuple):
    """What a level takes, each with its derivatives in order."""

    alpha: tuple
    """alpha_{i-1}."""
    k_l: tuple
    k_u: tuple
    slope: tuple
    """w_{i-1} s_{i-1}."""


def mapped_level(i, inputs):
    """alpha_i and w_i s_i of row i of (S.2); the error is a symbol of its own."""
    k_l, k_u = inputs.k_l[0], inputs.k_u[0]
    z = ERROR * k_l * k_u / ((k_l + ERROR) * (k_u - ERROR))
    z_e = sp.diff(z, ERROR)
    z_t = sp.diff(z, k_l) * inputs.k_l[1] + sp.diff(z, k_u) * inputs.k_u[1]
    slope = z * z_e
    chosen = inputs.alpha[1] - (K[i] * z + z_t) / z_e - C[i] * slope
    drift, gain = drift_and_gain(STATE, sp.cos, sp.sin, sp.exp)
    if i > 0:
        chosen -= ERROR / (WEIGHTS[i] * slope) * gain[i - 1] * inputs.slope[0]
    return (chosen - drift[i]) / gain[i], WEIGHTS[i] * slope


def total_derivative(expression, i, inputs):
    """d/dt along the flow of the plant of an expression of row i."""
    drift, gain = drift_and_gain(STATE, sp.cos, sp.sin, sp.exp)
    rates = {STATE[j]: drift[j] + gain[j] * STATE[j + 1] for j in range(ORDER - 1)}
    rates[ERROR] = rates[STATE[i]] - inputs.alpha[1]
    for symbols in inputs:
        rates.update(itertools.pairwise(symbols))
    present = expression.free_symbols & rates.keys()
    return sum(sp.diff(expression, symbol) * rates[symbol] for symbol in present)


@functools.cache
def derived_level(i):
    """The function of x, the error and the `Inputs` that gives alpha_i and w_i s_i with their
    derivatives."""
    terms = ORDER - i
    inputs = Inputs(*(sp.symbols(f"{name}0:{terms + 1}") for name in Inputs._fields))
    curves = [mapped_level(i, inputs)]
    for _ in range(terms - 1):
        curves.append([total_derivative(x, i, inputs) for x in curves[-1]])
    return sp.lambdify((STATE, ERROR, inputs), list(zip(*curves, strict=True)), "numpy", cse=True)


def derived_input(t, x):
    """alpha_1, alpha_2 and u at one state; the reference is sin(t)/2."""
    alpha, slope = derivatives((0.0, 0.5, 1.0), t, ORDER + 1), np.zeros(ORDER + 1)
    found = []
    for i in range(ORDER):
        lower, upper = (derivatives(side, t, len(alpha)) for side in sides(i))
        inputs = Inputs(alpha, alpha - lower, upper - alpha, slope)
        alpha, slope = map(np.asarray, derived_level(i)(x, x[i] - alpha[0], inputs))
        found.append(alpha[0])
    return found
