"""Transformations of a complete program that save time.

Divisions become products with a reciprocal, which costs one rounding. A division takes as long as
ten products. Where the denominator is of a lower class than the quotient (a bound, which only time
decides) or occurs in several quotients (a pivot), its reciprocal is computed once. The reciprocal
of a selection among shared denominators is the selection among their reciprocals.

`scheduled` orders the operations such that a processor need not wait for results.
"""

from __future__ import annotations

import dataclasses
import heapq
from collections import Counter
from collections.abc import Sequence

from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.operations import OPERATIONS
from iblf_jax.kernels.program import (
    PER_RUN,
    TIME,
    Builder,
    Node,
    Program,
    arguments_of,
    finished,
    needed,
)


def rebuilt(program: Program, rule) -> Program:
    """The program with other operations.

    Args:
      program: the program.
      rule: function (builder, node, arguments, index of the node) -> new node; None to copy it.
    """
    b = Builder(program.dtype)
    new: list[int] = []
    for i, node in enumerate(program.nodes):
        args = tuple([new[a] for a in node.args])
        replacement = rule(b, node, args, i)
        if replacement is None:
            replacement = b.copy(node, args)
        new.append(replacement)
    # The last entry serves the node -1 of numbers that a step does not read.
    new.append(-1)
    return finished(
        b,
        [new[before] for before, _ in program.carry],
        [new[after] for _, after in program.carry],
        [new[output] for output in program.outputs],
        program.recorded,
    )


@CACHES.function(maxsize=64)
def written_out(program: Program) -> Program:
    """The program with its functions inlined at each call."""
    results: dict[int, list[int]] = {}

    def rule(b: Builder, node, args, i):
        if node.op == "call":
            arguments = args[len(args) - len(arguments_of(node)) :]
            new: list[int] = []
            function = written_out(node.value)
            for inner in function.nodes:
                if inner.op == "argument":
                    new.append(arguments[inner.value])
                else:
                    new.append(b.copy(inner, [new[a] for a in inner.args]))
            results[i] = [new[output] for output in function.outputs]
            return -1
        if node.op == "result":
            return results[node.args[0]][node.value]
        return None

    return rebuilt(program, rule)


def with_reciprocals(program: Program) -> Program:
    """The program with products instead of divisions by shared or repeated denominators."""
    classes = program.classes()
    uses = Counter(node.args[1] for node in program.nodes if node.op == "div" and node.kind == "f")

    def is_selection_of_shared(i: int) -> bool:
        node = program.nodes[i]
        return node.op == "select" and not any(classes[a] & PER_RUN for a in node.args[1:])

    def reciprocal(b: Builder, old: int, new: int) -> int:
        one = b.constant(1, "f")
        if is_selection_of_shared(old) and classes[old] & PER_RUN and b.nodes[new].op == "select":
            condition, yes, no = b.nodes[new].args
            return b.emit("select", condition, b.emit("div", one, yes), b.emit("div", one, no))
        return b.emit("div", one, new)

    def rule(b: Builder, node, args, i):
        if node.op != "div" or node.kind != "f" or b.value(args[0]) == 1:
            return None
        denominator = node.args[1]
        pays = (
            is_selection_of_shared(denominator)
            or classes[denominator] != classes[i]
            or uses[denominator] > 1
        )
        if not pays:
            return None
        return b.emit("mul", args[0], reciprocal(b, denominator, args[1]))

    return rebuilt(program, rule)


def scheduled(program: Program) -> Program:
    """The program in an order in which a processor need not wait for results: of the nodes whose
    arguments are computed, first the one with the longest chain of users.

    A processor looks a few hundred instructions ahead. In depth-first order it finds one chain of a
    step there. In this order, operations of metrics and estimates are between the stages of the
    integrator.
    """
    nodes = program.nodes
    first = [i for i, c in enumerate(program.classes()) if c != PER_RUN | TIME]
    order = first + _by_longest_chain(nodes, set(first))
    # Nodes that only outputs need stay last: a call that only they need must not overwrite the
    # results that the next call has left (`layout.FunctionCalls`).
    in_time = set(needed(nodes, [after for _, after in program.carry])) | set(first)
    order.sort(key=lambda i: i not in in_time)
    place = {i: k for k, i in enumerate(order)}
    return dataclasses.replace(
        program,
        nodes=tuple(nodes[i]._replace(args=tuple(place[a] for a in nodes[i].args)) for i in order),
        carry=tuple((place.get(before, -1), place[after]) for before, after in program.carry),
        outputs=tuple(place[output] for output in program.outputs),
    )


def _by_longest_chain(nodes: Sequence[Node], known: set[int]) -> list[int]:
    """The order of `scheduled` of all nodes that are not known (list scheduling)."""
    cost = [0] * len(nodes)  # approximate number of instructions
    for i, node in enumerate(nodes):
        if node.op == "call":
            cost[i] = node.value.size
        elif node.op in OPERATIONS:
            cost[i] = OPERATIONS[node.op].cost or LIBRARY
    delay = [max(2 * c, LATENCY) if c else 0 for c in cost]
    users: list[list[int]] = [[] for _ in nodes]
    missing = [0] * len(nodes)
    for i, node in enumerate(nodes):
        if i in known:
            continue
        for a in set(node.args) - known:
            users[a].append(i)
            missing[i] += 1
    chain = [0] * len(nodes)
    for i in reversed(range(len(nodes))):
        chain[i] = delay[i] + max((chain[user] for user in users[i]), default=0)
    order = []
    waiting = [(0, i) for i in range(len(nodes)) if i not in known and not missing[i]]
    ready: list[tuple[int, int]] = []
    earliest = [0] * len(nodes)
    now = 0
    while waiting or ready:
        if not ready:
            now = max(now, waiting[0][0])
        while waiting and waiting[0][0] <= now:
            _, i = heapq.heappop(waiting)
            heapq.heappush(ready, (-chain[i], i))
        _, i = heapq.heappop(ready)
        order.append(i)
        for user in users[i]:
            earliest[user] = max(earliest[user], now + delay[i])
            missing[user] -= 1
            if not missing[user]:
                heapq.heappush(waiting, (earliest[user], user))
        now += cost[i]
    return order


LATENCY = 4
"""Cycles until the result of an instruction is available."""
LIBRARY = 100
"""Instructions of a call of the C library, approximately."""
