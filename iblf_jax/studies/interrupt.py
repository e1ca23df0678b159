"""Asked to stop between two units: the first signal asks, the second one insists."""

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
"""Signals that ask, what they are called, and who handles them where nobody else does.  A cluster
sends SIGTERM before it kills.

Ctrl-C is the first, as it is what may raise in the middle of anything where nobody handles it: it
is taken over first and given back last.
"""


class Interrupted(KeyboardInterrupt):
    """A sweep that was stopped after a unit; the message says how to go on."""


class StopRequest:
    """While this context is open, the first Ctrl-C or SIGTERM only sets `requested`; the second one
    interrupts at once.

    Signals reach the main thread only; elsewhere, and where somebody else handles or ignores them,
    this does nothing.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            now = {number: signal.getsignal(number) for number in STOP_SIGNALS}
            self._before = {
                number: now[number]
                for number, (_, usual) in STOP_SIGNALS.items()
                if now[number] in usual
            }
            for number in self._before:
                signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._give_back()

    def _give_back(self) -> None:
        for number, handler in reversed(self._before.items()):
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            # before it raises: that may be inside __enter__ or __exit__, which then do not come to
            # their end
            self._give_back()
            before = self._before[signal.Signals(number)]
            (before if callable(before) else signal.default_int_handler)(number, frame)
        self.requested = True
        with contextlib.suppress(Exception):  # nobody may be there to read it
            sys.stderr.write(
                f"\n{STOP_SIGNALS[signal.Signals(number)][0]}: stopping after the unit at hand;"
                " again to stop at once.\n"
            )
