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
def announce_if_slow(text: str) -> Iterator[None]:
    """Print a line once the body has taken `SLOW` seconds, in a terminal or a notebook."""
    line = threading.Timer(SLOW, lambda: sys.stderr.write(f"iblf_jax: {text}\n"))
    line.daemon = True
    if has_reader():
        line.start()
    try:
        yield
    finally:
        line.cancel()
