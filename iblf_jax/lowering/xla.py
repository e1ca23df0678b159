"""The xla backend: a scalar program with one (batch,) array a number, in `lax.scan`.

What time decides is tabulated for a stretch of steps at once.  Needs nothing but jax and runs on any device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.scipy import special

from iblf_jax.lowering import vector_math
from iblf_jax.lowering.program import LANE, SHARED, TIME, Node, Program, frontier
from iblf_jax.lowering.step import Packed
from iblf_jax.lowering.toolchain import threads

BLOCK = 1024
"""Runs that go through all steps together on CPU."""
MOST_STREAMS = 8
SEGMENT = 200
"""Operations that XLA may fuse with one another on CPU: it computes shared values again for every result of a step, and without a border
does twice the work."""
STRETCH = 8192
"""Steps whose signals are tabulated at once, at most."""

FUNCTIONS: dict[str, Callable] = {
    "add": jnp.add, "sub": jnp.subtract, "mul": jnp.multiply, "neg": jnp.negative, "abs": jnp.abs, "max": jnp.maximum, "min": jnp.minimum,
    "sqrt": jnp.sqrt, "rsqrt": jax.lax.rsqrt, "cbrt": jnp.cbrt, "sign": jnp.sign, "floor": jnp.floor, "ceil": jnp.ceil,
    "round_even": jnp.round, "sin": jnp.sin, "cos": jnp.cos, "tan": jnp.tan, "asin": jnp.arcsin, "acos": jnp.arccos, "atan": jnp.arctan,
    "sinh": jnp.sinh, "cosh": jnp.cosh, "tanh": jnp.tanh, "asinh": jnp.arcsinh, "acosh": jnp.arccosh, "atanh": jnp.arctanh,
    "exp": jnp.exp, "exp2": jnp.exp2, "expm1": jnp.expm1, "log": jnp.log, "log1p": jnp.log1p, "pow": jnp.power, "atan2": jnp.arctan2,
    "erf": special.erf, "erfc": special.erfc, "logistic": jax.nn.sigmoid, "is_finite": jnp.isfinite, "eq": jnp.equal,
    "ne": jnp.not_equal, "lt": jnp.less, "le": jnp.less_equal, "gt": jnp.greater, "ge": jnp.greater_equal, "and": jnp.bitwise_and,
    "or": jnp.bitwise_or, "xor": jnp.bitwise_xor, "not": jnp.bitwise_not, "select": jnp.where, "rem": jax.lax.rem, "div": jax.lax.div,
}  # fmt: skip
ON_CPU = {"sin": vector_math.sin, "cos": vector_math.cos}
"""In place of functions that XLA's CPU backend does not vectorise."""


class Evaluator:
    """Evaluates nodes of a program on arrays; `known` maps a node to its array."""

    def __init__(self, program: Program, vectors: bool) -> None:
        """`vectors`: for arrays of runs, which are many, rather than of times."""
        self.program = program
        self.segment = SEGMENT if vectors and jax.default_backend() == "cpu" else 0
        self.functions = FUNCTIONS | (ON_CPU if vectors and jax.default_backend() == "cpu" else {})
        self.types = {"f": program.dtype, "i": np.dtype(np.int32), "b": np.dtype(np.bool_)}

    def compute(self, known: dict[int, Any], wanted: Iterable[int]) -> None:
        """Adds `wanted`, and what it needs, to `known`."""
        nodes, needed, stack = self.program.nodes, set(), list(wanted)
        while stack:
            i = stack.pop()
            if i not in known and i not in needed:
                needed.add(i)
                stack.extend(nodes[i].args)
        order = sorted(needed)
        size = self.segment or len(order)
        last_use = {a: i for i in order for a in nodes[i].args} | dict.fromkeys(wanted, len(nodes))
        for start in range(0, len(order), max(size, 1)):
            self._segment(known, order[start : start + size], last_use)

    def _segment(self, known: dict[int, Any], order: list[int], last_use: dict[int, int]) -> None:
        """Adds the nodes of `order` to `known`; on CPU as a function of its own, whose results are stored once."""
        nodes = self.program.nodes
        outputs = [i for i in order if last_use.get(i, -1) > order[-1] and nodes[i].op != "const"]
        inputs = sorted({a for i in order for a in nodes[i].args} - set(order))

        def body(*values):
            local = dict(zip(inputs, values, strict=True))
            for i in order:
                local[i] = self._value(nodes[i], [local[a] for a in nodes[i].args])
            return [local[i] for i in outputs]

        call = as_function(body) if self.segment else body
        known |= {i: self._value(nodes[i], []) for i in order if nodes[i].op == "const"}
        known |= zip(outputs, call(*(known[i] for i in inputs)), strict=True)

    def _value(self, node: Node, args: list[Any]) -> Any:
        if node.op == "const":
            return np.asarray(node.value, self.types[node.kind])
        if node.op == "convert":
            return jnp.asarray(args[0]).astype(self.types[node.kind])
        if node.op == "div":
            args = list(jnp.broadcast_arrays(*args))
        return self.functions[node.op](*args)


