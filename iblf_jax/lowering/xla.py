"""The xla backend: a scalar program with one array of runs a number, in `lax.scan`.  Needs nothing but jax and runs on any device.

What time decides is tabulated for a stretch of steps at once.  On CPU a block of runs goes through a stretch of steps as one machine
function (`one_function`), its numbers in the first-level cache.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata

from iblf_jax.lowering import vector_math
from iblf_jax.lowering.program import LANE, SHARED, TIME, Node, Program, UnsupportedError, frontier
from iblf_jax.lowering.step import Packed
from iblf_jax.one_function import as_one_function

BLOCK = 64
"""Runs that go through a stretch of steps together on CPU."""
STORED = 8
"""Cost from which a number with several uses is stored on CPU.  XLA would compute it again for each use."""
SEGMENT = 2000
"""Operations in one XLA computation, on CPU: its passes take more than linear time."""
LONGEST = 20_000
"""Operations of a step above which XLA would take many minutes over it."""
STRETCH = 4096
"""Steps whose signals are tabulated at once, at most."""

FUNCTIONS: dict[str, Callable] = {
    "add": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div, "rem": lax.rem, "neg": lax.neg, "abs": lax.abs, "max": lax.max,
    "min": lax.min, "sqrt": lax.sqrt, "rsqrt": lax.rsqrt, "cbrt": lax.cbrt, "sign": lax.sign, "floor": lax.floor, "ceil": lax.ceil,
    "round_even": lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN), "sin": lax.sin, "cos": lax.cos, "tan": lax.tan,
    "asin": lax.asin, "acos": lax.acos, "atan": lax.atan, "sinh": lax.sinh, "cosh": lax.cosh, "tanh": lax.tanh, "asinh": lax.asinh,
    "acosh": lax.acosh, "atanh": lax.atanh, "exp": lax.exp, "exp2": lax.exp2, "expm1": lax.expm1, "log": lax.log, "log1p": lax.log1p,
    "pow": lax.pow, "atan2": lax.atan2, "erf": lax.erf, "erfc": lax.erfc, "logistic": lax.logistic, "is_finite": lax.is_finite,
    "eq": lax.eq, "ne": lax.ne, "lt": lax.lt, "le": lax.le, "gt": lax.gt, "ge": lax.ge, "and": lax.bitwise_and, "or": lax.bitwise_or,
    "xor": lax.bitwise_xor, "not": lax.bitwise_not, "select": lax.select,
}  # fmt: skip
"""No function of jnp: those are jitted, and within a function that XLA may not inline each would be a call."""
POLYNOMIALS = {"sin": vector_math.sin, "cos": vector_math.cos}
"""In place of functions that XLA's CPU backend does not vectorise."""
CHEAP = frozenset(
    ("add", "sub", "mul", "neg", "abs", "max", "min", "select", "convert", "and", "or", "xor", "not", "lt", "le", "gt", "ge", "eq", "ne")
)
"""Operations of one instruction; others count as eight."""


class Entry(NamedTuple):
    """One number of a row of the table, not yet read: what uses it reads it, rather than each number being copied out."""

    part: str
    place: int

    def read(self, row: Table) -> jax.Array:
        """The number, ()."""
        return lax.squeeze(lax.slice(getattr(row, self.part), (self.place,), (self.place + 1,)), (0,))


class Table(NamedTuple):
    """What time decides, one row a step: floats, and whole numbers or flags as int32."""

    floats: jax.Array
    ints: jax.Array


