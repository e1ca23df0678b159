"""Ends a process in which XLA is still compiling.

Ctrl-C while XLA compiles raises KeyboardInterrupt at once, and XLA goes on compiling in threads of
its own. If the interpreter then shuts down, it frees the data of these threads, and the process
crashes or hangs. `finish` therefore waits for the threads before the interpreter shuts down. A
process that ends by Ctrl-C does not wait: it ends by that signal without a shutdown.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import signal
import sys
import threading
import time
from pathlib import Path

from iblf_jax._start import AT_END
from iblf_jax.kernels import stop_compilers

TASKS = Path("/proc/self/task")
MAX_WAIT = 300.0
"""Longest time that `finish` waits for XLA [s]: a compilation can take minutes."""
CONFIRMATIONS, CONFIRMATION_INTERVAL = 5, 0.002
"""Number of times that no thread may run before all count as idle, and seconds between them: a
thread that waits for memory is not running."""


AT_END.append(stop_compilers)


def native_threads_run() -> bool:
    """Whether a thread that Python did not start is running; False where this is unknown."""
    known = {thread.native_id for thread in threading.enumerate()}
    for _ in range(CONFIRMATIONS):
        tasks: list[Path] = []
        with contextlib.suppress(OSError):
            tasks = list(TASKS.iterdir())
        if any(_is_running(task) for task in tasks if int(task.name) not in known):
            return True
        time.sleep(CONFIRMATION_INTERVAL)
    return False


def _is_running(task: Path) -> bool:
    try:
        state = (task / "stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return False
    return state in "RD"


def finish() -> None:
    """Waits for XLA, or ends the process by SIGINT if Ctrl-C has ended the program."""
    end = time.monotonic() + MAX_WAIT
    while native_threads_run() and time.monotonic() < end:
        if getattr(sys, "last_type", None) is KeyboardInterrupt:
            _end_by_interrupt()
        time.sleep(10 * CONFIRMATION_INTERVAL)


def _end_by_interrupt() -> None:
    """Ends the process by SIGINT, as Python does after Ctrl-C, without shutting the interpreter
    down.
    """
    for last in AT_END:
        last()
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # it may be closed, or nobody may be there to read it
            stream.flush()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGINT)


def finish_at_exit() -> None:
    """Registers `finish` to run at the end of this process, before JAX shuts XLA down."""
    atexit.register(finish)
