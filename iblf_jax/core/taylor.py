"""Derivatives of higher order of a function along a curve in time, by Taylor arithmetic.

A curve is a list of pytrees of one structure, the derivatives x(t0), x'(t0), x"(t0), ... of its
arguments.  `along` returns the derivatives of f(x(t)).  Nested forward differentiation computes the
same numbers, but the number of its operations grows exponentially with the order.  Taylor
arithmetic carries the coefficients x[m] of

    x(t0 + s) = x[0] + x[1] s + x[2] s^2 + ... + x[K] s^K,   x[m] = (m-th derivative) / m!,

through the operations of f, and the number of operations grows like K^2.

The rules of the primitives are those of `jax.experimental.jet`, except for a few that are cheaper
or more accurate here.  A function with a primitive that has no rule is differentiated by nested
forward differentiation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import jet

from iblf_jax.kernels import jaxprs

Coefficients = list[Any]
"""Taylor coefficients of one array; None for a coefficient that is zero."""


class NoRuleError(Exception):
    """A primitive has no rule for Taylor coefficients."""


def along(function: Callable, curve: Sequence[tuple]) -> list[Any]:
    """The derivatives of `function(*arguments)` where the arguments follow a curve.

    Args:
      function: a function of pytrees of floating-point arrays.
      curve: the derivatives of the arguments, curve[m] a tuple of the m-th ones; K + 1 of them.

    Returns:
      K + 1 pytrees: the value of the function, and its derivatives of the orders 1 to K.
    """
    order = len(curve) - 1
    if order == 0:
        return [function(*curve[0])]
    if order == 1:
        return list(jax.jvp(function, curve[0], curve[1]))
    try:
        return _by_taylor_arithmetic(function, curve)
    except NoRuleError:
        return _by_nested_jvp(function, curve)


def in_time(function: Callable, t: jax.Array, order: int) -> list[Any]:
    """The value of a function of time and its derivatives up to an order, by nested forward
    differentiation: for the short formulas of references.
    """
    if order == 0:
        return [function(t)]

    def lower(t):
        return in_time(function, t, order - 1)

    values, rates = jax.jvp(lower, (t,), (jnp.ones_like(t),))
    return [*values, rates[-1]]


def curve_of_time(t: jax.Array, count: int) -> list[jax.Array]:
    """The time as a curve: t and its derivatives 1, 0, 0, ..., `count` in all, () each."""
    one, zero = jnp.ones_like(t), jnp.zeros_like(t)
    return [t, one, *[zero] * count][:count]


def _by_nested_jvp(function: Callable, curve: Sequence[tuple]) -> list[Any]:
    """`along` by nested forward differentiation, for every function that JAX differentiates."""
    coefficients = [_divided(x, math.factorial(m)) for m, x in enumerate(curve)]

    def value(s: jax.Array) -> Any:
        def polynomial(*terms):
            total = terms[-1]
            for term in reversed(terms[:-1]):
                total = total * s + term
            return total

        return function(*jax.tree.map(polynomial, *coefficients))

    dtype = jnp.result_type(jax.tree.leaves(curve[0])[0])
    return in_time(value, jnp.zeros((), dtype), len(curve) - 1)


def _divided(tree: Any, divisor: int) -> Any:
    """A pytree divided by a whole number."""
    if divisor == 1:
        return tree
    return jax.tree.map(lambda x: x * (1.0 / divisor), tree)


# --- Taylor arithmetic on a traced function -----------------------------------------------------


def _by_taylor_arithmetic(function: Callable, curve: Sequence[tuple]) -> list[Any]:
    """`along` by Taylor arithmetic; NoRuleError for a primitive without a rule."""
    traced, shape = jax.make_jaxpr(function, return_shape=True)(*curve[0])
    rows = [jax.tree.leaves(_divided(x, math.factorial(m))) for m, x in enumerate(curve)]
    inputs = [list(coefficients) for coefficients in zip(*rows, strict=True)]
    outputs = _evaluated(traced, inputs, len(curve) - 1)
    structure = jax.tree.structure(shape)
    dense = [_with_zeros(coefficients) for coefficients in outputs]
    found = []
    for m, row in enumerate(zip(*dense, strict=True)):
        scaled = [_scaled(x, float(math.factorial(m))) for x in row]
        found.append(jax.tree.unflatten(structure, scaled))
    return found


def _with_zeros(coefficients: Coefficients) -> list[jax.Array]:
    """Coefficients with arrays of zeros in the place of None."""
    zero = jnp.zeros_like(coefficients[0])
    return [zero if x is None else x for x in coefficients]


def _of_one_shape(coefficients: Coefficients) -> Coefficients:
    """Coefficients of the shape of the first: one operand of an operation may be a scalar, and a
    higher coefficient may be that of the scalar alone.
    """
    shape = coefficients[0].shape
    return [
        x if x is None or x.shape == shape else jnp.broadcast_to(x, shape) for x in coefficients
    ]


def _evaluated(function: Any, inputs: list[Coefficients], order: int) -> list:
    """The coefficients of the outputs of a traced function.

    Calls are evaluated in place: the rules of functions with derivatives of their own
    (`jax.custom_jvp`) are of first order only.
    """
    jaxpr, consts = jaxprs.opened(function)
    known: dict[Any, Coefficients] = {}
    constant = [None] * order

    def read(atom) -> Coefficients:
        if not jaxprs.is_variable(atom):
            return [jnp.asarray(atom.val, atom.val.dtype), *constant]
        return known[atom]

    for variable, value in zip(jaxpr.constvars, consts, strict=True):
        known[variable] = [value, *constant]
    known.update(zip(jaxpr.invars, inputs, strict=True))
    for equation in jaxpr.eqns:
        found = _evaluated_equation(equation, [read(x) for x in equation.invars], order)
        known.update(zip(equation.outvars, found, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _evaluated_equation(equation: Any, inputs: list[Coefficients], order: int) -> list:
    """The coefficients of the outputs of one equation."""
    primitive, params = equation.primitive, equation.params
    if all(x is None for coefficients in inputs for x in coefficients[1:]):
        values = primitive.bind(*[x[0] for x in inputs], **params)
        if not primitive.multiple_results:
            values = [values]
        return [[x, *[None] * order] for x in values]
    function = jaxprs.called(equation)
    if function is not None:
        return _evaluated(function, inputs, order)
    if primitive.name == "scan":
        return _evaluated_scan(params, inputs, order)
    if primitive in RULES:
        return [_of_one_shape(RULES[primitive](inputs, params))]
    if primitive in LINEAR:
        return [_termwise(partial(primitive.bind, **params), inputs)]
    if primitive not in jet.jet_rules:
        raise NoRuleError(primitive.name)
    dense = [_with_zeros(x) for x in inputs]
    values, series = jet.jet_rules[primitive](
        [x[0] for x in dense], [x[1:] for x in dense], **params
    )
    if not primitive.multiple_results:
        values, series = [values], [series]
    found = []
    for value, terms in zip(values, series, strict=True):
        if terms is jet.zero_series:
            terms = [None] * order
        found.append([value, *terms])
    return found


def _evaluated_scan(params: dict, inputs: list[Coefficients], order: int) -> list:
    """The coefficients of the outputs of a loop of fixed length, written out."""
    consts_count, carry_count = jaxprs.scan_sizes(params)
    consts = inputs[:consts_count]
    carry = inputs[consts_count : consts_count + carry_count]
    sequences = inputs[consts_count + carry_count :]
    steps = list(range(params["length"]))
    if params["reverse"]:
        steps.reverse()
    collected: list[list] = []
    for i in steps:
        entries = [[None if x is None else x[i] for x in sequence] for sequence in sequences]
        found = _evaluated(params["jaxpr"], [*consts, *carry, *entries], order)
        carry = found[:carry_count]
        collected.append(found[carry_count:])
    if params["reverse"]:
        collected.reverse()
    stacked = []
    for outputs in zip(*collected, strict=True):
        rows = [_with_zeros(output) for output in outputs]
        stacked.append([jnp.stack(terms) for terms in zip(*rows, strict=True)])
    return [*carry, *stacked]


# --- rules ----------------------------------------------------------------------------------------


def _total(terms: list) -> Any:
    """The sum of the terms that are not None; None for no term."""
    known = [term for term in terms if term is not None]
    if not known:
        return None
    total = known[0]
    for term in known[1:]:
        total = total + term
    return total


def _difference(a: Any, b: Any) -> Any:
    """The difference of two coefficients, where None is zero."""
    if b is None:
        return a
    if a is None:
        return -b
    return a - b


def _product(a: Any, b: Any, times: Callable = lax.mul) -> Any:
    """The product of two coefficients, where None is zero."""
    if a is None or b is None:
        return None
    return times(a, b)


def _scaled(x: Any, factor: float) -> Any:
    """A coefficient times a number, where None is zero."""
    if x is None or factor == 1.0:
        return x
    return x * factor


def _termwise(operation: Callable, inputs: list[Coefficients]) -> Coefficients:
    """A linear operation, applied to every coefficient on its own."""
    found: Coefficients = []
    for terms in zip(*inputs, strict=True):
        if all(term is None for term in terms):
            found.append(None)
            continue
        dense = [
            jnp.zeros_like(coefficients[0]) if term is None else term
            for term, coefficients in zip(terms, inputs, strict=True)
        ]
        found.append(operation(*dense))
    return found


def _bilinear(primitive: Any, inputs: list[Coefficients], params: dict) -> Coefficients:
    first, second = inputs
    return _product_of(first, second, partial(primitive.bind, **params))


def _product_of(a: Coefficients, b: Coefficients, times: Callable = lax.mul) -> Coefficients:
    """The coefficients of a product."""
    found: Coefficients = []
    for k in range(len(a)):
        terms = [_product(a[j], b[k - j], times) for j in range(k + 1)]
        found.append(_total(terms))
    return found


def _divide(inputs: list[Coefficients], params: dict) -> Coefficients:
    """By a = y b:  y[k] b[0] = a[k] - sum of y[j] b[k - j], j = 0 ... k - 1."""
    a, b = inputs
    quotient: Coefficients = [a[0] / b[0]]
    reciprocal = 1.0 / b[0]
    for k in range(1, len(a)):
        rest = _total([_product(quotient[j], b[k - j]) for j in range(k)])
        quotient.append(_product(_difference(a[k], rest), reciprocal))
    return quotient


def _integrated(factor: Coefficients, x: Coefficients, k: int) -> Any:
    """Coefficient k of y with y' = factor x'."""
    terms = [_product(_scaled(x[j], float(j)), factor[k - j]) for j in range(1, k + 1)]
    return _scaled(_total(terms), 1.0 / k)


def _sine_and_cosine(x: Coefficients) -> tuple[Coefficients, Coefficients]:
    """Both together, because each contains the other's lower coefficients."""
    sine: Coefficients = [jnp.sin(x[0])]
    cosine: Coefficients = [jnp.cos(x[0])]
    for k in range(1, len(x)):
        sine_k = _integrated(cosine, x, k)
        cosine_k = _difference(None, _integrated(sine, x, k))
        sine.append(sine_k)
        cosine.append(cosine_k)
    return sine, cosine


