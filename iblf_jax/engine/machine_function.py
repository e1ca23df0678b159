"""Machine functions: a time loop, or a piece of one, compiled as one function of the processor
instead of many of XLA's operations.

XLA dispatches every operation of a CPU loop by itself, which costs microseconds a step, more than
the arithmetic of a robot.  Two attributes on a call make it compile the whole callee as one
function: two to five times faster for one run and for small batches, with the same numbers.  The
attributes are XLA's own, and its CPU compiler fails on some operations inside such a function
(matrix products, calls into libraries) and on arrays large enough to be shared out over threads.
So the callee is traced first, and only what is known to work gets them.

The compiler's time grows faster than the length of a function.  A long loop (an arm of seven joints
has ten thousand operations an evaluation) is therefore not made one function but called piece by
piece: each piece is one function, and the loop around it XLA's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Jaxpr, jaxpr_as_fun, jaxprs_in_params

from iblf_jax.core import devices
from iblf_jax.engine import thresholds

REFUSED = frozenset(
    {
        "dot_general",
        "conv_general_dilated",
        "sort",
        "top_k",
        "fft",
        "scatter",
        "scatter-add",
        "custom_call",
        "ffi_call",
        "pure_callback",
        "io_callback",
        "debug_callback",
        "cholesky",
        "triangular_solve",
        "lu",
        "geqrf",
        "householder_product",
        "eigh",
        "eig",
        "svd",
        "schur",
    }
)
"""Operations that are not trusted inside: matrix products and decompositions become library calls,
the others were not needed.  Loops and branches are judged by what is in them."""

COPIES = frozenset(
    {
        "concatenate",
        "iota",
        "convert_element_type",
        "broadcast_in_dim",
        "reshape",
        "slice",
        "squeeze",
        "dynamic_update_slice",
    }
)
"""Operations that compute nothing; their size does not matter."""


def machine_function(function: Callable) -> Callable:
    """`function`, compiled as one machine function where that is known to work; else as it is.

    Args:
      function: pure function of pytrees of arrays.  Do not `vmap` the result: batch inside
        `function`, where its size is seen.
    """

    def traced(*args: Any) -> Any:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        call = jaxpr_as_fun(closed)
        operations = list(_operations(closed.jaxpr))
        if (
            thresholds.has_machine_functions(devices.platform())
            and len(operations) <= thresholds.LONGEST_FUNCTION
            and all(map(_is_trusted, operations))
        ):
            call = set_xla_metadata(inlineable="false", xla_cpu_small_call="true")(jax.jit(call))
        return jax.tree.unflatten(jax.tree.structure(shapes), call(*jax.tree.leaves(args)))

    return traced


def count_operations(function: Callable, *args: Any) -> int:
    """Number of operations of a function, those of its inner functions included."""
    return sum(1 for _ in _operations(jax.make_jaxpr(function)(*args).jaxpr))


def _operations(jaxpr: Jaxpr) -> Iterator[Any]:
    """Every operation of a jaxpr, those of its inner functions included."""
    for operation in jaxpr.eqns:
        bodies = list(jaxprs_in_params(operation.params))
        for body in bodies:
            yield from _operations(body)
        if not bodies:
            yield operation


def _is_trusted(operation: Any) -> bool:
    name = operation.primitive.name
    if name in REFUSED:
        return False
    if name.startswith(("reduce_", "arg")):
        return all(v.aval.size <= thresholds.LARGEST_REDUCED for v in operation.invars)
    computed = [
        v.aval for v in operation.outvars if jax.numpy.issubdtype(v.aval.dtype, jax.numpy.floating)
    ]
    return name in COPIES or all(aval.size <= thresholds.LARGEST_ARRAY for aval in computed)
