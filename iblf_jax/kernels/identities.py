"""Constant folding, and identities that hold for every floating-point number, NaN and infinities
included.

x + 0 and x * 1 are x (the sign of a zero aside); x * 0 is not 0, because infinity times 0 is NaN,
and a run that is not finite must be seen to be so.  There are three exceptions: programs of
derivatives (`Builder.sparse`), whose values are those of a program without derivatives; zeros of a
mechanism (`Builder.absent`): what has no lever moves nothing; and whether a sum with logarithms is
  finite, where it is so large that it overflows (`_is_finite`).
"""

from __future__ import annotations

import math
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from iblf_jax.kernels.operations import OPERATIONS

if TYPE_CHECKING:
    from iblf_jax.kernels.program import Builder, Node


def fold(op: str, values: list, kinds: list[str], kind: str, dtype: np.dtype):
    """The value of an operation on constants, or None if it is not known here."""
    if op == "convert":
        return {"f": float, "i": int, "b": bool}[kind](values[0])
    function = OPERATIONS[op].numpy
    if function is None:
        return None
    if op == "div" and kind == "i":
        return None if values[1] == 0 else int(values[0] / values[1])
    types = {"f": dtype.type, "i": np.int64, "b": np.bool_}
    with np.errstate(all="ignore"):
        return function(*(types[k](v) for k, v in zip(kinds, values, strict=True))).item()


def simplify(b: Builder, op: str, args: tuple[int, ...], kind: str) -> int | None:
    """A node that equals op(*args) and costs less, or None."""
    rule = _RULES.get(op)
    return rule(b, args, kind) if rule else None


def without_absent(b: Builder, op: str, args: tuple[int, ...]) -> int | None:
    """op(*args), of which one is not there (`Builder.absent`); None for an operation to which it is
    a zero as any other.
    """
    x, y = args[0], args[-1]
    if op in ("mul", "neg") or (op == "div" and y != b.absent):
        return b.absent
    if op == "add":
        return y if x == b.absent else x
    if op == "sub":
        return x if y == b.absent else b.emit("neg", y)
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
    if (
        kind == "f"
        and value
        and math.isfinite(value)
        and abs(math.frexp(value)[0]) == 0.5
        and abs(math.frexp(value)[1]) < 100
    ):
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
    return (
        b.emit("abs", node.args[0], kind=kind)
        if node.op == "neg"
        else args[0]
        if node.op == "abs"
        else None
    )


def _select(b: Builder, args, kind):
    condition, yes, no = args
    if yes == no:
        return yes
    if b.value(condition) is not None:
        return yes if b.value(condition) else no
    if b.nodes[condition].op == "not" and b.nodes[condition].kind == "b":
        return b.emit("select", b.nodes[condition].args[0], no, yes, kind=kind)
    return None


def _logic(neutral: bool):
    def rule(b: Builder, args, kind):
        x, y = args
        if x == y:
            return x
        for one, other in ((x, y), (y, x)):
            value = b.value(one)
            if kind == "b" and value is not None:
                return other if value == neutral else one
            if kind == "i" and value is not None and value == (-1 if neutral else 0):
                return other
        return None

    return rule


def _not(b: Builder, args, kind):
    node = b.nodes[args[0]]
    return node.args[0] if node.op == "not" else None


LONGEST_SUM = 64
"""Operations of a sum in which logarithms are looked for: V has 17 with two joints, 57 with
seven."""


def _is_finite(b: Builder, args, kind):
    """Whether a sum is finite: its logarithms have a value, and the rest is.

    No logarithm is above 1e3, and where a sum may overflow its numbers have no digits there.  A
    status asks so of V, which a run that is not recorded needs for nothing else.
    """
    parts = _of_sum(b, args[0])
    if not any(b.nodes[i].op == "log1p" for i in parts):
        return None
    rest, logarithms = _without_logarithms(b, parts)
    found = [b.emit("is_finite", rest, kind="b")] if rest is not None else []
    for x in logarithms:
        found += [
            b.emit("gt", x, b.constant(-1, "f"), kind="b"),
            b.emit("lt", x, b.constant(math.inf, "f"), kind="b"),
        ]
    return reduce(lambda one, other: b.emit("and", one, other, kind="b"), found)


def _halves(b: Builder, node: Node) -> bool:
    return node.op == "mul" and any(0 < abs(b.value(a) or 0) <= 1 for a in node.args)


def _adds(b: Builder, node: Node) -> bool:
    return node.kind == "f" and (node.op in ("add", "sub", "neg") or _halves(b, node))


def _of_sum(b: Builder, total: int) -> list[int]:
    """The sums that a sum is made of and their terms, terms first; none if they are too many."""
    found, waiting = set[int](), [total]
    while waiting and len(found) <= LONGEST_SUM:
        i = waiting.pop()
        if i not in found:
            found.add(i)
            waiting += b.nodes[i].args if _adds(b, b.nodes[i]) else ()
    return [] if waiting else sorted(found)


def _without_logarithms(b: Builder, parts: list[int]) -> tuple[int | None, list[int]]:
    """The last of `parts` (`_of_sum`) without its terms log1p(x), None if it has no others, and
    these x.
    """
    known: dict[int, tuple[int | None, list[int]]] = {}
    for i in parts:
        node = b.nodes[i]
        terms = [known[a] for a in node.args] if _adds(b, node) else []
        logarithms, rests = (
            list(dict.fromkeys(x for _, found in terms for x in found)),
            [rest for rest, _ in terms if rest is not None],
        )
        if node.op == "log1p":
            known[i] = None, [node.args[0]]
        elif not logarithms:
            known[i] = i, []
        elif len(rests) == len(terms):
            known[i] = b.emit(node.op, *rests), logarithms
        elif _halves(b, node) or not rests:
            known[i] = None, logarithms
        else:
            known[i] = (
                (b.emit("neg", rests[0]) if node.op == "sub" and terms[0][0] is None else rests[0]),
                logarithms,
            )
    return known[parts[-1]]


def _extreme(b: Builder, args, kind):
    return args[0] if args[0] == args[1] else None


_RULES = {
    "add": _add, "sub": _sub, "mul": _mul, "div": _div, "neg": _neg, "abs": _abs, "select": _select,
    "and": _logic(True), "or": _logic(False), "not": _not, "is_finite": _is_finite, "max": _extreme, "min": _extreme,
}  # fmt: skip
