"""What the package knows of JAX's internals holds for the version that is installed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from iblf_jax.kernels import jaxprs
from iblf_jax.kernels.primitives import is_zero, new_primitive, without_symbol

TABLE = jnp.asarray([1.0, 2.0, 4.0])


@jax.custom_jvp
def with_a_rule(x):
    return jnp.sin(x)


with_a_rule.defjvp(lambda primals, tangents: (jnp.sin(primals[0]), tangents[0]))


@jax.custom_vjp
def with_a_reverse_rule(x):
    return jnp.sin(x)


with_a_reverse_rule.defvjp(lambda x: (jnp.sin(x), x), lambda x, g: (g,))
CALLS = {
    "jit": jax.jit(jnp.sin),
    "custom_jvp": with_a_rule,
    "custom_vjp": with_a_reverse_rule,
    "checkpoint": jax.checkpoint(jnp.sin),
}


def names(function):
    return [equation.primitive.name for equation in jaxprs.opened(function)[0].eqns]


@pytest.mark.parametrize("kind", CALLS)
def test_the_function_that_an_equation_calls_is_found(kind):
    traced = jax.make_jaxpr(CALLS[kind])(1.0)
    (equation,) = jaxprs.opened(traced)[0].eqns
    inner = jaxprs.called(equation)
    assert names(inner) == ["sin"]
    (innermost,) = jaxprs.opened(inner)[0].eqns
    assert jaxprs.called(innermost) is None and jaxprs.count_operations(traced) == 2


def test_a_function_that_is_called_often_is_visited_once():
    """Forty functions, each of which calls the next one twice: 2^40 calls."""

    def doubled(inner):
        return jax.jit(lambda x: inner(inner(x)))

    function = jax.jit(lambda x: jnp.sin(x) + 0.25)
    for _ in range(40):
        function = doubled(function)
    traced = jax.make_jaxpr(function)(1.0)
    assert [float(x) for x in jaxprs.constants(traced)] == [0.25]
    assert {"sin", "add"} <= jaxprs.primitives(traced)
    assert len(list(jaxprs.nested(traced))) == 42
    assert jaxprs.count_operations(traced) == 1 + 40 * 2 + 2
    assert jaxprs.count_executed_operations(traced) == 2 * 2**40


def test_dependences():
    traced = jax.make_jaxpr(lambda x, y, z: (x + 1.0, jnp.sin(x) * z, z, 2.0))(1.0, 2.0, 3.0)
    assert jaxprs.depend_on_last(traced, 1) == [False, True, True, False]
    assert jaxprs.depend_on_last(traced, 3) == [True, True, True, False]
    assert jaxprs.depend_on_last(traced, 0) == [False] * 4
    jaxpr, _ = jaxprs.opened(traced)
    x, y, z = jaxpr.invars
    found = jaxprs.needed(traced)
    assert {x, z} <= found and y not in found


def test_one_entry_of_a_stack():
    def stacked(x):
        return jnp.stack([jnp.sin(x) * TABLE, jnp.cos(x) + TABLE])

    traced = jax.make_jaxpr(stacked)(0.3)
    for index in range(2):
        entry = jaxprs.entry_of_stack(traced, index)
        np.testing.assert_array_equal(entry(jnp.asarray(0.3)), stacked(0.3)[index])
    other_axis = jax.make_jaxpr(lambda x: jnp.stack([x, x], axis=1))(jnp.ones(2))
    for other in (jax.make_jaxpr(jnp.sin)(0.3), other_axis):
        assert jaxprs.entry_of_stack(other, 0) is None


def test_constants_and_primitives_of_inner_functions():
    """Before JAX 0.11 a function that a loop calls keeps its constants for itself."""
    captured = jnp.arange(6.0).reshape(2, 3)

    def branches(x):
        return jax.lax.cond(x[0] > 0.5, lambda x: jnp.sum(jnp.sin(x)) * 7.5, lambda x: x @ TABLE, x)

    def body(carry, _):
        return jax.jit(lambda x: x @ jnp.diag(np.array([3.0, 5.0, 8.0])))(carry), None

    def loop(x):
        return jax.lax.scan(body, x, None, length=2)[0]

    traced = jax.make_jaxpr(branches)(TABLE)
    assert {"cond", "sin", "dot_general", "reduce_sum"} <= jaxprs.primitives(traced)
    for function, *wanted in (
        (traced, TABLE, 7.5),
        (jax.make_jaxpr(jax.jit(lambda x: x + captured))(1.0), captured),
        (jax.make_jaxpr(loop)(jnp.ones(3)), [3.0, 5.0, 8.0]),
    ):
        found = [np.asarray(x) for x in jaxprs.constants(function)]
        assert all(any(np.array_equal(x, y) for x in found) for y in wanted)


double_sum = new_primitive(
    "double_sum_of_the_tests",
    lambda x, y: 2.0 * x + 2.0 * y,
    shapes=lambda x, y: x,
    jvp=lambda primals, tangents: (
        double_sum.bind(*primals),
        double_sum.bind(*map(without_symbol, tangents)),
    ),
    batch=lambda operands, axes: (double_sum.bind(*operands), axes[0]),
    transpose=lambda g, x, y: [2.0 * without_symbol(g)] * 2,
)


def test_a_primitive_of_our_own_and_its_derivatives():
    x, y = jnp.asarray([1.0, 2.0]), jnp.asarray([3.0, 5.0])
    for transform in (lambda f: f, jax.jit, jax.vmap):
        np.testing.assert_array_equal(transform(double_sum.bind)(x, y), [8.0, 14.0])
    assert names(jax.make_jaxpr(double_sum.bind)(x, y)) == ["double_sum_of_the_tests"]
    assert jax.jvp(lambda x: double_sum.bind(x, 3.0 * x), (1.0,), (1.0,))[1] == 8.0
    assert jax.linear_transpose(double_sum.bind, 1.0, 1.0)(1.0) == (2.0, 2.0)
    seen = []

    def jvp(primals, tangents):
        seen.append([is_zero(x) for x in tangents])
        return primals[0], without_symbol(tangents[0])

    first = new_primitive(
        "first_of_the_tests",
        lambda x, y: x,
        shapes=lambda x, y: x,
        jvp=jvp,
        batch=lambda operands, axes: (operands[0], axes[0]),
    )
    assert jax.jvp(lambda x: first.bind(x, jnp.asarray(2.0)), (1.0,), (4.0,))[1] == 4.0
    assert seen == [[False, True]]
