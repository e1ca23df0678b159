"""Kernels for NVIDIA GPUs: an entire rollout in one CUDA kernel, one run per thread.

The kernel is the C of `cpu`, from the same emitter, in which a name stands for the number of one
run instead of a vector of runs. NVRTC compiles it for a given architecture; the system's C++
compiler builds the few lines that launch it from within jit (`c/launch.h`), so neither nvcc nor
CUDA's headers are necessary. Long rollouts are launched in groups of steps; another kernel first
tabulates the signals that depend on time only.
"""

from __future__ import annotations

import jax
import numpy as np

from iblf_jax.kernels import nvrtc
from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.cpu import register
from iblf_jax.kernels.emit_c import CUDA, header, sizes, source
from iblf_jax.kernels.layout import Layout
from iblf_jax.kernels.packed import Packed, record_shapes
from iblf_jax.kernels.program import Program
from iblf_jax.kernels.toolchain import built


def launcher(program: Program, shared: int, per_run: int, image: bytes) -> str:
    """The C source that launches a kernel.

    Args:
      program: what a step computes.
      shared: number of shared leaf entries that go in.
      per_run: number of leaf entries that go in for each run.
      image: the kernel's machine code.
    """
    padded = image + bytes(-len(image) % 8)
    words = ",".join(map(hex, np.frombuffer(padded, "<u8").tolist()))
    array = f"static const unsigned long long image[] = {{{words}}};\n"
    definitions = sizes(program, shared, per_run, CUDA)
    return "\n".join([definitions, array, header("frame.h"), header("launch.h")])


@CACHES.function(maxsize=64)
def kernel(program: Program, shared: int, per_run: int, architecture: str) -> str:
    """The name by which XLA knows the launcher of a program's kernel; compiles both if necessary.

    Args:
      program, shared, per_run: as `cpu.kernel`.
      architecture: of the GPU, as in "sm_90".

    Raises:
      ToolchainError: no NVRTC or no C++ compiler, or an error from one of them.
      UnsupportedError: an operation that C does not have.
    """
    image = nvrtc.compiled(source(program, shared, per_run, CUDA), architecture)
    library, key = built(launcher(program, shared, per_run, image))
    return register(f"iblf_jax_{key}", library, "iblf_jax_kernel", "CUDA")


def call(
    name: str,
    program: Program,
    shared: jax.Array,
    per_run: jax.Array,
    carry: Packed,
    steps: int,
    every: int | None,
    *,
    threads: int,
    table: int,
) -> tuple[Packed, list[jax.Array]]:
    """All steps of all runs by the launcher of a name.

    Args:
      name: of `kernel`.
      program, shared, per_run, carry, steps, every: as `cpu.run`.
      threads: number of threads of a block.
      table: steps of a launch, at most, for which signals are tabulated.

    Returns:
      The same as `cpu.run`.
    """
    layout = Layout.of(program)
    runs = carry.floats.shape[1]
    columns = CUDA.columns(program, len(layout.columns))
    table_rows = max(min(steps, table), 1)
    outputs = [
        *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry),
        jax.ShapeDtypeStruct((1, len(layout.constants)), program.dtype),
        jax.ShapeDtypeStruct((table_rows, columns), program.dtype),
        *record_shapes(program, runs, steps, every),
    ]
    floats, ints, _, _, *records = jax.ffi.ffi_call(name, outputs)(
        shared.reshape(1, -1),
        per_run,
        *carry,
        steps=np.int64(steps),
        every=np.int64(every or 0),
        threads=np.int64(threads),
    )
    return Packed(floats, ints), [x.reshape(len(x), -1, runs) for x in records]
