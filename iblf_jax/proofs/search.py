"""Branch and bound over boxes: proves that one of several functions is negative at every point.

A box is finished if an alternative is negative on it, or if it is outside the region; otherwise it
is bisected. The whole box is first divided into some thousand boxes, the units of work. A compiled
kernel (`kernels/c/boxes.h`) searches each of them depth-first.

The number of boxes does not depend on the number of threads: results count in the order of the
units, up to the first one that is not proved.

**Which coordinate is bisected.** The one whose bisection removes most of the margin, of those whose
width is at least 1/guard of the widest one, each in parts of its scale. Without a guard the search
may bisect one coordinate for ever: where the margin falls only after bisections along several
coordinates, a bisection along each one of them alone gains nothing. Random descents from the units
estimate the number of boxes with each guard of GUARDS before the search.

**Why the choice cannot prove too much.** A bisection replaces [low, high] by [low, middle] and
[middle, high] along one coordinate, with one floating-point number low < middle < high in both, and
keeps all other ends. The union of the halves is the box, whichever coordinate was chosen. By
induction, the boxes that are finished, that wait or that count as undecided cover the whole box
after every bisection. A box is finished only by its own bound, which is rounded outward and holds
at each of its points, and which knows nothing of the bisections before. A search has proved its
statement only if no box waits and none is undecided, so that finished boxes cover the whole. Each
weight, scale and guard, also a wrong one or NaN, decides how many boxes that takes, and if the
search ends; no more. The estimate by descents reads copies of the units and changes no result.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.core.progress import bar
from iblf_jax.core.whole_files import written_whole
from iblf_jax.kernels import (
    ENCLOSURE_FLAGS,
    IntervalKernel,
    ToolchainError,
    interval_kernel,
    pointer,
)

STATUSES = ("proved", "undecided", "refuted", "out of boxes", "stopped", "out of memory")
"""How the search of a unit ended, in the order of `kernels/c/boxes.h`."""
PROVED, UNDECIDED, REFUTED, OUT_OF_BOXES, STOPPED, OUT_OF_MEMORY = range(6)
UNITS = 4096
"""Units of work, at least, unless fewer boxes prove the statement."""
RENEWAL = 7
"""Bisections after which the weights of the coordinates are measured again."""
GUARDS = (3.0, 16.0, math.inf)
"""Guards of which a search takes the one that is estimated to need the fewest boxes. Which is the
best differs by a factor of 1000 and more: a coordinate on which the bound hardly depends should not
be bisected, and one that counts together with another one only must be."""
FEW_BOXES = 4.0
"""Further guards are tried if the search is expected to take more than this multiple of the boxes
of an estimate."""
DIFFERENCE = 2.0
"""Standard errors that are added to an estimate before it is compared with another one."""
DESCENTS = 512
"""Units from which a random path descends to estimate the number of boxes."""
GROUPS = 16
"""Groups of these units, from whose differences the standard error follows."""
NARROWEST = 2.0**-24
"""Width, in parts of the whole, up to which a coordinate is not bisected."""
MAX_UNDECIDED = 16
"""Boxes of a unit that are too narrow to be bisected, after which its search ends."""
SECONDS_BETWEEN_CHECKPOINTS = 10.0
FORMAT = "checkpoint 3"
"""Name of the form of a checkpoint."""
RESULT_TYPES = {
    "divide_box": ctypes.c_int64,
    "search_box": ctypes.c_int,
    "expected_boxes": ctypes.c_int,
}
"""Function of a kernel -> the C type of its result, which is negative if it has not run."""


class SearchedBox(NamedTuple):
    """The box that has the largest bound at its centre, of those that are left."""

    lower: np.ndarray
    """Lower corner, (d,)."""
    upper: np.ndarray
    """Upper corner, (d,)."""
    bound: float
    """Upper bound of the smallest alternative on the box."""
    value: float
    """The same at its centre."""


class Expectation(NamedTuple):
    """An estimate of the number of boxes of a search, which is made before it.

    Each of some random units contributes one path to a random leaf; what is evaluated there after k
    bisections counts 2^k times (D. E. Knuth, Mathematics of Computation 29 (1975) 122-136). The
    expectation is the number of boxes itself; the estimate is too small where few deep paths, which
    a sample misses, make up most of the search.
    """

    boxes: float
    """Infinite if a path ends at a box that is too narrow to be bisected, or that refutes."""
    error: float
    """Standard error of the estimate."""

    @property
    def at_most(self) -> float:
        """The number that is compared with those of other rules."""
        return self.boxes + DIFFERENCE * self.error

    def __str__(self) -> str:
        if not math.isfinite(self.boxes):
            return "no number of boxes is enough, by random descents"
        return f"{self.boxes:.2g} boxes expected, standard error {self.error:.1g}"


class SearchResult(NamedTuple):
    """The result of a search."""

    status: str
    """ "proved", "refuted" (no alternative is negative on a box inside the region), "undecided" (a
    box is too narrow to be bisected), "out of boxes" or "out of memory"."""
    boxes: int
    """Number of boxes that were evaluated."""
    seconds: float
    done: float
    """Part of the volume on which the statement is proved."""
    worst: SearchedBox | None
    """None if the statement is proved."""
    expected: Expectation | None
    """None where the division into units ends the search."""
    units: int
    """Number of units of work."""
    left: np.ndarray
    """Lower and upper corners of the units that are not proved, (k, 2, d); the first one was
    begun."""

    @property
    def proved(self) -> bool:
        """Whether the statement is proved."""
        return self.status == STATUSES[PROVED]


class _Options(ctypes.Structure):
    _fields_ = (
        ("max_boxes", ctypes.c_int64),
        ("max_undecided", ctypes.c_int64),
        ("renewal", ctypes.c_int64),
        ("smallest", ctypes.c_void_p),
        ("scale", ctypes.c_void_p),
        ("stop", ctypes.c_void_p),
        ("guard", ctypes.c_double),
    )


class _Found(NamedTuple):
    """What a kernel found."""

    boxes: int
    status: int
    done: float
    worst: SearchedBox | None


class _Problem:
    """A statement on boxes of one kernel.

    Args:
      kernel: kernel of the function.
      lower: lower corners of the boxes that are to be searched, (p, d).
      upper: upper corners, (p, d).
      scales: widths at which coordinates count as equally wide, (d,); all of the width if None.
    """

    def __init__(
        self,
        kernel: IntervalKernel,
        lower: np.ndarray,
        upper: np.ndarray,
        scales: np.ndarray | None = None,
    ) -> None:
        self.kernel = kernel
        self.lower = lower
        self.upper = upper
        self.smallest = (upper - lower)[0] * NARROWEST
        self.scales = (upper - lower)[0] if scales is None else scales
        self.guard = GUARDS[0]
        self.stop = np.zeros(1, np.int32)
        self.size = int(kernel.library.record_size())
        self.dimension = lower.shape[1]

    def digest(self, units: np.ndarray) -> str:
        """A hash of everything on which the results of the units depend, and of the units
        themselves: their division depends on the processor and its compiler.

        Each part has its length in front of it, so that no two problems have the same bytes.
        """
        options = (
            FORMAT,
            UNITS,
            RENEWAL,
            self.guard,
            NARROWEST,
            MAX_UNDECIDED,
            ENCLOSURE_FLAGS,
            np.shape(units),
        )
        corners = (self.lower, self.upper, self.smallest, self.scales)
        arrays = (self.kernel.numbers, *corners, units)
        parts = [repr(options).encode(), self.kernel.compiled.source.encode()]
        parts += [np.ascontiguousarray(x).tobytes() for x in arrays]
        found = hashlib.sha256()
        for part in parts:
            found.update(len(part).to_bytes(8, "little"))
            found.update(part)
        return found.hexdigest()

    def divided(self, max_boxes: int) -> tuple[np.ndarray, _Found]:
        """The units of work, in an order without regularity, and what their division found."""
        target = math.ceil(UNITS / len(self.lower))
        records = []
        parts: list[_Found] = []
        left = max_boxes
        for low, high in zip(self.lower, self.upper, strict=True):
            room = np.zeros((2 * target, self.size))
            room[0, : 2 * self.dimension] = np.concatenate([low, high])
            result, count = self._call("divide_box", left, room, ctypes.c_int64(target))
            left = max(left - result.boxes, 0)
            records.append(room[:count])
            parts.append(result)
        units = np.concatenate(records)
        division = _Found(
            sum(part.boxes for part in parts),
            max(part.status for part in parts),
            sum(part.done for part in parts) / len(parts),
            max(
                (part.worst for part in parts if part.worst is not None),
                key=lambda box: box.value,
                default=None,
            ),
        )
        return units[np.random.default_rng(0).permutation(len(units))], division

    def choose_guard(self, units: np.ndarray) -> Expectation:
        """Chooses the guard that is expected to need the fewest boxes for some units.

        Returns:
          The estimate with this guard.
        """
        self.guard = GUARDS[0]
        best, boxes = self.expected(units)
        chosen = self.guard
        for guard in GUARDS[1:]:
            if best.boxes <= FEW_BOXES * boxes:
                break
            self.guard = guard
            found, _ = self.expected(units)
            if found.at_most < best.at_most:
                best = found
                chosen = guard
        self.guard = chosen
        return best

    def expected(self, units: np.ndarray) -> tuple[Expectation, int]:
        """An estimate of the boxes of some units, which are in a random order, and the boxes that
        it takes itself.
        """
        sampled = units[:DESCENTS].copy()
        groups = np.array_split(sampled, min(GROUPS, len(sampled)))
        means = []
        boxes = 0
        for seed, group in enumerate(groups):
            more = (ctypes.c_int64(len(group)), ctypes.c_uint64(seed))
            result, _ = self._call("expected_boxes", 0, group, *more)
            means.append(result.done / len(group))
            boxes += result.boxes
        if not np.isfinite(means).all():
            return Expectation(math.inf, math.inf), boxes
        deviation = float(np.std(means)) / math.sqrt(max(1, len(means) - 1))
        return Expectation(len(units) * float(np.mean(means)), len(units) * deviation), boxes

    def searched(self, unit: np.ndarray, max_boxes: int) -> _Found:
        """The result of a unit."""
        result, _ = self._call("search_box", max_boxes, unit)
        return result._replace(done=result.done / len(self.lower))

    def worst(self, units: np.ndarray) -> SearchedBox | None:
        """The worst of some units."""
        result = self._result_type()()
        self.kernel.library.worst_box(
            pointer(self.kernel.numbers),
            pointer(units),
            ctypes.c_int64(len(units)),
            ctypes.byref(result),
        )
        return self._worst_of(result)

    def _call(self, name: str, max_boxes: int, boxes: np.ndarray, *more: Any) -> tuple[_Found, int]:
        """Calls a function of the kernel."""
        options = _Options(
            max_boxes,
            MAX_UNDECIDED,
            RENEWAL,
            pointer(self.smallest),
            pointer(self.scales),
            pointer(self.stop),
            self.guard,
        )
        result = self._result_type()()
        function = getattr(self.kernel.library, name)
        function.restype = RESULT_TYPES[name]
        count = function(
            pointer(self.kernel.numbers),
            pointer(boxes),
            *more,
            ctypes.byref(options),
            ctypes.byref(result),
        )
        if count < 0:
            raise ToolchainError("the processor refuses the rounding mode that enclosures need")
        return _Found(result.boxes, result.status, result.done, self._worst_of(result)), count

    def _result_type(self) -> Any:
        """`search_result` of the kernel."""
        corner = ctypes.c_double * self.dimension
        fields = [
            *((name, ctypes.c_int64) for name in ("boxes", "undecided", "status")),
            *((name, ctypes.c_double) for name in ("done", "bound", "value")),
            ("low", corner),
            ("high", corner),
        ]
        return type("Result", (ctypes.Structure,), {"_fields_": fields})

    def _worst_of(self, result: Any) -> SearchedBox | None:
        """The worst box of a result; None if there is none."""
        if result.value == -math.inf:
            return None
        return SearchedBox(np.array(result.low), np.array(result.high), result.bound, result.value)


class _Results:
    """The results of the units that are proved, in memory and in a file.

    Args:
      path: of the file; None for none.
      digest: of the problem.
      units: number of units.
    """

    def __init__(self, path: str | os.PathLike | None, digest: str, units: int) -> None:
        self.path = None if path is None else Path(path)
        self.digest = digest
        self.boxes = np.zeros(units, np.int64)
        self.done = np.zeros(units)
        self.saved = time.monotonic()
        if self.path is not None and self.path.exists():
            self._load(self.path)

    def add(self, unit: int, found: _Found) -> None:
        """Adds a unit that is proved."""
        self.boxes[unit] = found.boxes
        self.done[unit] = found.done
        if time.monotonic() - self.saved > SECONDS_BETWEEN_CHECKPOINTS:
            self.save()

    def save(self) -> None:
        """Writes the file."""
        self.saved = time.monotonic()
        if self.path is None:
            return
        with written_whole(self.path) as file:
            np.savez(file, digest=np.asarray(self.digest), boxes=self.boxes, done=self.done)

    def _load(self, path: Path) -> None:
        """Reads the file.

        Raises:
          ValueError: it is no checkpoint, or one of another problem.
        """
        place = checks.file_to_read("checkpoint", path)
        try:
            with np.load(place) as file:
                found = {name: file[name] for name in ("digest", "boxes", "done")}
        except (
            Exception
        ) as error:  # incomplete, another kind of file, or one that begins like a zip
            remedy = (
                f"It cannot be read ({type(error).__name__}: {error}): delete it or name another"
                " file."
            )
            raise checks.fail("checkpoint", str(path), "a checkpoint of a proof", remedy) from error
        if str(found["digest"]) != self.digest or found["boxes"].shape != self.boxes.shape:
            remedy = (
                "Scenario, level, parameters or the package's version differ: delete it or name"
                " another file."
            )
            raise checks.fail("checkpoint", str(path), "a checkpoint of this very proof", remedy)
        self.boxes = found["boxes"]
        self.done = found["done"]


def search(
    function: Callable,
    lower: ArrayLike,
    upper: ArrayLike,
    constants: Sequence[Any] = (),
    *,
    patterns: ArrayLike | None = None,
    scales: ArrayLike | None = None,
    max_boxes: int = 1_000_000_000,
    threads: int | None = None,
    progress: bool | None = None,
    checkpoint: str | os.PathLike | None = None,
) -> SearchResult:
    """Tries to prove that at every point x of a box with region(x) <= 0, one of the alternatives is
    negative.

    Args:
      function: function (x, constants) -> (alternatives (m,), region (r,)) of one point, (d,), and
        of a list of constants. All points of the box are in the region if r = 0.
      lower: lower corner of the box, (b,).
      upper: upper corner, (b,).
      constants: numbers and arrays of the function, which count as exact.
      patterns: values of the last d - b coordinates, which are not divided, (p, d - b): the
        statement is to be proved for each row. None if d = b.
      scales: widths at which coordinates count as equally wide, (b,); the widths of the whole box
        if None. They decide how many boxes are needed, not what is proved.
      max_boxes: number of boxes after which the search ends, at the end of a generation of boxes
        where it is reached during the division into units.
      threads: number of threads; None for the number of processors.
      progress: whether a bar shows the part of the volume that is done and an estimate of the
        remaining time; None for where a user sees it.
      checkpoint: file from which the search continues if it exists, and to which the units that are
        proved are written; None for none.

    Raises:
      ValueError: a bad argument, or the checkpoint is one of another problem.
      UnsupportedError: an operation is not available on intervals.
      ToolchainError: no compiler, or one that does not honour the rounding mode.
    """
    start = time.monotonic()
    max_boxes = checks.positive_integer("max_boxes", max_boxes)
    if threads is not None:
        threads = checks.positive_integer("threads", threads)
    low, high, widths = _corners(lower, upper, patterns, scales)
    problem = _Problem(interval_kernel(function, low.shape[1], constants), low, high, widths)
    units, division = problem.divided(max_boxes)
    expected = None
    if division.status == PROVED and len(units) > 0:
        expected = problem.choose_guard(units)
    results = _Results(checkpoint, problem.digest(units), len(units))
    ended = division
    proved = 0
    with bar(progress, total=100, unit="% of the volume") as shown:
        shown.update(100 * division.done)
        shown.set_postfix_str(str(expected or ""))
        if division.status == PROVED:
            left = max_boxes - division.boxes
            for found in _in_order(problem, units, results, left, threads):
                ended = found._replace(
                    boxes=ended.boxes + found.boxes, done=ended.done + found.done
                )
                shown.update(100 * found.done)
                shown.set_postfix_str(f"{ended.boxes:.3g} boxes, {expected}", refresh=False)
                if found.status != PROVED:
                    break
                proved += 1
    corners = units[proved:, : 2 * problem.dimension].reshape(-1, 2, problem.dimension)
    return SearchResult(
        status=STATUSES[ended.status],
        boxes=ended.boxes,
        seconds=time.monotonic() - start,
        done=ended.done,
        worst=_worst_left(problem, ended, units[proved:]),
        expected=expected,
        units=len(units),
        left=corners,
    )


def _corners(
    lower: ArrayLike, upper: ArrayLike, patterns: ArrayLike | None, scales: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Lower and upper corner of the box of each pattern, (p, d), and the scales, (d,); checked."""
    low, high = (np.asarray(x, np.float64) for x in (lower, upper))
    if low.shape != high.shape or low.ndim != 1 or not (low <= high).all():
        remedy = f"The upper corner is {high.tolist()}."
        raise checks.fail("lower", low.tolist(), "a corner below the upper one", remedy)
    rows = np.zeros((1, 0))
    if patterns is not None:
        rows = np.asarray(patterns, np.float64)
    widths = None
    if scales is not None:
        widths = np.asarray(scales, np.float64)
        if widths.shape != low.shape or not (np.isfinite(widths) & (widths > 0.0)).all():
            raise checks.fail("scales", scales, f"{len(low)} positive numbers")
        widths = np.concatenate([widths, np.zeros(rows.shape[1])])
    low, high = (
        np.concatenate([np.broadcast_to(corner, (len(rows), len(corner))), rows], axis=1)
        for corner in (low, high)
    )
    return low, high, widths


