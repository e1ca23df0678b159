"""The paths of leaves within a component: their tokens, the leaf that they lead to, and copies of
the component with that leaf replaced.

`simulation.paths` describes the language and applies it to scenarios.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import re
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, modules
from iblf_jax.core.families import statements_of
from iblf_jax.core.modules import NUMBERS, RowName
from iblf_jax.core.pytree import field_values, wrapped_field

BARE = r"[^\[\]]*[^\W\d_][^\[\]]*"
"""The name of a row that needs no quotes."""
_TOKEN = re.compile(
    rf"""\.?([A-Za-z_]\w*)|\[(-?\d{{1,18}})\]|\[("(?:[^"\\]|\\.)*")\]|\[({BARE})\]"""
)


def parse(path: str) -> list[str | int]:
    """The tokens of a path: names, indices and names of rows.  ValueError if it is not a path."""
    expected = 'names joined by dots, with [i] for an entry, such as "plant.mass[1]"'
    if not isinstance(path, str) or not path:
        raise checks.fail("path", path, expected)
    tokens: list[str | int] = []
    position = 0
    while position < len(path):
        # A path begins with a name; a dot or a bracket begins every later token.
        is_separated = path[position] in ".["
        match = _TOKEN.match(path, position)
        token = None
        if is_separated == (position > 0):
            token = _token(match)
        if match is None or token is None:
            raise checks.fail("path", path, expected)
        tokens.append(token)
        position = match.end()
    return tokens


def _token(match: re.Match | None) -> str | int | None:
    """The token that `_TOKEN` matched; None without a match, and for an invalid JSON string."""
    if match is None:
        return None
    field, index, quoted, bare = match.groups()
    if field is not None:
        return field
    if index is not None:
        return int(index)
    if bare is not None:
        return RowName(bare)
    try:
        return RowName(json.loads(quoted))
    except ValueError:
        return None


def resolve(part: object, path: str) -> tuple[list[str | int], Any]:
    """Fields and indices of the path of a leaf of a component, and the value there.

    The names of wrapped components are inserted, and the name of a row becomes an index.

    Raises:
      LookupError: the path leads to no leaf.
      ValueError: it is not a path.
    """
    value = part
    found: list[str | int] = []
    tokens = parse(path)
    while tokens:
        try:
            steps, tokens = steps_of(value, tokens)
            for step in steps:
                value = member_of(value, step)
        except (AttributeError, IndexError, TypeError, KeyError, ValueError):
            raise LookupError(path) from None
        is_part = dataclasses.is_dataclass(value) or modules.is_module(value)
        is_entry = isinstance(value, jax.Array | np.ndarray | float)
        if isinstance(steps[-1], int) and not (is_entry or is_part):
            raise LookupError(path)
        found += steps
    if not isinstance(value, NUMBERS):
        raise LookupError(path)
    return found, value


def steps_of(part: object, tokens: list[str | int]) -> tuple[list[str | int], list[str | int]]:
    """The fields and indices of the first tokens of a path in a component, and the tokens that are
    left.
    """
    token = tokens[0]
    if isinstance(token, int) or modules.is_module(part):
        return [token], tokens[1:]
    if isinstance(token, RowName):
        raise KeyError(token)
    if has_field(part, token):
        return [token], tokens[1:]
    rows = statements_of(part).named_rows
    if token in rows:
        names, fields = rows[token]
        row, field = tokens[1:3]
        if field not in fields:
            raise KeyError(field)
        index = row if isinstance(row, int) else vars(part)[names].index(row)
        return [field, index], tokens[3:]
    stacked = statements_of(part).stacked
    if token in stacked:
        row = tokens[1]
        if not isinstance(row, int):
            raise KeyError(row)
        return rows_of(part, stacked[token])[row], tokens[2:]
    wrapped = wrapped_field(part)
    if wrapped:
        return [wrapped], tokens
    return [token], tokens[1:]


def rows_of(part: object, names: Sequence[str]) -> list[list[Any]]:
    """The steps to each row of a stack of leaves, of which the last one has several rows; none if
    the component does not have it.
    """
    *single, last = names
    values = field_values(part)
    if values[last] is None:
        return []
    return [*[[name] for name in single], *[[last, i] for i in range(len(values[last]))]]


def has_field(part: Any, name: str) -> bool:
    """Whether a component has a field of this name."""
    return any(field.name == name for field in dataclasses.fields(part))


def member_of(part: Any, step: str | int) -> Any:
    """The non-static field or the entry of a part.  An error if there is none: JAX would take the
    nearest entry.
    """
    if modules.is_module(part):
        return modules.entry(part, step)
    if isinstance(step, str):
        if step not in [f.name for f in dataclasses.fields(part) if not f.metadata.get("static")]:
            raise AttributeError(step)
        return vars(part)[step]
    if not isinstance(part, tuple | list | jax.Array | np.ndarray):
        raise TypeError(part)
    if not -len(part) <= step < len(part):
        raise IndexError(step)
    return part[step]


def replaced(part: Any, tokens: list[str | int], value: Any, path: str, sign: str | None) -> Any:
    """A copy of `part` with the leaf at `tokens` replaced: checked, and of the same structure."""
    if not tokens or isinstance(part, NUMBERS):
        old = jnp.asarray(part)
        index = tuple(t for t in tokens if isinstance(t, int))
        shape = old[index].shape if index else old.shape
        new = checks.as_floats(path, value)
        if new.shape not in ((), shape):
            expected = f"one number or shape {shape}"
            raise checks.fail(path, value, expected, f"Its shape is {new.shape}.")
        checks.check_values(path, new, sign)
        new = jnp.broadcast_to(new, shape).astype(old.dtype)
        return old.at[index].set(new) if index else new
    head, rest = tokens[0], tokens[1:]
    if modules.is_module(part):
        entry = replaced(member_of(part, head), rest, value, path, None)
        return modules.with_entry(part, head, entry)
    if isinstance(head, int):
        parts = list(part)
        parts[head] = replaced(part[head], rest, value, path, sign)
        return tuple(parts)
    changed = copy.copy(part)
    sign = next(f.metadata.get("sign") for f in dataclasses.fields(part) if f.name == head)
    member = replaced(vars(part)[head], rest, value, path, sign)
    object.__setattr__(changed, head, member)
    return changed
