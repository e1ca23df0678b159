"""A digest of a compiled program, for what is continued in another process: stores of sweeps and
checkpoints of tunings.

Two programs with one digest compute the same numbers from the same arguments.  The digest is that
of the text of StableHLO, from which XLA compiles, and of the arrays that JAX keeps beside this
text.  Names of classes, addresses and the text of a jaxpr, which prints no array, are no part of
it.  A program that calls functions of Python while it runs has no digest, because no text holds
what these functions compute.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jax.extend import core


class CallsPythonError(ValueError):
    """A program calls functions of Python while it runs."""


def program_digest(traced: Any) -> str:
    """The digest of a traced function, 64 hexadecimal digits.

    Args:
      traced: result of `jax.jit(f).trace(...)`.

    Raises:
      CallsPythonError: the program contains a callback.
    """
    found = hashlib.sha256()
    for jaxpr in _jaxprs(traced.jaxpr):
        for equation in jaxpr.eqns:
            if "callback" in equation.primitive.name:
                raise CallsPythonError(equation.primitive.name)
        for array in _arrays(jaxpr):
            found.update(f"{array.dtype} {array.shape} ".encode() + array.tobytes())
    found.update(traced.lower().as_text().encode())
    return found.hexdigest()


def _jaxprs(jaxpr: Any) -> Iterator[Any]:
    """A jaxpr and all jaxprs inside it, each time that one occurs."""
    yield jaxpr
    # Before JAX 0.11, a closed jaxpr holds an open one; from 0.11 on, they are one class.
    for equation in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        for inner in core.jaxprs_in_params(equation.params):
            yield from _jaxprs(inner)


def _arrays(jaxpr: Any) -> Iterator[np.ndarray]:
    """The constants and the literals of a jaxpr."""
    yield from map(_numbers, getattr(jaxpr, "consts", ()))
    for equation in jaxpr.eqns:
        yield from (_numbers(x.val) for x in equation.invars if isinstance(x, core.Literal))


def _numbers(constant: Any) -> np.ndarray:
    """A constant as an array of NumPy; of a key of random numbers, its data."""
    if isinstance(constant, jax.Array) and jax.dtypes.issubdtype(
        constant.dtype, jax.dtypes.prng_key
    ):
        constant = jax.random.key_data(constant)
    return np.asarray(constant)
