"""What is compiled in: which numbers of a robot's geometry are 0, 1 or -1, which are equal to
others, and which factors of a law are 1.

Axes, offsets and rotations of real arms are mostly zeros, and model and plant mostly agree.  A
scalar program that knows it needs fewer operations.  Numbers themselves are never compiled in, nor
anything of masses, gains and loads, so new ones compile nothing: a robot says which these are
(`geometry_fields`).  A law has factors that are mostly 1, such as the weight of a barrier
(`unit_factors`): one that is 1 costs nothing.  What differs between runs is not shared, and nothing
  is known of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.pytree import layers
from iblf_jax.kernels import Known
from iblf_jax.simulation.scenario import Scenario

QUATERNIONS = ("rotation", "tip_rotation")
"""Fields whose rows hold equal numbers for a reason: a right angle."""


class Mechanism(NamedTuple):
    """What is known of every number of a scenario, leaf after leaf, None where nothing is;
    hashable.
    """

    numbers: tuple[Known | None, ...]

    def of_shared(self, is_lane: Sequence[bool], sizes: Sequence[int]) -> tuple[Known | None, ...]:
        """What is known of the numbers that are shared, for leaves of these sizes of which the
        scenario's come first.
        """
        place: dict[int, int] = {}
        number = 0
        for lane, size in zip(is_lane, sizes, strict=True):
            if not lane:
                place.update({number + i: len(place) + i for i in range(size)})
            number += size
        found: list[Known | None] = [None] * len(place)
        for i, known in enumerate(self.numbers):
            if known is not None and i in place:
                same = known.same if known.same is None else place.get(known.same)
                found[place[i]] = known._replace(
                    same=same, sign=known.sign if same is not None else 1
                )
        return tuple(found)


def _declared(part: Any, attribute: str) -> tuple[str, ...]:
    """The fields of which a class declares that they may be compiled in; none where users have a
    field of that name.
    """
    names = getattr(type(part), attribute, ())
    return (
        names if isinstance(names, tuple) and all(isinstance(name, str) for name in names) else ()
    )


def mechanism_of(scenario: Scenario) -> Mechanism | None:
    """What is known of the numbers of a scenario's robots; None where they are tracers, or no robot
    has a geometry.
    """
    robots = {
        name: _declared(getattr(scenario, name), "geometry_fields") for name in ("plant", "model")
    }
    if not any(robots.values()) or not checks.is_concrete((scenario.plant, scenario.model)):
        return None
    numbers: list[Known | None] = []
    begin: dict[str, tuple[int, np.ndarray]] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(scenario)[0]:
        names = [getattr(key, "name", "") for key in path]
        if len(names) == 2 and names[1] in robots.get(names[0], ()):
            values = np.asarray(leaf, float)
            twin = begin.get(names[1])
            begin.setdefault(names[1], (len(numbers), values))
            row = values.shape[-1] if names[1] in QUATERNIONS else 1
            flat = values.ravel()
            for i, x in enumerate(flat):
                known = _known(x, flat[i - i % row : i], len(numbers) - i % row)
                first = numbers[known.same] if known and known.same is not None else None
                # The model's numbers are the plant's, so what is equal to one of them is equal to
                # that of the plant.
                numbers.append(
                    known._replace(same=first.same)
                    if known and first and first.same is not None
                    else known
                )
                if (
                    twin
                    and numbers[-1] == Known()
                    and twin[1].shape == values.shape
                    and twin[1].flat[i] == x
                ):
                    numbers[-1] = Known(same=twin[0] + i)
        else:
            numbers += [None] * int(np.size(leaf))
    return Mechanism(tuple(numbers))


def known_of(scenario: Scenario) -> Mechanism | None:
    """What is known of a scenario's numbers, robots' and law's; None where nothing is.

    Of the law: which entries of its `unit_factors` are 1.
    """
    mechanism = mechanism_of(scenario)
    factors = _factors(scenario)
    if not any(np.any(np.asarray(factor) == 1.0) for factor in factors.values()):
        return mechanism
    numbers: list[Known | None] = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(scenario)[0]:
        factor = factors.get(tuple(getattr(key, "name", "") for key in path))
        if factor is None:
            numbers += [None] * int(np.size(leaf))
            continue
        numbers += [Known(1.0) if x == 1.0 else None for x in np.ravel(factor)]
    if mechanism is None:
        return Mechanism(tuple(numbers))
    both = zip(mechanism.numbers, numbers, strict=True)
    return Mechanism(tuple(known if known is not None else of_law for known, of_law in both))


def _factors(scenario: Scenario) -> dict[tuple[str, ...], Any]:
    """The factors of a scenario's law that may be compiled in where they are 1, by where they are,
    but for tracers.
    """
    path: tuple[str, ...] = ("controller",)
    found: dict[tuple[str, ...], Any] = {}
    for law in layers(scenario.controller):
        for name in _declared(law, "unit_factors"):
            found[*path, name] = getattr(law, name)
        path = (*path, getattr(type(law), "wraps", ""))
    return {names: factor for names, factor in found.items() if checks.is_concrete(factor)}


def _known(x: float, before: np.ndarray, start: int) -> Known | None:
    """What is known of a number, given those before it in its row, of which the first has the
    number `start`.
    """
    if not np.isfinite(x):
        return None
    if x in (0.0, 1.0, -1.0):
        return Known(float(x))
    for k, y in enumerate(before):
        if abs(x) == abs(y):
            return Known(same=start + k, sign=int(np.sign(x) * np.sign(y)))
    return Known()