def _worst_left(problem: _Problem, ended: _Found, left: np.ndarray) -> SearchedBox | None:
    """The worst box of what ended the search, and of the units that are left where boxes ran
    out.
    """
    if ended.status != OUT_OF_BOXES:
        return ended.worst
    boxes = [box for box in (ended.worst, problem.worst(left)) if box is not None]
    return max(boxes, key=lambda box: box.value, default=None)


def _in_order(
    problem: _Problem, units: np.ndarray, results: _Results, max_boxes: int, threads: int | None
) -> Iterator[_Found]:
    """The results of the units in their order, computed by several threads, up to the first one
    that is not proved.
    """
    waiting: dict[Future, int] = {}
    found: dict[int, _Found] = {}
    left = max_boxes
    started = 0
    number = threads or os.cpu_count() or 1
    pool = ThreadPoolExecutor(number)
    try:
        for k, unit in enumerate(units):
            while k not in found:
                while started < len(units) and len(waiting) < 2 * number:
                    if results.boxes[started] > 0:
                        found[started] = _Found(
                            int(results.boxes[started]), PROVED, float(results.done[started]), None
                        )
                    else:
                        waiting[pool.submit(problem.searched, units[started], left)] = started
                    started += 1
                if k in found:
                    break
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    place = waiting.pop(future)
                    found[place] = future.result()
                    if found[place].status == PROVED:
                        results.add(place, found[place])
            result = found.pop(k)
            if result.boxes > left:
                # The number of boxes that were left when it began depended on the other threads.
                result = problem.searched(unit, left)
            left -= result.boxes
            yield result
    finally:
        problem.stop[0] = 1
        pool.shutdown(cancel_futures=True)
        results.save()
