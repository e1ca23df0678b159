"""Writes the C of a scalar program.

The C has one function for the numbers that only shared leaves decide, one for those that time
decides, one that steps a block of runs, and one for each function that the program calls (the
closed loop of an arm).

The text is one statement per node, the same for every target; the headers before and after it
define its meaning. On a CPU, `c/vector.h` makes a name a vector of runs, `c/mathlib.h` has the
elementary functions, and `c/driver.h` the loops and threads. On a GPU, `c/scalar.h` makes a name
the number of one thread's run, and `c/kernels.h` has the kernels. For export, `c/plain.h` makes a
name a number of C99, and `plain_function` writes one function.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from iblf_jax.kernels.layout import FunctionCalls, Layout, c_type, literal, places, unpacked
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


class Target(NamedTuple):
    """What the generated text means, and where it differs from that of other targets."""

    before: tuple[str, ...]
    """The headers before the generated functions."""
    after: tuple[str, ...]
    """The headers after them."""
    opening: str = ""
    """A line before the generated functions."""
    closing: str = ""
    """A line after them."""
    in_c: Mapping[str, str] = MappingProxyType({})
    """Operation on floats -> its C, where the target has its own."""
    signal: str = "row[{}]"
    """The C expression of a number of the table of signals."""
    row_bytes: int = 1
    """A row of the table of signals is a multiple of so many bytes."""

    def columns(self, program: Program, columns: int) -> int:
        """The number of words of a row of the table of signals."""
        words = max(self.row_bytes // program.dtype.itemsize, 1)
        return -(-columns // words) * words


NATIVE = Target(("vector.h", "mathlib.h", "records.h", "series.h"), ("frame.h", "driver.h"))
CUDA = Target(
    ("scalar.h", "mathlib.h", "records.h", "device.h"),
    ("kernels.h",),
    opening="template <bool careful> struct rollout : angles<careful> {",
    closing="};",
    in_c=MappingProxyType(
        {
            "div": "f_div({}, {})",
            "max": "larger({}, {})",
            "min": "smaller({}, {})",
            "abs": "FN(fabs)({})",
            "is_finite": "MASK(FN(fabs)({}) < (F)INFINITY)",
        }
    ),
    signal="signal(row, {})",
    row_bytes=16,
)
SINES = frozenset({"sin", "cos"})
"""Operations that `mathlib.h` divides into a polynomial and its replacement for large angles."""


def expression(node: Node, args: list[str], kinds: list[str]) -> str:
    """The C of one operation; `args` are the C expressions of its arguments, of these kinds."""
    op = node.op
    if op == "convert":
        source, target, arg = kinds[0], node.kind, args[0]
        if source == "b" and target == "f":
            return f"{arg} ? splat(1) : splat(0)"
        if source == "b":
            return f"{arg} & 1"
        if target == "f":
            return f"to_float({arg})"
        return f"to_int({arg})"
    text = OPERATIONS[op].in_c(op, kinds[0], args)
    if text is not None:
        return text
    raise UnsupportedError(f"generated code has no {op} of kind {kinds}")


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
"""Parameters of the generated functions, besides the arrays of numbers that they share."""


class _Emitter:
    """Writes statements for nodes.

    Args:
      program: the program.
      tables: text of a table -> its name in the C; the program's tables are added.
      functions: places of the arguments and results of calls.

    `names`, an argument of many methods, has the C expressions of nodes that are computed already.
    """

    def __init__(
        self,
        program: Program,
        tables: dict[str, str],
        functions: FunctionCalls,
        target: Target = NATIVE,
    ) -> None:
        self.program = program
        self.with_shared_test = SINES
        """Operations of which several share one test (`_sines`)."""
        self.classes = program.classes()
        self.lines: list[str] = []
        self.tables = {
            i: tables.setdefault(self._numbers(node), f"table_{len(tables)}")
            for i, node in enumerate(program.nodes)
            if node.op == "lookup"
        }
        self.functions = functions
        self.calls = functions.of[id(program)]
        self.target = target
        self.in_place: dict[int, int] = {}
        """Selections that overwrite a carried number in its place -> the node of the number before
        the step."""
        self.end: list[str] = []
        """Statements at the end of every function."""

    def _numbers(self, lookup: Node) -> str:
        """The bits of a lookup's table: infinity is no constant for some compilers."""
        bits = np.asarray(lookup.value, self.program.dtype).view(f"u{self.program.dtype.itemsize}")
        return ", ".join(f"(integer){x:#x}" for x in bits.tolist())

    def needed(self, names: dict[int, str], outputs: Iterable[int]) -> list[int]:
        """The nodes without a name that the outputs depend on, in order."""
        return needed(self.program.nodes, outputs, names)

    def statements(
        self,
        names: dict[int, str],
        outputs: Iterable[int],
        stored: Mapping[int, str] = MappingProxyType({}),
    ) -> None:
        """Adds statements that compute the outputs and what they depend on.

        Args:
          names: see the class; the new names are added.
          outputs: nodes.
          stored: places in memory to which some nodes are written, too.
        """
        nodes = self.program.nodes
        order = self.needed(names, outputs)
        sines = [i for i in order if nodes[i].op in self.with_shared_test]
        for i in order:
            if i in names:
                continue
            if nodes[i].op in self.with_shared_test:
                ready = [j for j in sines if j not in names and nodes[j].args[0] in names]
                if len(ready) > 1:
                    self._sines(ready, names, stored)
                    continue
            names[i] = self._statement(i, names)
            if i in stored:  # at once: a compiler then needs no register for it
                self.lines.append(f"  {stored[i]} = {names[i]};")

    def _statement(self, i: int, names: dict[int, str]) -> str:
        """Adds the statement of a node, if it needs one; returns its name."""
        node = self.program.nodes[i]
        if node.op == "const":
            return literal(node, self.program.dtype)
        if node.op == "result":
            return self.calls.results[i]
        args = [names[a] for a in node.args]
        if i in self.in_place:
            # The carried number is overwritten where the selection takes another one.
            condition, yes, no = args
            if node.args[2] == self.in_place[i]:
                self.lines.append(f"  if (AT({condition}, 0)) {no} = {yes};")
                return no
            self.lines.append(f"  if (!AT({condition}, 0)) {yes} = {no};")
            return yes
        if node.op == "call":
            self.lines += self.calls.statements(i, args)
            return "called"
        if node.op == "lookup":
            text = f"f_lookup({self.tables[i]}, {len(node.value)}, {args[0]})"
        else:
            kinds = [self.program.nodes[a].kind for a in node.args]
            if node.op in self.target.in_c and kinds[0] == "f":
                text = self.target.in_c[node.op].format(*args)
            else:
                text = expression(node, args, kinds)
        self.lines.append(f"  {c_type(node)} v{i} = {text};")
        return f"v{i}"

    def _sines(self, sines: list[int], names: dict[int, str], stored: Mapping[int, str]) -> None:
        """Adds statements for sines and cosines whose angles are computed: one test decides
        whether any of the angles is large.
        """
        nodes = self.program.nodes
        angles = {i: names[nodes[i].args[0]] for i in sines}
        names |= {i: f"v{i}" for i in sines}
        self.lines += [f"  F v{i} = near_{nodes[i].op}({angle});" for i, angle in angles.items()]
        is_any_far = " | ".join(f"is_far({angle})" for angle in dict.fromkeys(angles.values()))
        self.lines.append(f"  if (RARELY({is_any_far})) {{")
        self.lines += [
            f"    v{i} = {nodes[i].op}_where(is_far({angle}), {angle}, v{i});"
            for i, angle in angles.items()
        ]
        self.lines.append("  }")
        self.lines += [f"  {stored[i]} = v{i};" for i in sines if i in stored]

    def function(self, head: str) -> str:
        """The C function of the statements so far."""
        body, self.lines = "\n".join([*self.lines, *self.end]), []
        return f"{head} {{\n{body}\n}}\n"


