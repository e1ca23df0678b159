"""Converts components to tables (dicts, lists, numbers, strings) of a scenario file, and back.

The conversion is generic.  The table of a component has one key per field, and `kind = "<name>"`
where the field may hold any member of a family.  The annotation of the field names the family
(`barrier: Barrier`), and the family's MEMBERS names its members.  A new member, or a law that
contains another law, therefore needs no change in this module.

Every error is a ValueError that names the dotted key, what came, what was expected, and the remedy.
"""

from __future__ import annotations

import dataclasses
import typing
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.control import actuators, barriers, controllers, decays, observers, sensors
from iblf_jax.core import checks, modules
from iblf_jax.core.pytree import field_values, is_component_class, is_leaf_field
from iblf_jax.files import earlier
from iblf_jax.files.modules import ReadPart, encode_module
from iblf_jax.files.values import (
    NONE,
    Words,
    as_table,
    decode_static,
    did_you_mean,
    dotted,
    encode_numbers,
    encode_static,
    entry_hint,
    known_keys,
    missing,
    not_storable,
    numbers,
    without_none,
)
from iblf_jax.world import bounds, disturbances, plants, process_noise, references, regions, robots


class Family(NamedTuple):
    """The classes that a field of one protocol may hold."""

    module: str
    """The public module of the family."""
    tables: dict[str, dict[str, Any]]
    """Name of a table of this module -> the table itself, and no copy: users add their classes to
    it.  A class of a user belongs into the last one."""

    @property
    def members(self) -> dict[str, Any]:
        """Name -> class, those of users included."""
        return {name: cls for table in self.tables.values() for name, cls in table.items()}

    def registration(self, name: str, cls: str) -> str:
        """The statement that gives a class a name in files."""
        return f'iblf_jax.{self.module}.{next(reversed(self.tables))}["{name}"] = {cls}'


def family(module: str, members: dict[str, Any]) -> Family:
    """The family whose members are those of one table."""
    return Family(module, {"MEMBERS": members})


FAMILIES: dict[Any, Family] = {
    robots.Robot: family("robots", robots.MEMBERS),
    plants.Plant: family("plants", plants.MEMBERS),
    plants.Restoring: Family("plants", {"RESTORING": plants.RESTORING}),
    references.Reference: family("references", references.MEMBERS),
    bounds.Side: family("bounds", bounds.MEMBERS),
    regions.Region: family("regions", regions.MEMBERS),
    disturbances.Disturbance: family("disturbances", disturbances.MEMBERS),
    controllers.TrackingLaw: family("controllers", controllers.MEMBERS),
    barriers.Barrier: family("barriers", barriers.MEMBERS),
    decays.Decay: family("decays", decays.MEMBERS),
    observers.DisturbanceObserver: family("observers", observers.MEMBERS),
    sensors.AnySensor: family("sensors", sensors.MEMBERS),
    sensors.LevelSensor: Family("sensors", {"LEVEL_SENSORS": sensors.LEVEL_SENSORS}),
    sensors.Velocity: Family("sensors", {"VELOCITIES": sensors.VELOCITIES}),
    process_noise.ProcessNoise: family("process_noise", process_noise.MEMBERS),
    actuators.Actuator: family("actuators", actuators.MEMBERS),
}
"""Base class -> its family; modules above this one add theirs."""


def field_hints(cls: Any) -> dict[str, Any]:
    """Field name -> annotation of a component class; empty if they cannot be resolved."""
    try:
        return typing.get_type_hints(cls, include_extras=True)
    except (NameError, TypeError, AttributeError):
        return {}


def families_of(hint: Any) -> list[Any]:
    """The protocols of the families of which an annotation allows the members; none if it allows
    other classes.

    `Annotated[Robot, Plant]` allows those of both families.
    """
    options = [without_none(hint)[0]]
    if typing.get_origin(hint) is typing.Annotated:
        options = [hint.__origin__, *hint.__metadata__]
    found = []
    for option in options:
        if not isinstance(option, type) or is_component_class(option):
            return []
        # Such as the base class of laws for a `RobotLaw`.
        bases = [base for base in option.__mro__ if base in FAMILIES]
        if not bases:
            return []
        found.append(bases[0])
    return found


def members_of(hint: Any) -> tuple[str, dict[str, Any]]:
    """Name and members of the families that an annotation names; for other annotations all members
    whose names are unique.
    """
    named = families_of(hint)
    if named:
        families = [FAMILIES[protocol] for protocol in named]
        words = " or ".join(dict.fromkeys(one.module for one in families))
        return words, {name: x for one in families for name, x in one.members.items()}
    seen: dict[str, list[Any]] = {}
    for one in FAMILIES.values():
        for name, cls in one.members.items():
            seen.setdefault(name, []).append(cls)
    return "any family", {name: found[0] for name, found in seen.items() if len(found) == 1}


# --- to tables


def encode(part: Any, hint: Any, path: str) -> Any:
    """The table, list or number of a file for one non-static field.

    Args:
      part: a component, an array, or a tuple of these.
      hint: annotation of the field.
      path: dotted key, for messages.

    Raises:
      ValueError: a class that is in no MEMBERS, or an object that a file cannot hold.
    """
    if part is None:
        return NONE
    family = hint
    hint, _ = without_none(hint)
    if isinstance(part, jax.Array | np.ndarray | np.generic | float | int):
        return encode_numbers(part)
    if modules.is_module(part) and not families_of(family):
        return encode_module(part)
    if isinstance(part, tuple | list):
        return [encode(x, entry_hint(hint, i), f"{path}[{i}]") for i, x in enumerate(part)]
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        raise not_storable(path, part, "a component, an array, a module or a tuple of these")
    if type(part) is hint:
        return encode_fields(part, path)
    words, members = members_of(family)
    name = next((name for name, cls in members.items() if cls is type(part)), None)
    if name is None:
        cls = type(part).__name__
        expected = f"a member of {words} that a file can name ({', '.join(members)})"
        entry = _registration(family, "my_name", cls, part)
        remedy = f"Name your class before saving and loading: {entry}."
        raise checks.fail(path, Words(f"an object of class {cls}"), expected, remedy)
    return {"kind": name, **encode_fields(part, path)}


