"""One path language for every leaf of a scenario: "controller.K2", "plant.mass[1]", "initial.q",
"disturbance.phase".

Sweeps, perturbations, tuning and scenario files address leaves by these paths.

- Names follow the fields of the components; `[i]` selects a part of a `Sum` or one entry of an
  array.
- A component whose rows have names (class attribute `rows`, such as `robots.Arm`) can be addressed
  by them: "plant.link[forearm].mass", "plant.joint[elbow].damping"; numbers from 0 work as well. A
  name without a letter, or with a bracket, a line break or the like, is written as a JSON string:
  'plant.link["a]b"].mass'.
- `robot.` stands for `plant.` and `model.` together and changes both robots alike.
- Several leaves may be addressed as the rows of one array (class attribute `stacked`):
  "initial.x[2]" is the third level of the start of a plant, "initial.x[0]" its initial.q.
- A component that wraps another (class attribute `wraps`, such as `controllers.Saturated`) is
  transparent: "controller.K2" is the wrapped law's K2, and "controller.law.K2" works too.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices, tables
from iblf_jax.core.pytree import component_member, field_values, wrapped_field
from iblf_jax.core.units import Unit, as_text, of_entry, resolved
from iblf_jax.simulation.scenario import HOW_TO_MAKE, NUMBERS, Scenario, canonical
from iblf_jax.simulation.units import symbols_of

Symbols: TypeAlias = Mapping[str, Unit]
"""Symbol of a formula of a unit -> its unit."""

_BARE = r"[^\[\]]*[^\W\d_][^\[\]]*"
"""The name of a row that needs no quotes."""
_TOKEN = re.compile(
    rf"""\.?([A-Za-z_]\w*)|\[(-?\d{{1,18}})\]|\[("(?:[^"\\]|\\.)*")\]|\[({_BARE})\]"""
)


class RowName(str):
    """Token of a path: the name of a row, in brackets."""

    __slots__ = ()


class Parameter(NamedTuple):
    """One addressable leaf."""

    path: str
    shape: tuple[int, ...]
    unit: str
    value: Any


class ParameterTable(tuple[Parameter, ...]):
    """The addressable leaves of a scenario; prints as a table, in notebooks too."""

    def _rows(self) -> list[tuple[str, str, str, str]]:
        return [(p.path, str(p.shape), p.unit, _value_text(p.value)) for p in self]

    def __repr__(self) -> str:
        return "\n".join(tables.as_text([Parameter._fields, *self._rows()]))

    def _repr_html_(self) -> str:
        return tables.as_html(Parameter._fields, self._rows())


def _value_text(value: Any) -> str:
    """A value as a table shows it."""
    if not checks.is_concrete(value):
        return "traced"
    return np.array2string(np.asarray(value), precision=6, threshold=8)


def parameters(scenario: Scenario, *, named: bool = True) -> ParameterTable:
    """Every addressable leaf of a scenario: path, shape, unit, value.

    Args:
      scenario: any Scenario.
      named: list rows of leaves by their names, too: "plant.link[forearm].mass" besides
        "plant.mass"; without them every number is listed once.

    Returns:
      A tuple of `Parameter`, which prints as a table.
    """
    _check_component(scenario)
    named = checks.boolean("named", named)
    return ParameterTable(_walk(scenario, "", named, symbols_of(scenario)))


def _check_component(scenario: Any) -> None:
    """Raises ValueError for something that has no fields."""
    if not _is_component(scenario):
        raise checks.fail("scenario", scenario, "a Scenario", HOW_TO_MAKE)


def _is_component(part: Any) -> bool:
    return dataclasses.is_dataclass(part) and not isinstance(part, type)


def _joined(path: str, name: str) -> str:
    """The path of a member of the component at `path`."""
    return f"{path}.{name}" if path else name


