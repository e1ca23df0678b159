"""Scalar programs that are kept on the disk: what another process has lowered is read.

To lower a step of an arm of six joints takes 1.3 s, to read its program 0.05 s.  The key of a
program is a digest of everything that the lowering reads: the jaxpr with its constants, the
arguments of `compile_step`, and the source of this package.  The file is one of the cache of
kernels (`toolchain.cached_file`), which are executed like a program's own code: a file that does
not match its digest is not read.
"""

from __future__ import annotations

import enum
import hashlib
import pickle
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.extend import core

from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.program import Program
from iblf_jax.kernels.toolchain import ToolchainError, cache_path, cached_file, content_of

SUFFIX = ".program"
MIN_NODES = 2000
"""Nodes of the smallest program that is kept: smaller ones are lowered in less than 0.2 s."""


class _UnknownError(Exception):
    """A parameter of a primitive has a type that has no canonical text."""


def kept_program(
    jaxpr: Any, parameters: dict[str, Callable], arguments: tuple, lower: Callable[[], Program]
) -> Program:
    """The program that `lower` returns for a jaxpr, from the disk if it is kept there.

    Args:
      jaxpr: the closed jaxpr of the step.
      parameters: primitive -> function (equation's parameters) -> those that the lowering reads;
        of all other primitives it may read every parameter.
      arguments: everything else that the lowering reads; its `repr` is exact.
      lower: function without arguments.
    """
    try:
        content = [_digest(jaxpr, parameters), repr(arguments), _this_package()]
        path = cache_path(content, SUFFIX)
    except (_UnknownError, ToolchainError):
        return lower()
    program = _read(path)
    if program is None:
        program = lower()
        if program.size >= MIN_NODES:
            _keep(content, program)
    return program


def _read(path: Path) -> Program | None:
    """The program in a file; None if there is none."""
    try:
        return pickle.loads(content_of(path))
    except (ToolchainError, pickle.UnpicklingError, EOFError, AttributeError, TypeError):
        return None


def _keep(content: list[str], program: Program) -> None:
    """Writes a program to the disk if there is a place for it."""
    try:
        cached_file(content, SUFFIX, lambda path: path.write_bytes(pickle.dumps(program)))
    except ToolchainError:  # The kernel, which has the same folder, gives the warning.
        return


@CACHES.function(maxsize=1)
def _this_package() -> str:
    """A digest of the modules of this package, and the versions of what they use."""
    sources = [file for file in files("iblf_jax.kernels").iterdir() if file.name.endswith(".py")]
    found = hashlib.sha256()
    for file in sorted(sources, key=lambda file: file.name):
        found.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return f"{found.hexdigest()} {sys.version} {np.__version__} {jax.__version__}"


def _digest(jaxpr: Any, parameters: dict[str, Callable]) -> str:
    """A digest of a jaxpr and of the values of its constants."""
    writer = _Writer(parameters)
    writer.write(jaxpr)
    return hashlib.sha256("\n".join(writer.lines).encode()).hexdigest()


class _Writer:
    """Writes a jaxpr as text.  Two jaxprs have the same text only if the lowering cannot tell one
    from the other.

    The lowering reads an inner jaxpr that several equations share only once.  The text of such a
    jaxpr is therefore written where it occurs first, and its number afterwards.
    """

    def __init__(self, parameters: dict[str, Callable]) -> None:
        self.lines: list[str] = []
        self._parameters = parameters
        self._numbers: dict[int, int] = {}

    def write(self, value: Any) -> None:
        """Adds the text of a value."""
        if isinstance(value, core.Jaxpr | core.ClosedJaxpr):
            self._write_once(value)
        elif isinstance(value, np.ndarray | np.generic | jax.Array):
            if jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended):
                raise _UnknownError  # a key of random numbers
            array = np.asarray(value)
            self.lines.append(f"{array.dtype} {array.shape} {array.tobytes().hex()}")
        elif isinstance(value, tuple | list):
            self.lines.append(f"{type(value).__name__} of {len(value)}")
            for entry in value:
                self.write(entry)
        elif isinstance(value, dict):
            self.write(tuple(sorted(value.items())))
        elif isinstance(value, None | bool | int | float | str | np.dtype | enum.Enum | type):
            self.lines.append(repr(value))
        else:
            raise _UnknownError

    def _write_once(self, jaxpr: Any) -> None:
        """Adds the text of a jaxpr, or its number if it has been written."""
        number = self._numbers.get(id(jaxpr))
        if number is not None:
            self.lines.append(f"jaxpr {number}")
            return
        self._numbers[id(jaxpr)] = len(self._numbers)
        self.lines.append(type(jaxpr).__name__)
        if isinstance(jaxpr, core.ClosedJaxpr):
            self.write(tuple(jaxpr.consts))
            self._write_once(jaxpr.jaxpr)
            return
        names: dict[Any, str] = {}
        self.lines.append(_declared([*jaxpr.constvars, *jaxpr.invars], names))
        for equation in jaxpr.eqns:
            name = equation.primitive.name
            read = " ".join(_atom(x, names) for x in equation.invars)
            self.lines.append(f"{_declared(equation.outvars, names)} = {name} {read}")
            of_lowering = self._parameters.get(name)
            self.write(of_lowering(equation.params) if of_lowering else equation.params)
        self.lines.append(" ".join(_atom(x, names) for x in jaxpr.outvars))


def _declared(variables: Any, names: dict[Any, str]) -> str:
    """New variables as text; `names` receives them."""
    texts = []
    for variable in variables:
        if not isinstance(variable.aval, jax.core.ShapedArray):
            raise _UnknownError
        names[variable] = f"v{len(names)}"
        texts.append(f"{names[variable]}:{variable.aval.dtype}{variable.aval.shape}")
    return " ".join(texts)


def _atom(atom: Any, names: dict[Any, str]) -> str:
    """A variable or a literal as text."""
    if not isinstance(atom, core.Literal):
        return names[atom]
    array = np.asarray(atom.val)
    return f"{array.dtype}{array.shape}:{array.tobytes().hex()}"
