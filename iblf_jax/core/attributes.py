"""Attributes of objects by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def attributes(part: object, names: Iterable[str]) -> dict[str, Any]:
    """Name -> value of these attributes of an object."""
    return {name: getattr(part, name) for name in names}


def missing_members(part: object, names: Iterable[str]) -> list[str]:
    """The names of which an object has no attribute and no method."""
    return [name for name in names if not hasattr(part, name)]


def has_members(part: object, *names: str) -> bool:
    """Whether an object has all of these attributes and methods."""
    return not missing_members(part, names)
