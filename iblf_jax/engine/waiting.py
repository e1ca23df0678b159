"""Waits for results of XLA and responds to Ctrl-C immediately."""

from __future__ import annotations

import threading
import time

import jax

RELATIVE_PAUSE = 0.02
"""Time between two queries, relative to the time waited so far."""
LONGEST_PAUSE = 0.02
"""Longest time between two queries [s]."""


def wait_until_ready(outputs: object) -> None:
    """Waits for arrays that XLA computes in its own threads.

    `jax.block_until_ready` raises KeyboardInterrupt only after the arrays are complete.  This
    function raises it immediately.  XLA continues its computation, which does no harm
    (`core.process_end`).  Python interrupts the main thread only, so that other threads block:
    queries take processor time from the computation.
    """
    arrays = [
        leaf
        for leaf in jax.tree.leaves(outputs)
        if isinstance(leaf, jax.Array) and not isinstance(leaf, jax.core.Tracer)
    ]
    if threading.current_thread() is not threading.main_thread():
        jax.block_until_ready(arrays)
        return
    begin = time.monotonic()
    for array in arrays:
        while not array.is_ready():  # type: ignore[attr-defined]
            time.sleep(min(RELATIVE_PAUSE * (time.monotonic() - begin), LONGEST_PAUSE))