def sizes(
    program: Program,
    shared_leaves: int,
    per_run_leaves: int,
    target: Target = NATIVE,
    series: int = 0,
) -> str:
    """The definitions of the sizes that the headers use.

    Args:
      program: the program.
      shared_leaves: number of shared leaf entries.
      per_run_leaves: number of leaf entries of each run.
      target: NATIVE or CUDA.
      series: numbers of each step of a run in the series that the program reads.
    """
    constants, columns, floats, ints = map(len, Layout.of(program))
    values: dict[str, object] = {
        "SHARED_LEAVES": shared_leaves,
        "LEAVES": per_run_leaves,
        "FLOATS": floats,
        "INTS": ints,
        "CONSTANTS": constants,
        "COLUMNS": target.columns(program, columns),
        "SERIES": series,
        "DOUBLE": int(program.dtype == np.float64),
        "RECORDED": len(program.recorded),
        # C has no empty list of initial values.
        "RECORDED_SIZES": f"{{{', '.join(map(str, [*program.recorded, 0]))}}}",
    }
    if target is CUDA:
        values["CALLS"] = int(any(node.op == "call" for node in program.nodes))
    return "".join(f"#define {name} {value}\n" for name, value in values.items())


def source(
    program: Program,
    shared_leaves: int,
    per_run_leaves: int,
    target: Target = NATIVE,
    segment: int | None = None,
    series: int = 0,
) -> str:
    """The C source of a program's kernel.

    Args:
      program: the program.
      shared_leaves: number of shared leaf entries.
      per_run_leaves: number of leaf entries of each run.
      target: NATIVE or CUDA.
      segment: operations of a function, at most; None for one function per step.
      series: numbers of each step of a run in the series that the program reads, if it reads one.
    """
    if target is NATIVE and not segment:
        # The functions that the program calls keep their order: they have enough independent
        # operations at any time, and no free registers.
        program = scheduled(program)
    layout = Layout.of(program)
    tables: dict[str, str] = {}
    calls = FunctionCalls(program, layout)
    e = _Emitter(program, tables, calls, target)
    functions = _functions(calls, tables, segment, target)
    constants = _constants(e, layout.constants)
    signals = _signals(e, layout.constants, layout.columns)
    parts = [
        sizes(program, shared_leaves, per_run_leaves, target, series),
        *map(header, target.before),
        *(f"TABLE {name}[] = {{{numbers}}};" for numbers, name in tables.items()),
        target.opening,
        *functions,
        constants,
        signals,
        _advance(e, layout, segment),
        target.closing,
        *map(header, target.after),
    ]
    return "\n".join(filter(None, parts))


