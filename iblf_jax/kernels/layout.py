"""Assigns a place in the generated C to every number of a program.

`Layout` has the constants, the numbers that are computed once per time step, and the carried
numbers. `FunctionCalls` has the arguments of the functions that a program calls, and `Calls` the
results of the calls in it or in one of the functions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from iblf_jax.kernels.program import (
    PER_RUN,
    SHARED,
    TIME,
    Node,
    Program,
    arguments_of,
    called_functions,
    frontier,
)


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

    def plus(self, other: Positions) -> Positions:
        """These positions in arrays that begin at the other ones."""
        return Positions(self.floats + other.floats, self.others + other.others)

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
    values: list[int | str | None]
    """What every call passes for each argument: a number of the program that calls first, a
    constant in C, or None if calls differ or the number is one of a function."""
    arguments: list[str]
    """The C expression of each argument inside the function."""
    passed: list[int]
    """Positions of the arguments that each call passes in arrays."""


class FunctionCalls:
    """The functions that a program calls, themselves or in each other, and their arguments.

    A function reads an argument that is the same in every call where it is: a shared constant, or a
    number that is computed once per run (`once`). Each call passes the other arguments in two
    arrays, `p` of floating-point numbers and `q` of all others.

    The results of each call have places of their own in the arrays `r` and `s`. A function writes
    its results to the beginning of these arrays, and what it calls to the places after them.
    """

    def __init__(self, program: Program, layout: Layout) -> None:
        self.dtype = program.dtype
        self.once: list[int] = []
        """Nodes that are computed once per run."""
        self._nodes = program.nodes
        self._classes = program.classes()
        self._constants = {i: f"constants[{k}]" for k, i in enumerate(layout.constants)}
        programs = called_functions(program)
        callers = [program]
        found: list[CalledFunction] = []
        for called in reversed(programs):  # a function after those that call it
            found.insert(0, self._function(called, callers, found))
            callers.append(called)
        self.functions = found
        """Each follows all that it calls."""
        self.of: dict[int, Calls] = {}
        """Identity of a program, this one or a function -> the calls in it."""
        for called in programs:
            results = START.after(called.nodes[output] for output in called.outputs)
            self.of[id(called)] = Calls(called, self, results)
        self.of[id(program)] = Calls(program, self, START)

    def _function(
        self, called: Program, callers: list[Program], others: list[CalledFunction]
    ) -> CalledFunction:
        """A called function with the places of its arguments.

        Args:
          called: the function.
          callers: the programs that may call it, first that which is no function.
          others: the functions among them.
        """
        calls = [
            (caller, node) for caller in callers for node in caller.nodes if node.value is called
        ]
        values_of = {id(other.program): other.values for other in others}
        columns = zip(
            *[
                [self._value(caller, values_of, a) for a in arguments_of(node)]
                for caller, node in calls
            ],
            strict=True,
        )
        values = [column[0] if len(set(column)) == 1 else None for column in columns]
        shared = [self._shared_place(value) for value in values]
        passed = [k for k, place in enumerate(shared) if place is None]
        caller, node = calls[0]
        in_arrays = places([caller.nodes[arguments_of(node)[k]] for k in passed], "p", "q")
        place_of = dict(zip(passed, in_arrays, strict=True))
        arguments = [place or place_of[k] for k, place in enumerate(shared)]
        return CalledFunction(called, values, arguments, passed)

    def _value(
        self, caller: Program, values_of: dict[int, list], argument: int
    ) -> int | str | None:
        """What a caller passes as an argument, as `CalledFunction.values`."""
        node = caller.nodes[argument]
        if node.op == "const":
            return literal(node, self.dtype)
        if id(caller) not in values_of:
            return argument
        return values_of[id(caller)][node.value] if node.op == "argument" else None

    def _shared_place(self, value: int | str | None) -> str | None:
        """The place of an argument that every call reads at the same place; None for others."""
        if not isinstance(value, int):
            return value
        node = self._nodes[value]
        if value in self._constants:
            return unpacked(node, self._constants[value])
        if self._classes[value] != PER_RUN or node.kind != "f":
            return None
        if value not in self.once:
            self.once.append(value)
        return f"once[{self.once.index(value)}]"

    def number(self, called: Program) -> int:
        """The position of a function among all."""
        return next(k for k, each in enumerate(self.functions) if each.program is called)

    def once_statements(self, names: dict[int, str]) -> list[str]:
        """Statements that store the numbers that are computed once per run."""
        return [f"  once[{k}] = {names[i]};" for k, i in enumerate(self.once)]


class Calls:
    """The calls in a program or in a function.

    Args:
      program: the program or the function.
      functions: all functions; those that it calls have their `Calls`.
      free: first free positions of the arrays of results.
    """

    def __init__(self, program: Program, functions: FunctionCalls, free: Positions) -> None:
        self.nodes = program.nodes
        self._functions = functions
        self.first: dict[int, Positions] = {}
        """Call -> positions of its first results."""
        self.size = free
        """Sizes of the arrays of results."""
        self.results: dict[int, str] = {}
        """Node of a result -> its C expression."""
        read: dict[int, list[int]] = {}
        for i, node in enumerate(self.nodes):
            if node.op == "result":
                read.setdefault(node.args[0], []).append(i)
        for call, node in enumerate(self.nodes):
            if node.op != "call":
                continue
            called = node.value
            results = [called.nodes[output] for output in called.outputs]
            self.first[call] = free
            self.size = self.size.largest(free.plus(functions.of[id(called)].size))
            place_of = places(results, "r", "s", free)
            here = read.get(call, [])
            self.results |= {i: place_of[self.nodes[i].value] for i in here}
            # The next call may overwrite the results that the program does not read.
            last = max((self.nodes[i].value for i in here), default=-1)
            free = free.after(results[: last + 1])

    @property
    def declarations(self) -> str:
        """Declarations of the arrays of numbers that are computed once, and of results."""
        floats, others = self.size
        once = len(self._functions.once)
        return f"  F once[{once + 1}], r[{floats + 1}]; I s[{others + 1}];"

    def statements(self, call: int, args: Sequence[str]) -> list[str]:
        """The statements of a call.

        Args:
          call: its node.
          args: C expressions of the arguments of the node.
        """
        node = self.nodes[call]
        is_conditional = node.kind != "call"
        values = args[len(args) - len(arguments_of(node)) :]
        number = self._functions.number(node.value)
        passed = {"F": list[str](), "I": list[str]()}
        for position in self._functions.functions[number].passed:
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
