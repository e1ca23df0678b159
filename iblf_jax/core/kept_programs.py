"""Compiled programs on the disk, which a later process reads in place of tracing and compiling.

JAX reads its own cache after the trace of a function, which takes most of the time of a first
result in a second process.  `KeptProgram` reads the executable by what the trace would depend on:
the function, its static arguments, structure, shapes and types of the others, and the environment
(`durable_keys`).  What has no such key is not kept.  An entry contains its complete key, which is
compared with the requested one, so that not even two keys with one hash share it.

An entry is a file of the cache of kernels, with a digest and only of this user, and it is executed
like these.  It names the kernels that the program calls.  Of a file that is damaged, or whose
kernels are gone, the program is compiled again.  A program that calls anything but kernels, such as
LAPACK or Python, is not kept: JAX prepares such calls while it compiles.
"""

from __future__ import annotations

import contextlib
import pickle
import re
import threading
import time
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
from jax.experimental import serialize_executable

from iblf_jax.core.disk_cache import keeps_programs, without_cache
from iblf_jax.core.durable_keys import NoKeyError, environment, text_of
from iblf_jax.kernels import ToolchainError, cache_path, cached_file, content_of, cpu

T = TypeVar("T")

_FORBIDDEN: ContextVar[set[str] | None] = ContextVar("iblf_jax_forbidden", default=None)
"""Why the program that is traced now is not kept."""
SUFFIX = ".program"
CALLED = re.compile(r'custom_call @("[^"]*"|[^(\s]+)')
"""A call in StableHLO of a function that XLA knows by name."""
COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"
"""JAX's event of a program that is compiled, or read from the disk."""
UNREADABLE = (
    jax.errors.JaxRuntimeError,
    ToolchainError,
    pickle.UnpicklingError,
    *(AttributeError, EOFError, TypeError, ValueError),
)
"""Errors of an entry that cannot be used."""
UNWRITABLE = (
    jax.errors.JaxRuntimeError,
    ToolchainError,
    pickle.PicklingError,
    *(AttributeError, NotImplementedError, TypeError, ValueError),
)
"""Errors of a program that cannot be kept."""


def key_of(*parts: Any) -> str | None:
    """The key of what these values and the environment determine; None if there is none, or if
    nothing is kept in this process.

    Args:
      parts: the values; the functions and classes among them are what a program is traced from.
    """
    if not keeps_programs():
        return None
    try:
        text = text_of(parts)
        return f"{text}\n{environment(text)}"
    except NoKeyError:
        return None


def forbid(reason: str) -> None:
    """The program that is traced now, if any, is not kept, because its key does not decide what it
    does: it falls back to what works in this process, or the trace warns.
    """
    reasons = _FORBIDDEN.get()
    if reasons is not None:
        reasons.add(reason)


def read(key: str) -> Any:
    """What is kept under a key; None if there is nothing, or if it is damaged."""
    try:
        own, value = pickle.loads(content_of(cache_path([key], SUFFIX)))
    except UNREADABLE:
        return None
    return value if own == key else None


def keep(key: str, value: Any) -> None:
    """Keeps a value, unless this is impossible."""

    def write(path: Path) -> None:
        path.write_bytes(pickle.dumps((key, value)))

    with contextlib.suppress(*UNWRITABLE):
        cached_file([key], SUFFIX, write)


def computed_once(compute: Callable[[], T], *parts: Any) -> T:
    """The value of a function, which is computed by one process and read by later ones.

    Args:
      compute: function without arguments.
      parts: values that determine, with the environment, its value.
    """
    key = key_of(*parts)
    kept = read(key) if key else None
    if kept is not None:
        return kept
    value = compute()
    if key:
        keep(key, value)
    return value


class Entry(NamedTuple):
    """A compiled program as it is kept."""

    kernels: dict[str, tuple[str, str]]
    """The kernels that it calls (`cpu.files_of`)."""
    executable: bytes
    result: Any
    """Its result with the number of each leaf in place of the leaf."""

    @staticmethod
    def of(lowered: Any, compiled: Any) -> Entry:
        """The entry of a program; raises NoKeyError if the program calls anything but kernels."""
        kernels = cpu.files_of(set(CALLED.findall(lowered.as_text())))
        if kernels is None:
            raise NoKeyError("calls")
        executable, _, structure = serialize_executable.serialize(compiled)
        result = jax.tree.unflatten(structure, range(structure.num_leaves))
        if jax.tree.structure(pickle.loads(pickle.dumps(result))) != structure:
            raise NoKeyError("result")
        return Entry(kernels, executable, result)

    def program(self, arguments: tuple[tuple, dict[str, Any]]) -> Callable:
        """The program, to be called with such arguments."""
        start = time.perf_counter()
        cpu.register_files(self.kernels)
        found = serialize_executable.deserialize_and_load(
            self.executable, jax.tree.structure(arguments), jax.tree.structure(self.result)
        )
        jax.monitoring.record_event_duration_secs(COMPILE_EVENT, time.perf_counter() - start)
        return found


class KeptProgram:
    """A function of `jax.jit` that is called with arguments of one structure and one type.

    Args:
      function: result of `jax.jit`.
      parts: values that determine, with the environment, the program.
      static_argnums, static_argnames: as those of `jax.jit`.
    """

    def __init__(
        self,
        function: Any,
        parts: tuple,
        static_argnums: tuple[int, ...],
        static_argnames: tuple[str, ...],
    ) -> None:
        self._function = function
        self._parts = parts
        self._argnums = static_argnums
        self._argnames = static_argnames
        self._program: Any = None
        self._lock = threading.Lock()
        self.trace, self.lower = function.trace, function.lower

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The value of the function."""
        dynamic = tuple([x for i, x in enumerate(args) if i not in self._argnums])
        named = {name: x for name, x in kwargs.items() if name not in self._argnames}
        if self._program is None:
            with self._lock:
                if self._program is None:
                    self._program = self._read_or_compiled(args, kwargs, (dynamic, named))
        return self._program(*dynamic, **named)

    def clear_cache(self) -> None:
        """As `clear_cache` of `jax.jit`."""
        self._program = None
        self._function.clear_cache()

    def _cache_size(self) -> int:
        """How many programs are compiled."""
        return int(self._program is not None)

    def _read_or_compiled(self, args: tuple, kwargs: dict[str, Any], arguments: Any) -> Callable:
        """The program from the disk; it is compiled, and kept, if it is not there."""
        key = key_of(*self._parts)
        entry = read(key) if key else None
        if isinstance(entry, Entry):
            with contextlib.suppress(*UNREADABLE):
                return entry.program(arguments)
        reasons: set[str] = set()
        token = _FORBIDDEN.set(reasons)
        try:
            lowered = self._function.lower(*args, **kwargs)
        finally:
            _FORBIDDEN.reset(token)
        if key is None or reasons:
            return lowered.compile()
        with without_cache():
            compiled = lowered.compile()
        with contextlib.suppress(NoKeyError, *UNWRITABLE):
            keep(key, Entry.of(lowered, compiled))
        return compiled
