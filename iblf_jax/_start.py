"""The first that is imported: a command can be interrupted from here on, quietly, while all the
rest is imported.

Only a process that was started as `python -m iblf_jax` or `iblf-jax` is meant; elsewhere this
changes nothing.  It imports nothing that takes time.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable

STARTED = time.time()
"""When this process began to load the package [s]."""
INTERRUPTED = 130
"""Exit code of a process that was interrupted."""
AT_END: list[Callable[[], None]] = []
"""What an interrupted process still does: it stops what it has started."""


def end_process(number: int, frame: object) -> None:
    """A signal's handler for a process of its own: it ends here and now.

    Nothing is unwound: XLA may be compiling in a thread, and crashes when what it works on goes.
    """
    sys.stdout.flush()
    sys.stderr.write("iblf-jax: error: interrupted\n")
    sys.stderr.flush()
    for last in AT_END:
        last()
    os._exit(INTERRUPTED)


def _is_a_command() -> bool:
    """Whether Python is about to run this package's command line; under `-m` it imports the package
    before it says so in sys.argv.
    """
    if sys.argv[:1] == ["-m"]:
        return sys.orig_argv[len(sys.orig_argv) - len(sys.argv)] in ("iblf_jax", "-miblf_jax")
    return bool(sys.argv) and os.path.basename(sys.argv[0]) in (
        "iblf-jax",
        "iblf-jax.exe",
        "iblf-jax-script.py",
    )


if _is_a_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, end_process)
