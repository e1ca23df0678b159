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
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from iblf_jax.core.caches import CACHE

X = TypeVar("X")
R = TypeVar("R")

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

        def __get__(self, part: object, owner: type | None = None) -> Any:
            return self if part is None else self.value(part)


class Part(metaclass=abc.ABCMeta):  # noqa: B024 (the families have abstract methods)
    """What every component may state about itself."""

    wraps: ClassVar[str | None] = None
    """The name of the field that holds a wrapped component. Paths then reach through it."""
    named_rows: ClassVar[Mapping[str, Any]] = NO_NAMES
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

    def symbols_of_part(self, field: str, index: int, symbols: object) -> Any:
        """The units of the symbols in a part, from those of the symbols in this component."""
        return symbols


class _Nothing(Part):
    """A part that states nothing."""


_NOTHING = _Nothing()


def statements_of(part: object) -> Part:
    """What a part states about itself: the part, or the defaults if it is no component."""
    return part if isinstance(part, Part) else _NOTHING


class Default:
    """A member of a base class in a class that does not inherit from it.

    What an object has, and what a class of its own has, come first: in whatever order the classes
    of the object stand, and whenever they are adopted.

    Args:
      base: the base class that defines the member.
      name: of the member.
    """

    def __init__(self, base: type, name: str) -> None:
        self.base = base
        self.name = name

    def __get__(self, part: Any, cls: type) -> Any:
        own = (vars(owner).get(self.name, self) for owner in cls.__mro__)
        member = next((x for x in own if not isinstance(x, Default)), None)
        if member is None and part is not None and hasattr(cls, "__getattr__"):
            # A wrapper of another object, whose members it takes.
            with suppress(AttributeError):
                return part.__getattr__(self.name)
        if member is None:
            member = vars(self.base)[self.name]
        return member.__get__(part, cls) if hasattr(member, "__get__") else member


def contract_of(part: object, of_x: type[X], of_robot: type[R]) -> type[X] | type[R]:
    """The contract that a part is meant to fit: that of parts of the state x, or that of parts of q
    and q'.

    A class without a base class says by the attribute `receives_x` that it receives x.
    """
    if isinstance(part, of_robot):
        return of_robot
    if isinstance(part, of_x) or getattr(part, "receives_x", False) is True:
        return of_x
    return of_robot


def adopt(cls: type, base: type) -> None:
    """Gives a class the members of `base` that it lacks, and makes its objects instances of `base`.

    Its own members, its fields and what it inherits stay as they are.
    """
    if not issubclass(base, Part) or issubclass(cls, base):
        return
    with _ADOPTING:
        own = set()
        for name in (*dir(cls), *_annotated(cls)):
            # The default of a class that `base` refines gives way.
            known = inspect.getattr_static(cls, name, None)
            if not (isinstance(known, Default) and issubclass(base, known.base)):
                own.add(name)
        for owner in _lines_of(base):
            for name, member in vars(owner).items():
                if name not in own and not _is_of_python(name) and not _is_abstract(member):
                    own.add(name)
                    setattr(cls, name, Default(owner, name))
        if cls.__reduce__ is object.__reduce__:
            # Another process that imports the class by its name adopts it, too.
            cls.__reduce__ = _reduced  # type: ignore[assignment, method-assign]
        earlier = getattr(cls, _BASES, ())
        setattr(cls, _BASES, (*(x for x in earlier if x is not base), base))
        base.register(cls)  # type: ignore[attr-defined]


def adopt_again(cls: type) -> None:
    """Makes a class that has come from another process by value an instance of what it was there:
    it has the members, but no base class knows it.
    """
    for base in getattr(cls, _BASES, ()):
        adopt(cls, base)


_ADOPTING = threading.RLock()
_BASES = "_adopted_by"
"""Attribute of a class with the base classes that have adopted it."""


def is_default(method: object, default: object) -> bool:
    """Whether the method of a part is that of its base class, `is_default(plant.at, Plant.at)`."""
    return getattr(method, "__func__", None) is default


@CACHE.memoised(64)
def required_members(base: type) -> tuple[str, ...]:
    """The names of the members without a default."""
    abstract = set(getattr(base, "__abstractmethods__", ()))
    without_value = {name for name in _annotated(base) if not hasattr(base, name)}
    return tuple(sorted(abstract | without_value))


def _reduced(part: object) -> tuple:
    cls = type(part)
    return _restored, (cls, getattr(cls, _BASES)), part.__getstate__()


def _restored(cls: type, bases: tuple[type, ...]) -> Any:
    """An empty object of a class that `bases` have adopted."""
    for base in bases:
        adopt(cls, base)
    return object.__new__(cls)


def _lines_of(base: type) -> Iterator[type]:
    """The classes that `base` consists of, the most special one first."""
    return (cls for cls in base.__mro__ if cls is not object)


def _annotated(cls: type) -> set[str]:
    """The names of the annotated attributes of a class and of those that it inherits from."""
    return {name for owner in _lines_of(cls) for name in inspect.get_annotations(owner)}


def _is_of_python(name: str) -> bool:
    return name.startswith("__") or name == "_abc_impl"


def _is_abstract(member: object) -> bool:
    return bool(vars(member).get("__isabstractmethod__")) if hasattr(member, "__dict__") else False
