"""One path language for every leaf of a scenario: "controller.K2", "plant.mass[1]", "initial.q",
"disturbance.phase".

Sweeps, perturbations, tuning and scenario files all address leaves by these paths.  Names follow
the fields of the components; `[i]` selects a part of a `Sum` or one entry of an array.  A component
with rows that have names (class attribute `rows`, such as `robots.Arm`) can be addressed by them:
"plant.link[forearm].mass", "plant.joint[elbow].damping"; numbers from 0 do as well as names. A name
without a letter, or with a bracket, a line break or the like, is written as a JSON string:
'plant.link["a]b"].mass'. `robot.` stands for `plant.` and `model.` together: use it to change the
robot that is simulated and the one that the law knows alike. A component that wraps another (class
attribute `wraps`, such as `controllers.Saturated`) is looked through: "controller.K2" is the
wrapped law's K2, and "controller.law.K2" works too.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices, tables
from iblf_jax.simulation.scenario import Scenario, canonical

_BARE = r"[^\[\]]*[^\W\d_][^\[\]]*"
"""The name of a row that needs no quotes."""
_TOKEN = re.compile(
    rf"""\.?([A-Za-z_]\w*)|\[(-?\d{{1,18}})\]|\[("(?:[^"\\]|\\.)*")\]|\[({_BARE})\]"""
)


class RowName(str):
    """A token of a path that was the name of a row, in brackets."""

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
        def shown(value):
            return (
                np.array2string(np.asarray(value), precision=6, threshold=8)
                if checks.is_concrete(value)
                else "traced"
            )

        return [(p.path, str(p.shape), p.unit, shown(p.value)) for p in self]

    def __repr__(self) -> str:
        return "\n".join(tables.as_text([Parameter._fields, *self._rows()]))

    def _repr_html_(self) -> str:
        return tables.as_html(Parameter._fields, self._rows())


def parameters(scenario: Scenario, *, named: bool = True) -> ParameterTable:
    """Every addressable leaf of a scenario: path, shape, unit, value.

    Args:
      scenario: any Scenario.
      named: rows of leaves by their names too, "plant.link[forearm].mass" besides "plant.mass";
        without them every number is there once.

    Returns:
      A tuple of `Parameter`, which prints as a table.
    """
    _need_component(scenario)
    return ParameterTable(_walk(scenario, "", checks.flag("named", named)))


def _need_component(scenario: Any) -> None:
    if not dataclasses.is_dataclass(scenario) or isinstance(scenario, type):
        raise checks.fail(
            "scenario", scenario, "a Scenario", "Make one with ij.presets or ij.Scenario."
        )


def _walk(
    part: Any, path: str, named: bool, units: Mapping[str, str] | None = None
) -> Iterator[Parameter]:
    units = units or {}
    if isinstance(part, tuple | list):
        for i, x in enumerate(part):
            yield from _walk(x, f"{path}[{i}]", named, units)
    elif dataclasses.is_dataclass(part) and not isinstance(part, type):
        own = {field.name for field in dataclasses.fields(part)}
        of_leaves = {**_own_units(part), **units}
        for field in dataclasses.fields(part):
            if field.metadata.get("static"):
                continue
            value, name = getattr(part, field.name), f"{path}.{field.name}" if path else field.name
            if field.name == getattr(type(part), "wraps", None):
                # As a user would type them, unless the wrapper has a field of that name.
                for inner in _walk(value, path, named):
                    rest = inner.path[len(path) :].lstrip(".")
                    yield (
                        inner
                        if parse(rest)[0] not in own
                        else inner._replace(path=f"{name}.{rest}")
                    )
                continue
            if isinstance(value, jax.Array | np.ndarray | np.generic | float | int):
                yield Parameter(name, jnp.shape(value), _unit(field, of_leaves), value)
            else:
                yield from _walk(value, name, named, {**units, **field.metadata.get("units", {})})
        if named:
            yield from _rows(part, path)


def _unit(field: dataclasses.Field, units: Mapping[str, str]) -> str:
    """The unit of a leaf: its own, unless what holds it says otherwise (`units` among the metadata
    of its field).
    """
    return str(units.get(field.name, field.metadata.get("unit", "")))


def _own_units(part: Any) -> Mapping[str, str]:
    """Units of a component's leaves that depend on its other fields, by name."""
    return part.leaf_units() if hasattr(part, "leaf_units") else {}


def _rows(part: Any, path: str) -> Iterator[Parameter]:
    """The rows that have names."""
    units = {field.name: field.metadata.get("unit", "") for field in dataclasses.fields(part)}
    for word, (names, fields) in getattr(type(part), "rows", {}).items():
        for i, name in enumerate(getattr(part, names)):
            for field in fields:
                value = getattr(part, field)
                row = value[..., i] if jnp.ndim(value) == 1 else value[i]
                place = f"{word}[{_quoted(name)}].{field}"
                yield Parameter(
                    f"{path}.{place}" if path else place, jnp.shape(row), units[field], row
                )


