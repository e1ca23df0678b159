"""Pages of the base classes, records and type aliases that user-written classes need.

The page of a base class lists its members, and that of a record its fields. The text of a field is
the string that follows it in the source, which `inspect` does not return.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

from iblf_jax.core import pytree
from iblf_jax.core.families import Part, attribute
from iblf_jax.simulation.signals import SIGNALS, Sample

ALIASES = {"Leaf": pytree}
"""Type alias at the top of the package -> the module that documents it."""


def is_contract(thing: Any) -> bool:
    """Whether something is a protocol or a base class, the contract of a family."""
    if not inspect.isclass(thing):
        return False
    is_base = issubclass(thing, Part) and not pytree.is_component_class(thing)
    return is_base or getattr(thing, "_is_protocol", False)


def is_record(thing: Any) -> bool:
    """Whether something is a NamedTuple of arrays, or the sample that metrics see."""
    return inspect.isclass(thing) and (hasattr(thing, "_fields") or thing is Sample)


def types_of(module: ModuleType) -> dict[str, Any]:
    """The public base classes and records of a family, base classes first."""
    things = {
        name: thing for name, thing in vars(module).items() if _belongs_to(thing, name, module)
    }
    contracts = {name: thing for name, thing in things.items() if is_contract(thing)}
    records = {name: thing for name, thing in things.items() if is_record(thing)}
    return contracts | records


def _belongs_to(thing: Any, name: str, module: ModuleType) -> bool:
    """Whether a public name of a family's module is one of its own: listed, defined there, or what
    its members see.
    """
    if name.startswith("_"):
        return False
    listed = getattr(module, "__all__", None)
    if listed is not None:
        return name in listed
    return getattr(thing, "__module__", None) == module.__name__ or thing is Sample


def texts_of_fields(body: list[ast.stmt]) -> dict[str, str]:
    """Name of every assignment in a body -> the string that follows it, "" if none does."""
    texts = {}
    for statement, after in zip(body, [*body[1:], None], strict=True):
        target = getattr(statement, "target", None) or next(
            iter(getattr(statement, "targets", [])), None
        )
        if not isinstance(target, ast.Name):
            continue
        follows = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        texts[target.id] = inspect.cleandoc(str(after.value.value)) if follows else ""
    return texts


def alias_text(module: ModuleType, name: str) -> str:
    """What the source says of a type alias."""
    return texts_of_fields(ast.parse(inspect.getsource(module)).body).get(name, "")


def fields_of(record: type) -> dict[str, str]:
    """Name of every field of a record -> what it is."""
    texts = (
        {name: f"{signal.meaning} [{signal.unit}]" for name, signal in SIGNALS.items()}
        if record is Sample
        else {}
    )
    definition = ast.parse(textwrap.dedent(inspect.getsource(record))).body[0]
    assert isinstance(definition, ast.ClassDef)
    return texts | texts_of_fields(definition.body)


def page(
    thing: Any, name: str, level: int, body: Callable[[str], str], defined: Callable[..., str]
) -> str:
    """A base class or a record in Markdown; `body` writes a docstring, `defined` a definition."""
    family, _, short = name.rpartition(".")
    module = f"iblf_jax.{family}".rstrip(".")
    definition = defined("class", module, short)
    lines = [f"{'#' * level} {name}", "", definition, body(inspect.getdoc(thing) or ""), ""]
    if is_record(thing):
        for field, text in fields_of(thing).items():
            lines.append(f"- **{field}**: {' '.join(text.split())}" if text else f"- **{field}**")
        lines.append("")
    for member, value in _members(thing).items():
        if member.startswith("_") or not isinstance(value, FunctionType | property | attribute):
            continue
        lines += [f"{'#' * (level + 1)} {name}.{member}", ""]
        if isinstance(value, FunctionType):
            arguments = ", ".join(list(inspect.signature(value).parameters)[1:])
            lines += [defined("method", module, f"{short}.{member}", f"({arguments})")]
        lines += [body(inspect.getdoc(value) or ""), ""]
    for name_of_field, text in ({} if is_record(thing) else _attributes(thing)).items():
        lines += [f"- **{name_of_field}**: {' '.join(text.split())}", ""]
    return "\n".join(lines)


def _bases(contract: type) -> list[type]:
    """A protocol, or the base class of a family with those that it inherits from, except for what
    all components may state; the most special one first.
    """
    inherited = [cls for cls in contract.__mro__[1:] if issubclass(cls, Part) and cls is not Part]
    return [contract, *inherited]


def _members(thing: type) -> dict[str, Any]:
    """The members of a class by name, with those that the base class of a family inherits."""
    if is_record(thing):
        return dict(vars(thing))
    found: dict[str, Any] = {}
    for cls in _bases(thing):
        found = {**found, **{name: x for name, x in vars(cls).items() if name not in found}}
    return found


def _attributes(contract: type) -> dict[str, str]:
    """Annotated attributes of a contract -> what they are."""
    texts: dict[str, str] = {}
    for cls in _bases(contract):
        definition = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
        assert isinstance(definition, ast.ClassDef)
        texts = {**texts_of_fields(definition.body), **texts}
    return texts