def _walk(part: Any, path: str, named: bool, symbols: Symbols) -> Iterator[Parameter]:
    """The leaves below a part; `symbols` has the unit of each symbol there."""
    if isinstance(part, tuple | list):
        for i, x in enumerate(part):
            yield from _walk(x, f"{path}[{i}]", named, symbols)
        return
    if not _is_component(part):
        return
    values = field_values(part)
    for field in dataclasses.fields(part):
        if field.metadata.get("static"):
            continue
        value = values[field.name]
        name = _joined(path, field.name)
        if field.name == wrapped_field(part):
            yield from _walk_wrapped(part, value, path, name, named, symbols)
        elif isinstance(value, NUMBERS):
            unit = as_text(_unit(part, field, symbols))
            yield Parameter(name, jnp.shape(value), unit, value)
        elif isinstance(value, tuple | list):
            for i, x in enumerate(value):
                below = _symbols_below(part, field, symbols, i)
                yield from _walk(x, f"{name}[{i}]", named, below)
        else:
            yield from _walk(value, name, named, _symbols_below(part, field, symbols))
    if named:
        yield from _named_rows(part, path)
        yield from _stacked_rows(part, path, symbols)


def _symbols_below(
    part: Any, field: dataclasses.Field, symbols: Symbols, index: int = 0
) -> Symbols:
    """The unit of each symbol in the part that a field holds, or in one of its parts."""
    symbols = component_member(part, "symbols_of_part")(field.name, index, symbols)
    change = field.metadata.get("part_units")
    return symbols if change is None else change(symbols, index)  # type: ignore[no-any-return]


def _walk_wrapped(
    wrapper: Any, inner: Any, path: str, name: str, named: bool, symbols: Symbols
) -> Iterator[Parameter]:
    """The leaves of a wrapped component under the path of its wrapper, except for those that have
    the name of a field of the wrapper.
    """
    for parameter in _walk(inner, path, named, symbols):
        rest = parameter.path[len(path) :].lstrip(".")
        if _has_field(wrapper, str(parse(rest)[0])):
            parameter = parameter._replace(path=f"{name}.{rest}")
        yield parameter


def _unit(part: Any, field: dataclasses.Field, symbols: Symbols) -> Unit:
    """The unit of a leaf of a component, as the component or the field states it."""
    stated = component_member(part, "leaf_units")()
    return resolved(stated.get(field.name, field.metadata.get("unit", "")), symbols)


def _named_rows(part: Any, path: str) -> Iterator[Parameter]:
    """The rows of leaves that have names."""
    units = {field.name: field.metadata.get("unit", "") for field in dataclasses.fields(part)}
    values = field_values(part)
    for kind, (names, fields) in component_member(type(part), "rows").items():
        for i, name in enumerate(values[names]):
            for field in fields:
                value = values[field]
                # A leaf with one axis has one entry per row, and others have rows first or last.
                row = value[..., i] if jnp.ndim(value) == 1 else value[i]
                full = _joined(path, f"{kind}[{_quoted(name)}].{field}")
                yield Parameter(full, jnp.shape(row), units[field], row)


def _stacked_rows(part: Any, path: str, symbols: Symbols) -> Iterator[Parameter]:
    """The rows of leaves that may be addressed as those of one array, of a component that has the
    last of these leaves.
    """
    fields = {field.name: field for field in dataclasses.fields(part)}
    values = field_values(part)
    for kind, names in component_member(type(part), "stacked").items():
        for i, (name, *index) in enumerate(_rows_of(part, names)):
            at = tuple(index)
            unit = of_entry(_unit(part, fields[name], symbols), at, jnp.ndim(values[name]))
            value, row = values[name][at], as_text(unit)
            yield Parameter(_joined(path, f"{kind}[{i}]"), jnp.shape(value), row, value)


def _rows_of(part: Any, names: Sequence[str]) -> list[list[Any]]:
    """The steps to each row of a stack of leaves, of which the last one has several rows; none if
    the component does not have it.
    """
    *single, last = names
    values = field_values(part)
    if values[last] is None:
        return []
    return [*[[name] for name in single], *[[last, i] for i in range(len(values[last]))]]


def _quoted(name: str) -> str:
    """The name of a row as a path contains it."""
    needs_no_quotes = re.fullmatch(_BARE, name) and name.isprintable() and not name.startswith('"')
    return name if needs_no_quotes else json.dumps(name)


def parse(path: str) -> list[str | int]:
    """The tokens of a path: names, indices and names of rows.  ValueError if it is not a path."""
    tokens: list[str | int] = []
    position = 0
    while isinstance(path, str) and position < len(path):
        match = _TOKEN.match(path, position)
        if match is None or (position == 0) == path[position].startswith((".", "[")):
            break
        token = _token(match)
        if token is None:
            break
        tokens.append(token)
        position = match.end()
    if not isinstance(path, str) or not path or position < len(path):
        expected = 'names joined by dots, with [i] for an entry, such as "plant.mass[1]"'
        raise checks.fail("path", path, expected)
    return tokens