def _quoted(name: str) -> str:
    """The name of a row as a path spells it."""
    return (
        name
        if re.fullmatch(_BARE, name) and name.isprintable() and not name.startswith('"')
        else json.dumps(name)
    )


def _unquoted(text: str) -> str | None:
    """The name that a JSON string spells; None if it is none."""
    try:
        return json.loads(text)
    except ValueError:
        return None


def parse(path: str) -> list[str | int]:
    """The tokens of a path: names, indices and names of rows.  ValueError if it is not a path."""
    tokens: list[str | int] = []
    position = 0
    while isinstance(path, str) and position < len(path):
        match = _TOKEN.match(path, position)
        if match is None or (position == 0) == path[position].startswith((".", "[")):
            break
        name = match[4] if match[3] is None else _unquoted(match[3])
        if match[1] is None and match[2] is None and name is None:
            break
        tokens.append(
            match[1]
            if match[1] is not None
            else int(match[2])
            if match[2] is not None
            else RowName(name)
        )
        position = match.end()
    if not isinstance(path, str) or not path or position < len(path):
        raise checks.fail(
            "path", path, 'names joined by dots, with [i] for an entry, such as "plant.mass[1]"'
        )
    return tokens


def expand(path: str) -> list[str]:
    """The full paths that one path stands for: two for `robot.`, else itself.  ValueError if it is
    not a path.
    """
    parse(path)
    if path == "robot" or path.startswith(("robot.", "robot[")):
        return ["plant" + path[5:], "model" + path[5:]]
    return [path]


def _unknown(scenario: Scenario, path: str) -> ValueError:
    known = [p.path for p in parameters(scenario)]
    close = difflib.get_close_matches(path, known, n=3)
    remedy = f"Did you mean {', '.join(close)}?" if close else "ij.parameters(scenario) lists them."
    return checks.fail("path", path, "the path of a leaf of this scenario", remedy)


def get(scenario: Scenario, path: str) -> Any:
    """The value at a path (the plant's, for `robot.`)."""
    return _resolved(scenario, path, expand(path)[0])[1]


def places(scenario: Scenario, path: str) -> list[list[str | int]]:
    """Where the numbers at a path are: fields and indices alone, for each full path that it stands
    for.
    """
    return [_resolved(scenario, path, full)[0] for full in expand(path)]


def leaves(scenario: Scenario, path: str) -> list[str]:
    """The paths of the whole leaves that hold what is at a path."""

    def joined(tokens):
        while isinstance(tokens[-1], int):
            tokens = tokens[:-1]
        return "".join(
            f"[{token}]" if isinstance(token, int) else f".{token}" for token in tokens
        ).lstrip(".")

    return [joined(tokens) for tokens in places(scenario, path)]


def unit_at(scenario: Scenario, path: str) -> str:
    """The unit of the leaf at a path."""
    return str(_metadata(scenario, path).get("unit", ""))


def sign_at(scenario: Scenario, path: str) -> str | None:
    """The sign that the finite numbers at a path must have: None, "positive" or "nonnegative"."""
    sign = _metadata(scenario, path).get("sign")
    return None if sign == "limit" else "positive" if sign == "positive limit" else sign


def _metadata(scenario: Scenario, path: str) -> Mapping[str, Any]:
    """What was declared of the leaf at a path."""
    part: Any = scenario
    metadata: Mapping[str, Any] = {}
    units: dict[str, str] = {}
    for token in places(scenario, path)[0]:
        if isinstance(token, int):
            part = part[token] if isinstance(part, tuple | list) else part
        else:
            field = next(f for f in dataclasses.fields(part) if f.name == token)
            metadata = {**field.metadata, "unit": _unit(field, {**_own_units(part), **units})}
            units |= field.metadata.get("units", {})
            part = getattr(part, token)
    return metadata


def _resolved(scenario: Scenario, path: str, full: str) -> tuple[list[str | int], Any]:
    """Where a full path leads, as fields and indices, and the value there.

    The names of wrapped components are filled in, and a row by its name becomes an index.
    """
    value: Any = scenario
    place: list[str | int] = []
    tokens = parse(full)
    while tokens:
        try:
            steps, tokens = _steps(value, tokens)
            for step in steps:
                value = _entry(value, step) if isinstance(step, int) else _field(value, step)
        except (AttributeError, IndexError, TypeError, KeyError, ValueError):
            raise _unknown(scenario, path) from None
        if (
            isinstance(steps[-1], int)
            and not isinstance(value, jax.Array | np.ndarray | float)
            and not dataclasses.is_dataclass(value)
        ):
            raise _unknown(scenario, path)
        place += steps
    if not isinstance(value, jax.Array | np.ndarray | np.generic | float | int):
        raise _unknown(scenario, path)
    return place, value


