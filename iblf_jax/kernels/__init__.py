"""A compiler for time steps: from JAX to C for CPUs or CUDA for NVIDIA GPUs.

This package imports nothing else of iblf_jax. A step is a JAX function of four arguments that
computes one time step of one run: leaves that all runs share, leaves that differ between runs, the
leaves of the state that goes from step to step (the carry), and the number of the step. The
pipeline has three stages:

    jaxpr           JAX traces the step.
    scalar program  `compile_step` splits arrays into numbers (`from_jaxpr`), with one rule for each
                    primitive (`rules`, `structure`). It removes equal and unused numbers, folds
                    constants and simplifies (`identities`), calls long inner functions instead of
                    inlining them (`functions`), and replaces divisions by products (`passes`).
    C or CUDA       `emit_c` writes one statement for each number. It computes what only shared
                    leaves decide once, what time decides once per step, and the rest once per step
                    and run (`program`). Headers in `c/` define a number as a vector of runs on a
                    CPU, and as the number of one run on a GPU.

`cpu` compiles the C with the system's C++ compiler or, where there is none, with Clang from the
package `ziglang` (`toolchain`), and calls it from within jit. `cuda` does the same with NVRTC.
`enclosure` evaluates a function over boxes, by interval arithmetic with outward rounding.

The following step integrates x' = -k x by Euler's method with a step size of 0.1 s. The gain k is
shared, and nothing differs between runs but the state:

    >>> import jax.numpy as jnp
    >>> import numpy as np
    >>> from iblf_jax import kernels
    >>> def step(shared, per_run, carry, index):
    ...     (k,), (x,) = shared, carry
    ...     return [x - 0.1 * k * x], [x]
    >>> number = kernels.Shapes((((), np.dtype("float64")),))
    >>> nothing = kernels.Shapes(())
    >>> compiled = kernels.compile_step(step, np.dtype("float64"), number, nothing, number)
    >>> print(compiled.program.listing())
    n0 = carry 0
    n1 = shared 0
    n2 = const 0.1
    n3 = mul n1 n2
    n4 = mul n0 n3
    n5 = sub n0 n4
    carry 0: n5
    output 0: n0

The product 0.1 k is shared, so the generated C computes it once, in `shared_constants`; the loop
over the steps contains one product and one difference:

    >>> text = kernels.c_source(compiled.program, shared=1, per_run=0)
    >>> print(text[text.index("for (int step") : text.index("if (every")].rstrip())
    for (int step = 0; step < count; step++, row += COLUMNS) {
      F v4 = c0 * splat(constants[0].f);
      F v5 = c0 - v4;

Three runs from 1, 2 and 3 make ten steps, of which every fifth is recorded:

    >>> start = kernels.pack([jnp.array([1.0, 2.0, 3.0])], number, "float64", runs=3)
    >>> k = jnp.array([2.0])
    >>> end, (x,) = kernels.cpu.run(compiled.program, k, jnp.zeros((0, 3)), start, 10, every=5)
    >>> np.testing.assert_allclose(end.floats[0], 0.8**10 * np.array([1.0, 2.0, 3.0]))
    >>> x.shape
    (2, 1, 3)
"""

from iblf_jax.kernels import cpu as cpu
from iblf_jax.kernels import cuda as cuda
from iblf_jax.kernels import nvrtc as nvrtc
from iblf_jax.kernels.caches import CACHES as CACHES
from iblf_jax.kernels.compilation import CompiledStep as CompiledStep
from iblf_jax.kernels.compilation import compile_step as compile_step
from iblf_jax.kernels.compilation import scalar_program as scalar_program
from iblf_jax.kernels.compilation import without_garbage_collection as without_garbage_collection
from iblf_jax.kernels.cpu import Build as Build
from iblf_jax.kernels.cpu import c_source as c_source
from iblf_jax.kernels.drafts import draft as draft
from iblf_jax.kernels.emit_c import header as header
from iblf_jax.kernels.emit_c import plain_function as plain_function
from iblf_jax.kernels.enclosure import ENCLOSURE_FLAGS as ENCLOSURE_FLAGS
from iblf_jax.kernels.enclosure import IntervalKernel as IntervalKernel
from iblf_jax.kernels.enclosure import enclose as enclose
from iblf_jax.kernels.enclosure import interval_kernel as interval_kernel
from iblf_jax.kernels.enclosure import pointer as pointer
from iblf_jax.kernels.folder import cpuinfo as cpuinfo
from iblf_jax.kernels.folder import directory as directory
from iblf_jax.kernels.folder import processor as processor
from iblf_jax.kernels.folder import vector_bytes as vector_bytes
from iblf_jax.kernels.interval_primitives import hull as hull
from iblf_jax.kernels.interval_primitives import lower as lower
from iblf_jax.kernels.interval_primitives import meet as meet
from iblf_jax.kernels.interval_primitives import upper as upper
from iblf_jax.kernels.interval_primitives import with_sign as with_sign
from iblf_jax.kernels.messages import announce_if_slow as announce_if_slow
from iblf_jax.kernels.messages import has_reader as has_reader
from iblf_jax.kernels.messages import in_notebook as in_notebook
from iblf_jax.kernels.operations import OPERATIONS as OPERATIONS
from iblf_jax.kernels.packed import EMPTY as EMPTY
from iblf_jax.kernels.packed import Packed as Packed
from iblf_jax.kernels.packed import Shapes as Shapes
from iblf_jax.kernels.packed import pack as pack
from iblf_jax.kernels.packed import unpack as unpack
from iblf_jax.kernels.packed import unpacked_records as unpacked_records
from iblf_jax.kernels.passes import written_out as written_out
from iblf_jax.kernels.primitives import is_tracing as is_tracing
from iblf_jax.kernels.primitives import is_zero as is_zero
from iblf_jax.kernels.primitives import new_primitive as new_primitive
from iblf_jax.kernels.primitives import without_symbol as without_symbol
from iblf_jax.kernels.products import MIN_TERMS_OF_CALL as MIN_TERMS_OF_CALL
from iblf_jax.kernels.products import matmul_in_order as matmul_in_order
from iblf_jax.kernels.program import INPUTS as INPUTS
from iblf_jax.kernels.program import PER_RUN as PER_RUN
from iblf_jax.kernels.program import SHARED as SHARED
from iblf_jax.kernels.program import TIME as TIME
from iblf_jax.kernels.program import Known as Known
from iblf_jax.kernels.program import LoweringLimits as LoweringLimits
from iblf_jax.kernels.program import Program as Program
from iblf_jax.kernels.program import UnsupportedError as UnsupportedError
from iblf_jax.kernels.toolchain import StoppedError as StoppedError
from iblf_jax.kernels.toolchain import ToolchainError as ToolchainError
from iblf_jax.kernels.toolchain import built_for as built_for
from iblf_jax.kernels.toolchain import cache_path as cache_path
from iblf_jax.kernels.toolchain import cached_file as cached_file
from iblf_jax.kernels.toolchain import compiler as compiler
from iblf_jax.kernels.toolchain import compiler_key as compiler_key
from iblf_jax.kernels.toolchain import content_of as content_of
from iblf_jax.kernels.toolchain import has_ziglang as has_ziglang
from iblf_jax.kernels.toolchain import stop_compilers as stop_compilers
from iblf_jax.kernels.toolchain import stop_own_compilers as stop_own_compilers
from iblf_jax.kernels.toolchain import ziglang as ziglang