class Evaluator:
    """Evaluates nodes of a program on arrays of one shape."""

    def __init__(self, program: Program, shape: tuple[int, ...]) -> None:
        self.program = program
        self.shape = shape
        self.bordered = on_cpu() and bool(shape)
        self.functions = FUNCTIONS | (POLYNOMIALS if self.bordered else {})
        self.types = {"f": program.dtype, "i": np.dtype(np.int32), "b": np.dtype(np.bool_)}

    def compute(self, known: dict[int, Any], wanted: Iterable[int], row: Table | None = None) -> None:
        """Adds `wanted`, and what it needs, to `known` (node -> array, or entry of `row`)."""
        nodes, needed, stack = self.program.nodes, set(), list(wanted)
        while stack:
            i = stack.pop()
            if i not in known and i not in needed:
                needed.add(i)
                stack.extend(nodes[i].args)
        known |= {i: np.asarray(nodes[i].value, self.types[nodes[i].kind]) for i in needed if nodes[i].op == "const"}
        order = sorted(i for i in needed if nodes[i].op != "const")
        stored = self._stored(order, wanted)
        size = SEGMENT if self.bordered else max(len(order), 1)
        for start in range(0, len(order), size):
            self._segment(known, order[start : start + size], order[start + size :], stored, row)

    def _stored(self, order: list[int], wanted: Iterable[int]) -> set[int]:
        """The nodes of `order` to be stored: what is wanted, and what costs more to compute again than to read."""
        nodes, cost, stored = self.program.nodes, dict.fromkeys(order, 0), set(wanted)
        uses = Counter([a for i in order for a in nodes[i].args] + list(stored))
        for i in order:
            here = (1 if nodes[i].op in CHEAP else 8) + sum(cost.get(a, 0) for a in nodes[i].args if a not in stored)
            cost[i] = here
            if uses[i] > 1 and here >= STORED:
                stored.add(i)
        return stored

    def _segment(self, known: dict[int, Any], order: list[int], later: list[int], stored: set[int], row: Table | None) -> None:
        """Adds the nodes of `order` to `known`.

        On CPU in a function of its own: XLA computes each of its results once, and nothing across its border.  The barrier keeps
        results that nobody reads, which are there to be stored only.
        """
        nodes, here = self.program.nodes, set(order)
        read_later = {a for i in later for a in nodes[i].args}
        outputs = [i for i in order if i in read_later or i in stored]
        inputs = sorted({a for i in order for a in nodes[i].args} - here)
        entries = {i: known[i] for i in inputs if isinstance(known[i], Entry)}
        arrays = {i: known[i] for i in inputs if i not in entries}

        def body(row, arrays):
            local = arrays | {i: x.read(row) for i, x in entries.items()}
            for i in order:
                local[i] = self._value(nodes[i], [local[a] for a in nodes[i].args])
            return [local[i] for i in outputs]

        results = lax.optimization_barrier(as_function(body)(row, arrays)) if self.bordered else body(row, arrays)
        known |= zip(outputs, results, strict=True)

    def _value(self, node: Node, args: list[Any]) -> Any:
        args = [jnp.broadcast_to(x, self.shape) for x in args]
        if node.op == "convert":
            return lax.convert_element_type(args[0], self.types[node.kind])
        return self.functions[node.op](*args)


def on_cpu() -> bool:
    """Whether arrays live on CPU."""
    return jax.default_backend() == "cpu"


def as_function(f):
    """`f` as a function that XLA does not inline: fusion stops at its border."""
    return set_xla_metadata(inlineable="false")(jax.jit(f))


def run(program: Program, shared: jax.Array, lane: jax.Array, carry: Packed, steps: int, every: int | None) -> tuple[Packed, jax.Array]:
    """All steps of all runs; arguments and results as `native.run`.  The last block repeats the last run.

    Raises:
      UnsupportedError: the step is too long for XLA.
    """
    if len(program.nodes) > LONGEST:
        raise UnsupportedError(f"its step has {len(program.nodes)} operations, over which XLA compiles for many minutes")
    runs = carry.floats.shape[1]
    width = min(BLOCK, runs) if on_cpu() else runs
    blocks = -(-runs // width)

    def apart(rows):
        padded = jnp.pad(rows, ((0, 0), (0, blocks * width - runs)), mode="edge")
        return jnp.moveaxis(padded.reshape(len(rows), blocks, width), 1, 0)

    def together(parts):
        rows = jnp.moveaxis(parts, 0, -2)
        return rows.reshape(*rows.shape[:-2], blocks * width)[..., :runs]

    done, samples = _in_blocks(program, shared, apart(lane), jax.tree.map(apart, carry), steps, every)
    return jax.tree.map(together, done), together(samples)


def _in_blocks(program: Program, shared, lane, carry: Packed, steps: int, every: int | None) -> tuple[Packed, jax.Array]:
    """All steps of some blocks: (blocks, rows, width) in, and out; samples (blocks, samples, rows, width)."""
    classes = program.classes()
    once = {i: shared[n.value] for i, n in enumerate(program.nodes) if n.op == "shared"}
    Evaluator(program, ()).compute(once, frontier(program, classes, SHARED, lambda c: c != SHARED))
    columns = frontier(program, classes, TIME, lambda c: bool(c & LANE))

    def block(once, table, lane, carry):
        return _block(program, once, columns, table, lane, carry, every)

    call = as_one_function(block) if on_cpu() else block

    def stretch(carry, first, count):
        table = _table(program, once, columns, first, count)
        return lax.map(lambda part: call(once, table, *part), (lane, carry))

    length = _stretch_length(steps, every or 1)
    whole, rest = divmod(steps, length)
    parts = []
    if whole:
        starts = length * jnp.arange(whole, dtype=jnp.int32)
        carry, rows = lax.scan(partial(stretch, count=length), carry, starts)
        parts.append(jnp.moveaxis(rows, 0, 1).reshape(rows.shape[1], whole * rows.shape[2], *rows.shape[3:]))
    if rest:
        carry, rows = stretch(carry, jnp.int32(whole * length), rest)
        parts.append(rows)
    return carry, parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=1)