def _steps(part: Any, tokens: list[str | int]) -> tuple[list[str | int], list[str | int]]:
    """The fields and indices that the first tokens stand for in a component, and the tokens that
    are left.
    """
    token = tokens[0]
    if isinstance(token, int):
        return [token], tokens[1:]
    if isinstance(token, RowName):
        raise KeyError(token)
    rows = getattr(type(part), "rows", {})
    if token in rows and not _has_field(part, token):
        names, fields = rows[token]
        which, field = tokens[1:3]
        if field not in fields:
            raise KeyError(field)
        index = which if isinstance(which, int) else getattr(part, names).index(which)
        return [field, index], tokens[3:]
    if getattr(type(part), "wraps", None) and not _has_field(part, token):
        return [type(part).wraps], tokens
    return [token], tokens[1:]


def _has_field(part: Any, name: str) -> bool:
    return any(field.name == name for field in dataclasses.fields(part))


def _entry(part: Any, index: int) -> Any:
    """Part or entry `index`; unlike an array of JAX, which takes the nearest entry, it raises
    IndexError beyond the ends.
    """
    if not isinstance(part, tuple | list | jax.Array | np.ndarray):
        raise TypeError(part)
    size = len(part) if isinstance(part, tuple | list) else part.shape[0]
    if not -size <= index < size:
        raise IndexError(index)
    return part[index]


def _field(part: Any, name: str) -> Any:
    """A non-static field of a component, by name."""
    if not dataclasses.is_dataclass(part):
        raise AttributeError(name)
    for field in dataclasses.fields(part):
        if field.name == name and not field.metadata.get("static"):
            return getattr(part, name)
    raise AttributeError(name)


def _replaced(part: Any, tokens: list[str | int], value: Any, path: str, sign: str | None) -> Any:
    """`part` with the leaf at `tokens` replaced; values are checked, structure is kept."""
    if not tokens or isinstance(part, jax.Array | np.ndarray | np.generic | float | int):
        return _new_value(part, tokens, value, path, sign)
    head, rest = tokens[0], tokens[1:]
    if isinstance(head, int):
        return tuple(
            _replaced(x, rest, value, path, sign) if i == head % len(part) else x
            for i, x in enumerate(part)
        )
    copy = object.__new__(type(part))
    for field in dataclasses.fields(part):
        old = getattr(part, field.name)
        new = (
            _replaced(old, rest, value, path, field.metadata.get("sign"))
            if field.name == head
            else old
        )
        object.__setattr__(copy, field.name, new)
    return copy


def _new_value(
    old: Any, tokens: list[str | int], value: Any, path: str, sign: str | None
) -> jax.Array:
    """The new array in place of a leaf, or of one of its entries."""
    old = jnp.asarray(old)
    index = tuple(t for t in tokens if isinstance(t, int))
    target = old[index] if index else old
    new = checks.as_floats(path, value)
    if new.shape not in ((), target.shape):
        raise checks.fail(
            path, value, f"one number or shape {target.shape}", f"Its shape is {new.shape}."
        )
    checks.check_values(path, new, sign)
    new = jnp.broadcast_to(new, target.shape).astype(old.dtype)
    return old.at[index].set(new) if index else new


def with_parameters(scenario: Scenario, values: Mapping[str, Any]) -> Scenario:
    """The scenario with some leaves replaced.

    Args:
      scenario: what to change; it stays as it is.
      values: path -> number or array; a scalar fills every entry of its leaf.  Traced values are
        fine: differentiate by them.

    Returns:
      A new Scenario of the same structure: nothing recompiles, unless a zero, one or equality of an
        arm's geometry comes or goes.

    Raises:
      ValueError: an unknown path, a wrong shape, sign or type; the message names the path and the
        remedy.
    """
    _need_component(scenario)
    if not isinstance(values, Mapping):
        raise checks.fail(
            "values", values, 'a mapping from path to value, such as {"controller.K2": 30.0}'
        )
    for path, value in values.items():
        for full in expand(path):
            scenario = _replaced(scenario, _resolved(scenario, path, full)[0], value, full, None)
    return scenario


def why_inadmissible(scenario: Scenario, values: Mapping[str, Any]) -> str:
    """Why the scenario with these leaves replaced cannot be run, in words (a start outside its
    bounds, a negative mass); "" if it can.
    """
    with notices.muted():  # advice on gains
        try:
            canonical(with_parameters(scenario, values))
        except ValueError as error:
            return str(error)
    return ""
