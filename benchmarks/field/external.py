"""Results of other programs: a trajectory as CSV, its consistency with a task, and its numbers.

    python benchmarks/field/check.py --result NAME FILE.csv --law "the law and its program"

The file has the columns t, of the states and of the inputs of `tasks/NAME.json`, by their names.
This module needs NumPy and `tasks/read_task.py` only, and nothing of the package.

A trajectory is consistent if the task's plant, started at a row with the stated input, reaches the
next row.  The input between two rows is not stated: it may differ from the earlier one by D_k, the
largest change between two rows in this interval and in both beside it, component by component.  Its
effect on the state is allowed, together with the error of the integration and of the digits:

    |x_k+1 - F(u_k, u_k+1)| <= sum_j |F(u_k + D_kj, u_k + D_kj) - F(u_k, u_k)|
                               + 2 |F - F with half as many steps| + rounding

F is the Runge-Kutta method of order 4 from x_k over a linear input, and D_kj is in component j.  A
force below D_k that the task does not have cannot be excluded, so the rows must be close enough for
`COARSEST`.  Within a period of a task that has one the input is constant, and D_k is 0.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE / "tasks"))

import read_task

TASKS = HERE / "tasks"
EXTERNAL = HERE / "external"
DIGITS = 1e-8
"""Rounding of the numbers of a file, as a share of the largest of their column."""
COARSEST = 0.05
"""Largest tolerance of a state between two rows, as a share of its range."""
STEPS = 4
"""Of the integration between two rows."""
INSTANT = 1e-6
"""Periods by which a row may miss an instant of the law."""
LIMITS = 1e-6
"""By which an input may exceed its limits, as a share of them."""
NARROWEST = 1e-6
"""Least distance of a reference from its bounds in the margin, as `iblf_jax.bounds` has it."""


def columns_of(task: dict[str, Any]) -> list[str]:
    """The columns of a trajectory."""
    return ["t", *task["state"]["names"], *task["input"]["names"]]


def read_result(task: dict[str, Any], path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time (T,), states (T, m) and inputs (T, n) of a CSV file.

    Raises:
      ValueError: the file lacks a column, or has something that is not a number.
    """
    with path.open(encoding="utf-8-sig") as file:
        names = [name.strip().strip('"') for name in file.readline().split(",")]
        table = np.loadtxt(file, delimiter=",", ndmin=2)
    lacking = [name for name in columns_of(task) if name not in names]
    if lacking:
        raise ValueError(f"{path.name} lacks the columns {', '.join(lacking)}; it has {names}")
    if len(table) < 2 or not np.isfinite(table).all():
        raise ValueError(f"{path.name} needs at least two rows of finite numbers")
    t, *others = (table[:, names.index(name)] for name in columns_of(task))
    count = len(task["state"]["names"])
    return t, np.stack(others[:count], axis=1), np.stack(others[count:], axis=1)


# ---------------------------------------------------------------------------- numbers


def numbers_of(
    task: dict[str, Any], t: np.ndarray, x: np.ndarray, u: np.ndarray
) -> dict[str, float]:
    """The numbers of a row, for the second half of the run and, effort and peak, the entire one."""
    n, count = task["components"], task["components"] * task["levels"]
    level = x[:, :count]
    reference = read_task.evaluate(task, "reference", t)[:, :n]
    lower, upper = (read_task.evaluate(task, side, t) for side in ("lower", "upper"))
    e = level[:, :n] - reference
    late = t >= 0.5 * task["duration"]
    steady = read_task.evaluate(task, "steady_input", x)
    room = np.where(e > 0.0, upper[:, :n] - reference, reference - lower[:, :n])
    shares = [1.0 - np.abs(e) / np.maximum(room, NARROWEST)]
    has_bounds = np.isfinite(lower) & np.isfinite(upper)
    with np.errstate(invalid="ignore"):
        share = np.minimum(level - lower, upper - level) / (0.5 * (upper - lower))
    shares.append(np.where(has_bounds, share, np.inf)[:, n:])
    return {
        "RMS error": float(np.sqrt(_mean(t[late], np.mean(e[late] ** 2, axis=1)))),
        "error": float(np.abs(e[late]).max()),
        "effort": float(np.sqrt(_mean(t, np.sum((u - steady) ** 2, axis=1)))),
        "peak input": float(np.abs(u).max()),
        "margin": float(min(part.min(initial=np.inf) for part in shares)),
    }


