"""Validates the values of a TOML file: tables, numbers, strings and lists.

Every error is a ValueError that names the dotted key, what came, what was expected, and the remedy.
"""

from __future__ import annotations

import math
import tomllib
import types
import typing
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.core.checks import Words, did_you_mean

NONE = "none"
"""The value in a file of a static field that is None although its default is not; TOML has no
null."""


def dotted(path: str, name: str) -> str:
    """The dotted key of an entry of a table; an empty path is the file itself."""
    return f"{path}.{name}" if path else name


def toml_tables(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
      tomllib.TOMLDecodeError: the text is not TOML.
      ValueError: the tables are nested deeper than in any file of this package.
    """
    problem = f"more than {checks.MAX_DEPTH} tables and lists inside each other"
    try:
        tables = tomllib.loads(text)
    except RecursionError:
        raise ValueError(problem) from None
    if checks.is_deep(tables):
        raise ValueError(problem)
    return tables


def as_table(value: object, path: str) -> dict[str, Any]:
    """`value` if it is a table, else a ValueError."""
    if isinstance(value, dict):
        return value
    raise checks.fail(path, value, f"a table, [{path}]")


def missing(key: str, expected: str, remedy: str = "") -> ValueError:
    """The error for a key that a file does not have."""
    return checks.fail(key, Words("nothing"), expected, remedy)


def by_path(
    table: dict[str, Any], is_entry: Callable[[Any], bool], prefix: str = ""
) -> dict[str, Any]:
    """Path -> entry: `"plant.mass" = x` and `plant.mass = x` mean the same.

    Args:
      table: tables inside each other.
      is_entry: whether a value is an entry; otherwise it is a table that continues the path.
      prefix: path of the table.
    """
    found: dict[str, Any] = {}
    for key, value in table.items():
        path = dotted(prefix, key)
        if is_entry(value):
            found[path] = value
        else:
            found |= by_path(value, is_entry, path)
    return found


def known_keys(table: dict[str, Any], path: str, known: Iterable[str]) -> None:
    """Raises ValueError for the first key that is not known."""
    known = list(known)
    for key in table:
        if key not in known:
            expected = "one of the keys of this table" if known else "no keys in this table"
            came = Words("an unknown key")
            raise checks.fail(dotted(path, str(key)), came, expected, did_you_mean(key, known))


def numbers(value: object, path: str, unit: str = "") -> Any:
    """A number, or nested lists of numbers, as floats; ValueError for anything else."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise checks.fail(path, value, "a number that fits into a float") from None
    if isinstance(value, list | tuple):
        return [numbers(entry, f"{path}[{i}]", unit) for i, entry in enumerate(value)]
    expected = "a number or a list of numbers"
    if unit:
        expected += f" [{unit}]"
    raise checks.fail(path, value, expected)


def without_none(hint: object) -> tuple[Any, bool]:
    """An annotation without its `| None`, and whether it had one.

    A union of several other types becomes Any.
    """
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return hint, False
    options = typing.get_args(hint)
    rest = [option for option in options if option is not type(None)]
    is_optional = len(rest) < len(options)
    if len(rest) == 1:
        return rest[0], is_optional
    return Any, is_optional


def entry_hint(hint: object, index: int) -> Any:
    """The annotation of one entry of a tuple."""
    if typing.get_origin(hint) is not tuple:
        return Any
    entries = typing.get_args(hint)
    if len(entries) == 2 and entries[1] is Ellipsis:
        return entries[0]
    return entries[index] if index < len(entries) else Any


def encode_numbers(array: ArrayLike) -> Any:
    """Floats, in nested lists, whose shortest decimal form gives the same bits in the array's
    precision.
    """
    array = np.asarray(array)
    if array.ndim:
        return [encode_numbers(x) for x in array]
    if array.dtype.itemsize < 8:
        short = float(str(array[()]))
        if array.dtype.type(short) == array:
            return short
    return float(array)


def encode_static(value: Any, path: str) -> Any:
    """The value of a static field for a file: tuples become lists.

    Raises:
      ValueError: a value that a file cannot hold.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, tuple):
        return [encode_static(x, f"{path}[{i}]") for i, x in enumerate(value)]
    if isinstance(value, str) and any("\ud800" <= x <= "\udfff" for x in value):
        raise not_storable(path, value, "text without unpaired surrogates")
    if isinstance(value, bool | str | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    if callable(value):
        expected = "a class whose fields a file can hold"
        remedy = (
            "Write the function as a method of a class (iblf_jax.component), and name the class in"
            " the MEMBERS of its family before saving and loading."
        )
        raise checks.fail(path, Words("a function"), expected, remedy)
    raise not_storable(path, value, "a finite number, a string, a bool or a tuple of these")


def not_storable(path: str, value: object, expected: str) -> ValueError:
    """The error for a value that a file cannot hold."""
    return checks.fail(path, value, expected, "A scenario file cannot hold it.")


def decode_static(value: Any, hint: Any, path: str) -> Any:
    """The value of a static field of the annotated type: a string, a bool, a number, or a tuple."""
    hint, optional = without_none(hint)
    if optional and value == NONE:
        return None
    if isinstance(value, list):
        if hint not in (Any, tuple) and typing.get_origin(hint) is not tuple:
            raise checks.fail(path, value, f"{_WORDS.get(hint, 'one value')}, not a list")
        return tuple(
            decode_static(x, entry_hint(hint, i), f"{path}[{i}]") for i, x in enumerate(value)
        )
    if hint is tuple or typing.get_origin(hint) is tuple:
        raise checks.fail(path, value, "a list")
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = numbers(value, path)
    fits = isinstance(value, bool | int | float | str)
    if hint in _WORDS:
        fits = type(value) is hint
    if not fits or (isinstance(value, float) and not math.isfinite(value)):
        raise checks.fail(path, value, _WORDS.get(hint, "a finite number, a string or a bool"))
    return value


_WORDS: dict[Any, str] = {
    str: "a string",
    int: "a whole number",
    float: "a finite number",
    bool: "true or false",
}
