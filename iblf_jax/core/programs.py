"""Bounds what compiled programs use: memory, and memory maps.

JAX keeps every program for the life of the process.  The programs of one scenario take some 20 to
40 MB, and a program uses 10 to 250 memory maps, of which Linux allows a process 65,530.  After some
hundred programs the compiler cannot allocate memory, and the process ends.

`PROGRAMS` therefore keeps the programs that were used last.  `programs.jit` takes the place of
`jax.jit` for a function that is compiled once for each structure, such as that of a scenario.  JAX
keeps a program only as long as the function that it was compiled for exists, so each structure has
a copy of the function of its own: without the copy, JAX releases the program.

Programs of other functions, of operations of `jnp` outside a compiled function among them, are
released all together when the number of maps comes close to the limit (`ProgramBound`).

What is needed again is compiled again, or read from the disk (`core.disk_cache`).
"""

from __future__ import annotations

import gc
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from functools import partial, update_wrapper, wraps
from pathlib import Path
from typing import Any

import jax
import numpy as np

from iblf_jax.core import devices
from iblf_jax.core.disk_cache import keeps_programs
from iblf_jax.core.kept_programs import COMPILE_EVENT, KeptProgram
from iblf_jax.core.thread_options import current_options, process_options
from iblf_jax.kernels import is_tracing, without_garbage_collection

MAPS, MAX_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
MAX_MAP_FRACTION = 0.6
"""Share of the permitted maps above which programs are released: libraries and other threads need
some, too."""
MAPS_OF_A_PROGRAM = 300
"""Approximate largest number of maps of a program: a step of an arm's closed loop has 250."""


SHORTEST_TO_COMPILE: dict[str, Any] = {"xla_backend_optimization_level": 0}
"""Compiler options of a program that is not optimised."""
if jax.__version_info__ < (0, 11):
    # XLA has two ways to write the code of operations. The older one, which later releases do not
    # have, needs half the time and gives the same numbers; a loop takes up to three times as long.
    SHORTEST_TO_COMPILE["xla_cpu_use_fusion_emitters"] = False
    # The code in one part, of up to 32: a quarter less of the time.
    SHORTEST_TO_COMPILE["xla_cpu_parallel_codegen_split_count"] = 1
MAX_PROGRAMS = 512
"""Programs that are kept.  `simulate` uses five for a scenario, a study two, `certify` twelve."""


def count_maps() -> int:
    """Number of memory maps of this process; 0 where it is unknown."""
    try:
        return MAPS.read_bytes().count(b"\n")
    except OSError:
        return 0


def most_maps() -> int | None:
    """Largest number of memory maps of a process; None where there is no such limit."""
    try:
        return int(MAX_MAPS.read_text())
    except (OSError, ValueError):
        return None


class Programs:
    """Functions that JAX has compiled, each for one structure of its arguments; those that were not
    used for longest leave.

    Args:
      size: how many are kept.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable, compiled: Callable[[], Any]) -> Any:
        """The function of a key; `compiled()` returns it if it is not kept."""
        with self._lock:
            found = self._kept.get(key)
            if found is None:
                found = self._kept[key] = compiled()
            self._kept.move_to_end(key)
            while len(self._kept) > self.size:
                self._kept.popitem(last=False)
        return found

    def release(self, number: int) -> None:
        """Releases the functions that were not used for longest; programs that run stay until their
        end.

        Args:
          number: how many.
        """
        with self._lock:
            for _ in range(min(number, len(self._kept))):
                self._kept.popitem(last=False)

    def of(self, function: Callable) -> list[Any]:
        """What is kept of a function."""
        with self._lock:
            keys = [key for key in self._kept if key[0] is function]  # type: ignore[index]
            return [self._kept[key] for key in keys]


class StructuredFunction:
    """A function that JAX compiles once for each structure of its arguments (`jit`).

    It has the methods of a function of `jax.jit` that this package uses.
    """

    def __init__(
        self,
        function: Callable,
        programs: Programs,
        static_argnums: tuple[int, ...] = (),
        static_argnames: tuple[str, ...] = (),
        options: dict[str, Any] | None = None,
        kept: bool = False,
    ) -> None:
        self._function = function
        self._programs = programs
        self._static_argnums = static_argnums
        self._static_argnames = static_argnames
        self._options = options
        self._kept = kept
        update_wrapper(self, function)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The value of the function."""
        program = self._program(args, kwargs)
        if program._cache_size():
            return program(*args, **kwargs)
        with without_garbage_collection():
            return program(*args, **kwargs)

    @without_garbage_collection()
    def trace(self, *args: Any, **kwargs: Any) -> Any:
        """As `trace` of `jax.jit`."""
        return self._program(args, kwargs).trace(*args, **kwargs)

    @without_garbage_collection()
    def lower(self, *args: Any, **kwargs: Any) -> Any:
        """As `lower` of `jax.jit`."""
        return self._program(args, kwargs).lower(*args, **kwargs)

    def clear_cache(self) -> None:
        """As `clear_cache` of `jax.jit`."""
        for program in self._programs.of(self._function):
            program.clear_cache()

    def _cache_size(self) -> int:
        """How many programs JAX has compiled."""
        return sum(program._cache_size() for program in self._programs.of(self._function))

    def _program(self, args: tuple, kwargs: dict[str, Any]) -> Any:
        """The copy of the function for the structure of these arguments.

        It is made for the static arguments, and for structure and shapes of the others. JAX
        distinguishes their types itself.
        """
        static = [args[i] for i in self._static_argnums]
        static += [kwargs.get(name) for name in self._static_argnames]
        others = [x for i, x in enumerate(args) if i not in self._static_argnums]
        named = {name: x for name, x in kwargs.items() if name not in self._static_argnames}
        leaves, structure = jax.tree.flatten((others, named))
        # JAX accepts options for XLA, and a program from the disk, only where it neither transforms
        # the function nor makes it a part of another program.
        options, kept = self._options, self._kept
        if devices.platform() != "cpu":
            options = None
        # A program from the disk is one for the only device.
        kept = kept and keeps_programs() and devices.is_alone()
        if options is not None or kept:
            kinds = set(map(type, leaves))
            if is_tracing() or any(issubclass(kind, jax.core.Tracer) for kind in kinds):
                options, kept = None, False
        shapes = tuple([getattr(x, "shape", ()) for x in leaves])
        # The options are a part of the key: two programs may be made of one function.
        of_compiler = tuple((options or {}).items())
        key = (self._function, of_compiler, tuple(static), structure, shapes)
        if not kept:
            return self._programs.get(key, partial(self._copy, options))
        parts = (*key, tuple(map(_type_of, leaves)))
        # A program of JAX knows itself what else it was traced for.
        now = (*current_options().values(), *process_options().values())
        return self._programs.get(
            (*parts, now),
            lambda: KeptProgram(
                self._copy(options), parts, self._static_argnums, self._static_argnames
            ),
        )

    def _copy(self, options: dict[str, Any] | None) -> Any:
        """A copy of the function, to be compiled by JAX for one structure."""
        function = self._function

        @wraps(function)
        def copy(*args: Any, **kwargs: Any) -> Any:
            return function(*args, **kwargs)

        # JAX finds the positions of static arguments by their names if only the names are given.
        return jax.jit(
            copy,
            static_argnums=self._static_argnums or None,
            static_argnames=self._static_argnames or None,
            compiler_options=options,
        )


