"""Ctrl-C and SIGTERM between two units of a store: the first signal stops the sweep after the
present unit, the second one at once.

No scheduler offers this: without it Ctrl-C would discard the unit that is being computed.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any

from iblf_jax._start import end_process

STOP_SIGNALS = {
    signal.SIGINT: ("Ctrl-C", (signal.default_int_handler, end_process)),
    signal.SIGTERM: ("SIGTERM", (signal.SIG_DFL,)),
}
"""Signal -> its name, and the default handlers that a `StopRequest` replaces.  A cluster sends
SIGTERM before it kills.

Ctrl-C is the first, because its default handler may raise anywhere: its handler is replaced first
and restored last.
"""


class Interrupted(KeyboardInterrupt):
    """A sweep that was stopped after a unit; the message says how to go on."""


class StopRequest:
    """While this context is open, the first Ctrl-C or SIGTERM only sets `requested`; the second one
    interrupts at once.

    Signals reach the main thread only: in other threads, and where the program handles or ignores
    them itself, this does nothing.
    """

    def __init__(self) -> None:
        self.requested = False
        self._replaced: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            now = {number: signal.getsignal(number) for number in STOP_SIGNALS}
            self._replaced = {
                number: now[number]
                for number, (_, defaults) in STOP_SIGNALS.items()
                if now[number] in defaults
            }
            for number in self._replaced:
                signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._restore_handlers()

    def _restore_handlers(self) -> None:
        for number, handler in reversed(self._replaced.items()):
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            # Restored first, because the handler below may raise inside __enter__ or __exit__.
            self._restore_handlers()
            before = self._replaced[signal.Signals(number)]
            (before if callable(before) else signal.default_int_handler)(number, frame)
        self.requested = True
        with contextlib.suppress(Exception):  # stderr may be closed
            sys.stderr.write(
                f"\n{STOP_SIGNALS[signal.Signals(number)][0]}: stopping after the unit at hand;"
                " again to stop at once.\n"
            )
