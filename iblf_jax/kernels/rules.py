"""What each jaxpr primitive becomes: the rules that compute.  Those that only move numbers about
are in `structure`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from iblf_jax.kernels.operations import OPERATIONS
from iblf_jax.kernels.program import Builder, Ids, UnsupportedError, kind_of
from iblf_jax.kernels.structure import STRUCTURE


def each(b: Builder, op: str, eqn, *operands: Ids, kind: str | None = None) -> Ids:
    """op, entry by entry, on operands of one shape (or scalars)."""
    kind = kind or kind_of(eqn.outvars[0].aval.dtype)
    shape = np.broadcast_shapes(*(x.shape for x in operands))
    flat = zip(*(np.broadcast_to(x, shape).ravel().tolist() for x in operands), strict=True)
    return np.asarray([b.emit(op, *args, kind=kind) for args in flat], np.int64).reshape(shape)


def _elementwise(op: str) -> Callable:
    return lambda b, eqn, *operands: each(b, op, eqn, *operands)


def _integer_pow(b: Builder, eqn, x: Ids) -> Ids:
    exponent = eqn.params["y"]
    return power(b, eqn, x, exponent)


def power(b: Builder, eqn, x: Ids, exponent: int) -> Ids:
    """x^exponent by squaring, for a whole exponent."""
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
    return each(b, "div", eqn, one, result) if exponent < 0 else result


def _pow(b: Builder, eqn, x: Ids, y: Ids) -> Ids:
    exponents = {b.value(int(i)) for i in y.ravel()}
    value = next(iter(exponents)) if len(exponents) == 1 else None
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


def _clamp(b: Builder, eqn, low: Ids, x: Ids, high: Ids) -> Ids:
    return each(b, "min", eqn, each(b, "max", eqn, x, low), high)


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


def _stop(b: Builder, eqn, *operands: Ids):
    return list(operands)


def _reduce(op: str) -> Callable:
    def rule(b: Builder, eqn, x: Ids) -> Ids:
        axes = eqn.params["axes"]
        kept = [a for a in range(x.ndim) if a not in axes]
        rows = np.transpose(x, [*axes, *kept]).reshape(-1, *(x.shape[a] for a in kept))
        if len(rows) == 0:
            kind = kind_of(eqn.outvars[0].aval.dtype)
            neutral = {
                "add": 0,
                "mul": 1,
                "or": 0,
                "and": -1 if kind == "i" else True,
                "max": -np.inf,
                "min": np.inf,
            }[op]
            return np.full(rows.shape[1:], b.constant(neutral, kind))
        return _along(b, op, eqn, rows)

    return rule


def _along(b: Builder, op: str, eqn, rows: Ids) -> Ids:
    total = rows[0]
    for row in rows[1:]:
        total = each(b, op, eqn, total, row)
    return total


def _arg_extreme(op: str) -> Callable:
    def rule(b: Builder, eqn, x: Ids) -> Ids:
        (axis,) = eqn.params["axes"]
        rows = np.moveaxis(x, axis, 0)
        best, where = rows[0], np.full(rows.shape[1:], b.constant(0, "i"))
        for i, row in enumerate(rows[1:], 1):
            better = each(b, op, eqn, row, best, kind="b")
            first_nan = each(
                b,
                "and",
                eqn,
                each(b, "ne", eqn, row, row, kind="b"),
                each(b, "eq", eqn, best, best, kind="b"),
                kind="b",
            )
            better = each(b, "or", eqn, better, first_nan, kind="b")
            where = each(b, "select", eqn, better, np.full(where.shape, b.constant(i, "i")), where)
            best = each(b, "select", eqn, better, row, best, kind=b.nodes[int(row.flat[0])].kind)
        return where

    return rule


def _cumulative(op: str) -> Callable:
    def rule(b: Builder, eqn, x: Ids) -> Ids:
        rows = np.moveaxis(x, eqn.params["axis"], 0)
        rows = rows[::-1] if eqn.params["reverse"] else rows
        done = [rows[0]] if len(rows) else []
        for row in rows[1:]:
            done.append(each(b, op, eqn, done[-1], row))
        result = np.stack(done) if done else rows
        return np.moveaxis(result[::-1] if eqn.params["reverse"] else result, 0, eqn.params["axis"])

    return rule


def _dot_general(b: Builder, eqn, x: Ids, y: Ids) -> Ids:
    """Products and sums; a factor that is a literal zero leaves its term out, as a matrix that is
    written with zeros means it.
    """
    (xc, yc), (xb, yb) = eqn.params["dimension_numbers"]
    xf = [a for a in range(x.ndim) if a not in (*xc, *xb)]
    yf = [a for a in range(y.ndim) if a not in (*yc, *yb)]
    batch, shape = [x.shape[a] for a in xb], ([x.shape[a] for a in xf], [y.shape[a] for a in yf])
    xs = np.transpose(x, [*xb, *xf, *xc]).reshape(int(np.prod(batch)), int(np.prod(shape[0])), -1)
    ys = np.transpose(y, [*yb, *yf, *yc]).reshape(int(np.prod(batch)), int(np.prod(shape[1])), -1)
    kind = kind_of(eqn.outvars[0].aval.dtype)
    flat = [
        _dot(b, kind, u.tolist(), v.tolist())
        for us, vs in zip(xs, ys, strict=True)
        for u in us
        for v in vs
    ]
    return np.asarray(flat, np.int64).reshape((*batch, *shape[0], *shape[1]))


def _dot(b: Builder, kind: str, u: list[int], v: list[int]) -> int:
    total = None
    for x, y in zip(u, v, strict=True):
        if b.value(x) == 0 or b.value(y) == 0:
            continue
        term = b.emit("mul", x, y, kind=kind)
        total = term if total is None else b.emit("add", total, term, kind=kind)
    return b.constant(0, kind) if total is None else total


def _square(b: Builder, eqn, x: Ids) -> Ids:
    return each(b, "mul", eqn, x, x)


def _one_minus_square(b: Builder, eqn, x: Ids) -> Ids:
    """As (1 + x) (1 - x), which is exact where |x| is close to 1."""
    one = np.full(x.shape, b.constant(1, "f"))
    return each(b, "mul", eqn, each(b, "add", eqn, one, x), each(b, "sub", eqn, one, x))


def _log2(b: Builder, eqn, x: Ids) -> Ids:
    return each(
        b, "div", eqn, each(b, "log", eqn, x), np.full(x.shape, b.constant(np.log(2.0), "f"))
    )


RULES: dict[str, Callable] = {
    **{name: _elementwise(op) for op, row in OPERATIONS.items() for name in ((op,) if row.primitives is None else row.primitives)},
    **STRUCTURE,
    "square": _square, "pow": _pow, "integer_pow": _integer_pow, "round": _round, "select_n": _select_n, "clamp": _clamp,
    # the last two since jax 0.11
    "convert_element_type": _convert, "one_minus_square": _one_minus_square, "log2": _log2,
    "stop_gradient": _stop, "optimization_barrier": _stop, "copy": _stop, "copy_p": _stop, "reduce_precision": _stop,
    "reduce_sum": _reduce("add"), "reduce_prod": _reduce("mul"), "reduce_max": _reduce("max"), "reduce_min": _reduce("min"),
    "reduce_and": _reduce("and"), "reduce_or": _reduce("or"), "argmin": _arg_extreme("lt"), "argmax": _arg_extreme("gt"),
    "cumsum": _cumulative("add"), "cumprod": _cumulative("mul"), "cummax": _cumulative("max"), "cummin": _cumulative("min"),
    "dot_general": _dot_general,
}  # fmt: skip
