"""Assigns a place in the generated C to every number of a program.

`Layout` has the constants, the numbers that are computed once per time step, and the carried
numbers. `FunctionCalls` has the arguments and the results of the functions that a program calls.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from iblf_jax.kernels.program import PER_RUN, SHARED, TIME, Node, Program, arguments_of, frontier


def literal(node: Node, dtype: np.dtype) -> str:
    """The C expression of a constant, as a vector with one entry per run."""
    if node.kind == "b":
        return f"splat_i({-int(node.value)})"
    if node.kind == "i":
        return f"splat_i({node.value})"
    if math.isnan(node.value):
        return "splat(NAN)"
    if node.value == math.inf:
        return "splat(INFINITY)"
    if node.value == -math.inf:
        return "splat(-INFINITY)"
    if dtype == np.float32:
        return f"splat({node.value.hex()}f)"
    return f"splat({node.value.hex()})"


def c_type(node: Node) -> str:
    """The C type of a node: "F" for floating-point numbers, "I" for integers and truth values."""
    if node.kind == "f":
        return "F"
    return "I"


def unpacked(node: Node, place: str) -> str:
    """The C expression of an entry of a table, as a vector with one entry per run."""
    if node.kind == "f":
        return f"splat({place}.f)"
    return f"splat_i({place}.i)"


class Layout(NamedTuple):
    """The places of the numbers of a program that are kept between its functions."""

    constants: list[int]
    """Nodes that are computed once."""
    columns: list[int]
    """Nodes that are computed once per time step, for all runs."""
    floats: list[int]
    """Positions of the floating-point numbers in the carry."""
    ints: list[int]
    """Positions of the integers and truth values in the carry."""

    @staticmethod
    def of(program: Program) -> Layout:
        """The layout of a program."""
        classes, kinds = program.classes(), program.kinds
        return Layout(
            frontier(program, classes, SHARED, lambda c: c != SHARED),
            frontier(program, classes, TIME, lambda c: bool(c & PER_RUN)),
            [i for i, kind in enumerate(kinds) if kind == "f"],
            [i for i, kind in enumerate(kinds) if kind != "f"],
        )


class Positions(NamedTuple):
    """The next free positions of two arrays."""

    floats: int = 0
    others: int = 0

    def after(self, nodes: Iterable[Node]) -> Positions:
        """The next free positions after these nodes."""
        types = [c_type(node) for node in nodes]
        return Positions(self.floats + types.count("F"), self.others + types.count("I"))

    def largest(self, other: Positions) -> Positions:
        """The larger position of each array."""
        return Positions(max(self.floats, other.floats), max(self.others, other.others))


START = Positions()
"""The beginning of both arrays."""


def places(nodes: Iterable[Node], floats: str, others: str, first: Positions = START) -> list[str]:
    """The C expression of the place of each node.

    Args:
      nodes: the nodes, in order.
      floats: name of the array of floating-point numbers.
      others: name of the array of all other numbers.
      first: position in each array of its first node.
    """
    names = {"F": floats, "I": others}
    positions = {"F": first.floats, "I": first.others}
    found = []
    for node in nodes:
        kind = c_type(node)
        found.append(f"{names[kind]}[{positions[kind]}]")
        positions[kind] += 1
    return found


class CalledFunction(NamedTuple):
    """A function that a program calls."""

    program: Program
    arguments: list[str]
    """The C expression of each argument inside the function."""
    passed: list[int]
    """Positions of the arguments that each call passes in arrays."""


class FunctionCalls:
    """The calls of a program, and the places of their arguments and results.

    A function reads an argument that is the same in every call where it is: a shared constant, or a
    number that is computed once per run (`once`). Each call passes the other arguments in two
    arrays, `p` of floating-point numbers and `q` of all others. The results of each call have
    places of their own in the arrays `r` and `s`.
    """

    def __init__(self, program: Program, layout: Layout) -> None:
        self.nodes = program.nodes
        self.dtype = program.dtype
        self.once: list[int] = []
        """Nodes that are computed once per run."""
        self._classes = program.classes()
        self._constants = {i: f"constants[{k}]" for k, i in enumerate(layout.constants)}
        calls = [i for i, node in enumerate(self.nodes) if node.op == "call"]
        programs = {id(self.nodes[i].value): self.nodes[i].value for i in calls}
        self.functions = [self._function(called, calls) for called in programs.values()]
        self.first: dict[int, Positions] = {}
        """Call -> positions of its first results."""
        self.size = START
        """Sizes of the arrays of results."""
        self.results = self._places_of_results(calls)
        """Node of a result -> its C expression in the program."""

    def _function(self, called: Program, calls: list[int]) -> CalledFunction:
        """A called function with the places of its arguments."""
        own_calls = [self.nodes[i] for i in calls if self.nodes[i].value is called]
        columns = list(zip(*map(arguments_of, own_calls), strict=True))
        shared = [self._shared_place(set(column)) for column in columns]
        passed = [k for k, place in enumerate(shared) if place is None]
        in_arrays = places([self.nodes[columns[k][0]] for k in passed], "p", "q")
        place_of = dict(zip(passed, in_arrays, strict=True))
        arguments = [place or place_of[k] for k, place in enumerate(shared)]
        return CalledFunction(called, arguments, passed)

    def _shared_place(self, values: set[int]) -> str | None:
        """The place of an argument that every call reads at the same place; None for others.

        Args:
          values: the nodes that the calls pass for this argument.
        """
        if len(values) > 1:
            return None
        (value,) = values
        node = self.nodes[value]
        if node.op == "const":
            return literal(node, self.dtype)
        if value in self._constants:
            return unpacked(node, self._constants[value])
        if self._classes[value] != PER_RUN or node.kind != "f":
            return None
        if value not in self.once:
            self.once.append(value)
        return f"once[{self.once.index(value)}]"

    def _places_of_results(self, calls: list[int]) -> dict[int, str]:
        """The places of all results, one call after the other."""
        place_of: dict[int, list[str]] = {}
        free = START
        for call in calls:
            called = self.nodes[call].value
            results = [called.nodes[output] for output in called.outputs]
            self.first[call] = free
            place_of[call] = places(results, "r", "s", free)
            self.size = self.size.largest(free.after(results))
            # The next call may overwrite the results that the program does not read.
            read = [n.value for n in self.nodes if n.op == "result" and n.args[0] == call]
            free = free.after(results[: max(read, default=-1) + 1])
        return {
            i: place_of[node.args[0]][node.value]
            for i, node in enumerate(self.nodes)
            if node.op == "result"
        }

    @property
    def declarations(self) -> str:
        """Declarations of the arrays of numbers that are computed once, and of results."""
        floats, others = self.size
        return f"  F once[{len(self.once) + 1}], r[{floats + 1}]; I s[{others + 1}];"

    def once_statements(self, names: dict[int, str]) -> list[str]:
        """Statements that store the numbers that are computed once per run."""
        return [f"  once[{k}] = {names[i]};" for k, i in enumerate(self.once)]

    def statements(self, call: int, args: Sequence[str]) -> list[str]:
        """The statements of a call.

        Args:
          call: its node.
          args: C expressions of the arguments of the node.
        """
        node = self.nodes[call]
        is_conditional = node.kind != "call"
        values = args[len(args) - len(arguments_of(node)) :]
        number = next(
            k for k, function in enumerate(self.functions) if function.program is node.value
        )
        passed = {"F": list[str](), "I": list[str]()}
        for position in self.functions[number].passed:
            argument = self.nodes[arguments_of(node)[position]]
            passed[c_type(argument)].append(values[position])
        lines = self._arrays(call, passed)
        floats, others = self.first[call]
        lines.append(
            f"  function_{number}(constants, once, p{call}, q{call}, r + {floats}, s + {others});"
        )
        if is_conditional:
            return [f"  if (AT({args[0]}, 0)) {{", *lines, "  }"]
        return lines

    @staticmethod
    def _arrays(call: int, passed: dict[str, list[str]]) -> list[str]:
        """Statements that fill the arrays of a call's arguments.

        They assign element by element: GCC clears an array that has a list of all its elements.
        """
        arrays = {"F": f"p{call}", "I": f"q{call}"}
        lines = [f"  {kind} {arrays[kind]}[{len(passed[kind]) + 1}];" for kind in ("F", "I")]
        for kind in ("F", "I"):
            lines += [f"  {arrays[kind]}[{k}] = {x};" for k, x in enumerate(passed[kind])]
        return lines