def _registration(hint: object, name: str, cls: str, part: object = None) -> str:
    """The statement that gives a class a name in files.

    Args:
      hint: annotation of the field that holds an object of the class.
      name, cls: the name and the class.
      part: the object; None if it is not known.
    """
    named = families_of(hint)
    if not named:
        return f'iblf_jax.<family>.MEMBERS["{name}"] = {cls}'
    base = next((base for base in named if isinstance(part, base)), named[0])
    return FAMILIES[base].registration(name, cls)


def encode_fields(part: Any, path: str) -> dict[str, Any]:
    """The table of one component, without its kind; optional fields that are empty are left out."""
    table: dict[str, Any] = {}
    hints = field_hints(type(part))
    values = field_values(part)
    for field in dataclasses.fields(part):
        value = values[field.name]
        key = dotted(path, field.name)
        if value is field.default is None:
            continue
        if isinstance(value, tuple) and not value and field.default == ():
            continue
        if value is None:
            table[field.name] = NONE
        elif field.metadata.get("static"):
            table[field.name] = encode_static(value, key)
        else:
            table[field.name] = encode(value, hints.get(field.name, Any), key)
    return table


# --- from tables


def decode(value: object, hint: Any, path: str) -> Any:
    """The component, array or tuple of one non-static field; the inverse of `encode`.

    Args:
      value: the value in the file.
      hint: annotation of the field.
      path: dotted key, for messages.

    Raises:
      ValueError: a value that does not fit; the message names the dotted key.
    """
    if isinstance(value, ReadPart):
        return value.part
    family = hint
    hint, is_optional = without_none(hint)
    if is_optional and value == NONE:
        return None
    if families_of(family):
        return _decode_member(as_table(value, path), family, path)
    if dataclasses.is_dataclass(hint):
        return decode_fields(hint, value, path)
    is_tuple = typing.get_origin(hint) is tuple
    if isinstance(value, list) and (is_tuple or any(isinstance(x, dict) for x in value)):
        return tuple(decode(x, entry_hint(hint, i), f"{path}[{i}]") for i, x in enumerate(value))
    if is_tuple and isinstance(value, dict):
        return (decode(value, entry_hint(hint, 0), path),)
    if is_tuple:
        raise checks.fail(path, value, "a list")
    if isinstance(value, dict):
        return _decode_member(value, hint, path)
    return checks.as_floats(path, numbers(value, path))


def _decode_member(table: dict[str, Any], hint: Any, path: str) -> Any:
    family, members = members_of(hint)
    expected = f"the name of one of the {family}"
    kind = table.get("kind")
    if isinstance(kind, str) and kind in earlier.FORMER_MEMBERS and kind not in members:
        table = earlier.FORMER_MEMBERS[kind](table)
        kind = table["kind"]
    if kind is None:
        remedy = f'Write kind = "{next(iter(members))}".'
        raise missing(f"{path}.kind", f"{expected}: {', '.join(members)}", remedy)
    if not isinstance(kind, str) or kind not in members:
        entry = _registration(hint, checks.one_line(str(kind)), "TheClass")
        remedy = (
            f"{did_you_mean(kind, members)} If it is your own class, register it first: {entry}."
        )
        raise checks.fail(f"{path}.kind", kind, expected, remedy.strip())
    return decode_fields(members[kind], {key: x for key, x in table.items() if key != "kind"}, path)


def decode_fields(cls: Any, table: Any, path: str) -> Any:
    """A component of class `cls` from its table; checks every key."""
    checks.flat_enough(path, as_table(table, path))
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
    table = earlier.with_present_names(table, fields)
    known_keys(table, path, fields)
    hints = field_hints(cls)
    values = {}
    for name, field in fields.items():
        key = dotted(path, name)
        if name in table:
            hint = hints.get(name, Any)
            if field.metadata.get("static"):
                values[name] = decode_static(table[name], hint, key)
            elif is_leaf_field(field):
                values[name] = numbers(table[name], key, field.metadata["unit"])
            else:
                values[name] = decode(table[name], hint, key)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            remedy = f"Add {name} to [{path}]; {cls.__name__} has no default for it."
            expected = "a table with a kind"
            if is_leaf_field(field):
                expected = f"a number{SHAPES[field.metadata['shape']]} [{field.metadata['unit']}]"
            elif field.metadata.get("static"):
                expected = "a value"
            raise missing(key, expected, remedy)
    return construct(cls, values, path)


SHAPES = {
    "joint": ", or one per joint",
    "level": ", or one per level",
    "any": " or a list of numbers",
    "scalar": "",
}
"""Shape of a leaf -> the words of an error message."""


def construct(make: Any, values: dict[str, Any], path: str) -> Any:
    """`make(**values)`; an error becomes a ValueError that names the key in the file instead of the
    class.
    """
    try:
        return make(**values)
    except Exception as error:
        text = str(error)
        class_name = f"{make.__name__}."
        if text.startswith(class_name):
            text = dotted(path, text.removeprefix(class_name))
        elif path and not text.startswith(path):
            text = f"{path}: {text}"
        raise ValueError(text) from error