def plain_function(
    program: Program,
    name: str,
    parameters: Sequence[str],
    inputs: Mapping[str, Sequence[str]],
    outputs: Sequence[str],
    segment: int,
) -> str:
    """A C99 function of one run, for the names of `c/plain.h`.

    Args:
      program: a program without calls (see `passes.written_out`).
      name: name of the function, and prefix of the functions that it is divided into.
      parameters: C declarations, such as `const F *q`.
      inputs: operation of an input -> C expression of each of these numbers.
      outputs: C expressions of the places of the carried numbers and of the outputs; none of them
        is an input.
      segment: operations above which the function is divided, into functions of so many.
    """
    tables = dict[str, str]()
    e = _Emitter(program, tables, FunctionCalls(program, Layout.of(program)))
    e.tables = {i: f"{name}_{table}" for i, table in e.tables.items()}
    e.with_shared_test = frozenset()  # `plain.h` has no shared test for large angles
    names = {
        i: inputs[node.op][node.value] for i, node in enumerate(program.nodes) if node.op in inputs
    }
    results = [*(o for _, o in program.carry), *program.outputs]
    arguments = _names_of(parameters)
    parts = list[str]()
    if len(program.nodes) > segment:
        segments = _Segments(e, names, segment, name, tuple(parameters))
        e.end = [f"  (void){x};" for x in [*arguments, "x", "y"]]
        calls = segments.add(sorted(set(results)), kept=False)
        parts = segments.functions
        names = segments.names
        e.lines = [segments.declarations, *(f"  {call}" for call in calls)]
        e.statements(names, results)
    else:
        e.statements(names, results)
        e.end = [f"  (void){x};" for x in arguments]
    e.lines += [f"  {place} = {names[i]};" for place, i in zip(outputs, results, strict=True)]
    parts.append(e.function(f"static void {name}({', '.join([*parameters, 'F *RESTRICT r'])})"))
    return "\n".join(
        [*(f"TABLE {name}_{table}[] = {{{numbers}}};" for numbers, table in tables.items()), *parts]
    )


def _names_of(parameters: Iterable[str]) -> list[str]:
    """The names in C declarations of parameters."""
    return [parameter.split()[-1].lstrip("*") for parameter in parameters]


def header(name: str) -> str:
    """The text of a file in `c/`."""
    return (files("iblf_jax.kernels") / "c" / name).read_text()


