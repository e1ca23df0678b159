"""Structural constants of a scenario: the numbers that are compiled into the kernel.

They are the numbers of a robot's geometry that are 0, 1 or -1 or equal other numbers, and the
factors of a law that are 0 or 1.  Axes, offsets and rotations of real arms are mostly zeros, and
model and plant mostly agree, so a kernel that uses this needs fewer operations.  Other values are
inputs of the kernel, and so are all masses, gains and loads: new values need no compilation.  A
robot declares the fields in question (`geometry_fields`), and so does a law (`factors`, such as the
weight of a barrier).  Leaves that differ between runs are never structural constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes
from iblf_jax.core.pytree import layers, wrapped_field
from iblf_jax.kernels import Known
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants
from iblf_jax.world.robots import Robot

COMPILED = (0.0, 1.0)
"""Factors of a law that are compiled into the kernel."""
QUATERNIONS = ("rotation", "tip_rotation")
"""Fields whose rows have equal numbers for a systematic reason: a right angle."""


class StructuralConstants(NamedTuple):
    """The structural constants of a scenario; hashable."""

    numbers: tuple[Known | None, ...]
    """One entry per number of the scenario, leaf after leaf; None for a number that is an input."""

    def of_shared(
        self, is_per_run: Sequence[bool], sizes: Sequence[int]
    ) -> tuple[Known | None, ...]:
        """The structural constants among the shared numbers.

        Args:
          is_per_run: whether a leaf differs between the runs, for all leaves; those of the scenario
            come first.
          sizes: number of entries of each leaf.
        """
        position: dict[int, int] = {}
        first = 0
        for differs, size in zip(is_per_run, sizes, strict=True):
            if not differs:
                position.update({first + i: len(position) + i for i in range(size)})
            first += size
        found: list[Known | None] = [None] * len(position)
        for i, known in enumerate(self.numbers):
            if known is None or i not in position:
                continue
            same = position.get(known.same) if known.same is not None else None
            if same is None:
                found[position[i]] = known._replace(same=None, sign=1)
            else:
                found[position[i]] = known._replace(same=same)
        return tuple(found)


def _field_names(names: Any) -> tuple[str, ...]:
    """The fields that a class declares; empty if a class of a user uses the attribute for something
    else.
    """
    if isinstance(names, tuple) and all(isinstance(name, str) for name in names):
        return names
    return ()


def _names(path: Sequence[Any]) -> tuple[str, ...]:
    """The names of the fields on the path of a leaf; empty texts for entries of containers."""
    return tuple(key.name if isinstance(key, jax.tree_util.GetAttrKey) else "" for key in path)


def robot_constants(scenario: Scenario) -> StructuralConstants | None:
    """The structural constants of a scenario's robots, also of those inside a plant in
    strict-feedback form; None if the robots are traced or declare no geometry.
    """
    # A robot is the plant or the model itself, or the field `robot` of either.
    robots: dict[tuple[str, ...], tuple[str, ...]] = {}
    for name, part in {"plant": scenario.plant, "model": scenario.model}.items():
        found = plants.as_plant(part).robot
        if isinstance(found, Robot):
            path = (name,) if found is part else (name, "robot")
            robots[path] = _field_names(found.geometry_fields)
    if not any(robots.values()) or not checks.is_concrete((scenario.plant, scenario.model)):
        return None
    numbers: list[Known | None] = []
    first_of_field: dict[str, tuple[int, np.ndarray]] = {}
    for keys, leaf in jax.tree_util.tree_flatten_with_path(scenario)[0]:
        names = _names(keys)
        robot, field = names[:-1], names[-1]
        if field not in robots.get(robot, ()):
            numbers += [None] * int(np.size(leaf))
            continue
        values = np.asarray(leaf, float)
        twin = first_of_field.get(field)
        first_of_field.setdefault(field, (len(numbers), values))
        row = 1
        if field in QUATERNIONS:
            row = values.shape[-1]
        for i in range(values.size):
            numbers.append(_of_entry(values, i, row, numbers, twin))
    return StructuralConstants(tuple(numbers))


def _of_entry(
    values: np.ndarray,
    i: int,
    row: int,
    numbers: Sequence[Known | None],
    twin: tuple[int, np.ndarray] | None,
) -> Known | None:
    """The property of an entry of a field of a robot.

    Args:
      values: the field.
      i: index of the entry.
      row: length of the rows within which entries are compared.
      numbers: the properties of all numbers before it.
      twin: the same field of the plant, with the index of its first number; None for the plant.
    """
    flat = values.ravel()
    start = i - i % row
    known = _known(flat[i], flat[start:i], len(numbers) - i % row)
    if known is not None and known.same is not None:
        # The entry may equal one that itself equals a number of the plant.
        first = numbers[known.same]
        if first is not None and first.same is not None:
            return known._replace(same=first.same)
    is_twin = twin is not None and twin[1].shape == values.shape and twin[1].flat[i] == flat[i]
    if twin is not None and is_twin and known == Known():
        return Known(same=twin[0] + i)
    return known


def constants_of(scenario: Scenario) -> StructuralConstants | None:
    """The structural constants of a scenario's robots and of its law; None if there are none.

    Those of a law are the entries of its `factors` that are 0 or 1.
    """
    of_robots = robot_constants(scenario)
    factors = _factors(scenario)
    if not any(np.any(np.isin(factor, COMPILED)) for factor in factors.values()):
        return of_robots
    numbers: list[Known | None] = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(scenario)[0]:
        values = np.ravel(factors.get(_names(path), np.full(np.size(leaf), np.nan)))
        numbers += [Known(x) if x in COMPILED else None for x in values.tolist()]
    if of_robots is not None:
        # A number is a constant of a robot or of the law, not of both.
        both = zip(of_robots.numbers, numbers, strict=True)
        numbers = [of_law if of_robot is None else of_robot for of_robot, of_law in both]
    return StructuralConstants(tuple(numbers))


def _factors(scenario: Scenario) -> dict[tuple[str, ...], Any]:
    """The `factors` of a scenario's law and of the laws that it wraps, by their paths; traced
    ones are excluded.
    """
    path: tuple[str, ...] = ("controller",)
    found: dict[tuple[str, ...], Any] = {}
    for law in layers(scenario.controller):
        names = _field_names(type(law).factors)
        for name, factor in attributes(law, names).items():
            if checks.is_concrete(factor):
                found[*path, name] = factor
        path = (*path, wrapped_field(law) or "")
    return found


def _known(x: float, before: np.ndarray, start: int) -> Known | None:
    """The property of a number.

    Args:
      x: the number.
      before: the numbers before it in its row.
      start: index of the first of them among all numbers of the scenario.
    """
    if not np.isfinite(x):
        return None
    if x in (0.0, 1.0, -1.0):
        return Known(float(x))
    for k, y in enumerate(before):
        if abs(x) == abs(y):
            return Known(same=start + k, sign=int(np.sign(x) * np.sign(y)))
    return Known()
