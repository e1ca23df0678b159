"""The caches and the state of the compiler in this process, in one object.

`CACHES` holds the results of functions that take long (a trace, a program, a text in C) and the
state that belongs to the process as such: loaded libraries, functions that XLA knows by name, and
compilers that run.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable)


class Caches:
    """The caches of the compiler, and the state that cannot be cleared while XLA holds addresses.

    A cached function keeps the results of its last `maxsize` different arguments, at most 64; all
    of them together take some megabytes for each scenario.
    """

    def __init__(self) -> None:
        self._functions: list[Any] = []
        self.failures: dict[str, Exception] = {}
        """Key of a kernel -> the error of the thread that built it in the background."""
        self.locks: dict[str, threading.Lock] = {}
        """Key of a kernel -> the lock of the thread that builds it."""
        self.running: dict[int, object] = {}
        """Process number of a compiler that runs -> the mark of the thread that needs it."""
        self.libraries: dict[str, ctypes.CDLL] = {}
        """Key of a kernel -> its library: loaded once, as XLA takes one address for a name."""
        self.registered: dict[str, tuple[str, str]] = {}
        """Name of a function that XLA knows -> its file in the cache, and its name there."""

    def function(self, maxsize: int | None) -> Callable[[F], F]:
        """A decorator: the function's last `maxsize` results are kept."""

        def decorate(function: F) -> F:
            cached: Any = lru_cache(maxsize=maxsize)(function)
            self._functions.append(cached)
            return cached

        return decorate

    @property
    def size(self) -> int:
        """The number of results that are kept."""
        return sum(function.cache_info().currsize for function in self._functions)

    def clear(self) -> None:
        """Forgets all results of functions, and all failures.

        Loaded libraries stay: XLA holds addresses in them.
        """
        self.failures.clear()
        for function in self._functions:
            function.cache_clear()


CACHES = Caches()
"""The caches of this process."""
