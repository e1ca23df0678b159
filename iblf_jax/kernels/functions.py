"""Inner functions of a jaxpr: each is read once, and written out wherever it is called or, if it is
long, called there.

The closed loop is such a function: a step evaluates it once a stage of the integrator.  A compiler
  that sees it once has a quarter of the
text to read, and its time grows faster than that.

A branch that all runs take or leave together, as only time decides (the law of a sampled loop), is
such a function too, and called where it is taken; what its other side gives is chosen afterwards.

A call computes what moves with the state.  What leaves and time alone decide stays with the caller,
which computes it as seldom as its class allows; so does what not every caller asks for (the sample,
which the first stage alone gives): it is written out there, on numbers that the call hands over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.passes import with_reciprocals
from iblf_jax.kernels.program import (
    INPUTS,
    PER_RUN,
    Builder,
    Ids,
    LoweringLimits,
    Program,
    finished,
    needed,
)

Uses = tuple[bool, ...]
"""Which results of a function somebody reads."""


class Called(NamedTuple):
    """What decides how an inner function is read."""

    jaxpr: Any
    pattern: tuple
    """Of its operands, number by number."""
    shapes: tuple[tuple[int, ...], ...]
    """Of its operands."""
    dtype: Any
    sparse: bool
    limits: LoweringLimits
    read: Callable
    """Function (builder, jaxpr, operands) -> results."""


class Template(NamedTuple):
    """A function, read once for operands of one pattern."""

    program: Program
    """Its samples are the results; operands are "argument" where they move with the state, else
    "shared"."""
    results: list[Ids]
    """Places among the samples, in the shape of each result."""


class Split(NamedTuple):
    """A template that is called."""

    program: Program
    """The template's, with products instead of divisions by what the caller can invert."""
    given: list[int]
    """Its nodes that the call is given."""
    handed: list[int]
    """Its nodes that the call hands over."""
    function: Program


def apply(
    b: Builder,
    jaxpr: Any,
    operands: Sequence[Ids],
    used: Uses,
    all_uses: Sequence[Uses],
    read: Callable,
    condition: int | None = None,
) -> list[Ids | None]:
    """The results of an inner function that are used.

    Args:
      b: of the caller.
      jaxpr: the function.
      operands: what it is given.
      used: which results this call's are used.
      all_uses: `used` of every call that the caller makes.
      read: function (builder, jaxpr, operands) -> results.
      condition: where it holds, the same for all runs, the results are wanted; everywhere if not
        given.
    """
    flat = [int(i) for x in operands for i in x.ravel()]
    called = Called(
        jaxpr,
        _pattern(b, flat),
        tuple(x.shape for x in operands),
        b.dtype,
        b.sparse,
        b.limits,
        read,
    )
    template, split = _template(called), None
    if _moving(template.program) > (
        b.limits.written_out if condition is None else b.limits.under_condition
    ):
        split = _split(
            called, *(tuple(map(which, zip(*all_uses, strict=True))) for which in (all, any))
        )

    program = split.program if split else template.program
    known = {i: flat[node.value] for i, node in enumerate(program.nodes) if node.op in INPUTS}
    if split:
        _write(b, program, known, split.given)
        call = b.call(split.function, [known[i] for i in split.given], condition)
        known |= {i: b.result(call, k) for k, i in enumerate(split.handed)}
    _write(b, program, known, _samples(program, template.results, used))
    return [
        _new(known, program, places) if yes else None
        for places, yes in zip(template.results, used, strict=True)
    ]


def _pattern(b: Builder, operands: list[int]) -> tuple:
    """What of the operands decides how a function is read: constants, equal ones, and what moves
    with the state.
    """
    first: dict[int, int] = {}
    pattern: list[tuple] = []
    for place, i in enumerate(operands):
        node = b.nodes[i]
        if i == b.absent:
            pattern.append((node.kind, None))
        elif node.op == "const":
            pattern.append((node.kind, node.value.hex() if node.kind == "f" else node.value))
        else:
            pattern.append(
                (node.kind, first.setdefault(i, place), b.depends_on_state(i), i in b.known_finite)
            )
    return tuple(pattern)


@CACHES.function(maxsize=16)
def _template(called: Called) -> Template:
    b = Builder(
        called.dtype,
        sparse=called.sparse,
        limits=called.limits._replace(written_out=math.inf, under_condition=math.inf),
    )

    def node_of(kind, value, *known):
        if value is None:
            return b.absent
        if not known:
            return b.constant(float.fromhex(value) if kind == "f" else value, kind)
        moves, finite = known
        node = b.input("argument" if moves else "shared", value, kind)
        b.known_finite.update([node] if finite else [])
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
    return with_reciprocals(_template(called).program)


def _moving(program: Program) -> int:
    """How many operations move with the state."""
    return sum(
        bool(c & PER_RUN) and node.op not in INPUTS
        for c, node in zip(program.classes(), program.nodes, strict=True)
    )


def _samples(program: Program, results: list[Ids], used: Uses) -> list[int]:
    return [
        program.samples[place]
        for places, yes in zip(results, used, strict=True)
        if yes
        for place in places.ravel()
    ]


@CACHES.function(maxsize=16)
def _split(called: Called, everywhere: Uses, anywhere: Uses) -> Split:
    """What a call computes: what moves and every caller uses."""
    program, places = _with_reciprocals(called), _template(called).results
    nodes, classes = program.nodes, program.classes()

    def moving(wanted: Iterable[int]) -> list[int]:
        return [
            i for i in needed(nodes, wanted) if classes[i] & PER_RUN and nodes[i].op not in INPUTS
        ]

    results, asked = _samples(program, places, everywhere), _samples(program, places, anywhere)
    inside = moving(results)
    within = set(inside)
    asked += [a for i in moving(asked) if i not in within for a in nodes[i].args]
    handed = list(dict.fromkeys(i for i in [*results, *asked] if i in within))
    given = sorted({a for i in inside for a in nodes[i].args if nodes[a].op != "const"} - within)

    b = Builder(program.dtype)
    new = {a: b.input("argument", k, nodes[a].kind) for k, a in enumerate(given)}
    _write(b, program, new, inside)
    return Split(program, given, handed, finished(b, [], [], [new[i] for i in handed]))


def _write(b: Builder, program: Program, known: dict[int, int], wanted: Iterable[int]) -> None:
    """Adds the nodes of a program that `wanted` needs to another builder; `known` says which of its
    nodes they are.
    """
    for i in needed(program.nodes, wanted, known):
        known[i] = b.copy(program.nodes[i], [known[a] for a in program.nodes[i].args])


def _new(known: dict[int, int], program: Program, places: Ids) -> Ids:
    return np.asarray(
        [known[program.samples[place]] for place in places.ravel()], np.int64
    ).reshape(places.shape)
