"""The step of a scenario as a scalar program, and the arrays that go in and out of it.

A kernel maps carry to carry over many steps.  What comes before (`time_loop.start`) and after (`time_loop.finish`) is done once a run
and stays in jnp.  The leaves of scenario and metrics are inputs of the kernel, never constants: new gains do not recompile.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.lowering.from_jaxpr import closed, kind_of
from iblf_jax.lowering.passes import with_reciprocals
from iblf_jax.lowering.program import Builder, Program, UnsupportedError, finished
from iblf_jax.paths import with_parameters


class Leaves(NamedTuple):
    """The leaves of a pytree, told apart by whether they differ between runs."""

    treedef: Any
    is_lane: tuple[bool, ...]
    shared: list[jax.Array]
    lane: list[jax.Array]
    """With a leading batch axis."""

    def together(self, shared: Sequence, lane: Sequence):
        """The pytree again, from one run's leaves."""
        one, other = iter(shared), iter(lane)
        return jax.tree.unflatten(self.treedef, [next(other) if lane else next(one) for lane in self.is_lane])


def split(scenario, varied: Mapping[str, jax.Array], folds, dt) -> Leaves:
    """The leaves of (scenario, folds, dt): those that `varied` replaces become one value a run."""
    before, treedef = jax.tree.flatten((scenario, folds, dt))

    def replaced(values):
        return jax.tree.leaves((with_parameters(scenario, values), folds, dt))

    touched: list[bool] = []

    def look(values):
        after = replaced(values)
        touched[:] = [new is not old for new, old in zip(after, before, strict=True)]
        return [new for new, yes in zip(after, touched, strict=True) if yes]

    lane = jax.vmap(look)(dict(varied)) if varied else []
    touched = touched or [False] * len(before)
    return Leaves(treedef, tuple(touched), [x for x, yes in zip(before, touched, strict=True) if not yes], list(lane))


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


@lru_cache(maxsize=64)
def lowered(step: Callable, dtype: np.dtype, shared: Shapes, lane: Shapes, carry: Shapes, sparse: bool = False) -> Program:
    """The program of `step(shared leaves, lane leaves, carry leaves, index) -> (carry leaves, samples)`.

    `sparse`: for steps that hold derivatives, see `Builder`.

    Raises:
      UnsupportedError: the step holds something that a scalar program cannot express.
    """
    index = jax.ShapeDtypeStruct((), jnp.int32)
    jaxpr, shapes = jax.make_jaxpr(step, return_shape=True)(shared.structs(), lane.structs(), carry.structs(), index)
    b = Builder(dtype, sparse=sparse)
    operands, read = [], []
    for op, group in (("shared", shared), ("lane", lane), ("carry", carry)):
        count = 0
        for (shape, array_dtype), _ in zip(group.items, group.structs(), strict=True):
            kind = _accepted(kind_of(array_dtype), array_dtype, op, dtype)
            size = int(np.prod(shape))
            ids = [b.input(op, count + i, kind) for i in range(size)]
            count += size
            operands.append(np.asarray(ids, np.int64).reshape(shape))
            read += ids if op == "carry" else []
    operands.append(np.asarray(b.input("index", 0, "i"), np.int64))
    out = closed(b, jaxpr, operands)
    n_carry = len(shapes[0])
    carry_out = [int(i) for ids in out[:n_carry] for i in ids.ravel()]
    samples = [_as_float(b, int(i)) for ids in out[n_carry:] for i in ids.ravel()]
    if Shapes.of(shapes[0]).kinds() != carry.kinds():
        raise UnsupportedError("the step changes the types of what it carries")
    return with_reciprocals(finished(b, read, carry_out, samples, tuple(ids.size for ids in out[n_carry:])))


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


def record_shapes(program: Program, runs: int, steps: int, every: int | None) -> list[jax.ShapeDtypeStruct]:
    """(samples, numbers * runs) of each recorded array, the sample at the end included if it is one; none without `every`."""
    return [jax.ShapeDtypeStruct((steps // every + 1, size * runs), program.dtype) for size in program.recorded] if every else []
