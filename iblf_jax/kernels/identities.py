"""Constant folding, and identities that hold for every floating-point number, including NaN and
infinities.

x + 0 and x * 1 are x (up to the sign of a zero). x * 0 is not 0, because infinity times 0 is NaN,
and a status flag must report that a run is not finite. There are three exceptions: programs of
derivatives (`Builder.sparse`), whose values are those of a program without derivatives; zeros of a
mechanism (`Builder.absent`), because a force without a lever arm has no moment; and the test of
whether a sum with logarithms is finite (`_is_finite`), where the sum is so large that it overflows.
"""

from __future__ import annotations

import math
import operator
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from iblf_jax.kernels.operations import OPERATIONS

if TYPE_CHECKING:
    from iblf_jax.kernels.program import Builder, Node


def fold(op: str, values: list, kinds: list[str], kind: str, dtype: np.dtype):
    """The value of an operation on constants; None if it is not computed here."""
    if op == "convert":
        return {"f": float, "i": int, "b": bool}[kind](values[0])
    function = OPERATIONS[op].numpy
    if function is None:
        return None
    if op == "div" and kind == "i":
        if values[1] == 0:
            return None
        return int(values[0] / values[1])
    types = {"f": dtype.type, "i": np.int64, "b": np.bool_}
    with np.errstate(all="ignore"):
        return function(*(types[k](v) for k, v in zip(kinds, values, strict=True))).item()


EXACT = frozenset({"neg", "abs", "max", "min", "sign", "floor", "ceil", "round_even"})
"""Operations on floating-point numbers whose results are not rounded."""
EXACT_ARITHMETIC = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
}
"""Operations that may be exact for some numbers -> the same on fractions."""


def is_exact(op: str, values: list, kind: str) -> bool:
    """Whether the floating-point result of an operation on constants is exact."""
    if kind != "f" or op in EXACT or op == "convert":
        return True
    if op not in EXACT_ARITHMETIC or not all(map(math.isfinite, values)):
        return False
    if op == "div" and values[1] == 0:
        return False
    from fractions import Fraction  # takes several milliseconds

    result = EXACT_ARITHMETIC[op](*map(Fraction, values))
    try:
        return Fraction(float(result)) == result
    except OverflowError:
        return False


def simplify(b: Builder, op: str, args: tuple[int, ...], kind: str) -> int | None:
    """A node that equals op(*args) and costs less; None if there is none."""
    if op not in _RULES:
        return None
    return _RULES[op](b, args, kind)


def without_absent(b: Builder, op: str, args: tuple[int, ...]) -> int | None:
    """op(*args), of which one is absent (`Builder.absent`); None if it counts as a usual zero."""
    x = args[0]
    y = args[-1]
    if op in ("mul", "neg") or (op == "div" and y != b.absent):
        return b.absent
    if op in ("add", "sub") and y == b.absent:
        return x
    if op == "add":
        return y
    if op == "sub":
        return b.emit("neg", y)
    return None


def _add(b: Builder, args, kind):
    x, y = args
    for one, other in ((x, y), (y, x)):
        if kind != "b" and b.value(one) == 0:
            return other
        if b.nodes[one].op == "neg":
            return b.emit("sub", other, b.nodes[one].args[0], kind=kind)
    return None


def _sub(b: Builder, args, kind):
    x, y = args
    if b.value(y) == 0:
        return x
    if x == y and x in b.known_finite:
        return b.absent
    if b.value(x) == 0 and kind == "f":
        return b.emit("neg", y, kind=kind)
    if b.nodes[y].op == "neg":
        return b.emit("add", x, b.nodes[y].args[0], kind=kind)
    return None


def _mul(b: Builder, args, kind):
    for one, other in (args, args[::-1]):
        if b.value(one) == 1:
            return other
        if b.sparse and b.value(one) == 0 and kind == "f":
            return one
        if b.value(one) == 0 and other in b.known_finite:
            return b.absent
        if b.value(one) == -1:
            return b.emit("neg", other, kind=kind)
        if b.nodes[one].op == "neg":
            return b.emit("neg", b.emit("mul", b.nodes[one].args[0], other, kind=kind), kind=kind)
    return None


def _div(b: Builder, args, kind):
    x, y = args
    value = b.value(y)
    if value == 1 or (b.sparse and b.value(x) == 0):
        return x
    if kind == "f" and value and math.isfinite(value):
        mantissa, exponent = math.frexp(value)
        if abs(mantissa) == 0.5 and abs(exponent) < 100:  # a power of two has an exact reciprocal
            return b.emit("mul", x, b.constant(1 / value, "f"), kind=kind)
    if kind == "f" and b.nodes[x].op == "neg":
        return b.emit("neg", b.emit("div", b.nodes[x].args[0], y))
    return None


def _neg(b: Builder, args, kind):
    node = b.nodes[args[0]]
    if node.op == "neg":
        return node.args[0]
    if node.op == "sub" and kind == "f":
        return b.emit("sub", node.args[1], node.args[0])
    return None


def _abs(b: Builder, args, kind):
    node = b.nodes[args[0]]
    if node.op == "neg":
        return b.emit("abs", node.args[0], kind=kind)
    if node.op == "abs":
        return args[0]
    return None


