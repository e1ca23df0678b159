"""Scalar programs: what one step of a run does, number by number.

A jaxpr works on small arrays; a processor that steps many runs at once wants to see single numbers,
each of which is a register full of runs.  So arrays are taken apart (`from_jaxpr`): a `Program` is
a list of nodes in an order in which each uses only earlier ones.  Equal nodes are one node
(hash-consing), constants are folded, and what no output needs is dropped.

Every node has one of four classes, by what it depends on; each is computed as seldom as that
allows:

    SHARED        the shared leaves alone                   once
    SHARED|TIME   shared leaves and time                    once a step, for all runs
    LANE          the leaves of a run                       once a run
    LANE|TIME     the state of a run                        once a step and run
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.kernels.identities import fold, simplify, without_absent
from iblf_jax.kernels.operations import OPERATIONS

SHARED, LANE, TIME = 0, 1, 2
INPUTS = ("shared", "lane", "carry", "index", "argument")
"""Operations that stand for an input: leaves that runs share, leaves of a run, what goes from step
to step, number of the step, and of a function that a program calls, what it is given."""


Ids = np.ndarray
"""An array of node numbers, int64, of the shape of the array that it stands for."""


class UnsupportedError(Exception):
    """What a scalar program cannot express; the message is one line for the user."""


def kind_of(dtype) -> str:
    """The kind "f", "i" or "b" of an array's type; UnsupportedError for others."""
    if np.issubdtype(dtype, np.floating):
        return "f"
    if np.issubdtype(dtype, np.signedinteger):
        return "i"
    if dtype == np.bool_:
        return "b"
    raise UnsupportedError(f"arrays of type {dtype} are not lowered")


class Node(NamedTuple):
    """One number: `op(*args)`; `kind` is "f" (float), "i" (int) or "b" (bool); `value` is that of a
    constant, an input's index, or the numbers among which a "lookup" chooses by its whole-numbered
    argument (the nearest end, outside).

    A "call" is no number: it has the results of a function, a program whose "samples" they are; a
    "result" is one of them.  One of the kind "call if" is made where its first argument, the same
    for all runs, holds; elsewhere its results are no numbers either.
    """

    op: str
    args: tuple[int, ...]
    kind: str
    value: Any = None


class Known(NamedTuple):
    """What is known beforehand of a shared number that is finite."""

    value: float | None = None
    """0, 1 or -1, if it is that: a constant, and what is multiplied by such a zero is not there."""
    same: int | None = None
    """The shared number that it is equal to, up to a sign."""
    sign: int = 1


class LoweringLimits(NamedTuple):
    """What is too long to be lowered; the caller says so."""

    choices: float = math.inf
    """Entries among which indices of the run may choose."""
    table: float = math.inf
    """Floating-point constants among which one may."""
    tables: float = math.inf
    """Numbers that the tables of one indexing may have in all."""
    scan: float = math.inf
    """Steps up to which an inner scan is unrolled."""
    written_out: float = math.inf
    """Nodes up to which a function is written out wherever it is called."""
    under_condition: float = math.inf
    """Nodes up to which a branch that all runs take together is written out."""
    power: float = math.inf
    """Whole exponents up to which a power is made of products."""


NO_LIMITS = LoweringLimits()


def extend_classes(classes: list[int], nodes: Sequence[Node], still: Container[int]) -> None:
    """Adds the classes of the nodes that have none yet; `still`: carried numbers that a step leaves
    alone, of class LANE.
    """
    of_input = {"const": SHARED, "shared": SHARED, "index": TIME, "lane": LANE}
    for node in nodes[len(classes) :]:
        if node.args:
            found = 0
            for a in node.args:
                found |= classes[a]
        else:
            found = LANE if len(classes) in still else of_input.get(node.op, LANE | TIME)
        classes.append(found)