def _functions(
    calls: FunctionCalls, tables: dict[str, str], segment: int | None, target: Target
) -> list[str]:
    """The C of the functions that a program calls, divided as in `source`."""
    texts = []
    for k, (function, _, arguments, _) in enumerate(calls.functions):
        e = _Emitter(function, tables, calls, target)
        names = {
            i: arguments[node.value]
            for i, node in enumerate(function.nodes)
            if node.op == "argument"
        }
        results = list(
            zip(
                function.outputs,
                places([function.nodes[i] for i in function.outputs], "r", "s"),
                strict=True,
            )
        )
        if segment:
            segments = _Segments(e, names, segment, f"part_{k}", SEEN_BY_FUNCTION)
            parts = segments.add(sorted(set(function.outputs)), kept=False, own=dict(results))
            texts += segments.functions
            e.lines += [segments.declarations, *(f"  {part}" for part in parts)]
        else:
            e.statements(names, function.outputs)
        e.lines += [f"  {place} = {names[i]};" for i, place in results if names[i] != place]
        texts.append(e.function(f"SEPARATE void function_{k}({', '.join(SEEN_BY_FUNCTION)})"))
    return texts


def _constants(e: _Emitter, constants: list[int]) -> str:
    """The C function that computes the shared numbers."""
    nodes = e.program.nodes
    names = {i: f"splat(shared[{n.value}])" for i, n in enumerate(nodes) if n.op == "shared"}
    e.statements(names, constants)
    for k, i in enumerate(constants):
        member = {"F": "f", "I": "i"}[c_type(nodes[i])]
        e.lines.append(f"  out[{k}].{member} = AT({names[i]}, 0);")
    return e.function("FUNCTION void shared_constants(const real *shared, word *out)")


def _signals(e: _Emitter, constants: list[int], columns: list[int]) -> str:
    """The C function that tabulates the numbers that time decides."""
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
    " const real *rows, int64_t runs, int64_t run)"
)


def _places_of_carry(layout: Layout) -> dict[int, str]:
    """Position in the carry -> C expression of its place in the arrays of the state."""
    floats = {c: f"floats[{k}]" for k, c in enumerate(layout.floats)}
    return floats | {c: f"ints[{k}]" for k, c in enumerate(layout.ints)}


def _names_of_inputs(e: _Emitter, layout: Layout) -> dict[int, str]:
    """C expressions of the shared numbers and of the leaves of a run."""
    nodes = e.program.nodes
    names = {i: unpacked(nodes[i], f"constants[{k}]") for k, i in enumerate(layout.constants)}
    return names | {i: f"leaves[{n.value}]" for i, n in enumerate(nodes) if n.op == "per_run"}


def _names_of_series(e: _Emitter) -> dict[int, str]:
    """C expressions of the numbers that a step reads from the series."""
    nodes = e.program.nodes
    return {i: f"series[{n.value}]" for i, n in enumerate(nodes) if n.op == "series"}


SERIES = "const F *series"
"""Parameter of the generated functions for what a step reads from the series."""


def _reads_series(program: Program) -> bool:
    """Whether a step reads a series."""
    return any(node.op == "series" for node in program.nodes)


def _loop(program: Program) -> list[str]:
    """The beginning of the loop over the steps; `rows` points to the row of the next step."""
    if not _reads_series(program):
        return ["  for (int step = 0; step < count; step++, row += COLUMNS) {"]
    return [
        "  for (int step = 0; step < count; step++, row += COLUMNS, rows -= SERIES * runs) {",
        "  read_series(rows, series, runs, run);",
    ]


def _names_of_columns(e: _Emitter, layout: Layout) -> dict[int, str]:
    """C expressions of the numbers of a time step that are the same for all runs."""
    nodes = e.program.nodes
    return {i: unpacked(nodes[i], e.target.signal.format(k)) for k, i in enumerate(layout.columns)}


def _of_kind(program: Program, c: int, of_float: str, of_other: str) -> str:
    """One of two texts, by the kind of a carried number."""
    if program.kinds[c] == "f":
        return of_float
    return of_other


def _sign(program: Program, c: int) -> str:
    """The sign between a carried truth value in memory, 0 or 1, and in a register, 0 or -1."""
    if program.kinds[c] == "b":
        return "-"
    return ""


def _moves(
    program: Program, moved: list[tuple[int, str]], place: Callable[[int], str]
) -> list[str]:
    """Statements that move new numbers to the places of carried ones.

    All are read before the first is written: a new number may be another one's old one.
    """
    lines = [f"  {_of_kind(program, c, 'F', 'I')} n{c} = {name};" for c, name in moved]
    return lines + [f"  {place(c)} = n{c};" for c, _ in moved]