def _exponential(x: Coefficients, value: jax.Array) -> Coefficients:
    """The exponential y of x, by y' = y x'; its value is passed."""
    found: Coefficients = [value]
    for k in range(1, len(x)):
        found.append(_integrated(found, x, k))
    return found


def _expm1(inputs: list[Coefficients], params: dict) -> Coefficients:
    found = _exponential(inputs[0], jnp.exp(inputs[0][0]))
    return [jnp.expm1(inputs[0][0]), *found[1:]]


def _logarithm(argument: Coefficients, value: jax.Array) -> Coefficients:
    """The natural logarithm y of the argument x, by y' = x'/x; its value is passed."""
    one = [jnp.ones_like(argument[0]), *[None] * (len(argument) - 1)]
    rate = _divide([one, argument], {})
    return [value, *[_integrated(rate, argument, k) for k in range(1, len(argument))]]


def _sqrt(inputs: list[Coefficients], params: dict) -> Coefficients:
    """By x = y y:  2 y[0] y[k] = x[k] - sum of y[j] y[k - j], j = 1 ... k - 1."""
    x = inputs[0]
    root: Coefficients = [jnp.sqrt(x[0])]
    half = 0.5 / root[0]
    for k in range(1, len(x)):
        rest = _total([_product(root[j], root[k - j]) for j in range(1, k)])
        root.append(_product(_difference(x[k], rest), half))
    return root