def _stretch_length(steps: int, every: int) -> int:
    """Steps of a stretch, a multiple of `every`: so that one length does for all where there is such a length, as each is compiled."""
    most = max(STRETCH // every, 1) * every
    if steps <= most:
        return steps
    exact = next((d for d in range(most, 0, -every) if steps % d == 0), 0)
    return exact if exact > most // 16 else most


def _block(program: Program, once, columns, table: Table, lane: jax.Array, carry: Packed, every: int | None) -> tuple[Packed, jax.Array]:
    """One block of runs through the steps of a table."""
    width = carry.floats.shape[1]
    evaluator = Evaluator(program, (width,))
    values = _separate(program, carry)
    fixed = once | {i: lane[n.value] for i, n in enumerate(program.nodes) if n.op == "lane"}
    fixed |= {a: values[c] for c, (a, o) in enumerate(program.carry) if a == o}
    evaluator.compute(fixed, frontier(program, program.classes(), LANE, lambda c: c == LANE | TIME))
    moving = [c for c, (a, o) in enumerate(program.carry) if a != o]
    outputs = [program.carry[c][1] for c in moving]

    wanted = program.samples if every else ()
    count = len(table.floats)
    rows = -(-count // every) if every else 0

    def step(state, now):
        state, records = state
        row, place = now
        known = fixed | _entries(program, columns, row)
        known |= {program.carry[c][0]: x for c, x in zip(moving, state, strict=True) if program.carry[c][0] >= 0}
        evaluator.compute(known, [*outputs, *wanted], row)
        found = [x.read(row) if isinstance(x, Entry) else x for x in (known[i] for i in [*outputs, *wanted])]
        filled = [jnp.broadcast_to(x, (width,)) for x in found]
        if every:
            records = lax.dynamic_update_slice(records, jnp.stack(filled[len(outputs) :])[None], (place, np.int32(0), np.int32(0)))
        return (filled[: len(outputs)], records), None

    # Every step writes its sample, to the row of the next step that is recorded, which so writes last: one copy of the step to compile.
    places = (np.arange(count, dtype=np.int32) + (every or 1) - 1) // (every or 1)
    records = jnp.zeros((rows + 1 if every else 0, len(wanted), width), program.dtype)
    (state, records), _ = lax.scan(step, ([values[c] for c in moving], records), (table, places))
    for c, x in zip(moving, state, strict=True):
        values[c] = x
    return _joined(program, values, width), records[:rows]


def _entries(program: Program, columns: list[int], row: Table) -> dict[int, Any]:
    """The columns of a row of the table."""
    places: Counter[str] = Counter()
    result: dict[int, Any] = {}
    for c in columns:
        kind = program.nodes[c].kind
        part = "floats" if kind == "f" else "ints"
        found = Entry(part, places[part])
        places[part] += 1
        result[c] = found.read(row) != 0 if kind == "b" else found
    return result


def _table(program: Program, once: dict[int, Any], columns: list[int], first: jax.Array, count: int) -> Table:
    """What time decides, for `count` steps from `first` on."""
    known = dict(once)
    known |= {i: first + jnp.arange(count, dtype=jnp.int32) for i, n in enumerate(program.nodes) if n.op == "index"}
    Evaluator(program, (count,)).compute(known, columns)

    def stacked(kinds, dtype):
        some = [jnp.broadcast_to(known[c], (count,)).astype(dtype) for c in columns if program.nodes[c].kind in kinds]
        return jnp.stack(some, axis=1) if some else jnp.zeros((count, 0), dtype)

    return Table(stacked("f", program.dtype), stacked("ib", jnp.int32))


def _separate(program: Program, carry: Packed) -> list[jax.Array]:
    floats, ints = iter(carry.floats), iter(carry.ints)
    return [next(floats) if k == "f" else next(ints) if k == "i" else next(ints) != 0 for k in program.kinds]


def _joined(program: Program, values: list[jax.Array], runs: int) -> Packed:
    def rows(kinds: str, dtype) -> jax.Array:
        some = [jnp.broadcast_to(x, (runs,)).astype(dtype) for x, k in zip(values, program.kinds, strict=True) if k in kinds]
        return jnp.stack(some) if some else jnp.zeros((0, runs), dtype)

    return Packed(rows("f", program.dtype), rows("ib", jnp.int32))
