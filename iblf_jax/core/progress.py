"""The progress bar of a study, in terminals and in notebooks."""

from __future__ import annotations

import warnings
from typing import Any

from iblf_jax.core import checks
from iblf_jax.kernels import has_reader

DELAY = 1.0
"""Seconds before a bar appears that the caller did not request."""


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
    shown = has_reader() if progress is None else progress
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