class Builder:
    """Makes nodes; equal ones are made once."""

    def __init__(self, dtype, *, sparse: bool = False, limits: LoweringLimits = NO_LIMITS) -> None:
        """`sparse`: a product with a literal zero is zero, for programs of derivatives, where such
        a zero says "does not depend". `limits`: for what is read from a jaxpr.
        """
        self.dtype = np.dtype(dtype)
        self.sparse = sparse
        self.limits = limits
        self.nodes: list[Node] = []
        self.still: set[int] = set()
        """Nodes of carried numbers that a step leaves alone."""
        self._known: dict[tuple, int] = {}
        self._classes: list[int] = []
        self.known_finite: set[int] = set()
        """Inputs that are known to be finite (`Known`), and what was computed of them alone."""
        self.absent = self._add(Node("const", (), "f", 0.0), "absent")
        """The zero of what is not there: a product with it is not there either, whatever the other
        factor."""

    def constant(self, value, kind: str) -> int:
        """The node of a constant."""
        value = (
            float(self.dtype.type(value))
            if kind == "f"
            else int(value)
            if kind == "i"
            else bool(value)
        )
        return self._add(Node("const", (), kind, value), value.hex() if kind == "f" else value)

    def input(self, op: str, index: int, kind: str) -> int:
        """The node of an input (`INPUTS`)."""
        return self._add(Node(op, (), kind, index), index)

    def emit(self, op: str, *args: int, kind: str = "f") -> int:
        """The node of op(*args): folded, simplified, or new."""
        if self.absent in args and kind == "f":
            rest = without_absent(self, op, args)
            if rest is not None:
                return rest
        for a in args:
            if self.nodes[a].op != "const":
                break
        else:
            nodes = [self.nodes[a] for a in args]
            folded = fold(op, [n.value for n in nodes], [n.kind for n in nodes], kind, self.dtype)
            if folded is not None:
                return self.constant(folded, kind)
        simpler = simplify(self, op, args, kind)
        if simpler is not None:
            return simpler
        new = self._add(
            Node(op, tuple(sorted(args)) if OPERATIONS[op].commutes else args, kind), None
        )
        if (
            self.known_finite
            and kind == "f"
            and all(a in self.known_finite or self._is_finite_constant(a) for a in args)
        ):
            self.known_finite.add(new)
        return new

    def lookup(self, table: tuple[float, ...], index: int) -> int:
        """The node of table[index], for an index that only the run knows."""
        return self._add(Node("lookup", (index,), "f", table), tuple(x.hex() for x in table))

    def call(self, function: Program, args: Sequence[int], condition: int | None = None) -> int:
        """The node of a call of a function, made where the condition holds if there is one."""
        args, kind = (tuple(args), "call") if condition is None else ((condition, *args), "call if")
        return self._add(Node("call", args, kind, function), id(function))

    def result(self, call: int, number: int) -> int:
        """The node of one of its results."""
        function = self.nodes[call].value
        return self._add(
            Node("result", (call,), function.nodes[function.samples[number]].kind, number), number
        )

    def again(self, node: Node, args: Sequence[int]) -> int:
        """A node of another builder, on nodes of this one."""
        if node.op == "const":
            return self.constant(node.value, node.kind)
        if node.op in INPUTS:
            return self.input(node.op, node.value, node.kind)
        if node.op == "lookup":
            return self.lookup(node.value, *args)
        if node.op == "call":
            return (
                self.call(node.value, args)
                if node.kind == "call"
                else self.call(node.value, args[1:], args[0])
            )
        return (
            self.result(args[0], node.value)
            if node.op == "result"
            else self.emit(node.op, *args, kind=node.kind)
        )

    def moves(self, node: int) -> bool:
        """Whether a node is of class LANE|TIME."""
        return self._class(node) == LANE | TIME

    def is_shared(self, node: int) -> bool:
        """Whether a node is the same for all runs."""
        return not self._class(node) & LANE

    def _class(self, node: int) -> int:
        extend_classes(self._classes, self.nodes, self.still)
        return self._classes[node]

    def _is_finite_constant(self, node: int) -> bool:
        return self.nodes[node].op == "const" and math.isfinite(self.nodes[node].value)

    def value(self, node: int):
        """The value of a constant node, else None."""
        return self.nodes[node].value if self.nodes[node].op == "const" else None

    def _add(self, node: Node, tag) -> int:
        key = (node.op, node.args, node.kind, tag)
        found = self._known.get(key)
        if found is None:
            found = self._known[key] = len(self.nodes)
            self.nodes.append(node)
        return found