def _advance(e: _Emitter, layout: Layout, segment: int | None) -> str:
    """The C function that makes some steps of a block of runs, the state in registers."""
    if segment:
        return _advance_in_segments(e, layout, segment)
    program = e.program
    names = _names_of_inputs(e, layout)
    places = _places_of_carry(layout)
    if _reads_series(program):
        e.lines.append("  F series[SERIES];")
    for c, place in places.items():
        kind = _of_kind(program, c, "F", "I")
        e.lines.append(f"  {kind} c{c} = {_sign(program, c)}{place};")
        before = program.carry[c][0]
        if before >= 0:
            names[before] = f"c{c}"
    e.in_place = _in_place(program)
    e.statements(names, frontier(program, e.classes, PER_RUN, lambda k: k == PER_RUN | TIME))
    if e.functions.functions:
        e.lines += [e.calls.declarations, *e.functions.once_statements(names)]
    e.lines += _loop(program)
    names |= _names_of_columns(e, layout) | _names_of_series(e)
    e.statements(names, [after for _, after in program.carry])
    if program.outputs:
        _record(e, names)
    moved = [
        (c, names[after])
        for c, (before, after) in enumerate(program.carry)
        if before != after and names[after] != f"c{c}"
    ]
    e.lines += _moves(program, moved, "c{}".format)
    e.lines.append("  }")
    e.lines += [f"  {place} = {_sign(program, c)}c{c};" for c, place in places.items()]
    return e.function(HEAD_OF_ADVANCE)


def _in_place(program: Program) -> dict[int, int]:
    """Selections, the same for all runs, between a carried number and a new one, where no other
    node needs the number before the step; node -> node of the number before.

    The output of a sampled law is thus written once per period and not copied in every step.
    """
    nodes = program.nodes
    classes = program.classes()
    uses = (
        Counter(a for node in nodes for a in node.args)
        + Counter(program.outputs)
        + Counter(o for _, o in program.carry)
    )
    found = {}
    for a, o in program.carry:
        node = nodes[o]
        if node.op == "select" and a in node.args[1:] and not classes[node.args[0]] & PER_RUN:
            (new,) = [x for x in node.args[1:] if x != a]
            reads = 1
            if nodes[new].op == "result":  # the call has read the number before the step
                reads += nodes[nodes[new].args[0]].args.count(a)
            if uses[a] == reads:
                found[o] = a
    return found


