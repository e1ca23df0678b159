"""C from a scalar program: one function for what only shared leaves decide, one for what time
decides, one for a block of runs, and one for each function that the program calls (the closed loop
of an arm).

The text is plain statements, one a node, and the same for every target; the headers around it say
what it means.  On a CPU `c/vector.h` makes of a name a vector of runs, `c/mathlib.h` has the
elementary functions and `c/driver.h` the loops and threads; on a GPU `c/scalar.h` makes of it the
number of one thread's run, and `c/kernels.h` has the kernels.  Out of the package `c/plain.h` makes
of it a number of C99, and `plain_function` gives the function alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from types import MappingProxyType

import numpy as np

from iblf_jax.kernels.layout import FunctionCalls, Layout, literal, places, unpacked
from iblf_jax.kernels.operations import OPERATIONS
from iblf_jax.kernels.passes import scheduled
from iblf_jax.kernels.program import (
    PER_RUN,
    TIME,
    Node,
    Program,
    UnsupportedError,
    frontier,
    needed,
)

NATIVE = (("vector.h", "mathlib.h", "records.h"), ("frame.h", "driver.h"))
CUDA = (("scalar.h", "mathlib.h", "records.h"), ("kernels.h",))
"""The headers before and after the generated functions, by target."""
TURNS = frozenset({"sin", "cos"})
"""Operations that `mathlib.h` has in two parts: a polynomial, and what takes its place where an
angle is huge."""


def expression(node: Node, args: list[str], kinds: list[str]) -> str:
    """One operation in C; `args` are expressions of vectors."""
    op = node.op
    if op == "convert":
        return _conversion(kinds[0], node.kind, args[0])
    text = OPERATIONS[op].in_c(op, kinds[0], args)
    if text is not None:
        return text
    raise UnsupportedError(f"generated code has no {op} of kind {kinds}")


def _conversion(source: str, target: str, arg: str) -> str:
    if source == "b":
        return f"{arg} ? splat(1) : splat(0)" if target == "f" else f"{arg} & 1"
    return f"to_float({arg})" if target == "f" else f"to_int({arg})"


SEEN_BY_FUNCTION = (
    "const word *constants",
    "const F *once",
    "const F *p",
    "const I *q",
    "F *RESTRICT r",
    "I *RESTRICT s",
)
SEEN_BY_ADVANCE = (
    "const word *constants",
    "const F *leaves",
    "const F *floats",
    "const I *ints",
    "const word *row",
    "const F *once",
    "F *r",
    "I *s",
)
"""What the generated functions are given, besides their places."""


class _Emitter:
    """Statements for nodes; `names` are the C expressions of nodes that were read or computed
    already.

    `tables` says into which table each lookup looks, by the table's text; `calls` where the numbers
    of a call are.
    """

    def __init__(self, program: Program, tables: dict[str, str], calls: FunctionCalls) -> None:
        self.program = program
        self.turns = TURNS
        """Operations of which several are done with one test (`_turned`)."""
        self.classes = program.classes()
        self.lines: list[str] = []
        self.tables = {
            i: tables.setdefault(self._numbers(node), f"table_{len(tables)}")
            for i, node in enumerate(program.nodes)
            if node.op == "lookup"
        }
        self.calls = calls
        self.in_place: dict[int, int] = {}
        """Choices that change a carried number where it stands -> the number before."""
        self.end: list[str] = []
        """What stands at the end of every function."""

    def _numbers(self, lookup: Node) -> str:
        """The bits of its table, which are constants for every compiler; infinity is a function's
        result for some.
        """
        bits = np.asarray(lookup.value, self.program.dtype).view(f"u{self.program.dtype.itemsize}")
        return ", ".join(f"(integer){x:#x}" for x in bits.tolist())

    def needed(self, names: dict[int, str], wanted: Iterable[int]) -> list[int]:
        """The nodes without a name that `wanted` needs, in order."""
        return needed(self.program.nodes, wanted, names)

    def statements(
        self,
        names: dict[int, str],
        wanted: Iterable[int],
        stored: Mapping[int, str] = MappingProxyType({}),
    ) -> None:
        """Adds statements for `wanted` and what it needs; `stored` has places in memory of some of
        them.
        """
        nodes = self.program.nodes
        order = self.needed(names, wanted)
        turns = [i for i in order if nodes[i].op in self.turns]
        for i in order:
            node = nodes[i]
            if i in names:
                continue
            together = (
                [j for j in turns if j not in names and nodes[j].args[0] in names]
                if node.op in self.turns
                else []
            )
            if len(together) > 1:
                self._turned(together, names, stored)
                continue
            if node.op == "const":
                names[i] = literal(node, self.program.dtype)
                continue
            if node.op == "result":
                names[i] = self.calls.results[i]
                continue
            args = [names[a] for a in node.args]
            if i in self.in_place:
                condition, yes, no = args
                old, new, unless = (
                    (no, yes, "") if node.args[2] == self.in_place[i] else (yes, no, "!")
                )
                self.lines.append(f"  if ({unless}AT({condition}, 0)) {old} = {new};")
                names[i] = old
                continue
            if node.op == "call":
                self.lines += self.calls.statements(i, args)
                names[i] = "called"
                continue
            if node.op == "lookup":
                text = f"f_lookup({self.tables[i]}, {len(node.value)}, {args[0]})"
            else:
                text = expression(node, args, [nodes[a].kind for a in node.args])
            self.lines.append(f"  {'F' if node.kind == 'f' else 'I'} v{i} = {text};")
            names[i] = f"v{i}"
            if i in stored:  # at once: a compiler then needs no place of its own for it
                self.lines.append(f"  {stored[i]} = v{i};")

    def _turned(self, turns: list[int], names: dict[int, str], stored: Mapping[int, str]) -> None:
        """Adds statements for sines and cosines: all whose angles are there, as one test sees
        whether any of these is huge.
        """
        nodes = self.program.nodes
        angles = {i: names[nodes[i].args[0]] for i in turns}
        names |= {i: f"v{i}" for i in turns}
        self.lines += [f"  F v{i} = near_{nodes[i].op}({angle});" for i, angle in angles.items()]
        self.lines.append(
            "  if"
            f" (RARELY({' | '.join(f'is_far({angle})' for angle in dict.fromkeys(angles.values()))})) {{"
        )
        self.lines += [
            f"    v{i} = {nodes[i].op}_where(is_far({angle}), {angle}, v{i});"
            for i, angle in angles.items()
        ]
        self.lines.append("  }")
        self.lines += [f"  {stored[i]} = v{i};" for i in turns if i in stored]

    def function(self, head: str) -> str:
        """The C function of the statements so far."""
        body, self.lines = "\n".join([*self.lines, *self.end]), []
        return f"{head} {{\n{body}\n}}\n"


def sizes(program: Program, shared_leaves: int, lane_leaves: int) -> str:
    """The definitions of the sizes that the headers ask for."""
    constants, columns, floats, ints = map(len, Layout.of(program))
    values: dict[str, object] = {
        "SHARED_LEAVES": shared_leaves, "LEAVES": lane_leaves, "FLOATS": floats, "INTS": ints, "CONSTANTS": constants,
        "COLUMNS": columns, "DOUBLE": int(program.dtype == np.float64),
    }  # fmt: skip
    values["RECORDED"], values["RECORDED_SIZES"] = (
        len(program.recorded),
        f"{{{', '.join(map(str, [*program.recorded, 0]))}}}",
    )
    return "".join(f"#define {name} {value}\n" for name, value in values.items())


def source(
    program: Program,
    shared_leaves: int,
    lane_leaves: int,
    target: tuple[tuple[str, ...], ...] = NATIVE,
    segment: int | None = None,
) -> str:
    """The whole C source of a program's kernel for a target, NATIVE or CUDA; cut into functions of
    `segment` operations if given.
    """
    if (
        target is NATIVE and not segment
        # not the functions that it calls: they have work enough at any time, and no registers to
        # spare
    ):
        program = scheduled(program)
    layout, tables = Layout.of(program), dict[str, str]()
    calls = FunctionCalls(program, layout)
    e = _Emitter(program, tables, calls)
    functions = _functions(calls, tables, segment)
    before, after = target
    parts = [sizes(program, shared_leaves, lane_leaves), *map(header, before)]
    parts += [f"TABLE {name}[] = {{{numbers}}};" for numbers, name in tables.items()]
    parts += [
        *functions,
        _constants(e, layout.constants),
        _signals(e, layout.constants, layout.columns),
    ]
    parts += [_advance_in_segments(e, segment, *layout) if segment else _advance(e, *layout)]
    return "\n".join([*parts, *map(header, after)])


def plain_function(
    program: Program,
    name: str,
    parameters: Sequence[str],
    inputs: Mapping[str, Sequence[str]],
    outputs: Sequence[str],
    segment: int,
) -> str:
    """One C99 function of one run, for the names of `c/plain.h`.

    Args:
      program: what it computes; without calls, which `passes.written_out` takes away.
      name: of the function, and the beginning of those that it is cut into.
      parameters: C declarations, `const F *q`.
      inputs: operation that stands for an input -> what C calls each of these numbers.
      outputs: places of the numbers that are carried and of the samples; none of them is an input.
      segment: operations above which it is cut, into functions of so many.
    """
    tables = dict[str, str]()
    e = _Emitter(program, tables, FunctionCalls(program, Layout.of(program)))
    e.tables = {i: f"{name}_{table}" for i, table in e.tables.items()}
    e.turns = frozenset()  # each by itself
    names = {
        i: inputs[node.op][node.value] for i, node in enumerate(program.nodes) if node.op in inputs
    }
    wanted = [*(o for _, o in program.carry), *program.samples]
    seen = [p.split()[-1].lstrip("*") for p in parameters]
    parts = list[str]()
    if len(program.nodes) > segment:
        segments = _Segments(e, names, segment, name, tuple(parameters))
        e.end = [f"  (void){x};" for x in [*seen, "x", "y"]]
        calls = segments.add(sorted(set(wanted)), kept=False)
        parts, names = segments.functions, segments.names
        e.lines = [segments.room, *(f"  {call}" for call in calls)]
        e.statements(names, wanted)
    else:
        e.statements(names, wanted)
        e.end = [f"  (void){x};" for x in seen]
    e.lines += [f"  {place} = {names[i]};" for place, i in zip(outputs, wanted, strict=True)]
    parts.append(e.function(f"static void {name}({', '.join([*parameters, 'F *RESTRICT r'])})"))
    return "\n".join(
        [*(f"TABLE {name}_{table}[] = {{{numbers}}};" for numbers, table in tables.items()), *parts]
    )


def header(name: str) -> str:
    """The text of a file in `c/`."""
    return (files("iblf_jax.kernels") / "c" / name).read_text()


def _functions(calls: FunctionCalls, tables: dict[str, str], segment: int | None) -> list[str]:
    """The functions that a program calls, each cut into some of `segment` operations if given."""
    texts = []
    for k, (function, arguments, _) in enumerate(calls.functions):
        e = _Emitter(function, tables, calls)
        names = {
            i: arguments[node.value]
            for i, node in enumerate(function.nodes)
            if node.op == "argument"
        }
        results = list(
            zip(
                function.samples,
                places([function.nodes[i] for i in function.samples], "r", "s"),
                strict=True,
            )
        )
        if segment:
            segments = _Segments(e, names, segment, f"part_{k}", SEEN_BY_FUNCTION)
            parts = segments.add(sorted(set(function.samples)), kept=False, own=dict(results))
            texts += segments.functions
            e.lines += [segments.room, *(f"  {part}" for part in parts)]
        else:
            e.statements(names, function.samples)
        e.lines += [f"  {place} = {names[i]};" for i, place in results if names[i] != place]
        texts.append(e.function(f"SEPARATE void function_{k}({', '.join(SEEN_BY_FUNCTION)})"))
    return texts


def _constants(e: _Emitter, constants: list[int]) -> str:
    nodes = e.program.nodes
    names = {i: f"splat(shared[{n.value}])" for i, n in enumerate(nodes) if n.op == "shared"}
    e.statements(names, constants)
    e.lines += [
        f"  out[{k}].{_part(nodes[i])} = AT({names[i]}, 0);" for k, i in enumerate(constants)
    ]
    return e.function("FUNCTION void shared_constants(const real *shared, word *out)")


def _part(node: Node) -> str:
    return "f" if node.kind == "f" else "i"


def _signals(e: _Emitter, constants: list[int], columns: list[int]) -> str:
    nodes = e.program.nodes
    names = {i: unpacked(nodes[i], f"constants[{k}]") for k, i in enumerate(constants)}
    names |= {i: "index" for i, n in enumerate(nodes) if n.op == "index"}
    e.lines.append("  I index = from(first);")
    e.statements(names, columns)
    e.lines += [f"  write_column(table + {k}, COLUMNS, {names[i]});" for k, i in enumerate(columns)]
    return e.function(
        "FUNCTION void shared_signals(const word *constants, integer first, word *table)"
    )


HEAD_OF_ADVANCE = (
    "FUNCTION void advance(const word *constants, const F *leaves, F *floats, I *ints, const word"
    " *row, int count,\n                    int64_t first, int64_t every, record_arrays records,"
    " int64_t runs, int64_t run)"
)


def _advance(
    e: _Emitter, constants: list[int], columns: list[int], floats: list[int], ints: list[int]
) -> str:
    program, nodes, classes = e.program, e.program.nodes, e.classes
    names = {i: unpacked(nodes[i], f"constants[{k}]") for k, i in enumerate(constants)}
    names |= {i: f"leaves[{n.value}]" for i, n in enumerate(nodes) if n.op == "per_run"}
    places = {c: f"floats[{k}]" for k, c in enumerate(floats)} | {
        c: f"ints[{k}]" for k, c in enumerate(ints)
    }
    for c in [*floats, *ints]:
        kind = program.kinds[c]
        e.lines.append(
            f"  {'F' if kind == 'f' else 'I'} c{c} = {'-' if kind == 'b' else ''}{places[c]};"
        )
        if program.carry[c][0] >= 0:
            names[program.carry[c][0]] = f"c{c}"
    e.in_place = _in_place(program)
    e.statements(names, frontier(program, classes, PER_RUN, lambda k: k == PER_RUN | TIME))
    e.lines += [e.calls.declarations, *e.calls.once_statements(names)] if e.calls.functions else []
    e.lines.append("  for (int step = 0; step < count; step++, row += COLUMNS) {")
    names |= {i: unpacked(nodes[i], f"row[{k}]") for k, i in enumerate(columns)}
    e.statements(names, [o for _, o in program.carry])
    if program.samples:
        _record(e, names)
    moved = [
        (c, names[o]) for c, (a, o) in enumerate(program.carry) if a != o and names[o] != f"c{c}"
    ]
    e.lines += [f"  {'F' if program.kinds[c] == 'f' else 'I'} n{c} = {name};" for c, name in moved]
    e.lines += [f"  c{c} = n{c};" for c, _ in moved]
    e.lines.append("  }")
    e.lines += [
        f"  {places[c]} = {'-' if program.kinds[c] == 'b' else ''}c{c};" for c in [*floats, *ints]
    ]
    return e.function(HEAD_OF_ADVANCE)


def _in_place(program: Program) -> dict[int, int]:
    """Choices, the same for all runs, between a carried number and the next one, where nobody else
    needs the number before.

    What a sampled law said is so written once a period, not copied in every step.
    """
    nodes, classes = program.nodes, program.classes()
    uses = (
        Counter(a for node in nodes for a in node.args)
        + Counter(program.samples)
        + Counter(o for _, o in program.carry)
    )
    found = {}
    for a, o in program.carry:
        node = nodes[o]
        if node.op == "select" and a in node.args[1:] and not classes[node.args[0]] & PER_RUN:
            (new,) = [x for x in node.args[1:] if x != a]
            # A call whose result is the new number has read the one before.
            if uses[a] == 1 + (
                nodes[new].op == "result" and nodes[nodes[new].args[0]].args.count(a)
            ):
                found[o] = a
    return found


class _Segments:
    """The statements of a long step, cut into functions of `size` operations; a number that one
    hands to another has a place in memory.
    """

    def __init__(
        self, e: _Emitter, names: dict[int, str], size: int, name: str, parameters: tuple[str, ...]
    ):
        """`name` begins those of the functions; `parameters` are what they see of the function that
        calls them.
        """
        self.e, self.names, self.size, self.name = e, names, size, name
        places = ("F *RESTRICT x", "I *RESTRICT y")
        self.head = f"SEPARATE void {{}}({', '.join([*parameters, *places])})"
        self.arguments = f"({', '.join(p.split()[-1].lstrip('*') for p in [*parameters, *places])})"
        self.functions: list[str] = []
        self.free: dict[str, list[str]] = {"x": [], "y": []}
        self.sizes = {"x": 0, "y": 0}

    def add(
        self, wanted: list[int], kept: bool, own: Mapping[int, str] = MappingProxyType({})
    ) -> list[str]:
        """Cuts `wanted` and what it needs; returns the calls.

        Args:
          wanted: nodes.
          kept: their places are never given to other numbers.
          own: places, in other arrays, that some of `wanted` have already.
        """
        nodes, needed = self.e.program.nodes, self.e.needed(self.names, wanted)
        computed = [i for i in needed if nodes[i].op not in ("const", "result")]
        part = {i: k // self.size for k, i in enumerate(computed)}
        last = dict.fromkeys(computed, -1) | dict.fromkeys(wanted, len(computed))
        for i in computed:
            for a in nodes[i].args:
                if a in part and a not in wanted:
                    last[a] = max(last[a], part[i])
        calls = []
        for k in range(0, len(computed), self.size):
            here = computed[k : k + self.size]
            calls.append(
                self._one(
                    here, [i for i in here if last[i] > part[i] and nodes[i].op != "call"], own
                )
            )
            if not kept:
                for i in (
                    i
                    for i in computed
                    if i in self.names and last[i] == k // self.size and nodes[i].op != "call"
                ):
                    self.free[self.names[i][0]].append(self.names[i])
        self.names |= {i: self.e.calls.results[i] for i in needed if nodes[i].op == "result"}
        return calls

    @property
    def room(self) -> str:
        """The places."""
        return f"  F x[{max(1, self.sizes['x'])}]; I y[{max(1, self.sizes['y'])}];"

    def _one(self, here: list[int], outlive: list[int], own: Mapping[int, str]) -> str:
        inner, stored = dict(self.names), dict[int, str]()
        for i in outlive:
            array = "x" if self.e.program.nodes[i].kind == "f" else "y"
            if i not in own and not self.free[array]:
                self.free[array].append(f"{array}[{self.sizes[array]}]")
                self.sizes[array] += 1
            stored[i] = own[i] if i in own else self.free[array].pop()
        self.e.statements(inner, here, stored)
        self.names |= stored | {i: inner[i] for i in here if self.e.program.nodes[i].op == "call"}
        name = f"{self.name}_{len(self.functions)}"
        self.functions.append(self.e.function(self.head.format(name)))
        return f"{name}{self.arguments};"


def _read_by_samples(e: _Emitter, names: dict[int, str], outputs: list[int]) -> list[int]:
    """The nodes of a step that its samples read, directly or on the way."""
    computed = set(e.needed(names, outputs))
    alone = [i for i in e.needed(names, e.program.samples) if i not in computed]
    return sorted(
        computed & {*e.program.samples, *(a for i in alone for a in e.program.nodes[i].args)}
    )


def _advance_in_segments(
    e: _Emitter,
    segment: int,
    constants: list[int],
    columns: list[int],
    floats: list[int],
    ints: list[int],
) -> str:
    """`_advance` for long steps, over which a compiler would take minutes: its time grows with the
    square of a function's length.

    The functions that the step calls stay whole calls; each is itself cut (`_functions`).
    """
    program, nodes, classes = e.program, e.program.nodes, e.classes
    names = {i: unpacked(nodes[i], f"constants[{k}]") for k, i in enumerate(constants)}
    names |= {i: unpacked(nodes[i], f"row[{k}]") for k, i in enumerate(columns)}
    names |= {i: f"leaves[{n.value}]" for i, n in enumerate(nodes) if n.op == "per_run"}
    places = {c: f"floats[{k}]" for k, c in enumerate(floats)} | {
        c: f"ints[{k}]" for k, c in enumerate(ints)
    }
    names |= {program.carry[c][0]: place for c, place in places.items() if program.carry[c][0] >= 0}
    segments = _Segments(e, names, segment, "segment", SEEN_BY_ADVANCE)
    before = segments.add(
        frontier(program, classes, PER_RUN, lambda k: k == PER_RUN | TIME), kept=True
    )
    outputs = sorted({o for _, o in program.carry})
    within = segments.add(
        sorted({*outputs, *_read_by_samples(e, segments.names, outputs)}), kept=False
    )
    signs = [f"  {places[c]} = -{places[c]};" for c in ints if program.kinds[c] == "b"]
    constant = {
        o: literal(nodes[o], program.dtype) for _, o in program.carry if nodes[o].op == "const"
    }
    moved = [
        (c, (segments.names | constant)[o]) for c, (a, o) in enumerate(program.carry) if a != o
    ]
    e.lines += [segments.room, e.calls.declarations, *signs]
    e.lines += [*(f"  {call}" for call in before), *e.calls.once_statements(segments.names)]
    e.lines += [
        "  for (int step = 0; step < count; step++, row += COLUMNS) {",
        *(f"  {call}" for call in within),
    ]
    if program.samples:
        _record(e, segments.names)
    e.lines += [f"  {'F' if program.kinds[c] == 'f' else 'I'} n{c} = {name};" for c, name in moved]
    e.lines += [f"  {places[c]} = n{c};" for c, _ in moved]
    e.lines += ["  }", *signs]
    return "\n".join([*segments.functions, e.function(HEAD_OF_ADVANCE)])


def _record(e: _Emitter, names: dict[int, str]) -> None:
    """The samples of a step that is recorded, written for the runs that exist."""
    e.lines.append("  if (every > 0 && (first + step) % every == 0) {")
    inner = dict(names)
    e.statements(inner, e.program.samples)
    e.lines.append(f"  F sample[] = {{{', '.join(inner[i] for i in e.program.samples)}}};")
    e.lines.append("  write_sample(&records, sample, (first + step) / every, runs, run);")
    e.lines.append("  }")
