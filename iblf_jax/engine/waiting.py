"""Waiting for XLA in a way that Ctrl-C ends at once."""

from __future__ import annotations

import time
from typing import Any

import jax

RELATIVE_PAUSE, LONGEST_PAUSE = 0.02, 0.02
"""Pause between two looks, as a part of the time waited so far, and in seconds at most."""


def wait_until_ready(outputs: Any) -> None:
    """Waits for arrays that XLA computes in threads of its own.

    JAX's own waiting sees Ctrl-C only when the arrays are there.  Here KeyboardInterrupt is raised
    at once; XLA goes on meanwhile, which does no harm (`core.process_end`).
    """
    begin = time.monotonic()
    for array in jax.tree.leaves(outputs):
        if not isinstance(array, jax.Array) or isinstance(array, jax.core.Tracer):
            continue  # under a transformation nothing is computed yet
        while not array.is_ready():  # type: ignore[attr-defined]
            time.sleep(min(RELATIVE_PAUSE * (time.monotonic() - begin), LONGEST_PAUSE))
