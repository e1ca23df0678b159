"""A step as a scalar program, and the arrays that go in and out of it: one row a number, one column
a run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.kernels.from_jaxpr import closed
from iblf_jax.kernels.passes import with_reciprocals
from iblf_jax.kernels.program import (
    Builder,
    Known,
    LoweringLimits,
    Program,
    UnsupportedError,
    finished,
    kind_of,
)


class Shapes(NamedTuple):
    """Shapes and types of one run's arrays; hashable."""

    items: tuple[tuple[tuple[int, ...], np.dtype], ...]

    @staticmethod
    def of(arrays: Sequence[Any], drop: int = 0) -> Shapes:
        """Of arrays with `drop` leading batch axes."""
        return Shapes(tuple((tuple(x.shape[drop:]), np.dtype(x.dtype)) for x in arrays))

    def structs(self) -> list[jax.ShapeDtypeStruct]:
        """Placeholders to trace with."""
        return [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in self.items]

    def kinds(self) -> list[str]:
        """Kind of every number, leaf after leaf."""
        return [kind_of(dtype) for shape, dtype in self.items for _ in range(int(np.prod(shape)))]

    @property
    def size(self) -> int:
        """How many numbers."""
        return sum(int(np.prod(shape)) for shape, _ in self.items)


class Lowered(NamedTuple):
    """A step as a program."""

    program: Program
    records: Any
    """Shapes and types of what a step gives besides its carry, for one run."""


@lru_cache(maxsize=64)
def lowered(
    step: Callable,
    dtype: np.dtype,
    shared: Shapes,
    lane: Shapes,
    carry: Shapes,
    limits: LoweringLimits,
    sparse: bool = False,
    known: tuple[Known | None, ...] = (),
) -> Lowered:
    """The program of `step(shared leaves, lane leaves, carry leaves, index) -> (carry leaves,
    records)`.

    `limits`: what is too long; `sparse`: for steps that hold derivatives, see `Builder`; `known`:
      of each shared number.

    Raises:
      UnsupportedError: the step holds something that a scalar program cannot express.
    """
    index = jax.ShapeDtypeStruct((), jnp.int32)
    jaxpr, (after, records) = jax.make_jaxpr(step, return_shape=True)(
        shared.structs(), lane.structs(), carry.structs(), index
    )
    b = Builder(dtype, sparse=sparse, limits=limits)
    operands, read = [], []
    for op, group in (("shared", shared), ("lane", lane), ("carry", carry)):
        count = 0
        for shape, array_dtype in group.items:
            kind = _accepted(kind_of(array_dtype), array_dtype, op, dtype)
            size = int(np.prod(shape))
            ids = [
                _shared(b, i, known) if op == "shared" else b.input(op, i, kind)
                for i in range(count, count + size)
            ]
            count += size
            operands.append(np.asarray(ids, np.int64).reshape(shape))
            read += ids if op == "carry" else []
    operands.append(np.asarray(b.input("index", 0, "i"), np.int64))
    begin = len(shared.items) + len(lane.items)
    for place, leaf in enumerate(jaxpr.jaxpr.outvars[: len(after)]):
        if leaf is jaxpr.jaxpr.invars[begin + place]:
            b.still.update(operands[begin + place].ravel().tolist())
    out = closed(b, jaxpr, operands)
    carry_out = [int(i) for ids in out[: len(after)] for i in ids.ravel()]
    samples = [_as_float(b, int(i)) for ids in out[len(after) :] for i in ids.ravel()]
    if Shapes.of(after).kinds() != carry.kinds():
        raise UnsupportedError("the step changes the types of what it carries")
    program = finished(b, read, carry_out, samples, tuple(ids.size for ids in out[len(after) :]))
    return Lowered(with_reciprocals(program), records)


def _shared(b: Builder, number: int, known: tuple[Known | None, ...]) -> int:
    """The node of a shared number."""
    found = known[number] if known else None
    if found is None:
        return b.input("shared", number, "f")
    if found.value is not None:
        return b.constant(found.value, "f") if found.value else b.absent
    node = b.input("shared", number if found.same is None else found.same, "f")
    b.known_finite.add(node)
    return node if found.sign > 0 else b.emit("neg", node)


def _accepted(kind: str, array_dtype, op: str, dtype) -> str:
    if kind == "f" and array_dtype != dtype:
        raise UnsupportedError(f"it mixes {array_dtype} with {dtype}")
    if op != "carry" and kind != "f":
        raise UnsupportedError(f"a leaf of type {array_dtype}")
    return kind


def _as_float(b: Builder, node: int) -> int:
    return node if b.nodes[node].kind == "f" else b.emit("convert", node, kind="f")


class Packed(NamedTuple):
    """One row a number, one column a run: floats, and whole numbers or flags as int32."""

    floats: jax.Array
    ints: jax.Array


def _rows(arrays: Sequence[jax.Array], dtype, runs: int) -> jax.Array:
    flat = [jnp.reshape(x, (runs, -1)).astype(dtype).T for x in arrays]
    return jnp.concatenate(flat) if flat else jnp.zeros((0, runs), dtype)


def pack(leaves: Sequence[jax.Array], shapes: Shapes, dtype, runs: int) -> Packed:
    """Rows from leaves with a leading batch axis."""
    kinds = [kind_of(d) for _, d in shapes.items]
    return Packed(
        _rows([x for x, kind in zip(leaves, kinds, strict=True) if kind == "f"], dtype, runs),
        _rows([x for x, kind in zip(leaves, kinds, strict=True) if kind != "f"], jnp.int32, runs),
    )


def unpack(packed: Packed, shapes: Shapes, runs: int) -> list[jax.Array]:
    """Leaves with a leading batch axis from rows."""
    used, result = {"f": 0, "i": 0}, []
    for shape, dtype in shapes.items:
        group = "f" if kind_of(dtype) == "f" else "i"
        size, start = int(np.prod(shape)), used[group]
        used[group] += size
        rows = (packed.floats if group == "f" else packed.ints)[start : start + size]
        result.append(rows.T.reshape(runs, *shape).astype(dtype))
    return result


def record_shapes(
    program: Program, runs: int, steps: int, every: int | None
) -> list[jax.ShapeDtypeStruct]:
    """(rows, numbers * runs) of each recorded array: a row for every `every`-th of the steps, from
    the first on.
    """
    return (
        [
            jax.ShapeDtypeStruct((-(-steps // every), size * runs), program.dtype)
            for size in program.recorded
        ]
        if every
        else []
    )


def unpacked_records(records: Any, arrays: Sequence[jax.Array]) -> Any:
    """What a step gives besides its carry, run axis first, then time, from arrays (rows, numbers,
    runs) and its shapes for one run.
    """
    shapes, treedef = jax.tree.flatten(records)
    rows = [
        a.transpose(2, 0, 1).reshape(a.shape[2], len(a), *x.shape).astype(x.dtype)
        for a, x in zip(arrays, shapes, strict=True)
    ]
    return jax.tree.unflatten(treedef, rows)
