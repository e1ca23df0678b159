"""Warnings of the package: each is shown once per call of a public function, at the user's line.

`warnings.warn(text, stacklevel=...)` counts frames, and the number of frames between a check and
the user's line depends on the path through the package. With a wrong count Python shows a line of
the package, and shows the same text again for every path, because it takes each for another place.
`warn` therefore searches for the frame of the user, and `each_warning_once` marks a call.

Python 3.12 has `skip_file_prefixes` for this search; the package also runs on 3.11.
"""

from __future__ import annotations

import contextlib
import functools
import sys
import warnings
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from types import FrameType
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable)

NOT_THE_USER = (
    *("iblf_jax", "jax", "jaxlib", "contextlib", "functools"),
    *("importlib", "concurrent", "threading", "runpy"),
)
"""Packages and modules whose frames lie between a check of this package and the line of its
user."""

_GIVEN: ContextVar[set[str] | None] = ContextVar("iblf_jax_warnings", default=None)
"""The warnings that the current public call has given; None outside of every such call."""
_MUTED: ContextVar[type[Warning] | None] = ContextVar("iblf_jax_muted", default=None)
"""The category of warnings that are not shown at present."""


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Warns at the user's line, unless the current call has given the same warning already.

    Args:
      text: the message.
      category: of the warning.
    """
    muted = _MUTED.get()
    if muted is not None and issubclass(category, muted):
        return
    given = _GIVEN.get()
    if given is not None:
        if text in given:
            return
        given.add(text)
    # How many frames above this one the user's line is, as the argument `stacklevel` counts them;
    # more than there are if there is no such line, as in the command line.
    level = 1
    frame: FrameType | None = sys._getframe()
    while frame is not None:
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package not in NOT_THE_USER:
            break
        # `warnings.warn` does not count the frames of the import system.
        filename = frame.f_code.co_filename
        if "importlib" not in filename or "_bootstrap" not in filename:
            level += 1
        frame = frame.f_back
    warnings.warn(text, category, stacklevel=level)


def each_warning_once(function: F) -> F:
    """Decorator of a public function: one call of it, including the public functions that it calls,
    gives each warning once.
    """

    @functools.wraps(function)
    def called(*args: Any, **options: Any) -> Any:
        if _GIVEN.get() is not None:
            return function(*args, **options)
        token = _GIVEN.set(set())
        try:
            return function(*args, **options)
        finally:
            _GIVEN.reset(token)

    return cast(F, called)


@contextlib.contextmanager
def muted(category: type[Warning] = Warning) -> Iterator[None]:
    """Context in which no warning of this category is shown, and none counts as given."""
    token = _MUTED.set(category)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", category)
            yield
    finally:
        _MUTED.reset(token)
