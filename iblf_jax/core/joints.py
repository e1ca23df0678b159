"""Selection of joints: the one meaning of every argument `joints=`.

    joints=None             all joints
    joints=[0, 1]           joints 0 and 1; joints=-1 is the last one
    joints="elbow"          by name, as in the robot's file
    joints=slice(0, 3)      a slice, "0:3" in a file
    joints=[True, False]    one truth value for each joint

A selection is structure, so it is stored as a hashable tuple; `indices` converts it to indices once
the robot is known.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from iblf_jax.core import checks

Selection: TypeAlias = tuple[int | str, ...] | None
"""Indices, names, slices as text, or truth values; None for all joints."""

Joints: TypeAlias = (
    int | str | slice | Sequence[int | str | slice | bool] | jax.Array | np.ndarray | None
)
"""What users give for `joints=`."""

EXPECTED = "indices, names or a slice of joints, or one truth value for each joint"
WEIGHTS = "Weights have an argument of their own, weights=."
SLICE = re.compile(r"(-?\d+)?:(-?\d+)?(?::(-?\d+)?)?")
"""A slice as text."""


def selection(field: str, joints: Joints) -> Selection:
    """A user's selection as a hashable tuple, with all checks that do not need the robot.

    Args:
      field: name of the argument, for error messages.
      joints: an index, a name, a slice, a sequence of these, or one truth value for each joint;
        None for all joints.

    Raises:
      ValueError: another type, numbers that are not integers, or an empty selection.
    """
    if joints is None:
        return None
    if isinstance(joints, jax.core.Tracer):
        raise checks.fail(
            field, joints, EXPECTED, "It decides what is compiled, so it cannot be traced."
        )
    entries = _entries(field, joints)
    found = tuple(_entry(field, joints, x) for x in entries)
    if not found:
        raise checks.fail(field, joints, "at least one joint")
    truths = sum(isinstance(x, bool) for x in found)
    if truths not in (0, len(found)):
        raise checks.fail(field, joints, EXPECTED, "Truth values cannot be mixed with indices.")
    return found


def _entries(field: str, joints: object) -> Sequence[Any]:
    if isinstance(joints, bool | np.bool_):
        raise checks.fail(
            field, joints, EXPECTED, "Give one truth value for each joint, in a list."
        )
    if isinstance(joints, jax.Array | np.ndarray | np.generic):
        if jax.dtypes.issubdtype(joints.dtype, jax.dtypes.prng_key):
            raise checks.fail(field, joints, EXPECTED)
        array = np.asarray(joints)
        if array.ndim > 1:
            raise checks.fail(field, joints, EXPECTED, f"Its shape is {array.shape}.")
        return np.atleast_1d(array).tolist()
    if isinstance(joints, int | float | str | slice):
        return [joints]
    if isinstance(joints, list | tuple | range):
        return joints
    raise checks.fail(field, joints, EXPECTED)


def _entry(field: str, joints: object, entry: object) -> int | str:
    if isinstance(entry, bool | np.bool_):
        return bool(entry)
    if isinstance(entry, int | np.integer) and abs(int(entry)) < 2**31:
        return int(entry)
    if isinstance(entry, str):
        return entry
    if isinstance(entry, slice):
        return _slice_as_text(field, entry)
    raise checks.fail(
        field, joints, EXPECTED, WEIGHTS if isinstance(entry, float | np.floating) else ""
    )


def _slice_as_text(field: str, given: slice) -> str:
    parts = (given.start, given.stop, given.step)
    if not all(
        x is None or (isinstance(x, int | np.integer) and not isinstance(x, bool)) for x in parts
    ):
        raise checks.fail(field, given, "a slice of whole numbers", "Name single joints in a list.")
    words = ["" if x is None else str(int(x)) for x in parts]
    if given.step is None:
        words = words[:2]
    return ":".join(words)


def indices(field: str, chosen: Selection, names: Sequence[str]) -> tuple[int, ...]:
    """The joints of a selection, from 0, in the order in which they were given.

    Args:
      field: name of the argument, for error messages.
      chosen: as `selection` returns it.
      names: of the n joints.

    Raises:
      ValueError: a joint that the robot does not have, one that is given twice, or none.
    """
    n = len(names)
    if chosen is None:
        return tuple(range(n))
    if isinstance(chosen[0], bool):
        if len(chosen) != n:
            raise checks.fail(field, list(chosen), f"{n} truth values, one for each joint")
        found = [i for i, taken in enumerate(chosen) if taken]
    else:
        found = [i for entry in chosen for i in _indices_of(field, entry, names)]
    if not found:
        raise checks.fail(field, list(chosen), "at least one joint")
    twice = next((i for i in found if found.count(i) > 1), None)
    if twice is not None:
        expected = f"each joint once, but it holds joint {twice} twice"
        raise checks.fail(field, list(chosen), expected, WEIGHTS)
    return tuple(found)


def _indices_of(field: str, entry: int | str, names: Sequence[str]) -> list[int]:
    n = len(names)
    if isinstance(entry, int):
        if not -n <= entry < n:
            expected = f"an index from 0 to {n - 1}, as the robot has {n} joints"
            raise checks.fail(field, entry, expected, WEIGHTS)
        return [entry % n]
    if entry in names:
        same = [i for i, name in enumerate(names) if name == entry]
        if len(same) > 1:
            raise checks.fail(
                field, entry, "the name of one joint", f"Joints {same} are called so: give indices."
            )
        return same
    if SLICE.fullmatch(entry):
        parts = [int(x) if x else None for x in entry.split(":")]
        if len(parts) == 3 and parts[2] == 0:
            raise checks.fail(field, entry, "a slice whose step is not 0")
        return list(range(n))[slice(*parts)]
    raise checks.fail(field, entry, "the name of a joint", checks.did_you_mean(entry, names))