def constants(b: Builder, array) -> Ids:
    """The node numbers of a concrete array."""
    array = np.asarray(array)
    kind = kind_of(array.dtype)
    flat = [b.constant(x, kind) for x in array.ravel().tolist()]
    return np.asarray(flat, np.int64).reshape(array.shape)


class Program(NamedTuple):
    """One step as a list of nodes.

    Args:
      dtype: floating-point type of every "f".
      nodes: in an order in which each uses earlier ones only.
      carry: (input node, output node) of every number that goes from step to step; input -1 where
        the step does not read it.
      samples: output nodes that a record may ask for; the results of a function.
      kinds: kind of every carried number.
      recorded: how many of the samples each recorded array has, in order.
    """

    dtype: np.dtype
    nodes: tuple[Node, ...]
    carry: tuple[tuple[int, int], ...]
    samples: tuple[int, ...]
    kinds: tuple[str, ...]
    recorded: tuple[int, ...] = ()

    def classes(self) -> list[int]:
        """The class of every node (head of this module); a carried number that a step leaves alone
        is of class LANE.
        """
        result: list[int] = []
        extend_classes(result, self.nodes, {a for a, b in self.carry if a == b})
        return result

    def counts(self) -> dict[int, Counter]:
        """Class -> how many of each operation; constants and inputs are not operations."""
        result: dict[int, Counter] = {c: Counter() for c in range(4)}
        for node, c in zip(self.nodes, self.classes(), strict=True):
            if node.op not in INPUTS and node.op != "const":
                result[c][node.op] += 1
        return result

    @property
    def size(self) -> int:
        """Nodes that a compiler sees: those of a function once, however often it is called."""
        functions = {id(node.value): node.value for node in self.nodes if node.op == "call"}
        return len(self.nodes) + sum(function.size for function in functions.values())


def needed(nodes: Sequence[Node], wanted: Iterable[int], known: Container[int] = ()) -> list[int]:
    """The nodes that `wanted` needs, itself included, in order; what is known needs nothing and is
    left out.
    """
    stack, found = list(wanted), set()
    while stack:
        i = stack.pop()
        if i not in known and i not in found:
            found.add(i)
            stack.extend(nodes[i].args)
    return sorted(found)


def finished(
    builder: Builder,
    carry_in: list[int],
    carry_out: list[int],
    samples: list[int],
    recorded: tuple[int, ...] = (),
) -> Program:
    """The program of the given outputs, without what they do not need, in depth-first order.

    The order matters to a compiler with few registers: a number is computed shortly before its
      first use.
    """
    order: list[int] = []
    place: dict[int, int] = {}
    for root in [*carry_out, *samples]:
        stack = [root]
        while stack:
            node = stack[-1]
            if node in place:
                stack.pop()
                continue
            missing = [a for a in builder.nodes[node].args if a not in place]
            if missing:
                stack.extend(reversed(missing))
                continue
            place[node] = len(order)
            order.append(node)
            stack.pop()
    nodes = tuple(
        builder.nodes[i]._replace(args=tuple(place[a] for a in builder.nodes[i].args))
        for i in order
    )
    carry = tuple((place.get(a, -1), place[b]) for a, b in zip(carry_in, carry_out, strict=True))
    kinds = tuple(builder.nodes[b].kind for b in carry_out)
    return Program(builder.dtype, nodes, carry, tuple(place[s] for s in samples), kinds, recorded)


def frontier(
    program: Program, classes: list[int], of: int, used_by: Callable[[int], bool]
) -> list[int]:
    """The operations and inputs of class `of` that a node of a class accepted by `used_by` reads,
    and no constants.
    """
    found = {a for i, node in enumerate(program.nodes) if used_by(classes[i]) for a in node.args}
    found |= {i for i in [*(o for _, o in program.carry), *program.samples] if used_by(LANE | TIME)}
    return sorted(a for a in found if classes[a] == of and program.nodes[a].op != "const")