def _mean(t: np.ndarray, values: np.ndarray) -> float:
    """The mean over the time."""
    return float(np.sum(0.5 * (values[1:] + values[:-1]) * np.diff(t)) / (t[-1] - t[0]))


def violations_of(task: dict[str, Any], t: np.ndarray, x: np.ndarray) -> list[str]:
    """Which bounds and constraints a trajectory does not keep, with the first time."""
    found = []
    names = task["state"]["names"]
    lower, upper = (read_task.evaluate(task, side, t) for side in ("lower", "upper"))
    for i in range(lower.shape[1]):
        outside = (x[:, i] < lower[:, i]) | (x[:, i] > upper[:, i])
        if outside.any():
            found.append(f"{names[i]} leaves its bounds at t = {t[outside][0]:.6g} s")
    values = read_task.evaluate(task, "constraints", t, x)
    for name, value in zip(task["constraints"], values.T, strict=True):
        if (value < 0.0).any():
            found.append(f"{name} becomes negative at t = {t[value < 0.0][0]:.6g} s")
    return found


# ---------------------------------------------------------------------------- consistency


def faults_of(task: dict[str, Any], t: np.ndarray, x: np.ndarray, u: np.ndarray) -> list[str]:
    """Why a trajectory is not one of the task, a sentence each; empty if it is one.  A trajectory
    that leaves its bounds is one.
    """
    if (np.diff(t) <= 0.0).any():
        return ["the times must increase"]
    slack = 1e-6 * task["duration"]
    found = []
    if abs(t[0]) > slack or abs(t[-1] - task["duration"]) > slack:
        found.append(
            f"it runs from {t[0]:g} to {t[-1]:g} s; the task from 0 to {task['duration']:g} s"
        )
    start, scale = np.array(task["start"]), np.abs(x).max(axis=0)
    wrong = np.abs(x[0] - start) > 1e-6 * scale + 1e-12
    for i in np.flatnonzero(wrong):
        found.append(f"{task['state']['names'][i]} starts at {x[0, i]:g}; the task at {start[i]:g}")
    return found + _faults_of_input(task, t, u) + _faults_of_rates(task, t, x, u)


def _faults_of_input(task: dict[str, Any], t: np.ndarray, u: np.ndarray) -> list[str]:
    """The limits of the input, and its changes in a task with a period."""
    found = []
    limits = (task["input"]["lower"], task["input"]["upper"])
    for side, sign in zip(limits, (-1.0, 1.0), strict=True):
        if side is None:
            continue
        beyond = (sign * (u - np.array(side)) > LIMITS * np.abs(side)).any(axis=1)
        if beyond.any():
            found.append(f"the input exceeds its limits {side} at t = {t[beyond][0]:.6g} s")
    if task["sampling"]:
        number = np.floor(periods_of(task, t) + INSTANT)
        changes = np.abs(np.diff(u, axis=0)).max(axis=1) > DIGITS * np.abs(u).max()
        within = changes & (np.diff(number) == 0.0)
        if within.any():
            found.append(
                f"the input changes at t = {t[1:][within][0]:.6g} s, within a period of"
                f" {task['sampling']['period']:g} s"
            )
    return found


def periods_of(task: dict[str, Any], t: np.ndarray) -> np.ndarray:
    """The time in periods of the input, of a task that has some."""
    return (t - task["sampling"]["delay"]) / task["sampling"]["period"]


def held_intervals(task: dict[str, Any], t: np.ndarray) -> np.ndarray:
    """Whether the input is constant from each row until the next one, because both are within a
    period or at its ends, (T - 1,).
    """
    if not task["sampling"]:
        return np.zeros(len(t) - 1, bool)
    number = periods_of(task, t)
    return np.floor(number[:-1] + INSTANT) >= np.floor(number[1:] - INSTANT)


