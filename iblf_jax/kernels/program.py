"""Scalar programs: what one step of a run computes, number by number.

A jaxpr works on small arrays. A processor that steps many runs at once needs single numbers, each
of which is a register with one entry per run. `from_jaxpr` therefore splits arrays into numbers: a
`Program` is a list of nodes in an order in which each node uses only earlier ones. Equal nodes are
one node (hash-consing), constants are folded, and nodes that no output needs are removed.

Every node has one of four classes, which follows from what it depends on. Generated code computes
each node as rarely as its class permits:

    class           depends on                  computed
    SHARED          shared leaves only          once
    SHARED|TIME     shared leaves and time      once per time step, for all runs
    PER_RUN         the leaves of a run         once per run
    PER_RUN|TIME    the state of a run          once per time step and run
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.kernels.identities import fold, is_exact, simplify, without_absent
from iblf_jax.kernels.operations import COMMUTING

SHARED, PER_RUN, TIME = 0, 1, 2
INPUTS = ("shared", "per_run", "carry", "index", "series", "argument")
"""Operations that stand for an input: leaves that all runs share, leaves of one run, the carry, the
number of the step, the numbers that a step of a run reads from a series, and the arguments of a
function that a program calls."""


SPECIAL = frozenset((*INPUTS, "const", "lookup", "call", "result"))
"""Operations for which a `Builder` has a method of their own."""


Uses = tuple[bool, ...]
"""Which results of a function a call uses."""


Ids = np.ndarray
"""An array of node numbers, int64, with the shape of the array that it represents."""


class UnsupportedError(Exception):
    """A scalar program cannot express a step; the message is one line for the user."""


def kind_of(dtype) -> str:
    """The kind "f", "i" or "b" of a type of array; UnsupportedError for other types."""
    if np.issubdtype(dtype, np.floating):
        return "f"
    if np.issubdtype(dtype, np.signedinteger):
        return "i"
    if dtype == np.bool_:
        return "b"
    raise UnsupportedError(f"arrays of type {dtype} are not lowered")


class Node(NamedTuple):
    """One number, `op(*args)`.

    Three operations are special. A "lookup" selects an entry of the table `value` by its integer
    argument; an index outside the table selects the nearest end. A "call" has the results of a
    function; the "outputs" of the program `value` are these results, and each "result" is one of
    them. A call of kind "call if" is executed where its first argument, which is the same for all
    runs, is true; otherwise its results have no defined value.
    """

    op: str
    args: tuple[int, ...]
    kind: str
    """"f" (float), "i" (integer) or "b" (truth value); "call" or "call if" for a call."""
    value: Any = None
    """A constant's value, an input's index, a lookup's table, or a call's function."""


def arguments_of(call: Node) -> tuple[int, ...]:
    """The nodes that a call passes to its function."""
    if call.kind == "call":
        return call.args
    return call.args[1:]  # the first one is the condition


class Known(NamedTuple):
    """What is known beforehand of a shared number that is finite."""

    value: float | None = None
    """0, 1 or -1 if the number has this value: it is a constant then, and a product with such a
    zero is absent."""
    same: int | None = None
    """The shared number that it equals, up to a sign."""
    sign: int = 1


class LoweringLimits(NamedTuple):
    """Sizes above which a step is not compiled."""

    choices: float = math.inf
    """Entries among which indices that depend on the run may select."""
    table: float = math.inf
    """Floating-point constants among which one such index may select."""
    tables: float = math.inf
    """Numbers in all tables of one indexing operation."""
    scan: float = math.inf
    """Steps of an inner scan, which is unrolled."""
    written_out: float = math.inf
    """Nodes of a function that is inlined at each call; a longer one is called, and inside another
    function only if it has several calls."""
    under_condition: float = math.inf
    """Nodes of a branch that is inlined if all runs take it together; a longer one is called."""
    power: float = math.inf
    """Integer exponents of powers that become products."""


NO_LIMITS = LoweringLimits()


CLASS_OF_INPUT = {"const": SHARED, "shared": SHARED, "index": TIME, "per_run": PER_RUN}
"""The class of a node without arguments; all others are of class PER_RUN | TIME."""


def extend_classes(
    classes: list[int], nodes: Sequence[Node], constant_carry: Container[int]
) -> None:
    """Appends the classes of the nodes that have none yet.

    Args:
      classes: classes of the first nodes.
      nodes: all nodes.
      constant_carry: nodes of carried numbers that a step returns unchanged; they are of class
        PER_RUN.
    """
    for i in range(len(classes), len(nodes)):
        node = nodes[i]
        if node.args:
            union = 0
            for a in node.args:
                union |= classes[a]
            classes.append(union)
        elif i in constant_carry:
            classes.append(PER_RUN)
        else:
            classes.append(CLASS_OF_INPUT.get(node.op, PER_RUN | TIME))


class Builder:
    """Adds nodes to a list; equal nodes are one node."""

    def __init__(
        self,
        dtype,
        *,
        sparse: bool = False,
        limits: LoweringLimits = NO_LIMITS,
        exact: bool = False,
        uses: Mapping[Any, tuple[Uses, ...]] = MappingProxyType({}),
        in_function: bool = False,
    ) -> None:
        """Starts an empty list of nodes.

        Args:
          dtype: floating-point type.
          sparse: whether a product with a literal zero is zero. This holds for programs of
            derivatives, in which such a zero means "does not depend".
          limits: sizes above which a jaxpr is not compiled.
          exact: whether the program must be equal to the jaxpr in real arithmetic, as one on
            intervals must: constants are folded only where the result is not rounded.
          uses: function of a jaxpr -> which of its results each of its calls uses.
          in_function: whether the nodes are those of a function that is called.
        """
        self.dtype = np.dtype(dtype)
        self.exact = exact
        self.sparse = sparse
        self.limits = limits
        self.uses = uses
        self.in_function = in_function
        self.nodes: list[Node] = []
        self.constant_carry: set[int] = set()
        """Nodes of carried numbers that a step returns unchanged."""
        self._known: dict[tuple, int] = {}
        self._emitted: dict[tuple, int] = {}
        """Operation, arguments and kind of each call of `emit` -> its node."""
        self._classes: list[int] = []
        self.known_finite: set[int] = set()
        """Inputs that are known to be finite (`Known`), and nodes that depend only on these."""
        self.absent = self._add(Node("const", (), "f", 0.0), "absent")
        """The zero of an absent quantity: a product with it is absent, too, whatever the other
        factor is."""

    def constant(self, value, kind: str) -> int:
        """The node of a constant."""
        if kind == "f":
            number = float(self.dtype.type(value))
            return self._add(Node("const", (), kind, number), number.hex())
        exact = {"i": int, "b": bool}[kind](value)
        return self._add(Node("const", (), kind, exact), exact)

    def input(self, op: str, index: int, kind: str) -> int:
        """The node of an input (`INPUTS`)."""
        return self._add(Node(op, (), kind, index), index)

    def emit(self, op: str, *args: int, kind: str = "f") -> int:
        """The node of op(*args): folded, simplified, or new.

        The tangents of a step repeat most operations, many of them on constants.
        """
        call = (op, args, kind)
        node = self._emitted.get(call)
        if node is None:
            node = self._emitted[call] = self._emit(op, args, kind)
        return node

    def emit_each(self, op: str, calls: Iterable[tuple[int, ...]], kind: str) -> list[int]:
        """The node of op(*args) for each tuple of arguments."""
        emitted = self._emitted
        found = []
        for args in calls:
            node = emitted.get((op, args, kind))
            if node is None:
                node = self.emit(op, *args, kind=kind)
            found.append(node)
        return found

    def _emit(self, op: str, args: tuple[int, ...], kind: str) -> int:
        """As `emit`, for arguments that it has not had yet."""
        if self.absent in args and kind == "f":
            rest = without_absent(self, op, args)
            if rest is not None:
                return rest
        # The first argument decides most cases.
        if self.nodes[args[0]].op == "const" and all(self.nodes[a].op == "const" for a in args):
            nodes = [self.nodes[a] for a in args]
            values = [node.value for node in nodes]
            if not self.exact or is_exact(op, values, kind):
                folded = fold(op, values, [node.kind for node in nodes], kind, self.dtype)
                if folded is not None:
                    return self.constant(folded, kind)
        simpler = simplify(self, op, args, kind)
        if simpler is not None:
            return simpler
        if op in COMMUTING:
            args = tuple(sorted(args))
        new = self._add(Node(op, tuple(args), kind), None)
        if kind == "f" and self.known_finite and all(map(self._is_finite, args)):
            self.known_finite.add(new)
        return new

    def lookup(self, table: tuple[float, ...], index: int) -> int:
        """The node of table[index], for an index that is unknown at compile time."""
        return self._add(Node("lookup", (index,), "f", table), tuple(x.hex() for x in table))

    def call(self, function: Program, args: Sequence[int], condition: int | None = None) -> int:
        """The node of a call of a function, which is executed where the condition holds, if any."""
        if condition is None:
            return self._add(Node("call", tuple(args), "call", function), id(function))
        return self._add(Node("call", (condition, *args), "call if", function), id(function))

    def result(self, call: int, number: int) -> int:
        """The node of a result of a call."""
        function = self.nodes[call].value
        kind = function.nodes[function.outputs[number]].kind
        return self._add(Node("result", (call,), kind, number), number)

    def copy(self, node: Node, args: Sequence[int]) -> int:
        """A node of another builder, with arguments of this one."""
        if node.op not in SPECIAL:
            return self.emit(node.op, *args, kind=node.kind)
        if node.op == "const":
            return self.constant(node.value, node.kind)
        if node.op in INPUTS:
            return self.input(node.op, node.value, node.kind)
        if node.op == "lookup":
            return self.lookup(node.value, *args)
        if node.op == "call" and node.kind == "call":
            return self.call(node.value, args)
        if node.op == "call":
            return self.call(node.value, args[1:], args[0])
        return self.result(args[0], node.value)

    def depends_on_state(self, node: int) -> bool:
        """Whether a node is of class PER_RUN|TIME."""
        return self._class(node) == PER_RUN | TIME

    def is_shared(self, node: int) -> bool:
        """Whether a node is the same for all runs."""
        return not self._class(node) & PER_RUN

    def _class(self, node: int) -> int:
        extend_classes(self._classes, self.nodes, self.constant_carry)
        return self._classes[node]

    def _is_finite(self, node: int) -> bool:
        """Whether a node is known to be finite."""
        if node in self.known_finite:
            return True
        return self.nodes[node].op == "const" and math.isfinite(self.nodes[node].value)

    def value(self, node: int):
        """The value of a constant; None for every other node."""
        if self.nodes[node].op != "const":
            return None
        return self.nodes[node].value

    def _add(self, node: Node, tag) -> int:
        """The node, which is added unless there is an equal one; `tag` identifies its value."""
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


@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """One step as a list of nodes.

    Programs are compared by identity.  They are keys of the caches of their C and of their kernels,
    and equality of their numbers would give 0.0 and -0.0 one kernel.

    Args:
      dtype: floating-point type of every "f".
      nodes: in an order in which each uses earlier ones only.
      carry: (input node, output node) of every number that goes from one step to the next; the
        input is -1 where the step does not read the number.
      outputs: nodes of the recorded numbers; for a function that is called, its results.
      kinds: kind of every carried number.
      recorded: number of outputs of each recorded array, in order.
    """

    dtype: np.dtype
    nodes: tuple[Node, ...]
    carry: tuple[tuple[int, int], ...]
    outputs: tuple[int, ...]
    kinds: tuple[str, ...]
    recorded: tuple[int, ...] = ()

    def classes(self) -> list[int]:
        """The class of every node (see the docstring of this module)."""
        result: list[int] = []
        extend_classes(result, self.nodes, {a for a, b in self.carry if a == b})
        return result

    def counts(self) -> dict[int, Counter]:
        """Class -> number of each operation; constants and inputs are not operations."""
        result: dict[int, Counter] = {c: Counter() for c in range(4)}
        for node, c in zip(self.nodes, self.classes(), strict=True):
            if node.op not in INPUTS and node.op != "const":
                result[c][node.op] += 1
        return result

    def listing(self) -> str:
        """The program as text: one line for each node, then the carry and the outputs."""
        lines = []
        for i, node in enumerate(self.nodes):
            words = [node.op, *(f"n{a}" for a in node.args)]
            if node.op in INPUTS or node.op in ("const", "result"):
                words.append(str(node.value))
            lines.append(f"n{i} = {' '.join(words)}")
        lines += [f"carry {c}: n{after}" for c, (_, after) in enumerate(self.carry)]
        lines += [f"output {k}: n{node}" for k, node in enumerate(self.outputs)]
        return "\n".join(lines)

    @property
    def size(self) -> int:
        """Number of nodes that a compiler reads; those of a function count once."""
        return len(self.nodes) + sum(len(function.nodes) for function in called_functions(self))


def called_functions(program: Program) -> list[Program]:
    """The functions that a program calls, and those that they call; each follows all that it calls
    itself.
    """
    found: dict[int, Program] = {}
    for node in program.nodes:
        if node.op == "call" and id(node.value) not in found:
            inner = called_functions(node.value)
            found |= {id(function): function for function in (*inner, node.value)}
    return list(found.values())


def needed(nodes: Sequence[Node], outputs: Iterable[int], known: Container[int] = ()) -> list[int]:
    """The outputs and all nodes that they depend on, in order.

    Args:
      nodes: all nodes.
      outputs: some of them.
      known: nodes that are computed already; they and what only they depend on are excluded.
    """
    stack = list(outputs)
    found: set[int] = set()
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
    outputs: list[int],
    recorded: tuple[int, ...] = (),
) -> Program:
    """The program of the given outputs, without nodes that they do not need, in depth-first order.

    The order matters to a compiler with few registers: a number is computed shortly before its
    first use.
    """
    found = builder.nodes
    place: dict[int, int] = {}
    nodes: list[Node] = []
    for root in [*carry_out, *outputs]:
        stack = [root]
        while stack:
            i = stack[-1]
            if i in place:
                stack.pop()
                continue
            op, args, kind, value = found[i]
            missing = [a for a in args if a not in place]
            if missing:
                missing.reverse()
                stack += missing
                continue
            place[i] = len(nodes)
            nodes.append(Node(op, tuple([place[a] for a in args]), kind, value))
            stack.pop()
    carry = tuple((place.get(a, -1), place[b]) for a, b in zip(carry_in, carry_out, strict=True))
    kinds = tuple(builder.nodes[b].kind for b in carry_out)
    results = tuple(place[i] for i in outputs)
    return Program(builder.dtype, tuple(nodes), carry, results, kinds, recorded)


def frontier(
    program: Program, classes: list[int], of: int, used_by: Callable[[int], bool]
) -> list[int]:
    """The operations and inputs of one class that nodes of other classes read; no constants.

    Args:
      program: the program.
      classes: classes of its nodes.
      of: the class.
      used_by: whether a class is one of those that read.
    """
    read = {a for i, node in enumerate(program.nodes) if used_by(classes[i]) for a in node.args}
    if used_by(PER_RUN | TIME):
        read.update(output for _, output in program.carry)
        read.update(program.outputs)
    return sorted(a for a in read if classes[a] == of and program.nodes[a].op != "const")
