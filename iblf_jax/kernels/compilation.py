"""From a JAX function to its scalar program: `compile_step` for a step of a run, `scalar_program`
for a function of one point.
"""

from __future__ import annotations

import contextlib
import gc
import math
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.kernels import jaxprs
from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.from_jaxpr import closed
from iblf_jax.kernels.functions import uses_in
from iblf_jax.kernels.messages import announce_if_slow
from iblf_jax.kernels.packed import EMPTY, Shapes
from iblf_jax.kernels.passes import with_reciprocals
from iblf_jax.kernels.program import (
    NO_LIMITS,
    Builder,
    Ids,
    Known,
    LoweringLimits,
    Program,
    UnsupportedError,
    finished,
    kind_of,
)

if TYPE_CHECKING:
    from jax.extend import core


class CompiledStep(NamedTuple):
    """A step as a scalar program."""

    program: Program
    records: Any
    """Shapes and types of the records of one step of one run, a pytree."""


@contextlib.contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Context manager, also a decorator, in which Python does not look for garbage.

    A trace and a program are many small objects that stay.  Python looks through all of them again
    and again, which takes a tenth of the time of a compilation.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@CACHES.function(maxsize=64)
@without_garbage_collection()
def compile_step(
    step: Callable,
    dtype: np.dtype,
    shared: Shapes,
    per_run: Shapes,
    carry: Shapes,
    limits: LoweringLimits = NO_LIMITS,
    is_derivative: bool = False,
    known: tuple[Known | None, ...] = (),
    series: Shapes = EMPTY,
) -> CompiledStep:
    """The scalar program of a step of one run.

    Args:
      step: function (shared leaves, leaves of the run, series, carry leaves, index) -> (carry
        leaves, records) of JAX; without `series`, the function has no such argument. Leaves are
        lists of arrays, `index` is the number of the step, () int32. The function object is the
        key of a cache: pass the same one for the same step.
      dtype: floating-point type of all numbers.
      shared: shapes of the leaves that all runs share.
      per_run: shapes of the leaves of one run that differ between runs.
      carry: shapes of the leaves that go from one step to the next, for one run.
      limits: sizes above which a step is not compiled.
      is_derivative: whether the step computes tangents, in which a literal zero means "does not
        depend" (`program.Builder`).
      known: what is known beforehand of each shared number; empty for nothing.
      series: shapes of what a step of one run reads from a table with one row per step.

    Raises:
      UnsupportedError: the step contains an operation that a scalar program cannot express, or
        exceeds a limit.
    """
    index = jax.ShapeDtypeStruct((), jnp.int32)
    leaves = [shared.structs(), per_run.structs()]
    if series.items:
        leaves.append(series.structs())
    jaxpr, (after, records) = jax.make_jaxpr(step, return_shape=True)(
        *leaves, carry.structs(), index
    )
    arguments = (shared, per_run, carry, limits, is_derivative, known, series)
    operations = jaxprs.count_operations(jaxpr)
    with announce_if_slow(f"compiling a step of {operations:,} operations"):
        program = _lowered(jaxpr, len(after), *arguments, dtype=dtype)
    return CompiledStep(program, records)


def _lowered(
    jaxpr: core.ClosedJaxpr,
    carried: int,
    shared: Shapes,
    per_run: Shapes,
    carry: Shapes,
    limits: LoweringLimits,
    is_derivative: bool,
    known: tuple[Known | None, ...],
    series: Shapes,
    *,
    dtype: np.dtype,
) -> Program:
    """The program of the jaxpr of a step, whose first `carried` outputs are the carry; other
    arguments as `compile_step`.
    """
    b = Builder(dtype, sparse=is_derivative, limits=limits, uses=uses_in(jaxpr))
    shared_ids = _inputs(b, shared, lambda i, kind: _shared(b, i, known))
    per_run_ids = _inputs(b, per_run, lambda i, kind: b.input("per_run", i, kind))
    series_ids = _inputs(b, series, lambda i, kind: b.input("series", i, kind))
    carry_ids = _inputs(b, carry, lambda i, kind: b.input("carry", i, kind), of_carry=True)
    index_id = np.asarray(b.input("index", 0, "i"), np.int64)
    # The inputs of the jaxpr end with the carry and the index of the step.
    opened = jaxprs.opened(jaxpr)[0]
    inputs = opened.invars[-1 - len(carry_ids) : -1]
    for before, after, ids in zip(inputs, opened.outvars, carry_ids, strict=False):
        if after is before:
            b.constant_carry.update(ids.ravel().tolist())
    out = closed(b, jaxpr, [*shared_ids, *per_run_ids, *series_ids, *carry_ids, index_id])
    carry_out, recorded = out[:carried], out[carried:]
    if Shapes.of(jaxpr.out_avals[:carried]).kinds() != carry.kinds():
        raise UnsupportedError("the step changes the types of its carry")
    program = finished(
        b,
        _numbers(carry_ids),
        _numbers(carry_out),
        [_as_float(b, i) for i in _numbers(recorded)],
        tuple(ids.size for ids in recorded),
    )
    return with_reciprocals(program)


