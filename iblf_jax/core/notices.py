"""Warnings of the package: each once in a call of the user's, at the user's line.

`warnings.warn(text, stacklevel=...)` counts frames, and the number of frames between a check and
the user's line differs between the routes through the package.  A wrong count shows a line of the
package with its source, and the same text again for every route, because Python takes it for another
place.  So `warn` looks for the frame of the user, and `each_warning_once` marks a call.

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
"""Packages and modules whose frames lie between a check of this package and the line of its user."""

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
    frame = _users_frame()
    if frame is None:
        warnings.warn_explicit(text, category, filename="iblf_jax", lineno=1)
        return
    names = frame.f_globals
    module = names.get("__name__") or "<string>"
    registry = names.setdefault("__warningregistry__", {})
    filename, line = frame.f_code.co_filename, frame.f_lineno
    warnings.warn_explicit(text, category, filename, line, module, registry)


def _users_frame() -> FrameType | None:
    """The innermost frame that belongs neither to this package nor to what it calls, if any."""
    frame = sys._getframe(1)
    while frame is not None:
        module = str(frame.f_globals.get("__name__", ""))
        if module.partition(".")[0] not in NOT_THE_USER:
            return frame
        frame = cast(FrameType, frame.f_back)
    return None


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