def _faults_of_rates(
    task: dict[str, Any], t: np.ndarray, x: np.ndarray, u: np.ndarray
) -> list[str]:
    """The difference of the rows from the motion of the plant under the stated input."""
    difference, allowed = deviations(task, t, x, u)
    names, spread = task["state"]["names"], np.ptp(x, axis=0)
    coarse = allowed > COARSEST * spread + 10.0 * DIGITS * np.abs(x).max(axis=0) + 1e-12
    if coarse.any():
        k, i = np.argwhere(coarse)[0]
        return [
            f"the rows are too far apart at t = {t[k]:.6g} s: the input leaves {names[i]} open by"
            f" {allowed[k, i]:.2g}, where {COARSEST:g} of its range is allowed"
        ]
    wrong = difference > allowed
    if wrong.any():
        k, i = np.argwhere(wrong)[0]
        return [
            f"{names[i]} at t = {t[k + 1]:.6g} s is {difference[k, i]:.3g} from the motion of the"
            f" plant under the stated input from t = {t[k]:.6g} s, where {allowed[k, i]:.3g} is"
            " allowed"
        ]
    return []


def deviations(
    task: dict[str, Any], t: np.ndarray, x: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The difference of each row from the motion from the row before, and what is allowed, both
    (T - 1, m).
    """
    time, h = t[:-1], np.diff(t)
    held = held_intervals(task, t)
    before, after = u[:-1], np.where(held[:, None], u[:-1], u[1:])

    def reached(first, last, steps=STEPS):
        return _integrated(task, time, h, x[:-1], first, last, steps)

    fine = reached(before, after, 2 * STEPS)
    constant = reached(before, before)
    allowed = 2.0 * np.abs(fine - reached(before, after))
    change = np.pad(np.abs(np.diff(u, axis=0)), ((1, 1), (0, 0)))
    nearby = np.maximum(np.maximum(change[:-2], change[1:-1]), change[2:])
    nearby[held] = 0.0
    for j in range(u.shape[1]):
        one = before.copy()
        one[:, j] += nearby[:, j]
        allowed += np.abs(reached(one, one) - constant)
    moved = np.abs(fine - x[:-1]).max(axis=0)
    allowed += DIGITS * (2.0 * np.abs(x).max(axis=0) + moved) + 1e-12
    return np.abs(x[1:] - fine), allowed


def _integrated(task, t, h, x, first, last, steps):
    """The states after h under inputs that go linearly from `first` to `last`."""
    step = (h / steps)[:, None]

    def rate(share, state):
        return read_task.rates(task, t + share * h, state, first + share * (last - first))

    for k in range(steps):
        a, b, c = (k / steps, (k + 0.5) / steps, (k + 1.0) / steps)
        k1 = rate(a, x)
        k2 = rate(b, x + 0.5 * step * k1)
        k3 = rate(b, x + 0.5 * step * k2)
        k4 = rate(c, x + step * k3)
        x = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return x


# ---------------------------------------------------------------------------- rows


def digest(path: Path) -> str:
    """The SHA-256 digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def row_of(name: str, path: Path, law: str) -> dict[str, Any]:
    """The row of a result.

    Raises:
      ValueError: there is no such task, or the result is not one of it.
    """
    file = TASKS / f"{name}.json"
    if not file.exists():
        raise ValueError(f"there is no task {name}; benchmarks/field/tasks has them")
    task = read_task.read(file)
    if "reason" in task:
        raise ValueError(f"{name} cannot be run by other programs: {task['reason']}")
    t, x, u = read_result(task, path)
    if faults := faults_of(task, t, x, u):
        raise ValueError("; ".join(faults))
    difference, allowed = deviations(task, t, x, u)
    numbers = numbers_of(task, t, x, u)
    numbers["effort"] /= task["published"]["effort"]
    left = violations_of(task, t, x)
    if left:
        numbers |= dict.fromkeys(("RMS error", "error", "margin"), "left")
    return {
        "law": law,
        **numbers,
        "left": left,
        "rows": len(t),
        "used tolerance": float((difference / allowed).max()),
        "file": path.name,
        "sha256": digest(path),
        "sha256 of the task": digest(file),
        "date": time.strftime("%Y-%m-%d"),
    }


def add(name: str, path: Path, law: str) -> dict[str, Any]:
    """Puts the row of a result into the file of its entry, in place of one of the same law."""
    row = row_of(name, path, law)
    rows = [other for other in rows_of(name) if other["law"] != law]
    EXTERNAL.mkdir(exist_ok=True)
    text = json.dumps({"rows": [*rows, row]}, indent=1, ensure_ascii=False)
    (EXTERNAL / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    return row


def rows_of(name: str) -> list[dict[str, Any]]:
    """The rows of other programs on the task of an entry."""
    file = EXTERNAL / f"{name}.json"
    if not file.exists():
        return []
    return json.loads(file.read_text(encoding="utf-8"))["rows"]
