"""`help(Class)` of every component lists its fields, with what the fields themselves declare:
shape, unit, sign and default."""

import ast
import dataclasses
import functools
import importlib
import inspect
import re

from conftest import ROOT
from members import FAMILIES

import iblf_jax as ij

SHAPES = {"joint": r"\(n,\)", "scalar": r"\(\)", "any": r"\([\w, ]*\)|same shape"}
SIGNS = {"positive": "> 0", "positive limit": "> 0", "nonnegative": ">= 0"}


@functools.cache
def components() -> dict[str, type]:
    """Every class of the package under `@component`, by its name with its module."""
    found = {}
    for path in sorted((ROOT / "iblf_jax").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.parse(text).body if "component\n" in text else ():
            if "component" in map(ast.unparse, getattr(node, "decorator_list", ())):
                module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
                found[f"{module}.{node.name}"] = getattr(importlib.import_module(module), node.name)
    return found


def arguments(cls: type) -> dict[str, str]:
    """Name -> text of the Args of a class's docstring."""
    section = re.search(r"^Args:\n((?:  .*\n?)+)", inspect.getdoc(cls) or "", re.MULTILINE)
    entries = re.split(r"^  (?=\w+: )", section[1], flags=re.MULTILINE)[1:] if section else []
    pairs = (entry.split(": ", 1) for entry in entries)
    return {name: " ".join(text.split()) for name, text in pairs}


def default_of(field: dataclasses.Field) -> str:
    """What the text has to say of a field's default, "" for a field that must be given."""
    value = field.default
    if value is dataclasses.MISSING:
        return ""
    if value is None or isinstance(value, tuple):
        return "if not given"
    if isinstance(value, str):
        return f'"{value}" if not given'
    if isinstance(value, bool | int):
        return f"{value} if not given"
    if isinstance(value, float):
        return f"{value:g} if not given".replace("inf if", "infinite if")
    return f"`{type(value).__name__}()` if not given"


def lacking(cls: type) -> list[str]:
    """What the docstring of a component does not say of its fields, or says of none."""
    said, fields = arguments(cls), dataclasses.fields(cls)
    problems = [f"{name} is no field" for name in said.keys() - {field.name for field in fields}]
    for field in fields:
        text, declared = said.get(field.name, ""), field.metadata
        if not re.search(r"[A-Za-z]{3}", re.sub(r"\[.*?\]|if not given", "", text)):
            problems.append(f"{field.name} is not explained")
        if declared.get("unit") and f"[{declared['unit']}]" not in text:
            problems.append(f"{field.name} lacks its unit [{declared['unit']}]")
        if not re.search(SHAPES.get(declared.get("shape"), ""), text):
            problems.append(f"{field.name} lacks its shape")
        if SIGNS.get(declared.get("sign") or "", "") not in text:
            problems.append(f"{field.name} lacks its sign")
        if default_of(field) not in text or ("if not given" in text) != bool(default_of(field)):
            problems.append(f"{field.name} lacks its default, or has one too many")
    return problems


def test_help_lists_the_fields_with_shape_unit_sign_and_default():
    found = {name: lacking(cls) for name, cls in components().items()}
    assert found
    assert not any(found.values()), {name: x for name, x in found.items() if x}


def test_the_members_of_every_family_are_among_them():
    for _, registry, _ in FAMILIES.values():
        assert set(registry.values()) <= set(components().values())
    others = {ij.Scenario, ij.Initial, ij.bounds.Bounds, ij.robots.Payload, ij.VectorField}
    assert others <= set(components().values())


def test_this_test_can_fail():
    @ij.component
    class Half:
        """A spring.

        Args:
          k: stiffness, () or (n,) [N m], > 0.
          gone: (n,) [m].
          rest: position, (n,) [rad]; 1 if not given.
        """

        k: object = ij.leaf("N m/rad", sign="positive")
        damping: object = ij.leaf("1", sign="nonnegative", shape="scalar")
        rest: object = ij.leaf("rad", default=0.0)

    expected = {"gone is no field", "k lacks its unit [N m/rad]", "damping is not explained"}
    found = lacking(Half)
    assert expected <= {*found} and "k lacks its sign" not in found
    assert "rest lacks its default" in " ".join(found)
