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
from typing import Any

import jax
import numpy as np

from iblf_jax.kernels import jaxprs


class CallsPythonError(ValueError):
    """A program calls functions of Python while it runs."""


def program_digest(traced: Any) -> str:
    """The digest of a traced function, 64 hexadecimal digits.

    Args:
      traced: result of `jax.jit(f).trace(...)`.

    Raises:
      CallsPythonError: the program contains a callback.
    """
    primitives = jaxprs.primitives(traced.jaxpr)
    callbacks = sorted(x for x in primitives if "callback" in x or x == "debug_print")
    if callbacks:
        raise CallsPythonError(callbacks[0])
    found = hashlib.sha256()
    hash_constants(found, traced.jaxpr)
    found.update(traced.lower().as_text().encode())
    return found.hexdigest()


def hash_constants(found: Any, function: Any) -> None:
    """Adds all constants and literals of a jaxpr, and of the functions in it, to a hash."""
    for constant in jaxprs.constants(function):
        array = _numbers(constant)
        found.update(f"{array.dtype} {array.shape} ".encode() + array.tobytes())


def _numbers(constant: object) -> np.ndarray:
    """A constant as an array of NumPy; of a key of random numbers, its data."""
    if isinstance(constant, jax.Array) and jax.dtypes.issubdtype(
        constant.dtype, jax.dtypes.prng_key
    ):
        constant = jax.random.key_data(constant)
    return np.asarray(constant)
