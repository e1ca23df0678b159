"""Logs of a robot, read and checked: time, positions and torques of the joints.

    t [s], q (N, n) [rad], tau (N, n) [N m], and, where it was logged, q' (N, n) [rad/s]

A log is a Dataset or a mapping with these names (what `Rollout.to_xarray` gives), a Rollout, a CSV
file whose heading is t, q[0], ..., dq[0], ..., tau[0], ..., a netCDF file, or a rosbag2 recording
(`identification.bag`).  Time stamps may be irregular; a long time without samples is a gap, which
divides the log into two segments.  Logged velocities are mostly filtered differences of the
positions and serve as a check only.
"""

from __future__ import annotations

import csv
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import has_members
from iblf_jax.identification.bag import (
    BagOptions,
    is_bag,
    longest_interval,
    read_bag_log,
)
from iblf_jax.simulation.results import Rollout

LOG_FILE = "a .csv or .nc file or of a rosbag2 recording"
"""What a log on the disk is, in messages about paths."""
MIN_SAMPLES = 50
"""Samples that a log must have."""
UNITS = {
    "q": ("rad", "m", "1"),
    "dq": ("rad/s", "m/s", "1/s"),
    "tau": ("N m", "N", "Nm", "N*m", "N.m"),
    "t": ("s",),
}
"""Accepted units of a Dataset."""


class Log(NamedTuple):
    """One log, checked."""

    name: str
    t: np.ndarray
    q: np.ndarray
    tau: np.ndarray
    dq: np.ndarray | None

    @property
    def gap(self) -> float:
        """Time between samples above which there is a gap [s]."""
        return longest_interval(self.t)

    @property
    def step(self) -> float:
        """The mean time between samples without gaps [s]."""
        between = np.diff(self.t)
        return float(np.mean(between[between <= self.gap]))

    @property
    def segments(self) -> list[slice]:
        """The samples between gaps."""
        ends = np.flatnonzero(np.diff(self.t) > self.gap) + 1
        return [
            slice(int(a), int(b)) for a, b in zip([0, *ends], [*ends, len(self.t)], strict=True)
        ]


def read(log: object, n: int, what: str = "log", joints: Sequence[str] = ()) -> list[Log]:
    """The logs that a user gave, checked.

    Args:
      log: one, or a list of them.
      n: number of joints.
      what: the user's word for it.
      joints: names of the joints, by which the joint states of a recording are ordered.

    Raises:
      ValueError: something that is no log, or one with missing columns, rows without numbers, times
        that do not increase, another number of joints, too few samples, or units that are not SI.
      OSError: a file cannot be read.
    """
    if isinstance(log, list | tuple):
        checks.flat_enough(what, log)
        if not log:
            raise checks.fail(what, log, "at least one log")
        return [one for i, x in enumerate(log) for one in read(x, n, f"{what}[{i}]", joints)]
    if isinstance(log, str | os.PathLike):
        path = checks.file_path(what, log, LOG_FILE)
        if is_bag(path) and path.exists():
            found = read_bag_log(path, n, joints, BagOptions())
            return [_checked(found, n, str(path))]
        path = checks.file_to_read(what, log, LOG_FILE)
        return [_checked(_of_file(path), n, str(path))]
    if isinstance(log, Rollout):
        return [_checked(_of_rollout(log, what), n, what)]
    if isinstance(log, Mapping) or has_members(log, "data_vars"):
        return [_checked(_of_mapping(log, what), n, what)]
    raise checks.fail(
        what, log, f"a Dataset, a Rollout, the path of {LOG_FILE}, or a list of these"
    )


def _of_file(path: Path) -> dict[str, np.ndarray]:
    ending = path.suffix.lower()
    if ending == ".nc":
        import xarray

        try:
            data = xarray.load_dataset(path)
        except Exception as error:  # its readers raise errors of many kinds
            came = type(error).__name__
            raise checks.fail(str(path), came, "a netCDF file", str(error)) from error
        return _of_mapping(data, str(path))
    if ending == ".csv":
        return _of_columns(*_columns(path), str(path))
    raise checks.fail("log", str(path), f"the path of {LOG_FILE}")


