"""Warnings of the package: each once in a call of the user's, at the user's line.

`warnings.warn(text, stacklevel=...)` counts frames, and the number of frames between a check and
the user's line differs between the routes through the package.  A wrong count shows a line of the
package with its source, and the same text again for every route, because Python takes it for
another place.  So `warn` looks for the frame of the user, and `each_warning_once` marks a call.

Python 3.12 has `skip_file_prefixes` for the first; the package runs on 3.11 too.
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
"""The texts that the current call of the package has warned with; None outside of every call."""
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
    warnings.warn(text, category, stacklevel=_levels_to_the_user())


def _levels_to_the_user() -> int:
    """How many frames above `warn` the user's line is, as the argument `stacklevel` counts them.

    Where there is no line of a user's, as in the command line, it is more than there are frames.
    """
    level = 1
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and _is_of_the_package(frame):
        if not _is_skipped(frame):
            level += 1
        frame = frame.f_back
    return level


def _is_of_the_package(frame: FrameType) -> bool:
    """Whether a frame is of this package, or of what stands between it and its user."""
    return str(frame.f_globals.get("__name__", "")).partition(".")[0] in NOT_THE_USER


def _is_skipped(frame: FrameType) -> bool:
    """Whether `warnings.warn` does not count a frame: one of the machinery of imports."""
    filename = frame.f_code.co_filename
    return "importlib" in filename and "_bootstrap" in filename


def each_warning_once(function: F) -> F:
    """Decorator of a public function: inside of one call of it, each warning is given once.

    What it calls counts too, other public functions included.
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
    """Inside, no warning of this category is shown, and none counts as given."""
    token = _MUTED.set(category)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", category)
            yield
    finally:
        _MUTED.reset(token)
