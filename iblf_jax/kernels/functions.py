"""Inner functions of a jaxpr: each is interpreted once, and inlined at each call or, if it is long,
called.

The closed loop is such a function: a step evaluates it once per stage of the integrator. A compiler
that reads it once has a quarter of the text to read, and its time grows faster than the text.

A branch that all runs take together, because only time decides it (the law of a sampled loop), is
such a function, too. It is called in steps that take it; the result is selected afterwards. A
function may call others: the closed loop in such a branch is the same function as in the stages.

A call computes the numbers that depend on the state. The caller computes what depends on leaves and
time only, as rarely as its class permits. It also computes what only some calls need (the sample,
which only the first stage returns), from numbers that the call returns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from iblf_jax.kernels import jaxprs
from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.passes import with_reciprocals
from iblf_jax.kernels.program import (
    INPUTS,
    PER_RUN,
    Builder,
    Ids,
    LoweringLimits,
    Program,
    Uses,
    finished,
    needed,
)

if TYPE_CHECKING:
    from jax.extend import core


@CACHES.function(maxsize=64)
def uses_in(function: core.ClosedJaxpr) -> dict[core.ClosedJaxpr, tuple[Uses, ...]]:
    """As `jaxprs.uses_of_calls`."""
    return jaxprs.uses_of_calls(function)


class Called(NamedTuple):
    """An inner function and the properties of its operands on which its program depends."""

    jaxpr: core.ClosedJaxpr
    pattern: tuple
    """The pattern of its operands, number by number (`_pattern`)."""
    shapes: tuple[tuple[int, ...], ...]
    """The shapes of its operands."""
    dtype: np.dtype
    sparse: bool
    limits: LoweringLimits
    exact: bool
    uses: frozenset[tuple[core.ClosedJaxpr, tuple[Uses, ...]]]
    """The functions inside it, and which of their results each call in the complete step uses."""
    read: Callable
    """Function (builder, jaxpr, operands) -> results."""


class Template(NamedTuple):
    """The program of a function, for operands of one pattern."""

    program: Program
    """Its outputs are the results. An operand is an "argument" if it depends on the state, and
    "shared" otherwise."""
    results: list[Ids]
    """Positions among the outputs, in the shape of each result."""


class Split(NamedTuple):
    """A function that is called, divided into the work of the call and that of the caller."""

    program: Program
    """The template's program, with products instead of divisions where the caller can compute the
    reciprocal."""
    arguments: list[int]
    """Nodes of the program that are the arguments of the call."""
    returned: list[int]
    """Nodes of the program that are the results of the call."""
    function: Program
    """The program of the call."""


def apply(
    b: Builder,
    jaxpr: core.ClosedJaxpr,
    operands: Sequence[Ids],
    used: Uses,
    read: Callable,
    condition: int | None = None,
) -> list[Ids | None]:
    """The results of an inner function; None for results that are not used.

    Args:
      b: builder of the caller.
      jaxpr: the function.
      operands: its operands.
      used: which results of this call are used.
      read: function (builder, jaxpr, operands) -> results.
      condition: node of a truth value, the same for all runs: results are used only where it holds.
        None for always.
    """
    flat = [int(i) for x in operands for i in x.ravel()]
    called = Called(
        jaxpr,
        _pattern(b, flat),
        tuple(x.shape for x in operands),
        b.dtype,
        b.sparse,
        # A function is the same wherever it is called; branches in it are inlined.
        b.limits._replace(under_condition=math.inf),
        b.exact,
        frozenset([(inner, b.uses[inner]) for inner in uses_in(jaxpr) if inner in b.uses]),
        read,
    )
    template = _template(called)
    all_uses = b.uses.get(jaxpr, (used,))
    limit = b.limits.written_out
    if condition is not None:
        limit = b.limits.under_condition
    elif b.in_function and len(all_uses) == 1:
        limit = math.inf
    if _size_on_state(template.program) <= limit:
        program = template.program
        known = _known_inputs(program, flat)
    else:
        split = _split(called, frozenset(all_uses))
        program = split.program
        known = _known_inputs(program, flat)
        _write(b, program, known, split.arguments)
        call = b.call(split.function, [known[i] for i in split.arguments], condition)
        known |= {i: b.result(call, k) for k, i in enumerate(split.returned)}
    _write(b, program, known, _samples(program, template.results, used))
    return [
        _result(known, program, positions, is_used)
        for positions, is_used in zip(template.results, used, strict=True)
    ]


def _size_on_state(program: Program) -> int:
    """Number of operations on the state, those of functions that it calls included."""
    size = 0
    for c, node in zip(program.classes(), program.nodes, strict=True):
        if node.op == "call":
            size += node.value.size
        elif c & PER_RUN and node.op not in INPUTS:
            size += 1
    return size


def _known_inputs(program: Program, operands: list[int]) -> dict[int, int]:
    """Input of a function's program -> node of the caller."""
    return {i: operands[node.value] for i, node in enumerate(program.nodes) if node.op in INPUTS}


