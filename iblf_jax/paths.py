"""One path language for every leaf of a scenario: "controller.K2", "plant.mass[1]", "initial.q", "disturbance.phase".

Sweeps, perturbations, tuning and scenario files all address leaves by these paths.  Names follow the fields of the components;
`[i]` selects a part of a `Sum` or one entry of an array.  `robot.` stands for `plant.` and `model.` together: use it to change the
robot that is simulated and the one that the law knows alike.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax import checks
from iblf_jax.scenario import Scenario

_TOKEN = re.compile(r"\.?([A-Za-z_]\w*)|\[(-?\d+)\]")


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
            return np.array2string(np.asarray(value), precision=6, threshold=8) if checks.is_concrete(value) else "traced"

        return [(p.path, str(p.shape), p.unit, shown(p.value)) for p in self]

    def __repr__(self) -> str:
        rows = [("path", "shape", "unit", "value"), *self._rows()]
        widths = [max(len(row[i]) for row in rows) for i in range(4)]
        return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)

    def _repr_html_(self) -> str:
        import html

        head = "<tr><th>path</th><th>shape</th><th>unit</th><th>value</th></tr>"
        body = "".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in self._rows())
        return f"<table>{head}{body}</table>"


def parameters(scenario: Scenario) -> ParameterTable:
    """Every addressable leaf of a scenario: path, shape, unit, value.

    Args:
      scenario: any Scenario.

    Returns:
      A tuple of `Parameter`, which prints as a table.
    """
    _need_component(scenario)
    return ParameterTable(_walk(scenario, ""))


def _need_component(scenario: Any) -> None:
    if not dataclasses.is_dataclass(scenario) or isinstance(scenario, type):
        raise checks.fail("scenario", scenario, "a Scenario", "Make one with ij.presets or ij.Scenario.")


def _walk(part: Any, path: str) -> Iterator[Parameter]:
    if isinstance(part, tuple | list):
        for i, x in enumerate(part):
            yield from _walk(x, f"{path}[{i}]")
    elif dataclasses.is_dataclass(part) and not isinstance(part, type):
        for field in dataclasses.fields(part):
            if field.metadata.get("static"):
                continue
            value, name = getattr(part, field.name), f"{path}.{field.name}" if path else field.name
            if isinstance(value, jax.Array | np.ndarray | np.generic | float | int):
                yield Parameter(name, jnp.shape(value), field.metadata.get("unit", ""), value)
            else:
                yield from _walk(value, name)


def parse(path: str) -> list[str | int]:
    """The tokens of a path: names and indices.  ValueError if it is not a path."""
    tokens: list[str | int] = []
    position = 0
    while isinstance(path, str) and position < len(path):
        match = _TOKEN.match(path, position)
        if match is None or (position == 0) == path[position].startswith((".", "[")):
            break
        tokens.append(match[1] if match[1] is not None else int(match[2]))
        position = match.end()
    if not isinstance(path, str) or not path or position < len(path):
        raise checks.fail("path", path, 'names joined by dots, with [i] for an entry, such as "plant.mass[1]"')
    return tokens


def expand(path: str) -> list[str]:
    """The full paths that one path stands for: two for `robot.`, else itself.  ValueError if it is not a path."""
    parse(path)
    if path == "robot" or path.startswith(("robot.", "robot[")):
        return ["plant" + path[5:], "model" + path[5:]]
    return [path]


def _unknown(scenario: Scenario, path: str) -> ValueError:
    known = [p.path for p in parameters(scenario)]
    close = difflib.get_close_matches(path, known, n=3)
    mend = f"Did you mean {', '.join(close)}?" if close else "ij.parameters(scenario) lists them."
    return checks.fail("path", path, "the path of a leaf of this scenario", mend)


def get(scenario: Scenario, path: str) -> Any:
    """The value at a path (the plant's, for `robot.`)."""
    value: Any = scenario
    full = expand(path)[0]
    for token in parse(full):
        try:
            value = _entry(value, token) if isinstance(token, int) else _field(value, token)
        except (AttributeError, IndexError, TypeError, KeyError):
            raise _unknown(scenario, path) from None
        if isinstance(token, int) and not isinstance(value, jax.Array | np.ndarray | float) and not dataclasses.is_dataclass(value):
            raise _unknown(scenario, path)
    if not isinstance(value, jax.Array | np.ndarray | np.generic | float | int):
        raise _unknown(scenario, path)
    return value


def _entry(part: Any, index: int) -> Any:
    """Part or entry `index`; unlike an array of JAX, which takes the nearest entry, it raises IndexError beyond the ends."""
    if not isinstance(part, tuple | list | jax.Array | np.ndarray):
        raise TypeError(part)
    size = len(part) if isinstance(part, tuple | list) else part.shape[0]
    if not -size <= index < size:
        raise IndexError(index)
    return part[index]


def sign_at(scenario: Scenario, path: str) -> str | None:
    """The sign that the leaf at a path must have: None, "positive" or "nonnegative"."""
    part, sign = scenario, None
    for token in parse(expand(path)[0]):
        if isinstance(token, int):
            part = _entry(part, token)
        else:
            sign = next(f.metadata.get("sign") for f in dataclasses.fields(part) if f.name == token)
            part = getattr(part, token)
    return sign


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
        return tuple(_replaced(x, rest, value, path, sign) if i == head % len(part) else x for i, x in enumerate(part))
    copy = object.__new__(type(part))
    for field in dataclasses.fields(part):
        old = getattr(part, field.name)
        new = _replaced(old, rest, value, path, field.metadata.get("sign")) if field.name == head else old
        object.__setattr__(copy, field.name, new)
    return copy


def _new_value(old: Any, tokens: list[str | int], value: Any, path: str, sign: str | None) -> jax.Array:
    """The new array in place of a leaf, or of one of its entries."""
    old = jnp.asarray(old)
    index = tuple(t for t in tokens if isinstance(t, int))
    target = old[index] if index else old
    new = checks.as_floats(path, value)
    if new.shape not in ((), target.shape):
        raise checks.fail(path, value, f"one number or shape {target.shape}", f"Its shape is {new.shape}.")
    checks.check_values(path, new, sign)
    new = jnp.broadcast_to(new, target.shape).astype(old.dtype)
    return old.at[index].set(new) if index else new


def with_parameters(scenario: Scenario, values: Mapping[str, Any]) -> Scenario:
    """The scenario with some leaves replaced.

    Args:
      scenario: what to change; it stays as it is.
      values: path -> number or array; a scalar fills every entry of its leaf.  Traced values are fine: differentiate by them.

    Returns:
      A new Scenario of the same structure, so that nothing recompiles.

    Raises:
      ValueError: an unknown path, a wrong shape, sign or type; the message names the path and the mend.
    """
    _need_component(scenario)
    if not isinstance(values, Mapping):
        raise checks.fail("values", values, 'a mapping from path to value, such as {"controller.K2": 30.0}')
    for path, value in values.items():
        for full in expand(path):
            get(scenario, full)
            scenario = _replaced(scenario, parse(full), value, full, None)
    return scenario
