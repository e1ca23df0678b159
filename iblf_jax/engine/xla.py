"""The xla executor: a scalar program with one array of runs a number, in `lax.scan`.  Needs nothing
but jax and runs on any device.

What time decides is tabulated for a stretch of steps at once.  On CPU a block of runs goes through
a stretch of steps as one machine function (`machine_function`), its numbers in the first-level
cache.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from itertools import accumulate
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from iblf_jax.core import devices
from iblf_jax.engine import plan
from iblf_jax.engine.evaluator import Entry, Evaluator, Table, on_cpu
from iblf_jax.engine.machine_function import machine_function
from iblf_jax.kernels import (
    PER_RUN,
    SHARED,
    TIME,
    Packed,
    Program,
    UnsupportedError,
    frontier,
    written_out,
)


def run(
    program: Program,
    shared: jax.Array,
    per_run: jax.Array,
    carry: Packed,
    steps: int,
    every: int | None,
) -> tuple[Packed, list[jax.Array]]:
    """All steps of all runs; arguments and results as `native.run`.  The last block repeats the
    last run.

    Raises:
      UnsupportedError: the step is too long for XLA.
    """
    program = compilable(program)
    runs = carry.floats.shape[1]
    width = plan.xla_width(devices.platform(), len(program.nodes), runs)
    blocks = -(-runs // width)

    def apart(rows):
        padded = jnp.pad(rows, ((0, 0), (0, blocks * width - runs)), mode="edge")
        return jnp.moveaxis(padded.reshape(len(rows), blocks, width), 1, 0)

    def together(parts):
        rows = jnp.moveaxis(parts, 0, -2)
        return rows.reshape(*rows.shape[:-2], blocks * width)[..., :runs]

    done, samples = _in_blocks(
        program, shared, apart(per_run), jax.tree.map(apart, carry), steps, every
    )
    return jax.tree.map(together, done), jax.tree.map(together, samples)


def compilable(program: Program) -> Program:
    """The program without functions, which XLA does not have.

    Raises:
      UnsupportedError: it is too long for XLA.
    """
    program = written_out(program)
    if len(program.nodes) > plan.XLA_LONGEST:
        raise UnsupportedError(
            f"its step has {len(program.nodes)} operations, over which XLA compiles for many"
            " minutes"
        )
    return program


def _in_blocks(
    program: Program, shared, per_run, carry: Packed, steps: int, every: int | None
) -> tuple[Packed, list[jax.Array]]:
    """All steps of some blocks: (blocks, rows, width) in, and out; recorded arrays (blocks,
    samples, numbers, width).
    """
    classes = program.classes()
    once = {i: shared[n.value] for i, n in enumerate(program.nodes) if n.op == "shared"}
    Evaluator(program, ()).compute(once, frontier(program, classes, SHARED, lambda c: c != SHARED))
    columns = frontier(program, classes, TIME, lambda c: bool(c & PER_RUN))

    def block(once, table, per_run, carry):
        return _block(program, once, columns, table, per_run, carry, every)

    call = machine_function(block) if on_cpu() else block

    def stretch(carry, first, count):
        table = _table(program, once, columns, first, count)
        return lax.map(lambda part: call(once, table, *part), (per_run, carry))

    length = plan.xla_stretch(steps, every or 1)
    full, rest = divmod(steps, length)
    parts = []
    if full:
        starts = length * jnp.arange(full, dtype=jnp.int32)
        carry, arrays = lax.scan(partial(stretch, count=length), carry, starts)
        parts.append(
            [
                jnp.moveaxis(x, 0, 1).reshape(x.shape[1], full * x.shape[2], *x.shape[3:])
                for x in arrays
            ]
        )
    if rest:
        carry, arrays = stretch(carry, jnp.int32(full * length), rest)
        parts.append(arrays)
    return carry, [jnp.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True)]


def _block(
    program: Program,
    once,
    columns,
    table: Table,
    per_run: jax.Array,
    carry: Packed,
    every: int | None,
) -> tuple[Packed, list[jax.Array]]:
    """One block of runs through the steps of a table."""
    width = carry.floats.shape[1]
    evaluator = Evaluator(program, (width,))
    values = _separate(program, carry)
    fixed = once | {i: per_run[n.value] for i, n in enumerate(program.nodes) if n.op == "per_run"}
    fixed |= {a: values[c] for c, (a, o) in enumerate(program.carry) if a == o}
    evaluator.compute(
        fixed, frontier(program, program.classes(), PER_RUN, lambda c: c == PER_RUN | TIME)
    )
    changed = [c for c, (a, o) in enumerate(program.carry) if a != o]
    outputs = [program.carry[c][1] for c in changed]

    sampled = program.samples if every else ()
    count = len(table.floats)
    rows = -(-count // every) if every else 0

    def step(state, now):
        state, records = state
        row, place = now
        known = fixed | _entries(program, columns, row)
        known |= {
            program.carry[c][0]: x
            for c, x in zip(changed, state, strict=True)
            if program.carry[c][0] >= 0
        }
        evaluator.compute(known, [*outputs, *sampled], row)
        found = [
            x.read(row) if isinstance(x, Entry) else x
            for x in (known[i] for i in [*outputs, *sampled])
        ]
        filled = [jnp.broadcast_to(x, (width,)) for x in found]
        if every:
            records = lax.dynamic_update_slice(
                records, jnp.stack(filled[len(outputs) :])[None], (place, np.int32(0), np.int32(0))
            )
        return (filled[: len(outputs)], records), None

    # Every step writes its sample, to the row of the next step that is recorded, which so writes
    # last: one copy of the step to compile.
    places = (np.arange(count, dtype=np.int32) + (every or 1) - 1) // (every or 1)
    records = jnp.zeros((rows + 1 if every else 0, len(sampled), width), program.dtype)
    (state, records), _ = lax.scan(step, ([values[c] for c in changed], records), (table, places))
    for c, x in zip(changed, state, strict=True):
        values[c] = x
    ends = accumulate(program.recorded if every else ())
    return _joined(program, values, width), [
        records[:rows, end - size : end] for end, size in zip(ends, program.recorded, strict=False)
    ]


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


def _table(
    program: Program, once: dict[int, Any], columns: list[int], first: jax.Array, count: int
) -> Table:
    """What time decides, for `count` steps from `first` on."""
    known = dict(once)
    known |= {
        i: first + jnp.arange(count, dtype=jnp.int32)
        for i, n in enumerate(program.nodes)
        if n.op == "index"
    }
    Evaluator(program, (count,)).compute(known, columns)

    def stacked(kinds, dtype):
        some = [
            jnp.broadcast_to(known[c], (count,)).astype(dtype)
            for c in columns
            if program.nodes[c].kind in kinds
        ]
        return jnp.stack(some, axis=1) if some else jnp.zeros((count, 0), dtype)

    return Table(stacked("f", program.dtype), stacked("ib", jnp.int32))


def _separate(program: Program, carry: Packed) -> list[jax.Array]:
    floats, ints = iter(carry.floats), iter(carry.ints)
    return [
        next(floats) if k == "f" else next(ints) if k == "i" else next(ints) != 0
        for k in program.kinds
    ]


def _joined(program: Program, values: list[jax.Array], runs: int) -> Packed:
    def rows(kinds: str, dtype) -> jax.Array:
        some = [
            jnp.broadcast_to(x, (runs,)).astype(dtype)
            for x, k in zip(values, program.kinds, strict=True)
            if k in kinds
        ]
        return jnp.stack(some) if some else jnp.zeros((0, runs), dtype)

    return Packed(rows("f", program.dtype), rows("ib", jnp.int32))


def build(program: Program, shared: int, per_run: int, runs: int, steps: int) -> None:
    """Raises UnsupportedError where a program is too long; XLA compiles it with its caller."""
    compilable(program)
