"""One path language for every leaf of a scenario: "controller.K2", "plant.mass[1]", "initial.q",
"disturbance.phase".

Sweeps, perturbations, tuning and scenario files address leaves by these paths.

- Names follow the fields of the components; `[i]` selects a part of a `Sum` or one entry of an
  array.
- A component whose rows have names (class attribute `named_rows`, such as `robots.Arm`) can be
  addressed by them: "plant.link[forearm].mass", "plant.joint[elbow].damping"; numbers from 0 work
  as well. A name without a letter, or with a bracket, a line break or the like, is written as a
  JSON string: 'plant.link["a]b"].mass'.
- The last index of an array with one number for each joint may be the name of the joint, as the
  robot's file has it: "controller.K2[elbow]", "initial.q[elbow]".
- `robot.` stands for `plant.` and `model.` together and changes both robots alike.
- `bounds.lower` and `bounds.upper` without an index are those of the first level:
  "bounds.upper.value" is "bounds[0].upper.value".
- Several leaves may be addressed as the rows of one array (class attribute `stacked`):
  "initial.x[2]" is the third level of the start of a plant, "initial.x[0]" its initial.q.
- The arrays of a module of another library have the paths that its classes give them, with the
  keys of dicts in brackets: "controller.net.layers[0].weight[1][2]", "disturbance.weights[hidden]".
- A component that wraps another (class attribute `wraps`, such as `controllers.Saturated`) is
  transparent: "controller.K2" is the wrapped law's K2, and "controller.law.K2" works too.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, modules, notices, tables
from iblf_jax.core.component_paths import (
    BARE,
    has_field,
    member_of,
    parse,
    replaced,
    resolve,
    rows_of,
)
from iblf_jax.core.families import statements_of
from iblf_jax.core.modules import NUMBERS, RowName
from iblf_jax.core.pytree import field_values, wrapped_field
from iblf_jax.core.units import Unit, as_text, of_entry, resolved
from iblf_jax.simulation.scenario import HOW_TO_MAKE, Scenario, canonical
from iblf_jax.simulation.units import symbols_of
from iblf_jax.world.plants import component_names

Symbols: TypeAlias = Mapping[str, Unit]
"""Symbol of a formula of a unit -> its unit."""


class Parameter(NamedTuple):
    """One addressable leaf."""

    path: str
    shape: tuple[int, ...]
    unit: str
    value: Any


class ParameterTable(tuple[Parameter, ...]):
    """The addressable leaves of a scenario; prints as a table, in notebooks too.

    The table shows one row for a module of another library with many arrays.
    """

    large_modules: tuple[str, ...] = ()
    """Paths of the modules that are printed as one row."""

    def _rows(self) -> list[tuple[str, str, str, str]]:
        rows = []
        inside = {
            path: [p for p in self if p.path.startswith((f"{path}.", f"{path}["))]
            for path in self.large_modules
        }
        hidden = {p.path for leaves in inside.values() for p in leaves}
        heads = {leaves[0].path: path for path, leaves in inside.items()}
        for p in self:
            if p.path in heads:
                leaves = inside[heads[p.path]]
                count = sum(math.prod(x.shape) for x in leaves)
                words = f"{len(leaves)} arrays, {count} numbers"
                rows.append((f"{heads[p.path]} ...", "", "", words))
            if p.path not in hidden:
                rows.append((p.path, str(p.shape), p.unit, _value_text(p.value)))
        return rows

    def __repr__(self) -> str:
        return "\n".join(tables.as_text([Parameter._fields, *self._rows()]))

    def _repr_html_(self) -> str:
        return tables.as_html(Parameter._fields, self._rows())


def _value_text(value: Any) -> str:
    """A value as a table shows it."""
    if not checks.is_concrete(value):
        return "traced"
    values = np.asarray(value)
    if values.size > MAX_NUMBERS_OF_ROW:
        return f"{values.size} numbers from {values.min():.4g} to {values.max():.4g}"
    return np.array2string(values, precision=6, threshold=8)


MAX_NUMBERS_OF_ROW = 32
"""Most numbers of a leaf that a table shows by values."""


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
    table = ParameterTable(_walk(scenario, "", named, symbols_of(scenario)))
    table.large_modules = tuple(_large_modules(scenario, ""))
    return table


MAX_ROWS_OF_MODULE = 12
"""Most arrays of a module that a table lists one by one."""


def _large_modules(part: Any, path: str) -> Iterator[str]:
    """The paths of the modules below a part with more arrays than a table lists."""
    if modules.is_module(part):
        if modules.number_of_leaves(part)[0] > MAX_ROWS_OF_MODULE:
            yield path
        return
    if isinstance(part, tuple | list):
        for i, x in enumerate(part):
            yield from _large_modules(x, f"{path}[{i}]")
    if not _is_component(part):
        return
    for name, value in field_values(part).items():
        inner = path if name == wrapped_field(part) else _joined(path, name)
        yield from _large_modules(value, inner)


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
    if isinstance(part, tuple | list) or modules.is_module(part):
        for token, x in modules.entries(part).items():
            yield from _walk(x, path + written(token), named, symbols)
        return
    if modules.is_float_array(part):
        yield Parameter(path, jnp.shape(part), "", part)
    if not _is_component(part):
        return
    values = field_values(part)
    for field in dataclasses.fields(part):
        if field.metadata.get("static"):
            continue
        value = values[field.name]
        name = _joined(path, field.name)
        if field.name == wrapped_field(part):
            # A leaf with the name of a field of the wrapper needs the path of the wrapped part.
            for parameter in _walk(value, path, named, symbols):
                rest = parameter.path[len(path) :].lstrip(".")
                if has_field(part, str(parse(rest)[0])):
                    parameter = parameter._replace(path=f"{name}.{rest}")
                yield parameter
        elif isinstance(value, NUMBERS):
            unit = as_text(_unit(part, field, symbols))
            yield Parameter(name, jnp.shape(value), unit, value)
        elif isinstance(value, tuple | list) and not modules.is_module(value):
            for i, x in enumerate(value):
                below = statements_of(part).symbols_of_part(field.name, i, symbols)
                yield from _walk(x, f"{name}[{i}]", named, below)
        else:
            below = statements_of(part).symbols_of_part(field.name, 0, symbols)
            yield from _walk(value, name, named, below)
    if named:
        yield from _named_rows(part, path)
        yield from _stacked_rows(part, path, symbols)


def arrays_of_module(module: Any) -> dict[str, Any]:
    """Path in the module -> array, of every leaf of a module, in the order of its leaves."""
    return {p.path.lstrip("."): p.value for p in _walk(module, "", False, {})}


def _unit(part: Any, field: dataclasses.Field, symbols: Symbols) -> Unit:
    """The unit of a leaf of a component, as the component or the field states it."""
    stated = statements_of(part).leaf_units()
    return resolved(stated.get(field.name, field.metadata.get("unit", "")), symbols)


def _named_rows(part: Any, path: str) -> Iterator[Parameter]:
    """The rows of leaves that have names."""
    units = {field.name: field.metadata.get("unit", "") for field in dataclasses.fields(part)}
    values = field_values(part)
    for kind, (names, fields) in statements_of(part).named_rows.items():
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
    for kind, names in statements_of(part).stacked.items():
        for i, (name, *index) in enumerate(rows_of(part, names)):
            at = tuple(index)
            unit = of_entry(_unit(part, fields[name], symbols), at, jnp.ndim(values[name]))
            value, row = values[name][at], as_text(unit)
            yield Parameter(_joined(path, f"{kind}[{i}]"), jnp.shape(value), row, value)


def _quoted(name: str) -> str:
    """The name of a row as a path contains it."""
    needs_no_quotes = re.fullmatch(BARE, name) and name.isprintable() and not name.startswith('"')
    return name if needs_no_quotes else json.dumps(name)


SHORT_PATHS: tuple[tuple[re.Pattern, Any], ...] = (
    (re.compile(r"^bounds(?=\.(lower|upper)\b)"), "bounds[0]"),
    (re.compile(r"^velocity_bounds\b"), "bounds[1]"),
    (re.compile(r"^state_bounds\[(\d+)\]"), lambda found: f"bounds[{int(found[1]) + 1}]"),
)
"""Beginnings of paths -> the full ones.  Files of earlier versions have `velocity_bounds`, and
`state_bounds` from the second level on."""


def full_path(path: str) -> str:
    """A path without the shorthands of `SHORT_PATHS`."""
    for pattern, full in SHORT_PATHS:
        path = pattern.sub(full, path)
    return path


def expand(path: str) -> list[str]:
    """The full paths of a path: two for `robot.`, else one.  ValueError if it is not a path."""
    parse(path)
    path = full_path(path)
    if path == "robot" or path.startswith(("robot.", "robot[")):
        return ["plant" + path[5:], "model" + path[5:]]
    return [path]


def get(scenario: Scenario, path: str) -> Any:
    """The value at a path (the plant's, for `robot.`)."""
    return _resolved(scenario, path, expand(path)[0])[1]


def places(scenario: Scenario, path: str) -> list[list[str | int]]:
    """The location of the numbers at a path, for each of its full paths: fields and indices."""
    return [_resolved(scenario, path, full)[0] for full in expand(path)]


def leaves(scenario: Scenario, path: str) -> list[str]:
    """The paths of the complete leaves that contain the numbers at a path."""
    found = []
    for tokens in places(scenario, path):
        part: Any = scenario
        leaf_path = ""
        for token in tokens:
            if isinstance(part, NUMBERS):
                break
            part = member_of(part, token)
            leaf_path += written(token)
        found.append(leaf_path.lstrip("."))
    return found


def written(token: str | int) -> str:
    """A field, an index or a key as a path contains it."""
    if isinstance(token, RowName):
        return f"[{_quoted(token)}]"
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
    while not modules.is_module(part):
        name = str(tokens[0])
        after = itertools.takewhile(lambda token: isinstance(token, int), tokens[1:])
        index = tuple(int(i) for i in after)
        tokens = tokens[1 + len(index) :]
        field = next(f for f in dataclasses.fields(part) if f.name == name)
        value = vars(part)[name]
        if isinstance(value, NUMBERS):
            unit = of_entry(_unit(part, field, symbols), index, jnp.ndim(value))
            return {**field.metadata, "unit": unit}
        symbols = statements_of(part).symbols_of_part(name, index[0] if index else 0, symbols)
        part = value
        for i in () if modules.is_module(value) else index:
            part = part[i]
    return {}  # The numbers of a module have no declared unit.


def _resolved(scenario: Scenario, path: str, full: str) -> tuple[list[str | int], Any]:
    """Fields and indices of a full path, and the value there.

    The names of wrapped components are inserted, and the name of a row becomes an index.
    """
    try:
        return resolve(scenario, _with_joint_number(scenario, full))
    except LookupError:
        known = [p.path for p in parameters(scenario)]
        remedy = (
            _known_joints(scenario, full)
            or checks.nearest(full_path(path), known)
            or "ij.parameters(scenario) lists them."
        )
        expected = "the path of a leaf of this scenario"
        raise checks.fail("path", path, expected, remedy) from None


def _known_joints(scenario: Scenario, full: str) -> str:
    """The remedy for a path whose last index would be the name of a joint, if there were one."""
    leaf, _ = _split_at_joint(scenario, full)
    if not leaf:
        return ""
    field = parse(leaf)[-1]
    names = component_names(scenario.plant)
    entries = ", ".join(f"{field}[{i}] ({name})" for i, name in enumerate(names))
    return f"There are {entries}."


def _with_joint_number(scenario: Scenario, full: str) -> str:
    """A path whose last index is its number where it is the name of a joint.

    Paths that have a meaning of their own keep it: keys of dicts of modules, and rows of links.
    """
    leaf, name = _split_at_joint(scenario, full)
    if not leaf:
        return full
    joints = component_names(scenario.plant)
    return f"{leaf}[{joints.index(name)}]" if joints.count(name) == 1 else full


def _split_at_joint(scenario: Scenario, full: str) -> tuple[str, str]:
    """The path of a leaf with an entry for each joint, and the name that is its index; two empty
    texts for any other path.
    """
    try:
        last = parse(full)[-1]
        if not isinstance(last, RowName):
            return "", ""
        leaf = full.removesuffix(f"[{last}]").removesuffix(f"[{json.dumps(last)}]")
        value = resolve(scenario, leaf)[1]
        joints = component_names(scenario.plant)
    except (LookupError, ValueError, AttributeError):
        return "", ""
    return (leaf, last) if jnp.shape(value) == (len(joints),) else ("", "")


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
            scenario = replaced(scenario, _resolved(scenario, path, full)[0], value, full, None)
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
