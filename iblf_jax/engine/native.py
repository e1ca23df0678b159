"""The native executor: a program's C, built by the system's compiler and called from within jit.

A kernel is registered with XLA under a name that holds the hash of its content, so a program that
JAX keeps in its persistent cache finds the same kernel in another process.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core.devices import threads
from iblf_jax.engine import plan
from iblf_jax.kernels.emit_c import header, source
from iblf_jax.kernels.packed import Packed, Shapes, record_shapes
from iblf_jax.kernels.program import Program
from iblf_jax.kernels.toolchain import ToolchainError, build_ahead, built, compiler, loaded

_registered: set[str] = set()


def unavailable() -> str | None:
    """Why this process cannot run it, in one line, or None if it can."""
    try:
        compiler()
    except ToolchainError as error:
        return str(error)
    return None


@lru_cache(maxsize=8)
def _text(program: Program, shared: int, lane: int, narrow: bool) -> tuple[str, tuple[str, ...]]:
    """The C of a program's kernel, and the compiler's flags for it."""
    segment, flags = plan.native_build(program.size, narrow)
    return source(program, shared, lane, segment=segment), flags


def _is_narrow(program: Program, runs: int, steps: int) -> bool:
    return runs * program.dtype.itemsize <= plan.NATIVE_NARROW and steps > plan.NATIVE_FEW


def ahead(program: Program, shared: int, lane: int, runs: int, steps: int) -> None:
    """Starts to build the kernel of a program that `run` will be asked for."""
    build_ahead(*_text(program, shared, lane, _is_narrow(program, runs, steps)))


@lru_cache(maxsize=64)
def kernel(program: Program, shared: int, lane: int, narrow: bool) -> str:
    """The name under which the kernel of a program is registered; builds it if need be.

    Args:
      program: what a step does.
      shared, lane: how many numbers of each kind of leaf go in.
      narrow: for one or two runs of many steps, in short vectors.

    Raises:
      ToolchainError: no compiler, or an error from it.
      UnsupportedError: an operation that C has no word for.
    """
    library, key = built(*_text(program, shared, lane, narrow))
    return _register(f"iblf_jax_{key}", library, "iblf_jax_kernel")


@lru_cache(maxsize=2)
def _turner(name: str) -> str:
    """The name under which `iblf_jax_pack` or `iblf_jax_unpack` of `c/leaves.h` is registered."""
    text = "\n".join(
        ["#define RECORDED 0", "#define RECORDED_SIZES {0}", header("frame.h"), header("leaves.h")]
    )
    library, key = built(text)
    return _register(f"iblf_jax_{name}_{key}", library, f"iblf_jax_{name}")


def _register(target: str, library: Path, function: str) -> str:
    """Makes a function of a library known to XLA under a name, and gives the name."""
    if target not in _registered:
        jax.ffi.register_ffi_target(
            target, jax.ffi.pycapsule(getattr(loaded(library, function), function)), platform="cpu"
        )
        _registered.add(target)
    return target


def pack(leaves: Sequence[jax.Array], shapes: Shapes, dtype, runs: int) -> Packed:
    """As `packed.pack`, in one call."""
    kinds = shapes.kinds()
    floats = kinds.count("f")
    rows = [
        jax.ShapeDtypeStruct((floats, runs), dtype),
        jax.ShapeDtypeStruct((len(kinds) - floats, runs), jnp.int32),
    ]
    return Packed(*jax.ffi.ffi_call(_turner("pack"), rows)(*leaves))


def unpack(packed: Packed, shapes: Shapes, runs: int) -> list[jax.Array]:
    """As `packed.unpack`, in one call."""
    leaves = [jax.ShapeDtypeStruct((runs, *shape), dtype) for shape, dtype in shapes.items]
    return list(jax.ffi.ffi_call(_turner("unpack"), leaves)(*packed))


def run(
    program: Program,
    shared: jax.Array,
    lane: jax.Array,
    carry: Packed,
    steps: int,
    every: int | None,
    first: jax.Array | int = 0,
    narrow: bool | None = None,
) -> tuple[Packed, list[jax.Array]]:
    """All steps of all runs.

    Args:
      program: what a step does.
      shared: (S,) numbers of the shared leaves.
      lane: (P, runs) numbers of the leaves that differ.
      carry: rows before the first step.
      steps: how many.
      every: sample every so-many-th step, or None.
      first: number of the first step, () int32, a multiple of `every`.
      narrow: whether the kernel is the one for few runs of many steps; by the number of steps if
        not given.

    Returns:
      The rows after the last step, and the recorded arrays, (samples, numbers, runs), of every
      `every`-th step.
    """
    runs = carry.floats.shape[1]
    narrow = _is_narrow(program, runs, steps) if narrow is None else narrow
    name = kernel(program, shared.size, lane.shape[0], narrow)
    outputs = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry] + record_shapes(
        program, runs, steps, every
    )
    settings = jnp.asarray(np.asarray([[0, steps, every or 0, threads()]], np.int32))
    if not isinstance(first, int) or first:
        settings = settings.at[0, 0].set(first)
    floats, ints, *records = jax.ffi.ffi_call(name, outputs)(
        shared.reshape(1, -1), lane, *carry, settings
    )
    return Packed(floats, ints), [x.reshape(len(x), -1, runs) for x in records]


def build(program: Program, shared: int, per_run: int, runs: int, steps: int) -> None:
    """Compiles the kernel with which `run` makes so many steps of so many runs; see `kernel`."""
    kernel(program, shared, per_run, _is_narrow(program, runs, steps))