def _columns(path: Path) -> tuple[list[str], np.ndarray]:
    """The heading of a CSV file, and its rows of numbers, (N, columns)."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            # The heading that numpy.savetxt writes begins with "# ".
            heading = [word.strip().removeprefix("# ") for word in next(csv.reader(file), [])]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a file without rows is reported below
                return heading, np.genfromtxt(file, delimiter=",", ndmin=2)
    except UnicodeDecodeError as error:
        remedy = 'Save it as "CSV UTF-8": other encodings, such as UTF-16, are not read.'
        raise checks.fail(str(path), checks.Words(str(error)), "a text in UTF-8", remedy) from error
    except csv.Error as error:
        came = checks.Words(str(error))
        raise checks.fail(str(path), came, "a heading t, q[0], ..., tau[0], ...") from error
    except ValueError as error:  # of genfromtxt
        text = str(error)
        short = re.search(r"Line #(\d+) \(got (\d+) columns instead of (\d+)\)", text)
        if short is None:
            raise checks.fail(str(path), checks.Words(text), "rows of numbers") from error
        raise checks.fail(
            str(path),
            checks.Words(f"{short[2]} columns in row {int(short[1]) - 1}"),
            f"{short[3]}, as in the rows before",
            "Leave this row out: gaps are allowed.",
        ) from error


def _of_columns(heading: list[str], rows: np.ndarray, what: str) -> dict[str, np.ndarray]:
    """The signals in the columns of a table."""
    words = checks.Words(", ".join(heading))
    if "t" not in heading or rows.shape[1] != len(heading):
        raise checks.fail(
            what,
            checks.Words(
                f"the heading {words or 'of an empty file'} and rows of {rows.shape[1]} columns"
            ),
            "a column t, and one column for each word of the heading",
            "It begins t, q[0], q[1], ...",
        )
    if len(set(heading)) < len(heading):
        raise checks.fail(what, words, "columns of different names")
    found = {"t": rows[:, heading.index("t")]}
    for name in ("q", "dq", "tau"):
        matches = (re.fullmatch(rf"{name}\[(\d+)\]", word) for word in heading)
        column = {int(match[1]): i for i, match in enumerate(matches) if match}
        if not column:
            continue
        for j in range(max(column)):
            if j not in column:
                raise checks.fail(what, words, f"a column {name}[{j}]")
        found[name] = rows[:, [column[j] for j in sorted(column)]]
    return found


def _of_mapping(data: Any, what: str) -> dict[str, np.ndarray]:
    found = {}
    keys = {"t": "t", "q": "q", "dq": "dq", "tau": "tau"}
    if "t" not in data:
        keys["t"] = "time"
    for name, key in keys.items():
        if key not in data:
            continue
        x = data[key]
        if has_members(x, "attrs", "dims"):  # a DataArray of xarray
            unit = x.attrs.get("units", UNITS[name][0])
            if unit not in UNITS[name]:
                field = f"{what}: units of {name}"
                raise checks.fail(field, unit, UNITS[name][0], "Convert the log to SI units.")
            if "time" in x.dims:
                x = x.transpose("time", ...)
        try:
            found[name] = np.asarray(x, float)
        except (TypeError, ValueError) as error:
            raise checks.fail(f"{what}: {name}", x, "an array of numbers") from error
    return found


def _of_rollout(run: Rollout, what: str) -> dict[str, np.ndarray]:
    if np.ndim(run.t) != 1:
        remedy = "Give a list: [runs[0], runs[1]]."
        raise checks.fail(what, checks.Words("a batch of runs"), "one run", remedy)
    found = {"t": run.t, "q": run.q, "tau": run.tau}
    rows: Any = slice(None)
    if run.scenario.sampling is not None:
        # A sampled loop records its measurements at the start of each period.
        found["q"] = run.measured.q
        periods = np.asarray(run.t, float) / float(run.scenario.sampling.period)
        rows = np.abs(periods - np.round(periods)) < 1e-6
    return {name: np.asarray(x, float)[rows] for name, x in found.items()}


def _checked(found: dict[str, np.ndarray], n: int, what: str) -> Log:
    """The log of these signals; ValueError for one that is incomplete or invalid."""

    def invalid(about: str, came: str, expected: str, remedy: str = "") -> ValueError:
        return checks.fail(f"{what}{about}", checks.Words(came), expected, remedy)

    for name, columns in (
        ("t", "t"),
        ("q", f"q[0] ... q[{n - 1}]"),
        ("tau", f"tau[0] ... tau[{n - 1}]"),
    ):
        if name not in found:
            expected = f"t, q and tau: {columns} is missing"
            raise invalid(
                "", f"no {name}", expected, "Of a CSV file the heading names the columns."
            )
    t = found["t"]
    if t.ndim != 1:
        raise checks.fail(f"{what}: t", t, "one time a sample, (N,) [s]")
    count = len(t)
    for name in ("q", "tau", "dq"):
        if name not in found:
            continue
        shape = found[name].shape
        came = f"shape {shape}"
        if len(shape) == 2:
            came = f"{shape[1]} joints"
        if len(shape) != 2 or shape[1] != n:
            raise invalid(f": {name}", came, f"(N, {n}), as the scenario has {n} joints")
        if shape[0] != count:
            raise invalid(f": {name}", f"{shape[0]} samples", f"{count}, as t has")
    if count < MIN_SAMPLES:
        raise invalid("", f"{count} samples", f"at least {MIN_SAMPLES}", "Log for longer.")
    finite = {name: np.isfinite(x).reshape(count, -1).all(axis=1) for name, x in found.items()}
    broken = ~np.all(list(finite.values()), axis=0)
    if np.any(broken):
        first = int(np.argmax(broken))
        names = ", ".join(name for name, rows in finite.items() if not rows[first])
        raise invalid(
            ": rows that hold no numbers",
            f"{int(broken.sum())} of {count}, the first is row {first} (in {names})",
            "finite numbers",
            "Leave these rows out: gaps are allowed.",
        )
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back):
        k = int(back[0])
        raise invalid(
            ": t",
            f"{t[k]:.9g} and then {t[k + 1]:.9g} in rows {k} and {k + 1}",
            "times that increase",
            "Leave out rows that repeat a time, or log times with more digits.",
        )
    return Log(what, t, found["q"], found["tau"], found.get("dq"))
