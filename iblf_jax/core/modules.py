"""Modules of other libraries and containers of arrays as fields of components.

A field of a component may hold a network of Equinox or Flax NNX, or a dict, list, tuple or
registered dataclass of arrays.  Its floating-point arrays are leaves of the component.  Everything
else in it (functions, strings, flags, arrays of integers) is structure: it is compared when JAX
looks for a compiled program, and new weights therefore need no compilation.

JAX must flatten a component into arrays only.  The component replaces the other entries of such a
field by `Structure` nodes, which have no leaves, when JAX flattens it, and restores them when JAX
rebuilds it.
"""

from __future__ import annotations

import dataclasses
import functools
import numbers
import re
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import has_members
from iblf_jax.core.devices import on_device
from iblf_jax.core.exact_keys import exact_key

NUMBERS = (jax.Array, np.ndarray, np.generic, float, int)
"""Types of leaves."""


class RowName(str):
    """Token of a path: the name of a row, or a key of a dict, in brackets."""

    __slots__ = ()


class ConstantArray(NamedTuple):
    """An array of integers, truth values or keys as a hashable value."""

    data: bytes
    dtype: str
    shape: tuple[int, ...]

    @staticmethod
    def of(array: object) -> ConstantArray:
        """The value of an array."""
        values = np.asarray(array)
        return ConstantArray(values.tobytes(), values.dtype.str, values.shape)

    def array(self) -> jax.Array:
        """The array."""
        values = np.frombuffer(self.data, np.dtype(self.dtype)).reshape(self.shape)
        return on_device(values)


@jax.tree_util.register_pytree_node_class
class Structure:
    """A pytree without leaves that holds one hashable value, compared by its exact key."""

    def __init__(self, value: object) -> None:
        self.value = value

    def tree_flatten(self) -> tuple[tuple, Any]:
        """No leaves, and the value with its key."""
        return (), (exact_key(self.value), self.value)

    @classmethod
    def tree_unflatten(cls, aux: Any, children: Any) -> Structure:
        """The node of a value."""
        return cls(aux[1])


def is_component(value: object) -> bool:
    """Whether this is an object of a class that `component` was applied to."""
    return "_registered_component" in vars(type(value))


def is_module(value: Any) -> bool:
    """Whether a field holds a module: a pytree of another library, or a container of arrays."""
    if value is None or is_component(value) or isinstance(value, (str, *NUMBERS)):
        return False
    # A class that a user registered by hand may declare fields with `leaf`.
    fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
    if any(field.metadata.get("leaf") for field in fields):
        return False
    if checks.is_deep(value):
        return False
    if type(value) in (tuple, list):
        return any(is_module(x) or isinstance(x, NUMBERS) for x in value)
    try:
        return bool(entries(value))
    except Exception:  # a dict whose keys have no order, or a class that JAX cannot take apart
        return False


def entries(part: object) -> dict[str | int, Any]:
    """Token of a path -> entry of a module; empty for what JAX does not take apart by names.

    The order is that of the leaves.
    """
    # A path has one key, which is more than a position without a name.
    return {
        _token(path[0]): value
        for path, value in _one_level(part)[0]
        if len(path) == 1 and not isinstance(path[0], jax.tree_util.FlattenedIndexKey)
    }


def entry(part: object, token: str | int) -> Any:
    """The entry of a module at a token of a path.

    Raises:
      KeyError: there is none.
    """
    return entries(part)[_from_the_start(part, token)]


def with_entry(part: object, token: str | int, value: object) -> Any:
    """A copy of a module with one entry, which it must have, replaced."""
    pairs, structure = _one_level(part)
    values = {_token(path[0]): old for path, old in pairs}
    values[_from_the_start(part, token)] = value
    return jax.tree.unflatten(structure, values.values())


def _from_the_start(part: object, token: str | int) -> str | int:
    """The token, with a negative index of a list or tuple counted from its start."""
    if isinstance(part, tuple | list) and isinstance(token, int) and token < 0:
        return token + len(part)
    return token


def _one_level(part: object) -> Any:
    """The direct entries of a pytree with their keys, and its structure."""
    return jax.tree_util.tree_flatten_with_path(part, is_leaf=lambda x: x is not part)


def _token(key: object) -> str | int:
    """The token of a path for a key of JAX."""
    if isinstance(key, jax.tree_util.GetAttrKey):
        return key.name
    if isinstance(key, jax.tree_util.SequenceKey):
        return key.idx
    if isinstance(key, jax.tree_util.DictKey) and isinstance(key.key, int):
        return key.key
    return RowName(key.key if isinstance(key, jax.tree_util.DictKey) else str(key))


def is_float_array(value: Any) -> bool:
    """Whether this is an array of floating-point numbers, traced or not."""
    is_array = isinstance(value, jax.Array | np.ndarray | np.generic)
    return is_array and jnp.issubdtype(value.dtype, jnp.floating)


def has_structure(module: object) -> bool:
    """Whether a module contains anything besides numbers that can be leaves."""
    return not all(map(_can_be_leaf, jax.tree.leaves(module)))


def _can_be_leaf(value: object) -> bool:
    if isinstance(value, jax.core.Tracer):
        return True
    is_number = isinstance(value, float | int) and not isinstance(value, bool)
    return is_number or is_float_array(value)