def _type_of(leaf: Any) -> tuple[np.dtype, bool]:
    """The type of the numbers of a leaf, and whether it is weak: those of `jax.typeof`, which takes
    ten times as long for an array.
    """
    if isinstance(leaf, jax.Array):
        return leaf.dtype, leaf.weak_type  # type: ignore[attr-defined]
    if type(leaf) is np.ndarray:
        return jax.dtypes.canonicalize_dtype(leaf.dtype), False
    found: Any = jax.typeof(leaf)
    return found.dtype, found.weak_type


PROGRAMS = Programs(MAX_PROGRAMS)
"""The programs of this process."""


def jit(
    function: Callable | None = None,
    *,
    static_argnums: int | Sequence[int] = (),
    static_argnames: str | Sequence[str] = (),
    options: dict[str, Any] | None = None,
    kept: bool = False,
) -> Any:
    """As `jax.jit`, for a function of many structures (head of this module); also a decorator with
    options.

    Args:
      function: the function.
      static_argnums: positions of arguments that are compiled in; they are hashable.
      static_argnames: names of keyword arguments that are compiled in.
      options: compiler options of the program on a CPU, SHORTEST_TO_COMPILE for one that runs for
        less time than it compiles; XLA's own if None.
      kept: whether the program is kept on the disk (`kept_programs`).  What the trace of the
        function reads must then be its arguments or in the environment of `durable_keys`, and it
        must have no effect, such as a warning.
    """
    numbers = (static_argnums,) if isinstance(static_argnums, int) else tuple(static_argnums)
    names = (static_argnames,) if isinstance(static_argnames, str) else tuple(static_argnames)

    def decorated(function: Callable) -> StructuredFunction:
        return StructuredFunction(function, PROGRAMS, numbers, names, options, kept)

    if function is None:
        return decorated
    return decorated(function)


class ProgramBound:
    """Releases programs when the process has more than `bound` memory maps, of the `limit` that the
    system allows: the half of `PROGRAMS` that was not used for longest and, where that is not
    enough, all programs of JAX.
    """

    def __init__(self, limit: int, bound: int) -> None:
        self.limit = limit
        self.bound = bound
        self.released = 0
        """How many times programs were released."""
        self._until_count = 0
        """Programs to compile before maps are counted again: counting tens of thousands takes as
        long as compiling a small program."""
        self._lock = threading.Lock()

    def __call__(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        """Listens to JAX's events."""
        if event != COMPILE_EVENT:
            return
        self._until_count -= 1
        if self._until_count >= 0 or not self._lock.acquire(blocking=False):
            return
        try:
            self.check()
        finally:
            self._lock.release()

    def check(self) -> None:
        """Counts the maps, and releases programs if there are too many."""
        maps = count_maps()
        if maps > self.bound:
            PROGRAMS.release(len(PROGRAMS) // 2)
            maps = count_maps()
        if maps > self.bound:
            release_programs()
            self.released += 1
            maps = count_maps()
            # Where other code uses most maps, programs must not be released after every new one.
            self.bound = max(self.bound, maps + (self.limit - maps) // 4)
        self._until_count = max((self.bound - maps) // MAPS_OF_A_PROGRAM, 0)


def release_programs() -> None:
    """Clears the programs that JAX has compiled; running programs stay until their end."""
    jax.clear_caches()
    gc.collect()


def bound_programs() -> ProgramBound | None:
    """Bounds the programs of this process from now on; None where the system has no limit."""
    limit = most_maps()
    if limit is None:
        return None
    bound = ProgramBound(limit, int(MAX_MAP_FRACTION * limit))
    jax.monitoring.register_event_duration_secs_listener(bound)
    return bound
