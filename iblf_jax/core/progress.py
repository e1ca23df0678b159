"""What a waiting user sees: the bar of a study, and a line on what takes long; in terminals and in
notebooks.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import warnings
from collections.abc import Iterator
from typing import Any

from iblf_jax.core import checks

DELAY = 1.0
"""Seconds before a bar appears that was not asked for."""
SLOW = 2.0
"""Seconds before a line says what takes long."""


def _has_reader() -> bool:
    """Whether somebody watches: a terminal or a notebook."""
    if "ipykernel" in sys.modules and "IPython" in sys.modules:
        shell = sys.modules["IPython"].get_ipython()
        if shell is not None and hasattr(shell, "kernel"):
            return True
    return sys.stderr is not None and sys.stderr.isatty()


def bar(progress: bool | None, total: int, done: int = 0, unit: str = "runs") -> Any:
    """A tqdm bar over runs, or over something else, a context manager with `update(runs)`.

    Args:
      progress: True or False, or None: shown where somebody watches and it takes more than DELAY
        seconds.
      total: number of runs.
      done: runs that were there before.
      unit: what is counted.
    """
    progress = checks.flag("progress", progress, optional=True)
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # tqdm warns where a notebook lacks ipywidgets and then falls back to text by itself
        from tqdm.auto import tqdm
    shown = _has_reader() if progress is None else progress
    delay = DELAY if progress is None else 0.0
    return tqdm(
        total=total,
        initial=done,
        unit=f" {unit}",
        unit_scale=True,
        disable=not shown,
        delay=delay,
        dynamic_ncols=True,
    )


@contextlib.contextmanager
def told(what: str) -> Iterator[None]:
    """Says what is being done, once it has taken SLOW seconds and if somebody watches."""
    line = threading.Timer(SLOW, lambda: sys.stderr.write(f"iblf_jax: {what}\n"))
    line.daemon = True
    if _has_reader():
        line.start()
    try:
        yield
    finally:
        line.cancel()
