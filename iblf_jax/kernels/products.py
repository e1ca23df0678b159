"""Products of matrices, summed in the order of the terms.

XLA chooses the order of a reduction by the number of runs in the batch, so that its results depend
on that number.  Small products are therefore written out as sums.  Of larger ones XLA compiles
hundreds of terms, without optimisation for most of their time: on a CPU with a C++ compiler they
are calls of a function in C.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.kernels import cpu
from iblf_jax.kernels.primitives import is_zero, new_primitive, with_axis_first
from iblf_jax.kernels.toolchain import ToolchainError

MIN_TERMS_OF_CALL = 12
"""Terms of a sum from which on a product is called."""


@jax.jit
def written_out(left: jax.Array, right: jax.Array) -> jax.Array:
    """The product as a sum whose terms are written out and not a loop, because XLA then passes over
    the runs once and not once per term: the work before and after the steps of 4,096 runs of seven
    joints takes 0.33 s instead of 0.67 s.  JAX traces the terms once for all products of the same
    shapes.
    """
    # The first product is computed on its own. In a sum of two products a processor may round
    # either one, and a batch would differ from a single run.
    total = jax.lax.optimization_barrier(left[:, :1] * right[0])
    for k in range(1, len(right)):
        total = total + left[:, k, None] * right[k]
    return total


def _of_batches(left: jax.Array, right: jax.Array) -> jax.Array:
    return jnp.vectorize(written_out, signature="(m,n),(n,p)->(m,p)")(left, right)


def _shape_of_product(left: Any, right: Any) -> jax.core.ShapedArray:
    return jax.core.ShapedArray((*left.shape[:-1], right.shape[-1]), left.dtype)


def _by_compiler(left: jax.Array, right: jax.Array) -> jax.Array:
    try:
        name = cpu.array_function("multiply")
    except ToolchainError:
        return _of_batches(left, right)
    product = jax.ShapeDtypeStruct((*left.shape[:-1], right.shape[-1]), left.dtype)
    return jax.ffi.ffi_call(name, product)(left, right)  # type: ignore[no-any-return]


def _jvp(primals, tangents):
    product = _primitive.bind(*primals)
    pairs = [(tangents[0], primals[1]), (primals[0], tangents[1])]
    terms = [_of_batches(*pair) for pair in pairs if not any(map(is_zero, pair))]
    return product, sum(terms[1:], terms[0])


def _batch(operands, axes):
    return _primitive.bind(*with_axis_first(operands, axes)), 0


_primitive = new_primitive(
    "matmul_in_order",
    _of_batches,
    shapes=_shape_of_product,
    jvp=_jvp,
    batch=_batch,
    called=jax.jit(_of_batches),
    on_cpu=_by_compiler,
)


def matmul_in_order(left: jax.Array, right: jax.Array) -> jax.Array:
    """The product of matrices (m, n, ...) and (n, p, ...), (m, p, ...), summed in the order of the
    terms; further axes are those of runs.
    """
    if left.ndim > 2 or len(right) < MIN_TERMS_OF_CALL:
        return written_out(left, right)  # type: ignore[no-any-return]
    return _primitive.bind(left, right)  # type: ignore[no-any-return]
