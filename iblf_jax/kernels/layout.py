"""Where the numbers of a program stand in the generated C: constants, columns of time, and what
goes in and out of functions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from iblf_jax.kernels.program import LANE, SHARED, TIME, Node, Program, frontier


def literal(node: Node, dtype: np.dtype) -> str:
    """A constant as a vector of runs."""
    if node.kind == "b":
        return f"splat_i({-1 if node.value else 0})"
    if node.kind == "i":
        return f"splat_i({node.value})"
    if math.isnan(node.value):
        return "splat(NAN)"
    if math.isinf(node.value):
        return f"splat({'-' if node.value < 0 else ''}INFINITY)"
    return f"splat({node.value.hex()}{'f' if dtype == np.float32 else ''})"


def c_type(node: Node) -> str:
    """The C type of a number of every run."""
    return "F" if node.kind == "f" else "I"


def unpacked(node: Node, place: str) -> str:
    """A word of a table as a vector of runs."""
    return f"splat({place}.f)" if node.kind == "f" else f"splat_i({place}.i)"


class Layout(NamedTuple):
    """Which numbers of a program stand where in the generated code."""

    constants: list[int]
    """Nodes that are computed once."""
    columns: list[int]
    """Nodes that are computed once a step."""
    floats: list[int]
    ints: list[int]
    """Places in the carry."""

    @staticmethod
    def of(program: Program) -> Layout:
        """That of a program."""
        classes, kinds = program.classes(), program.kinds
        return Layout(
            frontier(program, classes, SHARED, lambda c: c != SHARED),
            frontier(program, classes, TIME, lambda c: bool(c & LANE)),
            [i for i, kind in enumerate(kinds) if kind == "f"],
            [i for i, kind in enumerate(kinds) if kind != "f"],
        )


def places(
    nodes: Iterable[Node], floats: str, others: str, begin: tuple[int, int] = (0, 0)
) -> tuple[list[str], tuple[int, int]]:
    """A place for each node, in two arrays that are filled from `begin` on, and how far they are
    filled then.
    """
    used, found = dict(zip((floats, others), begin, strict=True)), list[str]()
    for node in nodes:
        array = floats if c_type(node) == "F" else others
        found.append(f"{array}[{used[array]}]")
        used[array] += 1
    return found, (used[floats], used[others])


def given_to(call: Node) -> tuple[int, ...]:
    """What the function of a call is given."""
    return call.args if call.kind == "call" else call.args[1:]


class Calls:
    """The functions that a program calls, and where the numbers are that go in and out.

    What is the same in every call is read where it is: shared constants, and what is computed once
      a run (`once`).  The rest is put into
    arrays for each call, `p` of floats and `q` of others; the results of each call have places of
    their own, in `r` and `s`.
    """

    def __init__(self, program: Program, layout: Layout) -> None:
        nodes = self.nodes = program.nodes
        calls = [i for i, node in enumerate(nodes) if node.op == "call"]
        self.functions: list[Program] = list(
            {id(nodes[i].value): nodes[i].value for i in calls}.values()
        )
        self.once: list[int] = []
        """Nodes that are computed once a run."""
        self.given: list[list[str]] = []
        """What a function calls its arguments, one list a function."""
        self.put: list[list[int]] = []
        """Which of them are put into arrays."""
        self.results: dict[int, str] = {}
        """What the program calls a result."""
        self.begins: dict[int, tuple[int, int]] = {}
        """Where the results of a call begin."""
        self.used = (0, 0)
        constants, classes = (
            {i: f"constants[{k}]" for k, i in enumerate(layout.constants)},
            program.classes(),
        )

        def where_it_is(same: set[int]) -> str | None:
            a = next(iter(same))
            if len(same) == 1 and nodes[a].op == "const":
                return literal(nodes[a], program.dtype)
            if len(same) == 1 and a in constants:
                return unpacked(nodes[a], constants[a])
            if len(same) == 1 and classes[a] == LANE and nodes[a].kind == "f":
                self.once += [] if a in self.once else [a]
                return f"once[{self.once.index(a)}]"
            return None

        for function in self.functions:
            arguments = list(
                zip(*(given_to(nodes[i]) for i in calls if nodes[i].value is function), strict=True)
            )
            known = [where_it_is(set(each)) for each in arguments]
            self.put.append([k for k, name in enumerate(known) if name is None])
            own = iter(places([nodes[arguments[k][0]] for k in self.put[-1]], "p", "q")[0])
            self.given.append([name or next(own) for name in known])
        found, begin = {}, (0, 0)
        for i in calls:
            made = [nodes[i].value.nodes[s] for s in nodes[i].value.samples]
            read = max(
                (node.value for node in nodes if node.op == "result" and node.args[0] == i),
                default=-1,
            )
            self.begins[i] = begin
            found[i], end = places(made, "r", "s", begin)
            self.used = (max(self.used[0], end[0]), max(self.used[1], end[1]))
            # What nobody reads of a call may be written over by the next one.
            begin = places(made[: read + 1], "r", "s", begin)[1]
        self.results = {
            i: found[node.args[0]][node.value]
            for i, node in enumerate(nodes)
            if node.op == "result"
        }

    @property
    def room(self) -> str:
        """The arrays of what is computed once, and of results."""
        return f"  F once[{len(self.once) + 1}], r[{self.used[0] + 1}]; I s[{self.used[1] + 1}];"

    def filled(self, names: dict[int, str]) -> list[str]:
        """Statements that put there what is computed once."""
        return [f"  once[{k}] = {names[i]};" for k, i in enumerate(self.once)]

    def statement(self, call: int, args: Sequence[str]) -> list[str]:
        """A call."""
        node = self.nodes[call]
        condition, args = (None, args) if node.kind == "call" else (args[0], args[1:])
        k = next(k for k, function in enumerate(self.functions) if function is node.value)
        given = {"F": list[str](), "I": list[str]()}
        for place in self.put[k]:
            given[c_type(self.nodes[given_to(node)[place]])].append(args[place])
        # Element by element: a list of all makes GCC clear the array before.
        arrays = [
            f"  {t} {name}{call}[{len(given[t]) + 1}];" for t, name in (("F", "p"), ("I", "q"))
        ]
        arrays += [
            f"  {name}{call}[{k}] = {x};"
            for t, name in (("F", "p"), ("I", "q"))
            for k, x in enumerate(given[t])
        ]
        floats, others = self.begins[call]
        made = [
            *arrays,
            f"  function_{k}(constants, once, p{call}, q{call}, r + {floats}, s + {others});",
        ]
        return made if condition is None else [f"  if (AT({condition}, 0)) {{", *made, "  }"]
