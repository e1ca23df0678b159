"""Host-side checks: each failure is a ValueError that names the field, what came, what was expected, and the mend.

Values that JAX is tracing have no number yet; every check passes them by, so the same constructors and entry
points work under `jit`, `vmap` and `grad`.  What can only be known inside a run is in `status`, not here.
"""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

MOST_STEPS = 2**31 - 1
"""Steps are counted in int32 inside the compiled loop."""

LIMITS = ("limit", "positive limit")
"""Signs of leaves that may be infinite."""


def is_concrete(value: Any) -> bool:
    """Whether every leaf of `value` is a number now, rather than a tracer or a placeholder."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))


def fail(field: str, got: Any, expected: str, mend: str = "") -> ValueError:
    """The one form of error message: field, value, expectation and mend."""
    if not is_concrete(got):
        shown = "a value that JAX is tracing"
    elif isinstance(got, jax.Array | np.ndarray):
        shown = np.array2string(np.asarray(got), precision=6, threshold=8)
    else:
        shown = repr(got.item() if isinstance(got, np.generic) else got)
    if len(shown) > 160:
        shown = shown[:157] + "..."
    return ValueError(f"{field}: got {shown}, expected {expected}." + (f" {mend}" if mend else ""))


def _is_number_like(value: Any) -> bool:
    if isinstance(value, numbers.Number | np.ndarray | np.generic | jax.Array):
        return True
    return isinstance(value, list | tuple) and all(_is_number_like(x) for x in value)


def as_leaf(owner: str, field: dataclasses.Field, value: Any) -> Any:
    """Converts what a person typed for a leaf field to a floating-point array and checks it.

    A field that was not declared with `leaf` is converted too if it holds numbers, and is otherwise left alone
    (it is another component).
    """
    declared = field.metadata.get("leaf", False)
    name = f"{owner}.{field.name}"
    if value is None:
        if field.default is not None:
            raise fail(name, value, "a number or an array of numbers" if declared else "a component")
        return None
    if isinstance(value, tuple | list) and len(value) == 0 and not declared:
        return tuple(value)
    if not _is_number_like(value):
        if declared:
            raise fail(name, value, "a number or an array of numbers")
        return value
    array = as_floats(name, value)
    if declared:
        if field.metadata["shape"] == "scalar" and array.ndim != 0:
            raise fail(name, value, "one number", f"Its shape is {array.shape}.")
        if field.metadata["shape"] == "joint" and array.ndim > 1:
            raise fail(name, value, "one number, or one a joint, (n,)", f"Its shape is {array.shape}.")
    check_values(name, array, field.metadata.get("sign"))
    return array


def as_floats(name: str, value: Any) -> jax.Array:
    """An array of floating-point numbers, or a ValueError that names the field."""
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise fail(name, value, "numbers in a rectangular array") from error
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    if jnp.issubdtype(array.dtype, jnp.integer):
        return array.astype(jnp.result_type(float))
    raise fail(name, value, "real numbers", f"Its type is {array.dtype}.")


def check_values(name: str, array: Any, sign: str | None) -> None:
    """Raises if a concrete array has a NaN, an infinity or a number of the wrong sign."""
    if array is None or not is_concrete(array):
        return
    values = np.asarray(array)
    if sign in LIMITS and np.any(np.isnan(values)):
        raise fail(name, array, "numbers, infinite where there is no limit", "Replace the NaN entries.")
    if sign not in LIMITS and not np.all(np.isfinite(values)):
        raise fail(name, array, "finite numbers", "Replace the NaN or infinite entries.")
    if sign in ("positive", "positive limit") and not np.all(values > 0):
        raise fail(name, array, "numbers > 0", "Give positive values.")
    if sign == "nonnegative" and not np.all(values >= 0):
        raise fail(name, array, "numbers >= 0", "Give non-negative values.")


def structural(owner: str, name: str, value: Any) -> None:
    """Raises if a static field holds something that cannot be part of a compiled program's identity."""
    if isinstance(value, jax.Array | np.ndarray) or not isinstance(value, Hashable):
        raise fail(
            f"{owner}.{name}", value, "a hashable value", "It is a structural field: give a number, a string or a tuple, not an array."
        )
    try:
        hash(value)
    except TypeError as error:
        raise fail(f"{owner}.{name}", value, "a hashable value", "Give a tuple in place of a list.") from error


