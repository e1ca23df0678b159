"""Rewritings of a whole program that save time: divisions become products with a reciprocal, at the
price of one rounding, and operations are put in an order in which a processor need not wait.

A division takes as long as ten products.  Where the denominator is of a lower class than the
quotient (a bound, which only time decides) or serves several quotients (a pivot), its reciprocal is
computed once; a denominator that is a choice of shared ones has the choice of their reciprocals.
"""

from __future__ import annotations

import heapq
from collections import Counter

from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.operations import OPERATIONS
from iblf_jax.kernels.program import PER_RUN, TIME, Builder, Node, Program, finished, needed


def rebuilt(program: Program, rule) -> Program:
    """The program with every operation made again by `rule(builder, node, args, index)`, or as it
    was where that gives None.
    """
    b = Builder(program.dtype)
    new: list[int] = []
    for i, node in enumerate(program.nodes):
        args = tuple(new[a] for a in node.args)
        made = rule(b, node, args, i)
        new.append(b.copy(node, args) if made is None else made)
    carry_in = [new[a] if a >= 0 else -1 for a, _ in program.carry]
    return finished(
        b,
        carry_in,
        [new[o] for _, o in program.carry],
        [new[s] for s in program.samples],
        program.recorded,
    )


@CACHES.function(maxsize=64)
def written_out(program: Program) -> Program:
    """The program with its functions written out wherever they are called."""
    found: dict[int, list[int]] = {}

    def rule(b: Builder, node, args, i):
        if node.op == "call":
            function, new = node.value, list[int]()
            args = args if node.kind == "call" else args[1:]
            for inner in function.nodes:
                new.append(
                    args[inner.value]
                    if inner.op == "argument"
                    else b.copy(inner, [new[a] for a in inner.args])
                )
            found[i] = [new[s] for s in function.samples]
            return -1
        return found[node.args[0]][node.value] if node.op == "result" else None

    return rebuilt(program, rule)


def with_reciprocals(program: Program) -> Program:
    """Divisions by shared or repeated denominators as products (head of this module)."""
    classes = program.classes()
    uses = Counter(node.args[1] for node in program.nodes if node.op == "div" and node.kind == "f")

    def is_shared(i: int) -> bool:
        return not classes[i] & PER_RUN

    def reciprocal(b: Builder, old: int, new: int) -> int:
        node = program.nodes[old]
        if (
            node.op == "select"
            and classes[old] & PER_RUN
            and all(is_shared(a) for a in node.args[1:])
        ):
            condition, yes, no = (
                b.nodes[new].args if b.nodes[new].op == "select" else (None, None, None)
            )
            if condition is not None and yes is not None and no is not None:
                one = b.constant(1, "f")
                return b.emit("select", condition, b.emit("div", one, yes), b.emit("div", one, no))
        return b.emit("div", b.constant(1, "f"), new)

    def cheap(i: int, quotient: int) -> bool:
        node = program.nodes[i]
        choice = node.op == "select" and all(is_shared(a) for a in node.args[1:])
        return choice or classes[i] != classes[quotient] or uses[i] > 1

    def rule(b: Builder, node, args, i):
        if (
            node.op == "div"
            and node.kind == "f"
            and b.value(args[0]) != 1
            and cheap(node.args[1], i)
        ):
            return b.emit("mul", args[0], reciprocal(b, node.args[1], args[1]))
        return None

    return rebuilt(program, rule)


def scheduled(program: Program) -> Program:
    """The program in an order in which a processor need not wait: of what can be computed, first
    what the longest chain hangs on.

    A processor looks a few hundred instructions ahead.  In depth-first order it sees one chain of a
    step there; in this one, what metrics and estimates ask for stands between the stages of the
    integrator.
    """
    nodes, classes = program.nodes, program.classes()
    cost, users = [_cost(node) for node in nodes], [list[int]() for _ in nodes]
    delay = [max(2 * c, LATENCY) if c else 0 for c in cost]
    order, left = [i for i, c in enumerate(classes) if c != PER_RUN | TIME], [0] * len(nodes)
    known = set(order)
    for i, node in enumerate(nodes):
        for a in set(node.args) - known if i not in known else ():
            users[a].append(i)
            left[i] += 1
    height = [0] * len(nodes)
    for i in reversed(range(len(nodes))):
        height[i] = delay[i] + max((height[user] for user in users[i]), default=0)
    waiting = [(0, i) for i in range(len(nodes)) if i not in known and not left[i]]
    ready, at, now = list[tuple[int, int]](), [0] * len(nodes), 0
    while waiting or ready:
        now = now if ready else max(now, waiting[0][0])
        while waiting and waiting[0][0] <= now:
            i = heapq.heappop(waiting)[1]
            heapq.heappush(ready, (-height[i], i))
        i = heapq.heappop(ready)[1]
        order.append(i)
        for user in users[i]:
            at[user] = max(at[user], now + delay[i])
            left[user] -= 1
            if not left[user]:
                heapq.heappush(waiting, (at[user], user))
        now += cost[i]
    # What only samples need stays last: a call that only they need must not write over what the
    # next one has left there (`layout.FunctionCalls`).
    in_time = set(needed(nodes, [o for _, o in program.carry])) | known
    order.sort(key=lambda i: i not in in_time)
    place = {i: k for k, i in enumerate(order)}
    carry = tuple((place.get(a, -1), place[o]) for a, o in program.carry)
    moved = tuple(nodes[i]._replace(args=tuple(place[a] for a in nodes[i].args)) for i in order)
    return program._replace(
        nodes=moved, carry=carry, samples=tuple(place[s] for s in program.samples)
    )


LATENCY, LIBRARY = 4, 100
"""Cycles until an instruction's result is there; instructions of a call into the C library,
roughly."""


def _cost(node: Node) -> int:
    """Instructions of a node, roughly; constants and inputs are there."""
    if node.op == "call":
        return node.value.size
    return OPERATIONS[node.op].cost or LIBRARY if node.op in OPERATIONS else 0
