"""Logs of a robot, read and checked: time, positions and torques of the joints.

    t [s], q (N, n) [rad], tau (N, n) [N m], and, where it was logged, q' (N, n) [rad/s]

A log is a Dataset or a mapping with these names (what `Rollout.to_xarray` gives), a Rollout, a CSV
file whose heading is t, q[0], ..., dq[0], ..., tau[0], ..., or a netCDF file.  Time stamps may be
irregular; a long time without samples is a gap, which divides the log into two segments.  Logged
velocities are mostly filtered differences of the positions and serve as a check only.
"""

from __future__ import annotations

import csv
import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation.results import Rollout

GAP_RATIO, GAP_QUANTILE = 3.0, 0.95
"""A time between samples of more than GAP_RATIO times the quantile GAP_QUANTILE of these times is a
gap."""
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
        return GAP_RATIO * float(np.quantile(np.diff(self.t), GAP_QUANTILE))

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


def read(log: Any, n: int, what: str = "log") -> list[Log]:
    """The logs that a user gave, checked.

    Args:
      log: one, or a list of them.
      n: number of joints.
      what: the user's word for it.

    Raises:
      ValueError: something that is no log, or one with missing columns, rows without numbers, times
        that do not increase, another number of joints, too few samples, or units that are not SI.
      OSError: a file cannot be read.
    """
    if isinstance(log, list | tuple):
        if not log:
            raise checks.fail(what, log, "at least one log")
        return [one for i, x in enumerate(log) for one in read(x, n, f"{what}[{i}]")]
    if isinstance(log, str | os.PathLike):
        path = checks.file_to_read(what, log, "a log, .csv or .nc")
        return [_checked(_of_file(path), n, str(path))]
    if isinstance(log, Rollout):
        return [_checked(_of_rollout(log, what), n, what)]
    if isinstance(log, Mapping) or hasattr(log, "data_vars"):
        return [_checked(_of_mapping(log, what), n, what)]
    raise checks.fail(
        what, log, "a Dataset, a Rollout, the path of a .csv or .nc file, or a list of these"
    )


def _of_file(path: Path) -> dict[str, np.ndarray]:
    if path.suffix.lower() == ".nc":
        import xarray

        try:
            data = xarray.load_dataset(path)
        except Exception as error:  # whatever its reader makes of it
            raise checks.fail(
                str(path), type(error).__name__, "a netCDF file", str(error)
            ) from error
        return _of_mapping(data, str(path))
    if path.suffix.lower() != ".csv":
        raise checks.fail("log", str(path), "a file that ends in .csv or .nc")
    with open(path, newline="", encoding="utf-8-sig") as file:
        heading = [
            word.strip().removeprefix("# ") for word in next(csv.reader(file), [])
        ]  # numpy.savetxt's begins with "# "
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a file without rows is reported below
            try:
                rows = np.genfromtxt(file, delimiter=",", ndmin=2)
            except ValueError as error:
                short = re.search(r"Line #(\d+) \(got (\d+) columns instead of (\d+)\)", str(error))
                if short is None:
                    raise checks.fail(
                        str(path), checks.Words(str(error)), "rows of numbers"
                    ) from error
                came = checks.Words(f"{short[2]} columns in row {int(short[1]) - 1}")
                raise checks.fail(
                    str(path),
                    came,
                    f"{short[3]}, as in the rows before",
                    "Leave this row out: gaps are allowed.",
                ) from error
    if "t" not in heading or rows.shape[1] != len(heading):
        came = checks.Words(
            f"the heading {', '.join(heading) or 'of an empty file'} and rows of {rows.shape[1]}"
            " columns"
        )
        raise checks.fail(
            str(path),
            came,
            "a column t, and one column for each word of the heading",
            "It begins t, q[0], q[1], ...",
        )
    if len(set(heading)) < len(heading):
        raise checks.fail(str(path), checks.Words(", ".join(heading)), "columns of different names")
    found = {"t": rows[:, heading.index("t")]}
    for name in ("q", "dq", "tau"):
        own = {
            int(m[1]): i
            for i, word in enumerate(heading)
            if (m := re.fullmatch(rf"{name}\[(\d+)\]", word))
        }
        missing = set(range(max(own, default=0) + 1)) - set(own)
        if own and missing:
            raise checks.fail(
                str(path), checks.Words(", ".join(heading)), f"a column {name}[{min(missing)}]"
            )
        if own:
            found[name] = rows[:, [own[i] for i in range(len(own))]]
    return found


