"""Kernels for CPUs: the C of a program, built by the system's compiler and called from within jit.

XLA knows a kernel by a name that holds the hash of its content, so a program that JAX keeps in its
persistent cache finds the same kernel in another process.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.emit_c import header, source
from iblf_jax.kernels.packed import Packed, Shapes, record_shapes
from iblf_jax.kernels.program import Program
from iblf_jax.kernels.toolchain import build_ahead, built, cache_folder, loaded


class Build(NamedTuple):
    """How the C of a kernel is written and compiled; hashable."""

    segment: int | None = None
    """Operations of a function of the C, at most; None for one function."""
    flags: tuple[str, ...] = ("-DSTRETCH=128", "-DGROUP=32")
    """Flags of the compiler: STRETCH steps of GROUP blocks of runs are made together."""


@CACHES.function(maxsize=8)
def c_source(
    program: Program, shared: int, per_run: int, segment: int | None = None, series: int = 0
) -> str:
    """The C of a program's kernel.

    Args:
      program: what a step computes.
      shared: number of shared leaf entries that go in.
      per_run: number of leaf entries that go in for each run.
      segment: operations of a function, at most; None for one function.
      series: numbers of each step of a run in the series that the program reads, if it reads one.
    """
    return source(program, shared, per_run, segment=segment, series=series)


DEFAULT_BUILD = Build()


def start_build(
    program: Program, shared: int, per_run: int, build: Build = DEFAULT_BUILD, series: int = 0
) -> None:
    """Starts to compile a kernel in the background; arguments as `kernel`."""
    build_ahead(c_source(program, shared, per_run, build.segment, series), build.flags)


@CACHES.function(maxsize=64)
def kernel(
    program: Program, shared: int, per_run: int, build: Build = DEFAULT_BUILD, series: int = 0
) -> str:
    """The name by which XLA knows the kernel of a program; compiles the kernel if necessary.

    Args:
      program: what a step computes.
      shared: number of shared leaf entries that go in.
      per_run: number of leaf entries that go in for each run.
      build: how the C is written and compiled.
      series: numbers of each step of a run in the series that the program reads, if it reads one.

    Raises:
      ToolchainError: no compiler, or an error from it.
      UnsupportedError: an operation that C does not have.
    """
    library, key = built(c_source(program, shared, per_run, build.segment, series), build.flags)
    return register(f"iblf_jax_{key}", library, "iblf_jax_kernel", "cpu")


@CACHES.function(maxsize=3)
def array_function(name: str) -> str:
    """The name by which XLA knows a function of arrays that is no kernel of a program.

    Args:
      name: "pack" or "unpack" of `c/leaves.h`, or "multiply" of `c/products.h`.

    Raises:
      ToolchainError: no compiler, or an error from it.
    """
    definitions = ["#define RECORDED 0", "#define RECORDED_SIZES {0}"]
    own = "products.h" if name == "multiply" else "leaves.h"
    library, key = built("\n".join([*definitions, header("frame.h"), header(own)]))
    return register(f"iblf_jax_{name}_{key}", library, f"iblf_jax_{name}", "cpu")


def register(target: str, library: Path, function: str, platform: str) -> str:
    """Makes a function of a library known to XLA under the name `target`, and returns this name."""
    if target not in CACHES.registered:
        address = loaded(library, function)[function]
        jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(address), platform=platform)
        CACHES.registered[target] = (library.name, function)
    return target


def files_of(targets: Iterable[str]) -> dict[str, tuple[str, str]] | None:
    """Where the functions that XLA knows by these names are, as `register_files` reads it; None if
    one of them is not of a kernel.
    """
    if any(target not in CACHES.registered for target in targets):
        return None
    return {target: CACHES.registered[target] for target in targets}


def register_files(files: Mapping[str, tuple[str, str]]) -> None:
    """Makes functions of kernels that another process has built known to XLA (`files_of`).

    Raises:
      ToolchainError: a file is missing or damaged.
    """
    for target, (name, function) in files.items():
        register(target, cache_folder() / name, function, "cpu")


def pack(leaves: Sequence[jax.Array], shapes: Shapes, dtype, runs: int) -> Packed:
    """The same as `packed.pack`, in one call of compiled code."""
    kinds = shapes.kinds()
    floats = kinds.count("f")
    rows = [
        jax.ShapeDtypeStruct((floats, runs), dtype),
        jax.ShapeDtypeStruct((len(kinds) - floats, runs), jnp.int32),
    ]
    return Packed(*jax.ffi.ffi_call(array_function("pack"), rows)(*leaves))


def unpack(packed: Packed, shapes: Shapes, runs: int) -> list[jax.Array]:
    """The same as `packed.unpack`, in one call of compiled code."""
    leaves = [jax.ShapeDtypeStruct((runs, *shape), dtype) for shape, dtype in shapes.items]
    return list(jax.ffi.ffi_call(array_function("unpack"), leaves)(*packed))


def run(
    program: Program,
    shared: jax.Array,
    per_run: jax.Array,
    carry: Packed,
    steps: int | jax.Array,
    every: int | None = None,
    *,
    first: jax.Array | int = 0,
    series: jax.Array | None = None,
    build: Build = DEFAULT_BUILD,
    threads: int = 1,
) -> tuple[Packed, list[jax.Array]]:
    """All steps of all runs.

    Args:
      program: what a step computes.
      shared: entries of the shared leaves, (S,).
      per_run: entries of the leaves that differ between the runs, (P, runs).
      carry: rows before the first step.
      steps: number of steps; an array, () int32, only without records and series, whose shapes
        depend on it.
      every: interval of the recorded steps; None for no record.
      first: number of the first step, () int32, a multiple of `every`.
      series: what the steps read, if they read a series: (steps, numbers, runs).  The first step
        reads the last row.
      build: how the kernel is compiled.
      threads: number of threads.

    Returns:
      The rows after the last step, and the recorded arrays, (samples, numbers, runs).

    Raises:
      ToolchainError: no compiler, or an error from it.
      UnsupportedError: an operation that C does not have.
    """
    runs = carry.floats.shape[1]
    width = 0
    if series is not None:
        width = series.shape[1]
    name = kernel(program, shared.size, per_run.shape[0], build, width)
    outputs = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry]
    outputs += record_shapes(program, runs, steps, every)
    numbers = (first, steps, every or 0, threads)
    known = [x if isinstance(x, int) else 0 for x in numbers]
    attributes = jnp.asarray(np.asarray([known], np.int32))
    for i, x in enumerate(numbers):
        if not isinstance(x, int):
            attributes = attributes.at[0, i].set(x)
    operands = [shared.reshape(1, -1), per_run, *carry, attributes]
    if series is not None:
        operands.append(series.reshape(steps, -1))
    floats, ints, *records = jax.ffi.ffi_call(name, outputs)(*operands)
    return Packed(floats, ints), [x.reshape(len(x), -1, runs) for x in records]