def _pattern(b: Builder, operands: list[int]) -> tuple:
    """The properties of operands on which a program depends: constants, equal operands, and whether
    an operand depends on the state.
    """
    first: dict[int, int] = {}
    pattern: list[tuple] = []
    for place, i in enumerate(operands):
        node = b.nodes[i]
        if i == b.absent:
            pattern.append((node.kind, None))
        elif node.op == "const":
            # The digits of a float also distinguish NaN and the sign of zero.
            pattern.append((node.kind, node.value.hex() if node.kind == "f" else node.value))
        else:
            pattern.append(
                (node.kind, first.setdefault(i, place), b.depends_on_state(i), i in b.known_finite)
            )
    return tuple(pattern)


@CACHES.function(maxsize=16)
def _template(called: Called) -> Template:
    """The program of a function."""
    b = Builder(
        called.dtype,
        sparse=called.sparse,
        limits=called.limits,
        exact=called.exact,
        uses=dict(called.uses),
        in_function=True,
    )

    def node_of(kind, value, *known):
        if value is None:
            return b.absent
        if not known and kind == "f":
            return b.constant(float.fromhex(value), kind)
        if not known:
            return b.constant(value, kind)
        depends_on_state, is_finite = known
        node = b.input({True: "argument", False: "shared"}[depends_on_state], value, kind)
        if is_finite:
            b.known_finite.add(node)
        return node

    numbers = iter([node_of(*entry) for entry in called.pattern])
    operands = [
        np.asarray([next(numbers) for _ in range(math.prod(shape))], np.int64).reshape(shape)
        for shape in called.shapes
    ]
    results = called.read(b, called.jaxpr, operands)
    program = finished(b, [], [], [int(i) for ids in results for i in ids.ravel()])
    starts = np.cumsum([0, *(ids.size for ids in results)])
    return Template(
        program,
        [
            start + np.arange(ids.size).reshape(ids.shape)
            for start, ids in zip(starts, results, strict=False)
        ],
    )


@CACHES.function(maxsize=16)
def _with_reciprocals(called: Called) -> Program:
    """The program of a function, with products instead of divisions."""
    return with_reciprocals(_template(called).program)


def _samples(program: Program, results: list[Ids], used: Uses) -> list[int]:
    """The nodes of the results that are used."""
    return [
        program.outputs[position]
        for positions, is_used in zip(results, used, strict=True)
        if is_used
        for position in positions.ravel()
    ]


@CACHES.function(maxsize=16)
def _split(called: Called, all_uses: frozenset[Uses]) -> Split:
    """Divides a function: a call computes the operations that depend on the state and that every
    caller needs.

    Args:
      called: the function.
      all_uses: which results each of its calls uses.
    """
    program = _with_reciprocals(called)
    positions = _template(called).results
    nodes = program.nodes
    classes = program.classes()

    def on_state(outputs: Iterable[int]) -> list[int]:
        return [
            i for i in needed(nodes, outputs) if classes[i] & PER_RUN and nodes[i].op not in INPUTS
        ]

    by_result = list(zip(*all_uses, strict=True))
    read = _samples(program, positions, tuple(map(any, by_result)))
    results = _samples(program, positions, tuple(map(all, by_result)))
    needed_by = [set(on_state(_samples(program, positions, used))) for used in all_uses]
    within = set.intersection(*needed_by)
    inside = sorted(within)
    # Numbers that the caller computes on the state read numbers of the call.
    read += [a for i in on_state(read) if i not in within for a in nodes[i].args]
    returned = list(dict.fromkeys(i for i in [*results, *read] if i in within))
    operands = {a for i in inside for a in nodes[i].args if nodes[a].op != "const"}
    arguments = sorted(operands - within)

    b = Builder(program.dtype)
    new = {a: b.input("argument", k, nodes[a].kind) for k, a in enumerate(arguments)}
    _write(b, program, new, inside)
    function = finished(b, [], [], [new[i] for i in returned])
    return Split(program, arguments, returned, function)


def _write(b: Builder, program: Program, known: dict[int, int], outputs: Iterable[int]) -> None:
    """Copies the nodes of a program that the outputs depend on to another builder; `known`, node of
    the program -> node of the builder, receives them.
    """
    for i in needed(program.nodes, outputs, known):
        known[i] = b.copy(program.nodes[i], [known[a] for a in program.nodes[i].args])


def _result(known: dict[int, int], program: Program, positions: Ids, is_used: bool) -> Ids | None:
    """The nodes of a result; None if it is not used."""
    if not is_used:
        return None
    nodes = [known[program.outputs[position]] for position in positions.ravel()]
    return np.asarray(nodes, np.int64).reshape(positions.shape)