def _integer_power(inputs: list[Coefficients], params: dict) -> Coefficients:
    """By repeated squaring, which is regular where the base is 0."""
    exponent = params["y"]
    one = [jnp.ones_like(inputs[0][0]), *[None] * (len(inputs[0]) - 1)]
    if exponent == 0:
        return one
    base, power = inputs[0], None
    rest = abs(exponent)
    while rest:
        if rest % 2:
            factors = [x for x in (power, base) if x is not None]
            power = reduce(_product_of, factors)
        rest //= 2
        if rest:
            base = _product_of(base, base)
    assert power is not None
    if exponent < 0:
        power = _divide([one, power], {})
    return [lax.integer_pow(inputs[0][0], exponent), *power[1:]]


def _extreme(
    value: Callable, is_first: Callable, inputs: list[Coefficients], params: dict
) -> Coefficients:
    """The larger or the smaller argument; the higher coefficients are those of the chosen one."""
    a, b = inputs
    chosen = _termwise(partial(jnp.where, is_first(a[0], b[0])), inputs)
    return [value(a[0], b[0]), *chosen[1:]]


RULES: dict[Any, Callable[[list[Coefficients], dict], Coefficients]] = {
    lax.add_p: lambda inputs, _: [_total([x, y]) for x, y in zip(*inputs, strict=True)],
    lax.sub_p: lambda inputs, _: [_difference(x, y) for x, y in zip(*inputs, strict=True)],
    lax.mul_p: partial(_bilinear, lax.mul_p),
    lax.dot_general_p: partial(_bilinear, lax.dot_general_p),
    lax.div_p: _divide,
    lax.sin_p: lambda inputs, params: _sine_and_cosine(inputs[0])[0],
    lax.cos_p: lambda inputs, params: _sine_and_cosine(inputs[0])[1],
    lax.exp_p: lambda inputs, _: _exponential(inputs[0], jnp.exp(inputs[0][0])),
    lax.expm1_p: _expm1,
    lax.log_p: lambda inputs, _: _logarithm(inputs[0], jnp.log(inputs[0][0])),
    lax.log1p_p: lambda inputs, _: _logarithm(
        [1.0 + inputs[0][0], *inputs[0][1:]], jnp.log1p(inputs[0][0])
    ),
    lax.sqrt_p: _sqrt,
    lax.square_p: lambda inputs, _: _product_of(inputs[0], inputs[0]),
    lax.integer_pow_p: _integer_power,
    lax.select_n_p: lambda inputs, _: _termwise(partial(lax.select_n, inputs[0][0]), inputs[1:]),
    lax.max_p: partial(_extreme, lax.max, lax.ge),
    lax.min_p: partial(_extreme, lax.min, lax.le),
}
"""Primitive -> the coefficients of its output from those of its inputs."""

LINEAR = {
    lax.neg_p,
    lax.convert_element_type_p,
    lax.broadcast_in_dim_p,
    lax.concatenate_p,
    lax.pad_p,
    lax.reshape_p,
    lax.squeeze_p,
    lax.rev_p,
    lax.transpose_p,
    lax.slice_p,
    lax.reduce_sum_p,
    lax.copy_p,
    lax.cumsum_p,
}
"""Primitives that are linear in all their inputs."""
