"""What a waiting user sees, in terminals and in notebooks: a line that says what a call does if it
takes long, and the progress bar of a study.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, TypeVar, cast

from iblf_jax.core import checks
from iblf_jax.kernels import announce_if_slow, has_reader, in_notebook

F = TypeVar("F", bound=Callable)

DELAY = 1.0
"""Seconds before a bar appears that the caller did not request."""
_LINE: ContextVar[threading.Timer | None] = ContextVar("iblf_jax_line", default=None)
"""The line of the current public call; None outside of every such call."""


def announced(text: str) -> Callable[[F], F]:
    """Decorator of a public function: a call that takes longer than two seconds prints a line, once
    for all public functions that it calls.

    The line appears where a bar would.  An argument `progress` of the function has the same meaning
    for both, and the line does not appear once a bar has been made.

    Args:
      text: what the function does, such as "tuning".
    """

    def decorate(function: F) -> F:
        @functools.wraps(function)
        def called(*args: Any, **options: Any) -> Any:
            if _LINE.get() is not None:
                return function(*args, **options)
            progress = options.get("progress")
            shown = progress if isinstance(progress, bool) else None
            with announce_if_slow(text, shown) as line:
                token = _LINE.set(line)
                try:
                    return function(*args, **options)
                finally:
                    _LINE.reset(token)

        return cast(F, called)

    return decorate


def bar(progress: bool | None, total: int, done: int = 0, unit: str = "runs") -> Any:
    """A tqdm bar over runs, or over something else, a context manager with `update(runs)`.

    Args:
      progress: True or False; None shows the bar after DELAY seconds where a user can see it.
      total: number of runs.
      done: runs that were there before.
      unit: what is counted.
    """
    progress = checks.boolean("progress", progress, optional=True)
    line = _LINE.get()
    if line is not None:
        line.cancel()
    from tqdm import tqdm  # a line of text that is replaced, in notebooks too

    shown, delay = progress, 0.0
    if progress is None:
        shown, delay = has_reader(), DELAY
    return tqdm(
        total=total,
        initial=done,
        unit=f" {unit}",
        unit_scale=True,
        disable=not shown,
        delay=delay,
        dynamic_ncols=True,
        leave=not in_notebook(),
    )
