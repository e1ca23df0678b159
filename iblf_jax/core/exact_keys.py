"""Exact keys of static values, functions and classes.

JAX keeps a compiled program for each structure, and compares structures by `==`.  That is too
coarse: 1 == 1.0 == True, 0.0 == -0.0, and a function equals itself after what it captures has
changed.  `exact_key` returns a hashable value that differs where two values can make two programs.

A key holds of

- a number, a string, a tuple: its type and its value, zeros with their sign;
- a function: its code, its default values, the values that it captures, and the global variables
  that it names; functions of the same module are followed, those of installed packages are not;
- an array of NumPy: type, shape and content;
- everything else: its identity, with a reference, so that no other object gets the same address.

Not detected, as in `jax.jit`: what changes inside a list, a dict or an object that a function
captures, attributes of modules, and methods of this package that a user replaces.
"""

from __future__ import annotations

import dataclasses
import functools
import types
from collections.abc import Hashable, Iterator
from typing import Any

import jax
import numpy as np

CUSTOM_RULES = (jax.custom_jvp, jax.custom_vjp)
PLAIN_TYPES = (int, bool, str, bytes, types.NoneType)
"""Types whose values are equal only if they are the same to a program, given their type."""


class Identity:
    """An object, compared by identity."""

    __slots__ = ("value",)

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Identity) and self.value is other.value

    def __hash__(self) -> int:
        return object.__hash__(self.value)


def exact_key(value: Any) -> Hashable:
    """The key of a static value (head of this module)."""
    return _key(value, None, ())


def _key(value: Any, module: str | None, inside: tuple[int, ...]) -> Hashable:
    """The key of a value.

    Args:
      value: what is described.
      module: the module whose functions are followed; None for any.
      inside: identities of the functions whose description contains this one.
    """
    kind = type(value)
    if kind in PLAIN_TYPES:
        return kind, value
    if kind is float:
        return kind, value.hex()
    if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
        return kind, value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, tuple):
        return kind, tuple([_key(x, module, inside) for x in value])
    if isinstance(value, types.FunctionType):
        return _key_of_function(value, module, inside)
    if isinstance(value, types.MethodType):
        return kind, Identity(value.__self__), _key(value.__func__, module, inside)
    if isinstance(value, functools.partial):
        parts = (value.func, value.args, tuple(sorted(value.keywords.items())))
        return kind, _key(parts, module, inside)
    if isinstance(value, CUSTOM_RULES):
        rules = [x for x in vars(value).values() if isinstance(x, types.FunctionType)]
        return Identity(value), _key(tuple(rules), module, inside)
    if isinstance(value, type) or not _has_value(value):
        return Identity(value)
    if dataclasses.is_dataclass(value):
        fields = [getattr(value, field.name) for field in dataclasses.fields(value)]
        return kind, _key(tuple(fields), module, inside)
    return kind, value


def is_settled(value: Any) -> bool:
    """Whether the key of a static value is the same for as long as the value exists: the value
    consists of numbers, strings and classes, in tuples.
    """
    if isinstance(value, tuple):
        return all(map(is_settled, value))
    return isinstance(value, (*PLAIN_TYPES, float, type))


def _has_value(value: Any) -> bool:
    """Whether an object is hashable and compared by more than its identity."""
    kind = type(value)
    return kind.__hash__ not in (None, object.__hash__) and kind.__eq__ is not object.__eq__


def _key_of_function(
    function: types.FunctionType, module: str | None, inside: tuple[int, ...]
) -> Hashable:
    """The key of a function of Python."""
    home = function.__module__ or ""
    is_foreign = module not in (None, home) or is_of_a_library(home)
    if is_foreign or id(function) in inside or _is_installed(function):
        return Identity(function)
    within = (*inside, id(function))
    defaults = (function.__defaults__, tuple(sorted((function.__kwdefaults__ or {}).items())))
    captured = tuple([_cell(cell) for cell in function.__closure__ or ()])
    read = tuple(_globals_of(function))
    return (
        Identity(function),
        function.__code__,
        *[_key(part, home, within) for part in (defaults, captured, read)],
    )


def _is_installed(function: types.FunctionType) -> bool:
    """Whether a function belongs to an installed package, whose code a process does not change."""
    return "-packages" in function.__code__.co_filename


def _cell(cell: types.CellType) -> Any:
    """What a cell of a closure holds; the cell itself while it holds nothing."""
    try:
        return cell.cell_contents
    except ValueError:
        return cell


def _globals_of(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """The global variables that a function names, other than modules."""
    known = function.__globals__
    for name in _names_of(function.__code__):
        if name in known and not isinstance(known[name], types.ModuleType):
            yield name, known[name]


def _names_of(code: types.CodeType) -> Iterator[str]:
    """The names that are not local in a code and in the functions that are defined in it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names_of(constant)


def is_of_a_library(module: str) -> bool:
    """Whether a module belongs to this package or to JAX."""
    return module.partition(".")[0] in ("iblf_jax", "jax", "jaxlib")


def behaviour_of(cls: type) -> Hashable:
    """The key of the attributes of a user's class and of its bases; None for a class of the
    package.
    """
    parts = []
    for base in cls.__mro__:
        if base is object or is_of_a_library(base.__module__):
            continue
        for name, value in vars(base).items():
            if name.startswith("__") and name != "__call__":
                continue
            parts.append((name, exact_key(_function_in(value))))
    return tuple(parts) or None


def _function_in(attribute: Any) -> Any:
    """The functions of an attribute of a class."""
    if isinstance(attribute, staticmethod | classmethod):
        return attribute.__func__
    if isinstance(attribute, property):
        return attribute.fget
    return attribute