def _token(match: re.Match) -> str | int | None:
    """The token that `_TOKEN` matched; None for an invalid JSON string."""
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


def expand(path: str) -> list[str]:
    """The full paths of a path: two for `robot.`, else the path itself.  ValueError if it is not a
    path.
    """
    parse(path)
    if path == "robot" or path.startswith(("robot.", "robot[")):
        return ["plant" + path[5:], "model" + path[5:]]
    return [path]


def _unknown(scenario: Scenario, path: str) -> ValueError:
    """The error about a path that leads to no leaf."""
    known = [p.path for p in parameters(scenario)]
    remedy = checks.nearest(path, known) or "ij.parameters(scenario) lists them."
    return checks.fail("path", path, "the path of a leaf of this scenario", remedy)


def get(scenario: Scenario, path: str) -> Any:
    """The value at a path (the plant's, for `robot.`)."""
    return _resolved(scenario, path, expand(path)[0])[1]


def places(scenario: Scenario, path: str) -> list[list[str | int]]:
    """The location of the numbers at a path, for each of its full paths: fields and indices."""
    return [_resolved(scenario, path, full)[0] for full in expand(path)]


def leaves(scenario: Scenario, path: str) -> list[str]:
    """The paths of the complete leaves that contain the numbers at a path."""

    def leaf_path(tokens):
        while isinstance(tokens[-1], int):
            tokens = tokens[:-1]
        return "".join(map(_written, tokens)).lstrip(".")

    return [leaf_path(tokens) for tokens in places(scenario, path)]


def _written(token: str | int) -> str:
    """A field or an index as a path contains it."""
    return f"[{token}]" if isinstance(token, int) else f".{token}"


def unit_at(scenario: Scenario, path: str) -> str:
    """The unit of the leaf at a path."""
    return as_text(_metadata(scenario, path).get("unit", ""))


def sign_at(scenario: Scenario, path: str) -> str | None:
    """The sign that the finite numbers at a path must have: None, "positive" or "nonnegative"."""
    sign = _metadata(scenario, path).get("sign")
    if sign is None or sign == "limit":
        return None
    return sign.removesuffix(" limit")


def _metadata(scenario: Scenario, path: str) -> Mapping[str, Any]:
    """The declared metadata of the leaf at a path, with its unit."""
    part: Any = scenario
    symbols = symbols_of(scenario)
    tokens = places(scenario, path)[0]
    while True:
        name, index, tokens = _next_field(tokens)
        field = next(f for f in dataclasses.fields(part) if f.name == name)
        value = vars(part)[name]
        if not tokens:
            unit = of_entry(_unit(part, field, symbols), index, jnp.ndim(value))
            return {**field.metadata, "unit": unit}
        symbols = _symbols_below(part, field, symbols, *index[:1])
        part = value
        for i in index:
            part = part[i]


def _next_field(
    tokens: list[str | int],
) -> tuple[str, tuple[int, ...], list[str | int]]:
    """The first field of a full path, the indices after it, and the tokens that are left."""
    count = 1
    while count < len(tokens) and isinstance(tokens[count], int):
        count += 1
    return str(tokens[0]), tuple(int(i) for i in tokens[1:count]), tokens[count:]


def _resolved(scenario: Scenario, path: str, full: str) -> tuple[list[str | int], Any]:
    """Fields and indices of a full path, and the value there.

    The names of wrapped components are inserted, and the name of a row becomes an index.
    """
    value: Any = scenario
    found: list[str | int] = []
    tokens = parse(full)
    while tokens:
        try:
            steps, tokens = _steps(value, tokens)
            for step in steps:
                value = _member(value, step)
        except (AttributeError, IndexError, TypeError, KeyError, ValueError):
            raise _unknown(scenario, path) from None
        is_entry = isinstance(value, jax.Array | np.ndarray | float)
        if isinstance(steps[-1], int) and not (is_entry or dataclasses.is_dataclass(value)):
            raise _unknown(scenario, path)
        found += steps
    if not isinstance(value, NUMBERS):
        raise _unknown(scenario, path)
    return found, value