def run(program: Program, shared: jax.Array, lane: jax.Array, carry: Packed, steps: int, every: int | None) -> tuple[Packed, jax.Array]:
    """All steps of all runs; arguments and results as `native.run`.

    On CPU a block of runs goes through all steps before the next one, so that its numbers stay in the cache, and several streams of
    blocks go side by side, one a core.  The last blocks repeat the last run.
    """
    runs = carry.floats.shape[1]
    if runs <= BLOCK or jax.default_backend() != "cpu":
        return _block(program, shared, lane, carry, steps, every)
    streams = min(threads(), MOST_STREAMS, -(-runs // BLOCK))
    blocks = -(-runs // (BLOCK * streams))

    def apart(rows):
        padded = jnp.pad(rows, ((0, 0), (0, streams * blocks * BLOCK - runs)), mode="edge")
        return jnp.moveaxis(padded.reshape(-1, streams, blocks, BLOCK), 0, 2)

    def together(*parts):
        rows = jnp.concatenate(parts)
        return jnp.moveaxis(rows, 0, -2).reshape(*rows.shape[1:-1], streams * blocks * BLOCK)[..., :runs]

    def one(part):
        return _block(program, shared, part[0], part[1], steps, every)

    stream = as_function(lambda parts: jax.lax.map(one, parts))
    parts = jax.tree.map(apart, (lane, carry))
    return jax.tree.map(together, *(stream(entry(parts, i)) for i in range(streams)))


def entry(parts: Any, i: int) -> Any:
    """Entry i of every array."""
    return jax.tree.map(lambda x: x[i], parts)


def as_function(f):
    """`f` as a function that XLA does not inline: fusion stops at its border, and two of them may run side by side."""
    return set_xla_metadata(inlineable="false")(jax.jit(f))


def _block(program: Program, shared: jax.Array, lane: jax.Array, carry: Packed, steps: int, every: int | None) -> tuple[Packed, jax.Array]:
    classes = program.classes()
    runs = carry.floats.shape[1]
    once = {i: shared[n.value] for i, n in enumerate(program.nodes) if n.op == "shared"}
    Evaluator(program, False).compute(once, frontier(program, classes, SHARED, lambda c: c != SHARED))
    columns = frontier(program, classes, TIME, lambda c: bool(c & LANE))
    fixed = once | {i: lane[n.value] for i, n in enumerate(program.nodes) if n.op == "lane"}
    values = _separate(program, carry)
    fixed |= {a: values[c] for c, (a, o) in enumerate(program.carry) if a == o}
    Evaluator(program, True).compute(fixed, frontier(program, classes, LANE, lambda c: c == LANE | TIME))
    moving = [c for c, (a, o) in enumerate(program.carry) if a != o]

    def step(state, row, wanted=()):
        known = fixed | dict(zip(columns, row, strict=True))
        known |= {program.carry[c][0]: x for c, x in zip(moving, state, strict=True) if program.carry[c][0] >= 0}
        outputs = [program.carry[c][1] for c in moving]
        Evaluator(program, True).compute(known, [*outputs, *wanted])
        filled = [jnp.broadcast_to(known[o], (runs,)) for o in outputs]
        return filled, [jnp.broadcast_to(known[s], (runs,)) for s in wanted]

    def stretch(state, first, count):
        table = _table(program, once, columns, first, count)
        return jax.lax.scan(lambda s, row: (step(s, row)[0], None), state, table)[0]

    state = [values[c] for c in moving]
    if every:
        state, samples = _sampled(program, once, columns, step, state, steps, every)
    else:
        state, samples = _stretches(stretch, state, steps), jnp.zeros((0, 0, runs), program.dtype)
    for c, x in zip(moving, state, strict=True):
        values[c] = x
    return _joined(program, values, runs), samples


def _stretches(stretch, state, steps: int):
    """The state after all steps, in stretches of one length where a length divides the number of steps, so as to compile one."""
    length = max((d for d in range(1, min(steps, STRETCH) + 1) if steps % d == 0), default=1)
    length = length if length >= STRETCH // 16 else min(steps, STRETCH)
    whole, rest = divmod(steps, max(length, 1))
    if whole:
        starts = length * jnp.arange(whole, dtype=jnp.int32)
        state, _ = jax.lax.scan(lambda s, first: (stretch(s, first, length), None), state, starts)
    return stretch(state, jnp.int32(whole * length), rest) if rest else state


def _sampled(program, once, columns, step, state, steps: int, every: int):
    """The state after all steps, and the samples of every `every`-th one."""

    def advance(state, row):
        return step(state, row)[0], None

    def block(state, first):
        table = _table(program, once, columns, first, every)
        state, sample = step(state, [x[0] for x in table], program.samples)
        state, _ = jax.lax.scan(advance, state, [x[1:] for x in table])
        return state, jnp.stack(sample)

    whole, rest = divmod(steps, every)
    state, samples = jax.lax.scan(block, state, every * jnp.arange(whole, dtype=jnp.int32))
    if rest:
        table = _table(program, once, columns, jnp.int32(whole * every), rest)
        _, last = step(state, [x[0] for x in table], program.samples)
        state, _ = jax.lax.scan(advance, state, table)
        samples = jnp.concatenate([samples, jnp.stack(last)[None]])
    return state, samples


def _table(program: Program, once: dict[int, Any], columns: list[int], first: jax.Array, count: int) -> list[jax.Array]:
    """What time decides, for `count` steps from `first` on: one (count,) array a column."""
    known = dict(once)
    known |= {i: first + jnp.arange(count, dtype=jnp.int32) for i, n in enumerate(program.nodes) if n.op == "index"}
    Evaluator(program, False).compute(known, columns)
    return [jnp.broadcast_to(known[c], (count,)) for c in columns]


def _separate(program: Program, carry: Packed) -> list[jax.Array]:
    floats, ints = iter(carry.floats), iter(carry.ints)
    return [next(floats) if k == "f" else next(ints) if k == "i" else next(ints) != 0 for k in program.kinds]


def _joined(program: Program, values: list[jax.Array], runs: int) -> Packed:
    def rows(kinds: str, dtype) -> jax.Array:
        some = [jnp.broadcast_to(x, (runs,)).astype(dtype) for x, k in zip(values, program.kinds, strict=True) if k in kinds]
        return jnp.stack(some) if some else jnp.zeros((0, runs), dtype)

    return Packed(rows("f", program.dtype), rows("ib", jnp.int32))