def _of_mapping(data: Any, what: str) -> dict[str, np.ndarray]:
    found = {}
    time = next((name for name in ("t", "time") if name in data), "t")
    for name, key in (("t", time), ("q", "q"), ("dq", "dq"), ("tau", "tau")):
        if key not in data:
            continue
        x = data[key]
        unit = getattr(x, "attrs", {}).get("units")
        if unit is not None and unit not in UNITS[name]:
            raise checks.fail(
                f"{what}: units of {name}", unit, UNITS[name][0], "Convert the log to SI units."
            )
        if "time" in getattr(x, "dims", ()):
            x = x.transpose("time", ...)
        try:
            found[name] = np.asarray(x, float)
        except (TypeError, ValueError) as error:
            raise checks.fail(f"{what}: {name}", x, "an array of numbers") from error
    return found


def _of_rollout(run: Rollout, what: str) -> dict[str, np.ndarray]:
    if np.ndim(run.t) != 1:
        raise checks.fail(
            what, checks.Words("a batch of runs"), "one run", "Give a list: [runs[0], runs[1]]."
        )
    if isinstance(run.measured, tuple) and not hasattr(run.measured, "q"):
        return {
            "t": np.asarray(run.t, float),
            "q": np.asarray(run.q, float),
            "tau": np.asarray(run.tau, float),
        }
    # A sampled loop records its measurements at the start of each period.
    t = np.asarray(run.t, float)
    period = float(run.scenario.sampling.period)  # type: ignore[union-attr]
    taken = np.flatnonzero(np.abs(t / period - np.round(t / period)) < 1e-6)
    return {
        name: np.asarray(x, float)[taken]
        for name, x in (("t", t), ("q", run.measured.q), ("tau", run.tau))
    }


def _checked(found: dict[str, np.ndarray], n: int, what: str) -> Log:
    for name in ("t", "q", "tau"):
        if name not in found:
            columns = name if name == "t" else f"{name}[0] ... {name}[{n - 1}]"
            raise checks.fail(
                what,
                checks.Words(f"no {name}"),
                f"t, q and tau: {columns} is missing",
                "Of a CSV file the heading names the columns.",
            )
    t = found["t"]
    if t.ndim != 1:
        raise checks.fail(f"{what}: t", t, "one time a sample, (N,) [s]")
    for name in set(found) - {"t"}:
        if found[name].ndim != 2 or found[name].shape[1] != n:
            came = checks.Words(
                f"{found[name].shape[1]} joints"
                if found[name].ndim == 2
                else f"shape {found[name].shape}"
            )
            raise checks.fail(f"{what}: {name}", came, f"(N, {n}), as the scenario has {n} joints")
        if len(found[name]) != len(t):
            raise checks.fail(
                f"{what}: {name}",
                checks.Words(f"{len(found[name])} samples"),
                f"{len(t)}, as t has",
            )
    if len(t) < MIN_SAMPLES:
        raise checks.fail(
            what, checks.Words(f"{len(t)} samples"), f"at least {MIN_SAMPLES}", "Log for longer."
        )
    broken = ~np.all(
        [np.isfinite(x).reshape(len(t), -1).all(axis=1) for x in found.values()], axis=0
    )
    if np.any(broken):
        first = int(np.argmax(broken))
        names = ", ".join(name for name, x in found.items() if not np.isfinite(x[first]).all())
        raise checks.fail(
            f"{what}: rows that hold no numbers",
            checks.Words(f"{int(broken.sum())} of {len(t)}, the first is row {first} (in {names})"),
            "finite numbers",
            "Leave these rows out: gaps are allowed.",
        )
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back):
        k = int(back[0])
        raise checks.fail(
            f"{what}: t",
            checks.Words(f"{t[k]:.9g} and then {t[k + 1]:.9g} in rows {k} and {k + 1}"),
            "times that increase",
            "Leave out rows that repeat a time, or log times with more digits.",
        )
    return Log(what, t, found["q"], found["tau"], found.get("dq"))
