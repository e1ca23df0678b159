"""Rewritings of a whole program that save time at the price of one rounding: divisions become products with a reciprocal.

A division takes as long as ten products.  Where the denominator is of a lower class than the quotient (a bound, which only time
decides) or serves several quotients (a pivot), its reciprocal is computed once; a denominator that is a choice of shared ones has
the choice of their reciprocals.
"""

from __future__ import annotations

from collections import Counter
from functools import lru_cache

from iblf_jax.lowering.program import LANE, Builder, Program, finished


def rebuilt(program: Program, rule) -> Program:
    """The program with every operation made again by `rule(builder, node, args, index)`, or as it was where that gives None."""
    b = Builder(program.dtype)
    new: list[int] = []
    for i, node in enumerate(program.nodes):
        args = tuple(new[a] for a in node.args)
        made = rule(b, node, args, i)
        new.append(b.again(node, args) if made is None else made)
    carry_in = [new[a] if a >= 0 else -1 for a, _ in program.carry]
    return finished(b, carry_in, [new[o] for _, o in program.carry], [new[s] for s in program.samples], program.recorded)


@lru_cache(maxsize=64)
def written_out(program: Program) -> Program:
    """The program with its functions written out wherever they are called."""
    found: dict[int, list[int]] = {}

    def rule(b: Builder, node, args, i):
        if node.op == "call":
            function, new = node.value, list[int]()
            args = args if node.kind == "call" else args[1:]
            for inner in function.nodes:
                new.append(args[inner.value] if inner.op == "argument" else b.again(inner, [new[a] for a in inner.args]))
            found[i] = [new[s] for s in function.samples]
            return -1
        return found[node.args[0]][node.value] if node.op == "result" else None

    return rebuilt(program, rule)


def with_reciprocals(program: Program) -> Program:
    """Divisions by shared or repeated denominators as products (head of this module)."""
    classes = program.classes()
    uses = Counter(node.args[1] for node in program.nodes if node.op == "div" and node.kind == "f")

    def is_shared(i: int) -> bool:
        return not classes[i] & LANE

    def reciprocal(b: Builder, old: int, new: int) -> int:
        node = program.nodes[old]
        if node.op == "select" and classes[old] & LANE and all(is_shared(a) for a in node.args[1:]):
            condition, yes, no = b.nodes[new].args if b.nodes[new].op == "select" else (None, None, None)
            if condition is not None and yes is not None and no is not None:
                one = b.constant(1, "f")
                return b.emit("select", condition, b.emit("div", one, yes), b.emit("div", one, no))
        return b.emit("div", b.constant(1, "f"), new)

    def cheap(i: int, quotient: int) -> bool:
        node = program.nodes[i]
        choice = node.op == "select" and all(is_shared(a) for a in node.args[1:])
        return choice or classes[i] != classes[quotient] or uses[i] > 1

    def rule(b: Builder, node, args, i):
        if node.op == "div" and node.kind == "f" and b.value(args[0]) != 1 and cheap(node.args[1], i):
            return b.emit("mul", args[0], reciprocal(b, node.args[1], args[1]))
        return None

    return rebuilt(program, rule)