def one_of(name: str, value: Any, allowed: Any) -> None:
    """Raises if `value` is not one of the allowed words."""
    if not isinstance(value, str) or value not in allowed:
        raise fail(name, value, "one of " + ", ".join(repr(x) for x in allowed))


def conforms(name: str, value: Any, protocol: type, mend: str = "", optional: tuple[str, ...] = ()) -> None:
    """Raises unless `value` is an object that JAX can take apart and that has what `protocol` asks for, except `optional`."""
    members = {x for x in (*vars(protocol), *getattr(protocol, "__annotations__", {})) if not x.startswith("_")}
    expected = f"a component that fits {protocol.__module__.removesuffix('._base')}.{protocol.__name__}"
    if isinstance(value, type):
        raise fail(name, value, expected, "It is a class: make an instance, with brackets.")
    bare = value is None or isinstance(value, str | bytes | tuple | list | dict | jax.Array | np.ndarray) or _is_number_like(value)
    missing = sorted(x for x in members - set(optional) if bare or not hasattr(value, x))
    if bare or missing:
        raise fail(name, value, expected, " ".join(x for x in (mend, "" if bare else f"It lacks {', '.join(missing)}.") if x))
    if any(leaf is value for leaf in jax.tree.leaves(value)):
        raise fail(name, value, expected, "JAX does not know its class: decorate it with iblf_jax.component.")


def shape_is(name: str, array: Any, shape: tuple[int, ...]) -> None:
    """Raises if an array has another shape."""
    if jnp.shape(array) != shape:
        raise fail(name, array, f"shape {shape}", f"Its shape is {jnp.shape(array)}.")


def positive_number(name: str, value: Any, unit: str) -> float:
    """A finite positive Python float from a user's argument, or a ValueError."""
    if isinstance(value, jax.core.Tracer):
        mend = "It decides how many steps are compiled: use a Python number, or static_argnames in your jit."
        raise fail(name, value, f"a positive number [{unit}]", mend)
    array_like = isinstance(value, np.generic | np.ndarray | jax.Array)
    if isinstance(value, bool) or not (array_like or isinstance(value, numbers.Real)):
        raise fail(name, value, f"a positive number [{unit}]")
    if array_like and (value.ndim != 0 or value.dtype.kind not in "fiu"):
        raise fail(name, value, f"a positive number [{unit}]")
    try:
        number = float(value)
    except OverflowError:
        number = float("inf")
    if not np.isfinite(number) or number <= 0:
        raise fail(name, value, f"a positive number [{unit}]")
    return number


def positive_integer(name: str, value: Any) -> int:
    """A positive Python int from a user's argument, or a ValueError."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Integral):
        raise fail(name, value, "a whole number >= 1")
    if value < 1:
        raise fail(name, value, "a whole number >= 1")
    return int(value)


def whole_steps(duration: Any, dt: Any) -> int:
    """The number of steps of size `dt` in `duration`, or a ValueError that says which duration would do."""
    duration = positive_number("duration", duration, "s")
    dt = positive_number("dt", dt, "s")
    if not duration / dt <= MOST_STEPS:
        raise fail("duration", duration, f"at most {MOST_STEPS} steps dt = {dt:g} s", "Shorten the run or take a larger dt.")
    steps = round(duration / dt)
    # A thousandth of a step is forgiven, so that a duration that has been through float32 is taken for what it was.
    if steps < 1 or abs(steps * dt - duration) > 1e-3 * dt + 1e-12 * duration:
        near = max(steps, 1)
        raise fail(
            "duration", duration, f"a whole number of steps dt = {dt:g} s", f"Take duration={near * dt:.12g} or dt={duration / near:.12g}."
        )
    return steps
