"""The arrays that go in and out of a program: one row per number, one column per run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.kernels.program import Program, kind_of


class Shapes(NamedTuple):
    """Shapes and types of the arrays of one run; hashable."""

    items: tuple[tuple[tuple[int, ...], np.dtype], ...]

    @staticmethod
    def of(arrays: Sequence[Any], drop: int = 0) -> Shapes:
        """The shapes of arrays, without their `drop` leading axes."""
        return Shapes(tuple((tuple(x.shape[drop:]), np.dtype(x.dtype)) for x in arrays))

    def structs(self) -> list[jax.ShapeDtypeStruct]:
        """Placeholders to trace with."""
        return [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in self.items]

    def kinds(self) -> list[str]:
        """The kind of every number, leaf after leaf."""
        return [kind_of(dtype) for shape, dtype in self.items for _ in range(math.prod(shape))]

    @property
    def size(self) -> int:
        """The number of numbers."""
        return sum(math.prod(shape) for shape, _ in self.items)


EMPTY = Shapes(())
"""The shapes of no arrays."""


class Packed(NamedTuple):
    """Numbers of many runs, one row per number, one column per run."""

    floats: jax.Array
    ints: jax.Array
    """Integers and truth values, as int32."""


def _rows(arrays: Sequence[jax.Array], dtype, runs: int) -> jax.Array:
    """The rows of some leaves, of one type."""
    if not arrays:
        return jnp.zeros((0, runs), dtype)
    return jnp.concatenate([jnp.reshape(x, (runs, -1)).astype(dtype).T for x in arrays])


def pack(leaves: Sequence[jax.Array], shapes: Shapes, dtype, runs: int) -> Packed:
    """The rows of leaves that have a leading batch axis."""
    kinds = [kind_of(leaf_type) for _, leaf_type in shapes.items]
    floats = [x for x, kind in zip(leaves, kinds, strict=True) if kind == "f"]
    others = [x for x, kind in zip(leaves, kinds, strict=True) if kind != "f"]
    return Packed(_rows(floats, dtype, runs), _rows(others, jnp.int32, runs))


def unpack(packed: Packed, shapes: Shapes, runs: int) -> list[jax.Array]:
    """The leaves, with a leading batch axis, of rows."""
    start_of_floats = 0
    start_of_ints = 0
    leaves = []
    for shape, dtype in shapes.items:
        size = math.prod(shape)
        if kind_of(dtype) == "f":
            rows = packed.floats[start_of_floats : start_of_floats + size]
            start_of_floats += size
        else:
            rows = packed.ints[start_of_ints : start_of_ints + size]
            start_of_ints += size
        leaves.append(rows.T.reshape(runs, *shape).astype(dtype))
    return leaves


def record_shapes(
    program: Program, runs: int, steps: Any, every: int | None
) -> list[jax.ShapeDtypeStruct]:
    """The shape (rows, numbers * runs) of each recorded array: one row for every `every`-th step,
    from the first step on.
    """
    if not every:
        return []
    rows = -(-steps // every)
    return [jax.ShapeDtypeStruct((rows, size * runs), program.dtype) for size in program.recorded]


def unpacked_records(records: Any, arrays: Sequence[jax.Array]) -> Any:
    """The records of a step, with the run axis first and then the time axis.

    Args:
      records: shapes and types of the records of one step of one run, a pytree.
      arrays: (rows, numbers, runs) for each leaf.
    """
    shapes, treedef = jax.tree.flatten(records)
    leaves = [
        array.transpose(2, 0, 1).reshape(array.shape[2], len(array), *leaf.shape).astype(leaf.dtype)
        for array, leaf in zip(arrays, shapes, strict=True)
    ]
    return jax.tree.unflatten(treedef, leaves)
