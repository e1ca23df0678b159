"""Taylor arithmetic against nested forward differentiation, and against series that are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from iblf_jax.core import taylor
from iblf_jax.core.linalg import solve_gain, solve_spd

ORDER = 4
FUNCTIONS = {
    "quotient": lambda x, y: x / (1.0 + y**2) - y,
    "trigonometric": lambda x, y: jnp.sin(x) * jnp.cos(x * y),
    "exponential": lambda x, y: jnp.exp(x) + jnp.expm1(y) * jnp.tanh(x),
    "logarithm": lambda x, y: jnp.log(2.0 + x**2) + jnp.log1p(y**2),
    "roots and powers": lambda x, y: jnp.sqrt(1.0 + x**2) * (1.0 + y**2) ** -3 + y**2.5,
    "choices": lambda x, y: jnp.where(x > 0, x**3, y) + jnp.maximum(x, y) + jnp.minimum(x, 2 * y),
    "absolute value": lambda x, y: jnp.abs(x * y) + jnp.sign(x),
    "a matrix": lambda x, y: jnp.stack([x, y]).T @ jnp.stack([y, x]),
    "a loop": lambda x, y: jax.lax.scan(lambda c, z: (c * y + z, c), x, jnp.stack([x, y, x]))[1],
    "no dependence": lambda x, y: jnp.ones(2),
}


def curve(seed=0, size=3):
    rng = np.random.default_rng(seed)
    start = tuple(jnp.asarray(rng.uniform(0.4, 1.5, size)) for _ in range(2))
    return [start, *[tuple(jnp.asarray(rng.normal(size=(2, size)))) for _ in range(ORDER)]]


def assert_close(found, expected, tolerance):
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_equal_to_nested_forward_differentiation(name):
    f = FUNCTIONS[name]
    both = jax.jit(lambda curve: (taylor.along(f, curve), taylor._by_nested_jvp(f, curve)))
    found, expected = both(curve())
    assert len(found) == ORDER + 1
    assert_close(found, expected, 1e-10)


def test_a_function_without_a_rule_is_differentiated_by_nested_jvp():
    def with_condition(x, y):
        return jax.lax.cond(x[0] > 0, lambda: x * y, lambda: x + y)

    with pytest.raises(taylor.NoRuleError):
        taylor._by_taylor_arithmetic(with_condition, curve())
    expected = taylor.along(lambda x, y: x * y, curve())
    assert_close(taylor.along(with_condition, curve()), expected, 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [solve_spd, solve_gain])
def test_solutions_of_equations(solver):
    """Functions with a derivative rule of first order (`jax.custom_jvp`) are written out."""

    def solution(x, y):
        return solver(jnp.diag(2.0 + x**2) + 0.3 * jnp.outer(y, y), x * y)

    found = taylor.along(solution, curve())
    assert_close(found, taylor._by_nested_jvp(solution, curve()), 1e-9)


def test_derivatives_in_time():
    """sin 2t, and exp(sin t) at 0, whose derivatives are 1, 1, 1, 0, -3."""
    found = taylor.in_time(lambda t: jnp.sin(2.0 * t), jnp.asarray(0.3), 3)
    s, c = np.sin(0.6), np.cos(0.6)
    np.testing.assert_allclose(found, [s, 2 * c, -4 * s, -8 * c], rtol=1e-14)
    found = taylor.in_time(lambda t: jnp.exp(jnp.sin(t)), jnp.zeros(()), 4)
    np.testing.assert_allclose(found, [1.0, 1.0, 1.0, 0.0, -3.0], atol=1e-14)
