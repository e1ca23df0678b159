"""A line that reports a slow operation to a waiting user, in terminals and in notebooks."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator

SLOW = 2.0
"""Seconds before the line appears."""


def has_reader() -> bool:
    """Whether the output goes to a terminal or a notebook."""
    if "ipykernel" in sys.modules and "IPython" in sys.modules:
        shell = sys.modules["IPython"].get_ipython()
        if shell is not None and hasattr(shell, "kernel"):
            return True
    return sys.stderr is not None and sys.stderr.isatty()


@contextlib.contextmanager
def announce_if_slow(text: str, shown: bool | None = None) -> Iterator[threading.Timer]:
    """Print a line once the body has taken `SLOW` seconds, unless the body cancels it.

    Args:
      text: of the line.
      shown: whether it is printed; None for a line in a terminal or a notebook only.
    """
    line = threading.Timer(SLOW, lambda: sys.stderr.write(f"iblf_jax: {text}\n"))
    line.daemon = True
    if has_reader() if shown is None else shown:
        line.start()
    try:
        yield line
    finally:
        line.cancel()
