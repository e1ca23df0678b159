"""Base classes of families, and the adoption of classes that do not inherit from them.

A family (laws, barriers, sensors) is a folder with a base class in `_base.py`.  The base class is
the contract: its abstract methods and its attributes without a value are required, and everything
else has a default.  The package reads members as attributes and never by their names.

A user's class may inherit from the base class, or only have the members that it requires.
`adopt` gives such a class the defaults that it lacks, where one of its objects first becomes a part
of a component (`checks.conforms`).
"""

from __future__ import annotations

import abc
import inspect
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

NO_NAMES: Mapping[str, Any] = MappingProxyType({})


if TYPE_CHECKING:
    attribute = property
else:

    class attribute:  # noqa: N801 (used as `property`)
        """A property of a base class in whose place a member may have a field, a class attribute or
        a property of its own.
        """

        def __init__(self, value: Callable[[Any], Any]) -> None:
            self.value = value
            self.__doc__ = value.__doc__
            self.__isabstractmethod__ = getattr(value, "__isabstractmethod__", False)

        def __get__(self, part: Any, owner: type | None = None) -> Any:
            return self if part is None else self.value(part)


class Part(metaclass=abc.ABCMeta):  # noqa: B024 (the families have abstract methods)
    """What every component may state about itself."""

    wraps: ClassVar[str | None] = None
    """The name of the field that holds a wrapped component. Paths then reach through it."""
    rows: ClassVar[Mapping[str, Any]] = NO_NAMES
    """Rows of leaves with names."""
    stacked: ClassVar[Mapping[str, Any]] = NO_NAMES
    """Names for several leaves as the rows of one array."""

    @attribute
    def own_joints(self) -> Mapping[str, int]:
        """Field -> number of joints, of parts whose number differs from that of the scenario."""
        return NO_NAMES

    def check(self) -> None:
        """Raises ValueError for fields that do not fit together; called after construction."""
        return

    def leaf_units(self) -> Mapping[str, Any]:
        """The units of leaves that depend on other fields, by name."""
        return NO_NAMES

    def symbols_of_part(self, field: str, index: int | None, symbols: Any) -> Any:
        """The units of the symbols in a part, from those of the symbols in this component."""
        return symbols

    def advice(self) -> list[str]:
        """Warnings about the values of the fields."""
        return []


class _Nothing(Part):
    """A part that states nothing."""


_NOTHING = _Nothing()


def statements_of(part: Any) -> Part:
    """What a part states about itself: the part, or the defaults if it is no component."""
    return part if isinstance(part, Part) else _NOTHING


def adopt(cls: type, base: type) -> None:
    """Gives a class the members of `base` that it lacks, and makes its objects instances of `base`.

    Its own members, its fields and what it inherits stay as they are.
    """
    if not issubclass(base, Part) or issubclass(cls, base):
        return
    own = {*dir(cls), *_annotated(cls)}
    lacking: dict[str, Any] = {}
    for owner in _lines_of(base):
        for name, member in vars(owner).items():
            if name not in own and not _is_of_python(name):
                lacking.setdefault(name, member)
    defaults = {name: x for name, x in lacking.items() if not _is_abstract(x)}
    if hasattr(cls, "__getattr__"):
        cls.__getattr__ = _with_defaults(cls.__getattr__, defaults)
    else:
        for name, member in defaults.items():
            setattr(cls, name, member)
    base.register(cls)  # type: ignore[attr-defined]
    if cls.__reduce__ is object.__reduce__:
        # Another process that imports the class by its name adopts it, too.
        cls.__reduce__ = _reduced  # type: ignore[assignment, method-assign]
    cls._adopted_by = (*vars(cls).get("_adopted_by", ()), base)  # type: ignore[attr-defined]


def is_default(method: Any, default: Any) -> bool:
    """Whether the method of a part is that of its base class, `is_default(plant.at, Plant.at)`."""
    return getattr(method, "__func__", None) is default


def required_members(base: type) -> list[str]:
    """The names of the members without a default."""
    if not issubclass(base, Part):  # a Protocol, until the last family has its base class
        return [x for x in {*vars(base), *inspect.get_annotations(base)} if not x.startswith("_")]
    abstract = set(base.__abstractmethods__)  # type: ignore[attr-defined]
    without_value = {name for name in _annotated(base) if not hasattr(base, name)}
    return sorted(abstract | without_value)


def _reduced(part: Any) -> tuple:
    cls = type(part)
    return _restored, (cls, cls._adopted_by), part.__getstate__()


def _restored(cls: type, bases: tuple[type, ...]) -> Any:
    """An empty object of a class that `bases` have adopted."""
    for base in bases:
        adopt(cls, base)
    return object.__new__(cls)


def _with_defaults(
    own: Callable[[Any, str], Any], defaults: Mapping[str, Any]
) -> Callable[[Any, str], Any]:
    """The method `__getattr__` of a class that takes members from another object: what that object
    lacks as well is a default.
    """

    def member(part: Any, name: str) -> Any:
        try:
            return own(part, name)
        except AttributeError:
            if name not in defaults:
                raise
            found = defaults[name]
            return found.__get__(part, type(part)) if hasattr(found, "__get__") else found

    return member


def _lines_of(base: type) -> Iterator[type]:
    """The classes that `base` consists of, the most special one first."""
    return (cls for cls in base.__mro__ if cls is not object)


def _annotated(cls: type) -> set[str]:
    """The names of the annotated attributes of a class and of those that it inherits from."""
    return {name for owner in _lines_of(cls) for name in inspect.get_annotations(owner)}


def _is_of_python(name: str) -> bool:
    return name.startswith("__") or name == "_abc_impl"


def _is_abstract(member: Any) -> bool:
    return bool(vars(member).get("__isabstractmethod__")) if hasattr(member, "__dict__") else False
