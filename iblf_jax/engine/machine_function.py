"""Machine functions: XLA compiles a time loop, or a part of one, as one function of the processor.

In a loop on the CPU, XLA dispatches every operation separately.  This costs microseconds per step,
more than the arithmetic of a robot.  Two attributes of a call make XLA compile the complete callee
as one function, which is two to five times faster for one run and for small batches, with the same
numbers.  XLA's CPU compiler fails on some operations in such a function (matrix products, calls of
libraries) and on arrays so large that it divides them among threads.  Therefore the callee is
traced first, and the attributes are set only if all of its operations are known to work.

Compilation time grows faster than the length of a function.  A long time loop (an evaluation of an
arm of seven joints has ten thousand operations) is therefore compiled in parts: each part is a
machine function, and XLA's own loop calls them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
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
"""Operations that a machine function may not contain.  Matrix products and decompositions become
library calls; the others are not needed.  A loop or a branch is allowed if its operations are."""

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
"""Operations that only move or convert data; their size is not limited."""


def machine_function(function: Callable) -> Callable:
    """`function` as one machine function if that is known to work, and unchanged otherwise.

    Args:
      function: pure function of pytrees of arrays.  Do not `vmap` the result; apply `vmap` within
        `function`, so that the sizes of its arrays are known.
    """

    def traced(*args: Any) -> Any:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        call = jaxpr_as_fun(closed)
        operations = list(_operations(closed.jaxpr))
        if (
            thresholds.has_machine_functions(devices.platform())
            and len(operations) <= thresholds.MAX_FUNCTION_OPERATIONS
            and all(map(_is_allowed, operations))
        ):
            call = set_xla_metadata(inlineable="false", xla_cpu_small_call="true")(jax.jit(call))
        return jax.tree.unflatten(jax.tree.structure(shapes), call(*jax.tree.leaves(args)))

    return traced


def count_operations(function: Callable, *args: Any) -> int:
    """Number of operations of a function, including those of its inner functions."""
    return sum(1 for _ in _operations(jax.make_jaxpr(function)(*args).jaxpr))


def _operations(jaxpr: Jaxpr) -> Iterator[Any]:
    """The operations of a jaxpr, including those of its inner functions."""
    for operation in jaxpr.eqns:
        bodies = list(jaxprs_in_params(operation.params))
        for body in bodies:
            yield from _operations(body)
        if not bodies:
            yield operation


def _is_allowed(operation: Any) -> bool:
    """Whether a machine function may contain an operation."""
    name = operation.primitive.name
    if name in REFUSED:
        return False
    if name in COPIES:
        return True
    if name.startswith(("reduce_", "arg")):
        return all(v.aval.size <= thresholds.LARGEST_REDUCED for v in operation.invars)
    outputs = [v.aval for v in operation.outvars]
    return all(
        x.size <= thresholds.LARGEST_ARRAY or not jnp.issubdtype(x.dtype, jnp.floating)
        for x in outputs
    )