class Lowered(NamedTuple):
    """A function as a scalar program."""

    program: Program
    sizes: tuple[int, ...]
    """Number of entries of each output array."""
    shapes: tuple[tuple[int, ...], ...]
    """Shape of each output array."""


def scalar_program(
    function: Callable,
    dimension: int,
    shapes: tuple[tuple[int, ...], ...] = (),
    *,
    exact: bool = False,
) -> Lowered:
    """The scalar program of a function of one point, in float64.

    Its inputs are "carry" for the coordinates and "shared" for the numbers of the constants.

    Args:
      function: function (x, constants) -> arrays, of one point, (dimension,), and of a list of
        constants.
      dimension: number of coordinates.
      shapes: shapes of the constants.
      exact: whether it must be equal to the function in real arithmetic (`program.Builder`).

    Raises:
      UnsupportedError: an operation cannot be expressed.
    """
    structs = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes]
    with jax.enable_x64(True):
        jaxpr, out = jax.make_jaxpr(
            lambda x, c: jax.tree.leaves(function(x, c)), return_shape=True
        )(jax.ShapeDtypeStruct((dimension,), jnp.float64), structs)
    b = Builder(np.dtype(np.float64), sparse=True, exact=exact)
    x = np.asarray([b.input("carry", i, "f") for i in range(dimension)], np.int64)
    constants = Shapes.of(structs)
    shared = _inputs(b, constants, lambda i, kind: b.input("shared", i, kind))
    results = closed(b, jaxpr, [x, *shared])
    program = finished(b, [], [], _numbers(results))
    for output in program.outputs:
        if program.nodes[output].kind != "f":
            raise UnsupportedError("an output that is no floating-point number")
    return Lowered(program, tuple(ids.size for ids in results), tuple(x.shape for x in out))


def _numbers(arrays: Sequence[Ids]) -> list[int]:
    """The node numbers of arrays, one after the other."""
    return [int(i) for ids in arrays for i in ids.ravel()]


def _inputs(
    b: Builder, shapes: Shapes, node_of: Callable[[int, str], int], *, of_carry: bool = False
) -> list[Ids]:
    """The input nodes of leaves.

    Args:
      b: the builder.
      shapes: shapes of the leaves.
      node_of: function (index of a number, kind) -> node.
      of_carry: whether the leaves may hold integers and truth values.
    """
    first = 0
    arrays = []
    for shape, dtype in shapes.items:
        kind = kind_of(dtype)
        if kind == "f" and dtype != b.dtype:
            raise UnsupportedError(f"it mixes {dtype} with {b.dtype}")
        if kind != "f" and not of_carry:
            raise UnsupportedError(f"a leaf of type {dtype}")
        ids = [node_of(first + i, kind) for i in range(math.prod(shape))]
        arrays.append(np.asarray(ids, np.int64).reshape(shape))
        first += len(ids)
    return arrays


def _shared(b: Builder, number: int, known: tuple[Known | None, ...]) -> int:
    """The node of a shared number."""
    fact = known[number] if known else None
    if fact is None:
        return b.input("shared", number, "f")
    if fact.value == 0:
        return b.absent
    if fact.value is not None:
        return b.constant(fact.value, "f")
    equal = number if fact.same is None else fact.same
    node = b.input("shared", equal, "f")
    b.known_finite.add(node)
    if fact.sign > 0:
        return node
    return b.emit("neg", node)


def _as_float(b: Builder, node: int) -> int:
    """The node of a number as a floating-point number."""
    if b.nodes[node].kind == "f":
        return node
    return b.emit("convert", node, kind="f")
