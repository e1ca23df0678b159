"""Branch and bound over boxes: proves that one of several functions is negative at every point.

The box is divided into units of work, of which each is searched depth-first by a compiled kernel
(`kernels/c/boxes.h`). A box is finished if an alternative is negative on it, or if it is outside
the region; otherwise it is bisected along the coordinate that reduces the margin most. The number
of boxes does not depend on the number of threads.
"""

from __future__ import annotations

import ctypes
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core.progress import bar
from iblf_jax.kernels.enclosure import Kernel, kernel_of, pointer

FINISHED, UNDECIDED, REFUTED, OUT_OF_BOXES, STOPPED, OUT_OF_MEMORY = range(6)
"""How the search of a unit ended (`kernels/c/boxes.h`)."""
UNITS = 1024
"""Units of work, about."""
RENEWAL = 8
"""Bisections after which the weights of the coordinates are measured again."""
NARROWEST = 2.0**-24
"""Width, in parts of the whole, below which a coordinate is not bisected."""
MAX_UNDECIDED = 16
"""Boxes of a unit that cannot be bisected, after which its search ends."""


class WorstBox(NamedTuple):
    """The box with the largest bound at its centre among those that are left."""

    lower: np.ndarray
    upper: np.ndarray
    bound: float
    """Upper bound of the smallest alternative on the box."""
    value: float
    """The same at its centre."""


class SearchResult(NamedTuple):
    """The result of a search."""

    proved: bool
    refuted: bool
    """Whether there is a box in the region on which no alternative is negative."""
    boxes: int
    seconds: float
    done: float
    """Part of the volume for which the statement is proved."""
    worst: WorstBox | None


class _Unit(NamedTuple):
    """A part of the box."""

    lower: np.ndarray
    upper: np.ndarray
    volume: float


class _UnitResult(NamedTuple):
    boxes: int
    status: int
    done: float
    worst: WorstBox | None


def _result_type(dimension: int) -> type[ctypes.Structure]:
    class Result(ctypes.Structure):
        _fields_ = [
            ("boxes", ctypes.c_int64),
            ("undecided", ctypes.c_int64),
            ("status", ctypes.c_int64),
            ("done", ctypes.c_double),
            ("upper", ctypes.c_double),
            ("value", ctypes.c_double),
            ("low", ctypes.c_double * dimension),
            ("high", ctypes.c_double * dimension),
        ]

    return Result


def _searched(
    kernel: Kernel, unit: _Unit, max_boxes: int, smallest: np.ndarray, stop: np.ndarray
) -> _UnitResult:
    """The result of one unit."""
    dimension = len(unit.lower)
    found = _result_type(dimension)()
    kernel.library.search_box(
        pointer(kernel.numbers),
        pointer(unit.lower),
        pointer(unit.upper),
        ctypes.c_int64(max_boxes),
        ctypes.c_int64(MAX_UNDECIDED),
        ctypes.c_int64(RENEWAL),
        pointer(smallest),
        pointer(stop),
        ctypes.byref(found),
    )
    worst = None
    if found.value > -np.inf:
        low = np.array(found.low)
        worst = WorstBox(low, np.array(found.high), found.upper, found.value)
    return _UnitResult(found.boxes, found.status, found.done, worst)


def search(
    function: Callable,
    lower: Any,
    upper: Any,
    constants: Sequence[Any] = (),
    *,
    patterns: Any = None,
    max_boxes: int = 1_000_000_000,
    threads: int = 2,
    progress: bool | None = None,
) -> SearchResult:
    """Tries to prove that at every point x of a box with region(x) <= 0, one of the alternatives is
    negative.

    Args:
      function: function (x, constants) -> (alternatives (m,), region (r,)) of one point, (d,), and
        of a list of constants.
      lower: lower corner of the box, (b,).
      upper: upper corner, (b,).
      constants: numbers and arrays of the function, which count as exact.
      patterns: values of the last d - b coordinates, which are not divided, (p, d - b): the
        statement is to be proved for each row. None if d = b.
      max_boxes: number of boxes after which the search ends.
      threads: number of threads.
      progress: whether a bar shows the progress; None for where a user sees it.

    Raises:
      UnsupportedError: an operation is not available on intervals.
      ToolchainError: no compiler, or one that does not honour the rounding mode.
    """
    start = time.monotonic()
    low, high = (np.asarray(x, np.float64) for x in (lower, upper))
    rows = np.zeros((1, 0)) if patterns is None else np.asarray(patterns, np.float64)
    kernel = kernel_of(function, len(low) + rows.shape[1], constants)
    smallest = np.concatenate([(high - low) * NARROWEST, np.zeros(rows.shape[1])])
    stop = np.zeros(1, np.int32)
    units = _units(low, high, rows)
    results: dict[int, _UnitResult] = {}
    boxes = 0
    waiting = iter(range(len(units)))
    lock = threading.Lock()
    with bar(progress, total=len(units), unit="units") as shown:

        def work() -> None:
            while True:
                with lock:
                    k = next(waiting, None)
                if k is None or stop[0]:
                    return
                found = _searched(kernel, units[k], max_boxes, smallest, stop)
                with lock:
                    results[k] = found
                    shown.update(1)
                    spent = sum(r.boxes for r in results.values())
                    if found.status != FINISHED or spent > max_boxes:
                        stop[0] = 1

        with ThreadPoolExecutor(threads) as pool:
            for future in [pool.submit(work) for _ in range(threads)]:
                future.result()
    boxes = sum(r.boxes for r in results.values())
    done = sum(r.done * units[k].volume for k, r in results.items())
    found = [r.worst for r in results.values() if r.worst is not None]
    return SearchResult(
        len(results) == len(units) and all(r.status == FINISHED for r in results.values()),
        any(r.status == REFUTED for r in results.values()),
        boxes,
        time.monotonic() - start,
        done,
        max(found, key=lambda box: box.value, default=None),
    )


def _units(lower: np.ndarray, upper: np.ndarray, patterns: np.ndarray) -> list[_Unit]:
    """The units of work: the box divided by bisections along all coordinates in turn."""
    boxes = [(lower, upper)]
    axis = 0
    while len(boxes) * len(patterns) < UNITS and len(boxes) < UNITS:
        halves = []
        for low, high in boxes:
            middle = low[axis] + 0.5 * (high[axis] - low[axis])
            first, second = high.copy(), low.copy()
            first[axis] = second[axis] = middle
            halves += [(low, first), (second, high)]
        boxes = halves
        axis = (axis + 1) % len(lower)
    volume = 1 / (len(boxes) * len(patterns))
    units = [
        _Unit(np.concatenate([low, row]), np.concatenate([high, row]), volume)
        for row in patterns
        for low, high in boxes
    ]
    order = np.random.default_rng(0).permutation(len(units))
    return [units[k] for k in order]
