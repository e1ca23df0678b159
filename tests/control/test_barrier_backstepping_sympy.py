"""`BarrierBackstepping` against a derivation by SymPy: a scalar plant of order 3, with
`TransformedError` and time-varying bounds on every level.  Each level of (S.2) is written once, and
its total derivatives are formed by the chain rule over the symbols of time, of the states and of
what the level takes from the level below."""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy as sp

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, plants, references

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


def scenario():
    def rows(t, x):
        drift, gain = drift_and_gain(x[:, 0], jnp.cos, jnp.sin, jnp.exp)
        return jnp.stack(drift)[:, None], jnp.stack(gain)[:, None]

    functions = (lambda t, x: rows(t, x)[0]), (lambda t, x: rows(t, x)[1])
    mappings = (barriers.TransformedError(),) * ORDER
    return ij.Scenario(
        plant=plants.StrictFeedback(*functions, n=1, order=ORDER),
        reference=references.Sinusoid(offset=0.0, amplitude=0.5),
        bounds=[ij.Bounds(*(bounds.Sinusoid(*side) for side in sides(i))) for i in range(ORDER)],
        controller=controllers.BarrierBackstepping(k=K, barriers=mappings, c=C, weights=WEIGHTS),
        initial=ij.Initial(x=[[0.1], [0.0], [0.0]]),
    )


@pytest.mark.slow
def test_a_derivation_by_sympy_gives_the_same_input():
    case, rng = scenario(), np.random.default_rng(3)
    command = jax.jit(lambda t, x: case.controller.command(t, x, 0.0 * x, case.context, ())[0])
    for _ in range(20):
        t = rng.uniform(0.0, 10.0)
        x = rng.uniform([-0.7, -2.0, -8.0], [0.7, 2.0, 8.0])
        found = command(jnp.asarray(t), jnp.asarray(x)[:, None])
        alphas = [found.alpha[0], found.alpha_higher[0, 0], found.tau[0]]
        np.testing.assert_allclose(alphas, derived_input(t, x), rtol=1e-9)
