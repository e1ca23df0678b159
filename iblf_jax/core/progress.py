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
      progress: True or False; None shows the bar after DELAY seconds where a user can see it.
      total: number of runs.
      done: runs that were there before.
      unit: what is counted.
    """
    progress = checks.boolean("progress", progress, optional=True)
    with warnings.catch_warnings():
        # tqdm warns where a notebook lacks ipywidgets, and falls back to text.
        warnings.simplefilter("ignore")
        from tqdm.auto import tqdm
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
    )
