"""The gpu executor: a whole rollout in one CUDA kernel, one run a thread, its numbers in registers.

The kernel is the C that `native` has, from the same emitter, in which a name stands for one run's
number rather than for a vector of runs.  NVRTC compiles it for the GPU at hand; the system's C++
compiler builds the few lines that launch it from within jit (`c/launch.h`), so neither nvcc nor
CUDA's headers are needed.  Long rollouts are launched in stretches of steps, whose signals of time
another kernel tabulates first.

The tests run on a GPU where there is one; elsewhere the same source and the same launcher run on a
CPU, against a driver that loops over the threads, and are compiled for GPUs where NVRTC is
installed.
"""

from __future__ import annotations

import re
from functools import lru_cache

import jax
import numpy as np

from iblf_jax.core import devices
from iblf_jax.engine import plan
from iblf_jax.kernels import nvrtc
from iblf_jax.kernels.emit_c import CUDA, header, sizes, source
from iblf_jax.kernels.layout import Layout
from iblf_jax.kernels.packed import Packed, record_shapes
from iblf_jax.kernels.program import Program
from iblf_jax.kernels.toolchain import ToolchainError, built, compiler, loaded

_registered: set[str] = set()


def architecture() -> str:
    """What NVRTC calls this process's GPUs, as in "sm_90"; ToolchainError if they are none that it
    can compile for.
    """
    places = devices.default()
    found = {str(getattr(device, "compute_capability", "")) for device in places}
    if len(found) > 1:
        raise ToolchainError(f"the GPUs differ: compute capabilities {', '.join(sorted(found))}")
    match = re.fullmatch(r"(\d+)\.(\d)", found.pop())
    if not match:
        raise ToolchainError(f"it needs an NVIDIA GPU, not {places[0].device_kind}")
    return f"sm_{match[1]}{match[2]}"


def unavailable() -> str | None:
    """Why this process cannot run it, in one line, or None if it can."""
    try:
        architecture()
        nvrtc.library()
        compiler()
    except ToolchainError as error:
        return str(error)
    return None


def launcher(program: Program, shared: int, lane: int, image: bytes) -> str:
    """The C source that launches a kernel.

    Args:
      program: what a step does.
      shared, lane: how many numbers of each kind of leaf go in.
      image: the kernel's machine code.
    """
    padded = image + bytes(-len(image) % 8)
    words = ",".join(map(hex, np.frombuffer(padded, "<u8").tolist()))
    array = f"static const unsigned long long image[] = {{{words}}};\n"
    return "\n".join([sizes(program, shared, lane), array, header("frame.h"), header("launch.h")])


@lru_cache(maxsize=64)
def kernel(program: Program, shared: int, lane: int, target: str) -> str:
    """The name under which the launcher of a program's kernel is registered; builds both if need
    be.

    Args:
      program: what a step does.
      shared, lane: how many numbers of each kind of leaf go in.
      target: as in "sm_90".

    Raises:
      ToolchainError: no NVRTC or no C++ compiler, or an error from one of them.
      UnsupportedError: an operation that C has no word for.
    """
    image = nvrtc.compiled(source(program, shared, lane, CUDA), target)
    library, key = built(launcher(program, shared, lane, image))
    name = f"iblf_jax_{key}"
    if name not in _registered:
        jax.ffi.register_ffi_target(
            name,
            jax.ffi.pycapsule(loaded(library, "iblf_jax_kernel").iblf_jax_kernel),
            platform="CUDA",
        )
        _registered.add(name)
    return name


def call(
    name: str,
    program: Program,
    shared: jax.Array,
    lane: jax.Array,
    carry: Packed,
    steps: int,
    every: int | None,
    threads: int,
):
    """`run` by the launcher of a name, with so many threads in a block."""
    layout = Layout.of(program)
    runs = carry.floats.shape[1]
    room = [(1, len(layout.constants)), (max(min(steps, plan.GPU_STRETCH), 1), len(layout.columns))]
    outputs = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry] + [
        jax.ShapeDtypeStruct(shape, program.dtype) for shape in room
    ]
    outputs += record_shapes(program, runs, steps, every)
    attributes = {
        "steps": np.int64(steps),
        "every": np.int64(every or 0),
        "threads": np.int64(threads),
    }
    floats, ints, _, _, *records = jax.ffi.ffi_call(name, outputs)(
        shared.reshape(1, -1), lane, *carry, **attributes
    )
    return Packed(floats, ints), [x.reshape(len(x), -1, runs) for x in records]


def run(
    program: Program,
    shared: jax.Array,
    lane: jax.Array,
    carry: Packed,
    steps: int,
    every: int | None,
) -> tuple[Packed, list[jax.Array]]:
    """All steps of all runs; arguments and results as `native.run`."""
    name = kernel(program, shared.size, lane.shape[0], architecture())
    processors = getattr(devices.default()[0], "core_count", plan.GPU_PROCESSORS)
    return call(
        name,
        program,
        shared,
        lane,
        carry,
        steps,
        every,
        plan.gpu_threads(carry.floats.shape[1], processors),
    )


def build(program: Program, shared: int, per_run: int, runs: int, steps: int) -> None:
    """Compiles the kernel of `run`, which serves any number of runs and steps; see `kernel`."""
    kernel(program, shared, per_run, architecture())
