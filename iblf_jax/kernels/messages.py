"""A line that reports a slow operation to a waiting user, in terminals and in notebooks."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from typing import Any

SLOW = 2.0
"""Seconds before the line appears."""


def has_reader() -> bool:
    """Whether the output goes to a terminal or a notebook, and the user wants lines of progress:
    IBLF_JAX_PROGRESS=0 is for outputs that are stored.
    """
    if os.environ.get("IBLF_JAX_PROGRESS") == "0":
        return False
    return in_notebook() or (sys.stderr is not None and sys.stderr.isatty())


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    if "ipykernel" not in sys.modules or "IPython" not in sys.modules:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return shell is not None and hasattr(shell, "kernel")


class _Line:
    """A line that appears once; in a notebook it is removed in the end."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._handle: Any = None

    def show(self) -> None:
        """Shows the line."""
        if not in_notebook():
            sys.stderr.write(f"iblf_jax: {self._text}\n")
            return
        display = sys.modules["IPython"].display.display
        line = {"text/plain": f"iblf_jax: {self._text}"}
        self._handle = display(line, raw=True, display_id=True)

    def remove(self) -> None:
        """Replaces the line of a notebook by nothing."""
        if self._handle is not None:
            self._handle.update({"text/plain": ""}, raw=True)


@contextlib.contextmanager
def announce_if_slow(text: str, shown: bool | None = None) -> Iterator[threading.Timer]:
    """Shows a line once the body has taken `SLOW` seconds, unless the body cancels it; in a
    notebook the line disappears with the body.

    Args:
      text: of the line.
      shown: whether it is shown; None for a line in a terminal or a notebook only.
    """
    line = _Line(text)
    timer = threading.Timer(SLOW, line.show)
    timer.daemon = True
    if has_reader() if shown is None else shown:
        timer.start()
    try:
        yield timer
    finally:
        timer.cancel()
        line.remove()
