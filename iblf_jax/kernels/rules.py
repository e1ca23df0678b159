"""The rules of the primitives of a jaxpr that compute numbers.

The primitives that only rearrange numbers are in `structure`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce

import numpy as np

from iblf_jax.kernels.operations import ON_INTERVALS, OPERATIONS
from iblf_jax.kernels.program import Builder, Ids, UnsupportedError, kind_of
from iblf_jax.kernels.structure import STRUCTURE


def each(b: Builder, op: str, eqn, *operands: Ids, kind: str | None = None) -> Ids:
    """Applies an operation entry by entry to operands of one shape (or scalars)."""
    kind = kind or kind_of(eqn.outvars[0].aval.dtype)
    shape = operands[0].shape
    if any(x.shape != shape for x in operands):
        operands = np.broadcast_arrays(*operands)
        shape = operands[0].shape
    flat = zip(*(x.ravel().tolist() for x in operands), strict=True)
    return np.asarray(b.emit_each(op, flat, kind), np.int64).reshape(shape)


def _elementwise(op: str) -> Callable:
    return lambda b, eqn, *operands: each(b, op, eqn, *operands)


def power(b: Builder, eqn, x: Ids, exponent: int) -> Ids:
    """x^exponent by squaring, for an integer exponent; on intervals, an odd power is one operation,
    which does not lose that its factors are equal.
    """
    if b.exact and abs(exponent) > 2:
        power = each(b, "pow", eqn, x, np.full(x.shape, b.constant(abs(exponent), "f")))
        if exponent < 0:
            return each(b, "div", eqn, np.full(x.shape, b.constant(1, "f")), power)
        return power
    result, square, left = None, x, abs(exponent)
    kind = kind_of(eqn.outvars[0].aval.dtype)
    while left:
        if left & 1:
            result = square if result is None else each(b, "mul", eqn, result, square)
        left >>= 1
        if left:
            square = each(b, "mul", eqn, square, square)
    one = np.full(x.shape, b.constant(1, kind))
    if result is None:
        return one
    if exponent < 0:
        return each(b, "div", eqn, one, result)
    return result


def _pow(b: Builder, eqn, x: Ids, y: Ids) -> Ids:
    exponents = {b.value(int(i)) for i in y.ravel()}
    if len(exponents) == 1:
        (value,) = exponents
        if value is not None and float(value).is_integer() and abs(value) <= b.limits.power:
            return power(b, eqn, x, int(value))
    if kind_of(eqn.invars[1].aval.dtype) != "f":
        y = each(b, "convert", eqn, y, kind="f")
    return each(b, "pow", eqn, x, y)


def _select_n(b: Builder, eqn, which: Ids, *cases: Ids) -> Ids:
    result = cases[-1]
    for i in reversed(range(len(cases) - 1)):
        if kind_of(eqn.invars[0].aval.dtype) == "b":
            result = each(b, "select", eqn, which, result, cases[i])
        else:
            here = each(b, "le", eqn, which, np.full(which.shape, b.constant(i, "i")), kind="b")
            result = each(b, "select", eqn, here, cases[i], result)
    return result


def _convert(b: Builder, eqn, x: Ids) -> Ids:
    source, target = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
    if kind_of(source) == kind_of(target):
        return x
    if kind_of(target) == "b":
        return each(b, "ne", eqn, x, np.full(x.shape, b.constant(0, kind_of(source))))
    return each(b, "convert", eqn, x)


def _round(b: Builder, eqn, x: Ids) -> Ids:
    if int(eqn.params["rounding_method"]) != 1:
        raise UnsupportedError("rounding half away from zero is not lowered; use jnp.round")
    return each(b, "round_even", eqn, x)


def _neutral(op: str, kind: str):
    """The result of a reduction of no numbers."""
    if op == "and":
        return {"i": -1, "b": True}[kind]
    return {"add": 0, "mul": 1, "or": 0, "max": -np.inf, "min": np.inf}[op]


def _reduce(op: str) -> Callable:
    def rule(b: Builder, eqn, x: Ids) -> Ids:
        axes = eqn.params["axes"]
        kept = [a for a in range(x.ndim) if a not in axes]
        count = math.prod(x.shape[a] for a in axes)
        rows = np.transpose(x, [*axes, *kept]).reshape(count, *(x.shape[a] for a in kept))
        if len(rows) == 0:
            kind = kind_of(eqn.outvars[0].aval.dtype)
            return np.full(rows.shape[1:], b.constant(_neutral(op, kind), kind))
        return _along(b, op, eqn, rows)

    return rule


def _along(b: Builder, op: str, eqn, rows: Ids) -> Ids:
    """Reduces rows by an operation, one after the other."""
    total = rows[0]
    for row in rows[1:]:
        total = each(b, op, eqn, total, row)
    return total


def _arg_extreme(op: str) -> Callable:
    def rule(b: Builder, eqn, x: Ids) -> Ids:
        (axis,) = eqn.params["axes"]
        rows = np.moveaxis(x, axis, 0)
        best = rows[0]
        where = np.full(rows.shape[1:], b.constant(0, "i"))
        for i, row in enumerate(rows[1:], 1):
            better = each(b, op, eqn, row, best, kind="b")
            is_nan = each(b, "ne", eqn, row, row, kind="b")
            best_is_number = each(b, "eq", eqn, best, best, kind="b")
            first_nan = each(b, "and", eqn, is_nan, best_is_number, kind="b")
            better = each(b, "or", eqn, better, first_nan, kind="b")
            where = each(b, "select", eqn, better, np.full(where.shape, b.constant(i, "i")), where)
            best = each(b, "select", eqn, better, row, best, kind=b.nodes[int(row.flat[0])].kind)
        return where

    return rule


def _cumulative(op: str) -> Callable:
    def rule(b: Builder, eqn, x: Ids) -> Ids:
        axis = eqn.params["axis"]
        direction = slice(None)
        if eqn.params["reverse"]:
            direction = slice(None, None, -1)
        rows = np.moveaxis(x, axis, 0)[direction]
        if len(rows) == 0:
            return x
        done = [rows[0]]
        for row in rows[1:]:
            done.append(each(b, op, eqn, done[-1], row))
        return np.moveaxis(np.stack(done)[direction], 0, axis)

    return rule


def _dot_general(b: Builder, eqn, x: Ids, y: Ids) -> Ids:
    """Products and sums.

    A term with a factor that is a literal zero is excluded: a matrix that is written with zeros is
    sparse.
    """
    (x_summed, y_summed), (x_batch, y_batch) = eqn.params["dimension_numbers"]
    x_rows = _rows_of(x, x_batch, x_summed)
    y_rows = _rows_of(y, y_batch, y_summed)
    kind = kind_of(eqn.outvars[0].aval.dtype)
    flat = [
        _dot(b, kind, u.tolist(), v.tolist())
        for one, other in zip(x_rows, y_rows, strict=True)
        for u in one
        for v in other
    ]
    return np.asarray(flat, np.int64).reshape(eqn.outvars[0].aval.shape)


def _rows_of(x: Ids, batch: Sequence[int], summed: Sequence[int]) -> Ids:
    """An operand of a product as an array (batch, free, summed)."""
    free = [axis for axis in range(x.ndim) if axis not in (*batch, *summed)]
    sizes = [math.prod(x.shape[axis] for axis in axes) for axes in (batch, free, summed)]
    return np.transpose(x, [*batch, *free, *summed]).reshape(sizes)


def _dot(b: Builder, kind: str, u: list[int], v: list[int]) -> int:
    """The scalar product of two rows."""
    terms: list[int] = []
    for x, y in zip(u, v, strict=True):
        if b.value(x) == 0 or b.value(y) == 0:
            continue
        terms.append(b.emit("mul", x, y, kind=kind))
    if not terms:
        return b.constant(0, kind)
    return reduce(lambda total, term: b.emit("add", total, term, kind=kind), terms)


def _one_minus_square(b: Builder, eqn, x: Ids) -> Ids:
    """As (1 + x) (1 - x), which is exact where |x| is close to 1; on intervals as 1 - x^2, in which
    x occurs once.
    """
    one = np.full(x.shape, b.constant(1, "f"))
    if b.exact:
        return each(b, "sub", eqn, one, each(b, "mul", eqn, x, x))
    return each(b, "mul", eqn, each(b, "add", eqn, one, x), each(b, "sub", eqn, one, x))


def _log2(b: Builder, eqn, x: Ids) -> Ids:
    if b.exact:
        raise UnsupportedError("the operation 'log2' is not available on intervals")
    log_of_2 = np.full(x.shape, b.constant(np.log(2.0), "f"))
    return each(b, "div", eqn, each(b, "log", eqn, x), log_of_2)


def _of_intervals(op: str) -> Callable:
    """The rule of a primitive of `interval_primitives`, the identity elsewhere."""

    def rule(b: Builder, eqn, x: Ids, *others: Ids) -> Ids:
        if b.exact:
            return each(b, op, eqn, x, *others)
        return x

    return rule


def _primitives_of(op: str) -> tuple[str, ...]:
    """The primitives that apply an operation entry by entry."""
    primitives = OPERATIONS[op].primitives
    if primitives is None:
        return (op,)
    return primitives


RULES: dict[str, Callable] = {
    **{name: _elementwise(op) for op in OPERATIONS for name in _primitives_of(op)},
    **STRUCTURE,
    "square": lambda b, eqn, x: each(b, "mul", eqn, x, x),
    "pow": _pow,
    "integer_pow": lambda b, eqn, x: power(b, eqn, x, eqn.params["y"]),
    "round": _round,
    "select_n": _select_n,
    "clamp": lambda b, eqn, low, x, high: each(b, "min", eqn, each(b, "max", eqn, x, low), high),
    "convert_element_type": _convert,
    "one_minus_square": _one_minus_square,  # since jax 0.11
    "log2": _log2,  # since jax 0.11
    **dict.fromkeys(
        ("stop_gradient", "optimization_barrier", "copy", "copy_p", "reduce_precision"),
        lambda b, eqn, *operands: list(operands),
    ),
    "reduce_sum": _reduce("add"),
    "reduce_prod": _reduce("mul"),
    "reduce_max": _reduce("max"),
    "reduce_min": _reduce("min"),
    "reduce_and": _reduce("and"),
    "reduce_or": _reduce("or"),
    "argmin": _arg_extreme("lt"),
    "argmax": _arg_extreme("gt"),
    "cumsum": _cumulative("add"),
    "cumprod": _cumulative("mul"),
    "cummax": _cumulative("max"),
    "cummin": _cumulative("min"),
    "dot_general": _dot_general,
    **{op: _of_intervals(op) for op in ON_INTERVALS},
}