class _Segments:
    """Divides the statements of a long step into functions.

    A number that one function computes and another one reads has a place in the arrays `x` (floats)
    or `y` (others).

    Args:
      e: writes the statements.
      names: C expressions of nodes that are computed already; the places are added.
      size: operations of a function.
      name: prefix of the names of the functions.
      parameters: C declarations of what the functions share with the function that calls them.
    """

    def __init__(
        self, e: _Emitter, names: dict[int, str], size: int, name: str, parameters: tuple[str, ...]
    ):
        self.e = e
        self.names = names
        self.size = size
        self.name = name
        declarations = [*parameters, "F *RESTRICT x", "I *RESTRICT y"]
        self.head = f"SEPARATE void {{}}({', '.join(declarations)})"
        self.arguments = f"({', '.join(_names_of(declarations))})"
        self.functions: list[str] = []
        self.free: dict[str, list[str]] = {"x": [], "y": []}
        self.sizes = {"x": 0, "y": 0}

    def add(
        self, outputs: list[int], kept: bool, own: Mapping[int, str] = MappingProxyType({})
    ) -> list[str]:
        """Adds functions that compute the outputs and what they depend on; returns the calls.

        Args:
          outputs: nodes.
          kept: whether the places are never given to other numbers.
          own: places, in other arrays, that some of the outputs have already.
        """
        nodes = self.e.program.nodes
        needed = self.e.needed(self.names, outputs)
        computed = [i for i in needed if nodes[i].op not in ("const", "result")]
        part = {i: k // self.size for k, i in enumerate(computed)}
        # the last function that reads each node; the parts are in order
        last = dict.fromkeys(part, -1)
        for i, number in part.items():
            last |= {a: number for a in nodes[i].args if a in part}
        last |= dict.fromkeys(outputs, len(part))
        read_last = defaultdict[int, list[int]](list)
        for i in computed:
            if nodes[i].op != "call":
                read_last[last[i]].append(i)
        calls = []
        for first in range(0, len(computed), self.size):
            number = first // self.size
            here = computed[first : first + self.size]
            outlive = [i for i in here if last[i] > number and nodes[i].op != "call"]
            calls.append(self._one(here, outlive, own))
            if kept:
                continue
            for place in [self.names[i] for i in read_last[number] if i in self.names]:
                self.free[place[0]].append(place)
        self.names |= {i: self.e.calls.results[i] for i in needed if nodes[i].op == "result"}
        return calls

    @property
    def declarations(self) -> str:
        """Declarations of the arrays."""
        return f"  F x[{max(1, self.sizes['x'])}]; I y[{max(1, self.sizes['y'])}];"

    def _one(self, here: list[int], outlive: list[int], own: Mapping[int, str]) -> str:
        """Adds a function that computes the nodes `here`, of which others read `outlive`; returns
        the call.
        """
        nodes = self.e.program.nodes
        inner = dict(self.names)
        stored = {}
        for i in outlive:
            array = {"F": "x", "I": "y"}[c_type(nodes[i])]
            if i in own:
                stored[i] = own[i]
            elif self.free[array]:
                stored[i] = self.free[array].pop()
            else:
                stored[i] = f"{array}[{self.sizes[array]}]"
                self.sizes[array] += 1
        self.e.statements(inner, here, stored)
        self.names |= stored | {i: inner[i] for i in here if nodes[i].op == "call"}
        name = f"{self.name}_{len(self.functions)}"
        self.functions.append(self.e.function(self.head.format(name)))
        return f"{name}{self.arguments};"


def _advance_in_segments(e: _Emitter, layout: Layout, segment: int) -> str:
    """The same as `_advance` for long steps, divided into functions.

    The time of a compiler grows with the square of a function's length: it would take minutes. The
    functions that the step calls stay functions; each of them is divided, too (`_functions`).
    """
    program = e.program
    nodes = program.nodes
    names = _names_of_inputs(e, layout) | _names_of_columns(e, layout) | _names_of_series(e)
    places = _places_of_carry(layout)
    names |= {program.carry[c][0]: place for c, place in places.items() if program.carry[c][0] >= 0}
    seen: tuple[str, ...] = SEEN_BY_ADVANCE
    declarations = list[str]()
    if _reads_series(program):
        seen = (*seen, SERIES)
        declarations.append("  F series[SERIES];")
    segments = _Segments(e, names, segment, "segment", seen)
    once = frontier(program, e.classes, PER_RUN, lambda k: k == PER_RUN | TIME)
    before = segments.add(once, kept=True)
    carried = sorted({after for _, after in program.carry})
    # Nodes of the carried numbers may also be outputs, or be read by nodes for outputs alone.
    computed = set(e.needed(segments.names, carried))
    for_outputs = [i for i in e.needed(segments.names, program.outputs) if i not in computed]
    read = computed & {*program.outputs, *(a for i in for_outputs for a in nodes[i].args)}
    within = segments.add(sorted({*carried, *read}), kept=False)
    signs = [f"  {places[c]} = -{places[c]};" for c in layout.ints if program.kinds[c] == "b"]
    names_after = dict(segments.names)
    for _, after in program.carry:
        if nodes[after].op == "const":
            names_after[after] = literal(nodes[after], program.dtype)
    moved = [
        (c, names_after[after])
        for c, (unchanged, after) in enumerate(program.carry)
        if unchanged != after
    ]
    declarations += [segments.declarations, e.calls.declarations]
    e.lines += [*declarations, *signs]
    e.lines += [*(f"  {call}" for call in before), *e.functions.once_statements(segments.names)]
    e.lines += [*_loop(program), *(f"  {call}" for call in within)]
    if program.outputs:
        _record(e, segments.names)
    e.lines += _moves(program, moved, places.__getitem__)
    e.lines += ["  }", *signs]
    return "\n".join([*segments.functions, e.function(HEAD_OF_ADVANCE)])


def _record(e: _Emitter, names: dict[int, str]) -> None:
    """Adds statements that record the outputs of a step, for the runs that exist."""
    e.lines.append("  if (every > 0 && (first + step) % every == 0) {")
    inner = dict(names)
    e.statements(inner, e.program.outputs)
    e.lines.append(f"  F sample[] = {{{', '.join(inner[i] for i in e.program.outputs)}}};")
    e.lines.append("  write_sample(&records, sample, (first + step) / every, runs, run);")
    e.lines.append("  }")