def _steps(part: Any, tokens: list[str | int]) -> tuple[list[str | int], list[str | int]]:
    """The fields and indices of the first tokens of a path in a component, and the tokens that are
    left.
    """
    token = tokens[0]
    if isinstance(token, int):
        return [token], tokens[1:]
    if isinstance(token, RowName):
        raise KeyError(token)
    if _has_field(part, token):
        return [token], tokens[1:]
    rows = component_member(type(part), "rows")
    if token in rows:
        names, fields = rows[token]
        row, field = tokens[1:3]
        if field not in fields:
            raise KeyError(field)
        index = row if isinstance(row, int) else vars(part)[names].index(row)
        return [field, index], tokens[3:]
    stacked = component_member(type(part), "stacked")
    if token in stacked:
        row = tokens[1]
        if not isinstance(row, int):
            raise KeyError(row)
        return _rows_of(part, stacked[token])[row], tokens[2:]
    wrapped = wrapped_field(part)
    if wrapped:
        return [wrapped], tokens
    return [token], tokens[1:]


def _has_field(part: Any, name: str) -> bool:
    return any(field.name == name for field in dataclasses.fields(part))


def _member(part: Any, step: str | int) -> Any:
    """The non-static field or the entry of a part.  An error if there is none: JAX would take the
    nearest entry.
    """
    if isinstance(step, str):
        if step not in [f.name for f in dataclasses.fields(part) if not f.metadata.get("static")]:
            raise AttributeError(step)
        return vars(part)[step]
    if not isinstance(part, tuple | list | jax.Array | np.ndarray):
        raise TypeError(part)
    if not -len(part) <= step < len(part):
        raise IndexError(step)
    return part[step]


def _replaced(part: Any, tokens: list[str | int], value: Any, path: str, sign: str | None) -> Any:
    """A copy of `part` with the leaf at `tokens` replaced: checked, and of the same structure."""
    if not tokens or isinstance(part, NUMBERS):
        return _new_value(part, tokens, value, path, sign)
    head, rest = tokens[0], tokens[1:]
    if isinstance(head, int):
        parts = list(part)
        parts[head] = _replaced(part[head], rest, value, path, sign)
        return tuple(parts)
    copy = object.__new__(type(part))
    values = field_values(part)
    for field in dataclasses.fields(part):
        member = values[field.name]
        if field.name == head:
            member = _replaced(member, rest, value, path, field.metadata.get("sign"))
        object.__setattr__(copy, field.name, member)
    return copy


def _new_value(
    old: Any, tokens: list[str | int], value: Any, path: str, sign: str | None
) -> jax.Array:
    """The new array of a leaf of which all, or one entry, is replaced."""
    old = jnp.asarray(old)
    index = tuple(t for t in tokens if isinstance(t, int))
    shape = old[index].shape if index else old.shape
    new = checks.as_floats(path, value)
    if new.shape not in ((), shape):
        raise checks.fail(path, value, f"one number or shape {shape}", f"Its shape is {new.shape}.")
    checks.check_values(path, new, sign)
    new = jnp.broadcast_to(new, shape).astype(old.dtype)
    return old.at[index].set(new) if index else new


def with_parameters(scenario: Scenario, values: Mapping[str, Any]) -> Scenario:
    """A copy of the scenario with some leaves replaced.

    Args:
      scenario: the original; it stays as it is.
      values: path -> number or array; a scalar fills every entry of its leaf.  Values may be
        traced, for derivatives by them.

    Returns:
      A new Scenario of the same structure: nothing recompiles, unless a zero, a one or an equality
        in an arm's geometry appears or disappears.

    Raises:
      ValueError: an unknown path, a wrong shape, sign or type; the message names the path and the
        remedy.
    """
    _check_component(scenario)
    if not isinstance(values, Mapping):
        expected = 'a mapping from path to value, such as {"controller.K2": 30.0}'
        raise checks.fail("values", values, expected)
    for path, value in values.items():
        for full in expand(path):
            scenario = _replaced(scenario, _resolved(scenario, path, full)[0], value, full, None)
    return scenario


def why_inadmissible(scenario: Scenario, values: Mapping[str, Any]) -> str:
    """Why the scenario with these leaves replaced cannot be run, in words (a start outside its
    bounds, a negative mass); "" if it can.
    """
    with notices.muted():  # without advice on gains
        try:
            canonical(with_parameters(scenario, values))
        except ValueError as error:
            return str(error)
    return ""
