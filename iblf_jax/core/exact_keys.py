"""Exact keys of static values, functions and classes.

JAX keeps a compiled program for each structure, and compares structures by `==`.  That is too
coarse: 1 == 1.0 == True, 0.0 == -0.0, and a function equals itself after what it captures has
changed.  `exact_key` returns a hashable value that differs where two values can make two programs.

A key holds of

- a number, a string, a tuple, a frozenset, a frozen dataclass: its type and its value, zeros with
  their sign;
- a function: its code, its default values, the values that it captures, and the global variables
  that it names; functions of the same module are followed, and what functions of installed packages
  wrap, such as that of `jax.vmap`;
- an array of NumPy: type, shape and content;
- everything else: its identity, with a reference, so that no other object gets the same address.

Not detected, as in `jax.jit`: what changes inside a list, a dict or an object that a function
captures, attributes of modules and of functions, functions of other modules of the user, modules of
other libraries in fields of components, and methods of this package that a user replaces.
"""

from __future__ import annotations

import dataclasses
import functools
import marshal
import site
import sysconfig
import types
from collections.abc import Hashable, Iterator
from typing import Any

import jax
import numpy as np

CUSTOM_RULES = (jax.custom_jvp, jax.custom_vjp)
PLAIN_TYPES = (int, str, bytes, types.NoneType, np.dtype)
"""Types whose values are equal only if they are the same to a program, given their class."""
MARSHALLED = frozenset((bool, int, float, str, bytes, types.NoneType))
MARSHAL_VERSION = 2
"""Later formats depend on how often an object is referenced; earlier ones write floats as text."""
NOT_BEHAVIOUR = {
    *("__module__", "__qualname__", "__doc__", "__dict__", "__weakref__", "__annotations__"),
    *("__firstlineno__", "__static_attributes__"),
    # of abstract base classes
    *("_abc_impl", "__abstractmethods__"),
    # of dataclasses
    *("__dataclass_fields__", "__dataclass_params__", "__match_args__", "__init__", "__repr__"),
    *("__setattr__", "__delattr__", "__replace__"),
    # of components
    "__behaviour__",
}
"""Attributes of a class that no program depends on."""
INSTALLED = (
    *(sysconfig.get_path(name) for name in ("purelib", "platlib", "stdlib")),
    site.getusersitepackages(),
)
"""Folders of installed packages, whose code a process does not change."""


class Identity:
    """An object, compared by identity."""

    __slots__ = ("value",)

    def __init__(self, value: object) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Identity) and self.value is other.value

    def __hash__(self) -> int:
        return object.__hash__(self.value)


def exact_key(value: object) -> Hashable:
    """The key of a static value (head of this module)."""
    return _Keys().of(value, None)


class _Keys:
    """The keys of one value and of what it consists of; each function is described once."""

    def __init__(self) -> None:
        self._described: dict[types.FunctionType, int] = {}

    def of(self, value: object, module: str | None) -> Hashable:
        """The key of a value.

        Args:
          value: what is described.
          module: the module whose functions are followed; None for any.
        """
        kind = type(value)
        if isinstance(value, PLAIN_TYPES):
            return kind, value
        if isinstance(value, float):
            return kind, value.hex()
        if isinstance(value, complex):
            return kind, value.real.hex(), value.imag.hex()
        if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
            return kind, value.dtype, value.shape, value.tobytes()
        if isinstance(value, tuple):
            return kind, tuple([self.of(x, module) for x in value])
        if isinstance(value, frozenset):
            return kind, frozenset([self.of(x, module) for x in value])
        if isinstance(value, types.FunctionType):
            return self._of_function(value, module)
        if isinstance(value, types.MethodType):
            return kind, Identity(value.__self__), self.of(value.__func__, module)
        if isinstance(value, functools.partial):
            keywords = tuple(sorted(value.keywords.items()))
            return kind, self.of((value.func, value.args, keywords), module)
        if isinstance(value, CUSTOM_RULES):
            rules = [x for x in vars(value).values() if callable(x)]
            return Identity(value), self.of(tuple(rules), module)
        # Two objects of other classes are never equal, or no keys.
        is_value = kind.__eq__ is not object.__eq__ and kind.__hash__ is not None
        if is_value and dataclasses.is_dataclass(value) and not isinstance(value, type):
            fields = [getattr(value, field.name) for field in dataclasses.fields(value)]
            return kind, self.of(tuple(fields), module)
        return Identity(value)

    def _of_function(self, function: types.FunctionType, module: str | None) -> Hashable:
        """The key of a function of Python."""
        if function in self._described:
            return self._described[function]  # a function that is described already, by its number
        self._described[function] = len(self._described)
        home = function.__globals__.get("__name__", "")
        if _is_installed(function):
            inside = (*map(_content, function.__closure__ or ()), _wrapped_by(function))
            return Identity(function), self.of(tuple(filter(_is_of_a_user, inside)), module)
        if module not in (None, home):
            return Identity(function)
        # The global variables that it names, other than modules, are part of it.
        known = function.__globals__
        names = [name for name in _names_of(function.__code__) if name in known]
        variables = [(name, known[name]) for name in names]
        parts = (
            function.__defaults__,
            tuple(sorted((function.__kwdefaults__ or {}).items())),
            tuple([_content(cell) for cell in function.__closure__ or ()]),
            tuple([x for x in variables if not isinstance(x[1], types.ModuleType)]),
        )
        return Identity(function), function.__code__, self.of(parts, home)


def key_of_fields(values: tuple) -> Hashable:
    """The key of static fields, by `marshal` where they are numbers and texts: a component is
    flattened at every call of a compiled function.
    """
    if _is_written_exactly(values):
        return marshal.dumps(values, MARSHAL_VERSION)
    return exact_key(values)


def _is_written_exactly(values: tuple) -> bool:
    """Whether `marshal` writes types and all bits of values."""
    return all(
        type(x) in MARSHALLED or (type(x) is tuple and _is_written_exactly(x)) for x in values
    )


def _is_installed(function: types.FunctionType) -> bool:
    """Whether a function belongs to this package or to an installed one."""
    home = function.__globals__.get("__name__", "")
    return is_of_a_library(home) or function.__code__.co_filename.startswith(INSTALLED)


def _is_of_a_user(value: object) -> bool:
    """Whether a value is a function of a user, wraps one, or is a tuple with one."""
    if isinstance(value, tuple):
        return any(map(_is_of_a_user, value))
    if isinstance(value, types.FunctionType):
        return not _is_installed(value) or _is_of_a_user(_wrapped_by(value))
    return isinstance(value, (types.MethodType, functools.partial, *CUSTOM_RULES))


def _wrapped_by(function: types.FunctionType) -> Any:
    """The function that another one wraps (`functools.wraps`); None if it wraps none."""
    return vars(function).get("__wrapped__")


def _content(cell: types.CellType) -> Any:
    """What a cell of a closure holds; the cell itself while it holds nothing."""
    try:
        return cell.cell_contents
    except ValueError:
        return cell


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
    keys = _Keys()
    parts = []
    for base in cls.__mro__:
        if base is object or is_of_a_library(base.__module__):
            continue
        for name, value in vars(base).items():
            if name not in NOT_BEHAVIOUR:
                parts.append((name, keys.of(_functions_in(value), None)))
    return tuple(parts) or None


def _functions_in(attribute: object) -> Any:
    """The functions of an attribute of a class."""
    if isinstance(attribute, staticmethod | classmethod):
        return attribute.__func__
    if isinstance(attribute, property):
        return attribute.fget, attribute.fset
    # A property that keeps its value, or a method with some of its arguments.
    return getattr(attribute, "func", attribute)
