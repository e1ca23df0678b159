"""The one cache of the package: all state that a process keeps between calls.

`CACHE` holds two kinds of entries:

- results of functions that depend on hashable arguments only, such as the structure of a pytree
  and the shapes of its leaves; `@memoised(size)` stores them;
- marks, which record that something happened: a message was shown, a kernel could not be built.

Every function and every topic of marks has its own bound, and the least recently used entries are
removed first. All entries can be computed again, so `CACHE.clear()` costs only time. The programs
that JAX has compiled are bounded by `core.programs`, and the folder on the disk is bounded by
`core.disk_cache`.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable)

MEMOISED_TYPE = type(lru_cache(abs))
"""The type of a function whose results are kept."""
MAX_MARKS = 1024
"""Marks per topic: a mark is a text, or a tuple of shapes and of the structure of a pytree."""


class Cache:
    """Memoised results and marks of this process; its methods may be called by several threads."""

    def __init__(self) -> None:
        self._functions: list[Any] = []
        self._marks: dict[str, OrderedDict[Hashable, None]] = {}
        self._lock = threading.Lock()

    def memoised(self, size: int) -> Callable[[F], F]:
        """Decorator of a function of hashable arguments: its last `size` results are kept.

        The function must depend on its arguments only.  It has the attributes of
        `functools.lru_cache`, `cache_clear` among them.

        Args:
          size: how many results are kept at most.
        """

        def decorated(function: F) -> F:
            cached = lru_cache(maxsize=size)(function)
            self._functions.append(cached)
            return cast(F, cached)

        return decorated

    def mark(self, topic: str, key: Hashable) -> bool:
        """Marks a key; returns whether it had no mark.

        Args:
          topic: what the mark is about, such as "backend warnings".
          key: what is marked, such as the text of a warning.
        """
        with self._lock:
            marks = self._marks.setdefault(topic, OrderedDict())
            is_new = key not in marks
            marks[key] = None
            marks.move_to_end(key)
            if len(marks) > MAX_MARKS:
                marks.popitem(last=False)
        return is_new

    def is_marked(self, topic: str, key: Hashable) -> bool:
        """Whether a key has a mark."""
        with self._lock:
            return key in self._marks.get(topic, ())

    def clear(self, topic: str | None = None) -> None:
        """Removes the marks of one topic, or all marks and all memoised results."""
        with self._lock:
            if topic is not None:
                self._marks.pop(topic, None)
                return
            self._marks.clear()
        for function in self._functions:
            function.cache_clear()

    def __len__(self) -> int:
        """How many results and marks are kept."""
        with self._lock:
            marks = sum(len(keys) for keys in self._marks.values())
        return marks + sum(function.cache_info().currsize for function in self._functions)

    @property
    def bound(self) -> int:
        """How many results are kept at most, of all functions together; marks come in addition."""
        return sum(function.cache_info().maxsize for function in self._functions)


CACHE = Cache()
"""The cache of this process."""

memoised = CACHE.memoised
"""Decorator of a function whose results `CACHE` keeps."""
