"""Ctrl-C between two units: the first one asks, the second one insists."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType


class Interrupted(KeyboardInterrupt):
    """A sweep that was stopped by Ctrl-C after a unit; the message says how to go on."""


class CtrlC:
    """While this context is open, the first Ctrl-C only sets `asked`; the second one interrupts as usual.

    Signals reach the main thread only; elsewhere, and where somebody else handles or ignores them, this does nothing.
    """

    def __init__(self, active: bool = True):
        self.asked = False
        ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        self._active = active and ours

    def __enter__(self) -> CtrlC:
        if self._active:
            self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._active:
            signal.signal(signal.SIGINT, self._before)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        import sys

        sys.stderr.write("\nCtrl-C: stopping after the unit at hand; again to stop at once.\n")
