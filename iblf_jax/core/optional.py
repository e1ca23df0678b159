"""Access to the optional members of a protocol, with their defaults.

Classes that users write may leave out some attributes and methods of a protocol.  Each family
declares these once, with their defaults, as an `OptionalMembers` beside its protocol; the rest of
the package reads them through it and never by `getattr` with a default of its own.
"""

from __future__ import annotations

from typing import Any


class OptionalMembers:
    """Reads the optional members of a family: `law.uses_observer`.

    Args:
      defaults: name of a member -> its value for a class that does not have it.
    """

    def __init__(self, **defaults: Any) -> None:
        self.defaults = defaults

    def __call__(self, part: Any, name: str) -> Any:
        """The member of an object, or of a class, or its default.

        Raises:
          KeyError: a name that the family does not declare.
        """
        return getattr(part, name, self.defaults[name])

    def variant(self, part: Any, name: str) -> Any:
        """The variant of a part that its member `name` is, such as a sensor without rounding; the
        part itself if it declares none.

        Raises:
          KeyError: a name that the family does not declare.
        """
        found = self(part, name)
        return part if found is None else found