def _select(b: Builder, args, kind):
    condition, yes, no = args
    if yes == no:
        return yes
    value = b.value(condition)
    if value is not None and value:
        return yes
    if value is not None:
        return no
    if b.nodes[condition].op == "not" and b.nodes[condition].kind == "b":
        return b.emit("select", b.nodes[condition].args[0], no, yes, kind=kind)
    return None


def _logic(neutral: bool):
    """The rule of "and" (`neutral` is True) or "or" (False)."""
    neutral_bits = {True: -1, False: 0}[neutral]

    def rule(b: Builder, args, kind):
        x, y = args
        if x == y:
            return x
        for one, other in ((x, y), (y, x)):
            value = b.value(one)
            if kind == "b" and value == neutral:
                return other
            if kind == "b" and value is not None:
                return one
            if kind == "i" and value == neutral_bits:
                return other
        return None

    return rule


def _not(b: Builder, args, kind):
    node = b.nodes[args[0]]
    if node.op == "not":
        return node.args[0]
    return None


LONGEST_SUM = 64
"""Operations of a sum in which logarithms are searched: V has 17 with two joints, 57 with seven."""


def _is_finite(b: Builder, args, kind):
    """Whether a sum is finite: its logarithms are defined, and the other terms are finite.

    No logarithm exceeds 1e3, which is below the resolution of a sum that is close to overflow. A
    status flag makes this test of V, which a run without a record needs for nothing else.
    """
    parts = _of_sum(b, args[0])
    if not any(b.nodes[i].op == "log1p" for i in parts):
        return None
    known: dict[int, Terms] = {}
    for i in parts:
        known[i] = _terms_of(b, i, known)
    rest, logarithms = known[parts[-1]]
    found = []
    if rest is not None:
        found.append(b.emit("is_finite", rest, kind="b"))
    for x in logarithms:
        found += [
            b.emit("gt", x, b.constant(-1, "f"), kind="b"),
            b.emit("lt", x, b.constant(math.inf, "f"), kind="b"),
        ]
    return reduce(lambda one, other: b.emit("and", one, other, kind="b"), found)


def _halves(b: Builder, node: Node) -> bool:
    """Whether a node is a product with a constant of at most 1."""
    return node.op == "mul" and any(0 < abs(b.value(a) or 0) <= 1 for a in node.args)


def _adds(b: Builder, node: Node) -> bool:
    """Whether a node is a part of a sum and no term of it."""
    return node.kind == "f" and (node.op in ("add", "sub", "neg") or _halves(b, node))


def _of_sum(b: Builder, total: int) -> list[int]:
    """The partial sums of a sum and their terms, terms first; empty if they are too many."""
    found: set[int] = set()
    waiting = [total]
    while waiting and len(found) <= LONGEST_SUM:
        i = waiting.pop()
        if i in found:
            continue
        found.add(i)
        if _adds(b, b.nodes[i]):
            waiting += b.nodes[i].args
    if waiting:
        return []
    return sorted(found)


Terms = tuple[int | None, list[int]]
"""A sum without its terms log1p(x), None if it has no other terms, and these x."""


def _terms_of(b: Builder, i: int, known: dict[int, Terms]) -> Terms:
    """A part of a sum without its logarithms; `known` has those of its own parts."""
    node = b.nodes[i]
    if node.op == "log1p":
        return None, [node.args[0]]
    if not _adds(b, node):
        return i, []
    terms = [known[a] for a in node.args]
    logarithms = list(dict.fromkeys(x for _, found in terms for x in found))
    rests = [rest for rest, _ in terms if rest is not None]
    if not logarithms:
        return i, []
    if len(rests) == len(terms):
        return b.emit(node.op, *rests), logarithms
    if _halves(b, node) or not rests:
        return None, logarithms
    if node.op == "sub" and terms[0][0] is None:
        return b.emit("neg", rests[0]), logarithms
    return rests[0], logarithms


def _extreme(b: Builder, args, kind):
    if args[0] == args[1]:
        return args[0]
    return None


def _sign_of(b: Builder, node: int) -> int | None:
    """The node of the sign of a number whose sign is given (`with_sign`); None for others."""
    found = b.nodes[node]
    if found.op == "with_sign":
        return found.args[1]
    if found.op == "neg":
        sign = _sign_of(b, found.args[0])
        if sign is not None:
            return b.emit("neg", sign)
    return None


def _comparison(op: str):
    """The rule of a comparison: with 0, a given sign decides."""

    def rule(b: Builder, args, kind):
        signs = [_sign_of(b, a) for a in args]
        for one, other in ((0, 1), (1, 0)):
            if signs[one] is not None and b.value(args[other]) == 0:
                decided = list(args)
                decided[one] = signs[one]
                return b.emit(op, *decided, kind=kind)
        return None

    return rule


def _sign(b: Builder, args, kind):
    return _sign_of(b, args[0])


_RULES = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _neg,
    "abs": _abs,
    "select": _select,
    "and": _logic(True),
    "or": _logic(False),
    "not": _not,
    "is_finite": _is_finite,
    "max": _extreme,
    "min": _extreme,
    "sign": _sign,
    **{op: _comparison(op) for op in ("lt", "le", "gt", "ge", "eq", "ne")},
}