class Division(NamedTuple):
    """Which entries of a module are leaves of the component and which are structure.

    It is stored, because JAX rebuilds components with other objects in place of the arrays.
    """

    treedef: Any
    is_structure: tuple[bool, ...]

    @staticmethod
    def of(module: object) -> Division:
        """The division of a module that holds numbers."""
        values, treedef = jax.tree.flatten(module, is_leaf=lambda x: x is None)
        return Division(treedef, tuple(not _is_leaf(x) for x in values))

    def __reduce__(self) -> Any:
        """A division for pickle, which cannot store the structure of classes of others: a module
        with truth values in place of its entries.
        """
        return _division_from, (self.treedef.unflatten(self.is_structure),)

    def with_nodes(self, module: object) -> Any:
        """The module with its structure in nodes that have no leaves."""
        nodes = []
        values = self.treedef.flatten_up_to(module)
        for value, is_structure in zip(values, self.is_structure, strict=True):
            if is_structure and isinstance(value, jax.Array | np.ndarray):
                value = ConstantArray.of(value)
            nodes.append(Structure(value) if is_structure else value)
        return self.treedef.unflatten(nodes)

    def without_nodes(self, module: object) -> Any:
        """The inverse of `with_nodes`."""
        values = self.treedef.flatten_up_to(module)
        for i, node in enumerate(values):
            if isinstance(node, Structure):
                constant = node.value
                values[i] = constant.array() if isinstance(constant, ConstantArray) else constant
        return self.treedef.unflatten(values)


def _division_from(module: object) -> Division:
    """The division of which a module with truth values is the pickled form."""
    values, treedef = jax.tree.flatten(module)
    return Division(treedef, tuple(values))


def _is_leaf(value: object) -> bool:
    """Whether an entry of a module that holds functions is a leaf."""
    return is_float_array(value) or isinstance(value, jax.core.Tracer)


def as_module(name: str, value: object) -> Any:
    """A user's module as a field: arrays of NumPy and lists of numbers become arrays of JAX.

    Raises:
      ValueError: an entry that is neither a number nor a hashable value, or that hides arrays.
    """
    checks.flat_enough(name, value)
    value = _with_arrays(name, value)
    has_functions = has_structure(value)
    pairs, structure = jax.tree_util.tree_flatten_with_path(value)
    leaves = [
        _checked_entry(name + jax.tree_util.keystr(path), leaf, has_functions)
        for path, leaf in pairs
    ]
    return jax.tree.unflatten(structure, leaves)


def _with_arrays(name: str, value: Any) -> Any:
    """Containers of Python with their lists of numbers as arrays."""
    if type(value) is dict:
        for key in value:
            if not isinstance(key, str):
                raise checks.fail(name, key, "a dict whose keys are strings")
        return {key: _with_arrays(f"{name}[{key}]", x) for key, x in value.items()}
    if type(value) not in (tuple, list):
        return value
    if is_list_of_numbers(value):
        return checks.as_floats(name, value)
    return type(value)(_with_arrays(f"{name}[{i}]", x) for i, x in enumerate(value))


def is_list_of_numbers(value: object) -> bool:
    """Whether this is a list or tuple of numbers, or of such lists, that stands for one array."""
    if not isinstance(value, list | tuple):
        return False
    return bool(value) and all(_is_number(x) or is_list_of_numbers(x) for x in value)


def _is_number(value: object) -> bool:
    is_scalar = isinstance(value, jax.Array | np.ndarray) and value.ndim == 0
    return is_scalar or (isinstance(value, numbers.Number) and not isinstance(value, bool))


def _checked_entry(name: str, value: object, has_functions: bool) -> Any:
    """An entry of a module as a leaf or as structure."""
    if isinstance(value, jax.core.Tracer):
        return value
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _checked_array(name, value)
    if _can_be_leaf(value) and not has_functions:
        return checks.as_floats(name, value)
    remedy = (
        "Register its class with JAX (jax.tree_util.register_dataclass), or decorate it with"
        " iblf_jax.component, so that its arrays are leaves."
    )
    if _hides_arrays(value):
        raise checks.fail(name, value, "an array, a function or a setting", remedy)
    try:
        hash(value)
    except TypeError as error:
        raise checks.fail(name, value, "an array or a hashable value", remedy) from error
    return value


def _checked_array(name: str, value: Any) -> Any:
    """An array of a module; floating-point ones become arrays of JAX."""
    if jnp.issubdtype(value.dtype, jnp.complexfloating):
        raise checks.fail(name, value, "real numbers", f"Its type is {value.dtype}.")
    if is_float_array(value):
        return checks.as_floats(name, value)
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        remedy = "A random state belongs in no part of a scenario: remove it from the module."
        raise checks.fail(name, value, "numbers", remedy)
    return value


def _hides_arrays(value: object) -> bool:
    """Whether an object that JAX does not take apart has arrays among its attributes."""
    if isinstance(value, functools.partial):
        inside: Any = (value.args, value.keywords)
    elif isinstance(value, type) or not has_members(value, "__dict__"):
        return False
    else:
        inside = list(vars(value).values())
    leaves = jax.tree.leaves(inside)
    return any(isinstance(x, jax.Array | np.ndarray) for x in leaves)


def number_of_leaves(module: object) -> tuple[int, int]:
    """How many arrays and how many numbers a module has as leaves."""
    arrays = list(filter(_is_leaf, jax.tree.leaves(module)))
    return len(arrays), sum(int(np.size(x)) for x in arrays)


def name_of(value: Any) -> str:
    """A function or another entry of a structure in words that do not depend on the process."""
    if callable(value) and has_members(value, "__qualname__", "__module__"):
        return f"{value.__module__}:{value.__qualname__}"
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))
