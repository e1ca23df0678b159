"""Primitives of our own: the only module that knows how JAX registers one and its rules."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def new_primitive(
    name: str,
    evaluate: Callable,
    *,
    shapes: Callable,
    jvp: Callable,
    batch: Callable,
    transpose: Callable | None = None,
    called: Callable | None = None,
    on_cpu: Callable | None = None,
    several_results: bool = False,
) -> Primitive:
    """A primitive with its rules, which receive its parameters by name.

    Args:
      name: its name in a jaxpr.
      evaluate: function (operands) -> result, as JAX traces it.
      shapes: function (operands) -> the shape and type of the result, or a list of them.
      jvp: function (primals, tangents) -> (result, its tangent).
      batch: function (operands, axes) -> (result, its axis).
      transpose: function (cotangents, operands) -> the cotangent of each operand; None for a
        primitive that is not linear.
      called: `evaluate` as it runs outside of a trace, if that is another function.
      on_cpu: `evaluate` in programs for a CPU, if that is another function.
      several_results: whether results, tangents and axes are lists.
    """
    primitive = Primitive(name)
    primitive.multiple_results = several_results
    primitive.def_impl(called or evaluate)
    primitive.def_abstract_eval(shapes)
    lowering = mlir.lower_fun(evaluate, multiple_results=several_results)
    mlir.register_lowering(primitive, lowering)
    if on_cpu is not None:
        lowering = mlir.lower_fun(on_cpu, multiple_results=several_results)
        mlir.register_lowering(primitive, lowering, platform="cpu")
    ad.primitive_jvps[primitive] = jvp
    batching.primitive_batchers[primitive] = batch
    if transpose is not None:
        ad.primitive_transposes[primitive] = transpose
    return primitive


_probe = Primitive("probe")
_probe.def_impl(lambda: None)
_probe.def_abstract_eval(lambda: jax.core.ShapedArray((), np.bool_))
mlir.register_lowering(_probe, mlir.lower_fun(lambda: jnp.zeros((), bool), multiple_results=False))


def is_tracing() -> bool:
    """Whether JAX traces the code that calls this into a program."""
    return _probe.bind() is not None


def with_axis_first(operands: Sequence[jax.Array], axes: Sequence[int | None]) -> list[jax.Array]:
    """Operands of a batch with its axis as the first one of each; `axes` are their own, None where
    an operand has no such axis.
    """
    size = next(x.shape[a] for x, a in zip(operands, axes, strict=True) if a is not None)
    return [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands, axes, strict=True)
    ]


def is_zero(tangent: object) -> bool:
    """Whether a tangent or a cotangent is the symbol of zeros."""
    return isinstance(tangent, ad.Zero)


def without_symbol(tangent: Any) -> jax.Array:
    """A tangent as an array."""
    return ad.instantiate_zeros(tangent)  # type: ignore[no-any-return]
