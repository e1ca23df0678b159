"""Parameters of the plant in a box, as coordinates of a proof.

Coordinate k is the number z_k that `factor`, `offset` or `value` applies: the leaf entries that it
addresses are base + slope z_k.  Differences from the model are never formed by subtraction of
intervals.  By the mean value theorem, for each component of a function g of the parameters,

    g(p) - g(p0) = dg/dp(p*) . (p - p0),   p* between p0 and p,                               (U.1)
    p - p0 = (p(r) - p0) + sum_k slope_k (z_k - r_k)

with a reference value r_k of each coordinate, at which the leaf is the scenario's.  p(r) - p0 is
the difference of the scenario's plant from its model, which is zero in most scenarios.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.kernels import hull

P = TypeVar("P")
Place = tuple[int, int]
"""An entry of a leaf: the number of the leaf, and that of the entry in it."""


class Numbers(NamedTuple):
    """The numbers of the uncertain parameters; a pytree."""

    base: tuple[jax.Array, ...]
    """Of each coordinate, one number for each of its entries."""
    slope: tuple[jax.Array, ...]
    reference: jax.Array
    """r, (m,)."""


class Places(NamedTuple):
    """The entries that the coordinates address; static."""

    entries: tuple[tuple[Place, ...], ...]
    """Of each coordinate."""
    differing: tuple[Place, ...]
    """Entries in which the scenario's plant and its model differ."""
    rates: int = 0
    """Number of further coordinates, which are rates of disturbances: n, or 0."""

    @property
    def coordinates(self) -> int:
        """Number of coordinates, those of rates included."""
        return len(self.entries) + self.rates

    @property
    def varying_leaves(self) -> list[int]:
        """The leaves with an entry that is uncertain or differs from the model's."""
        entries = [place for together in self.entries for place in together]
        return sorted({leaf for leaf, _ in [*entries, *self.differing]})


def replaced(leaves: list[jax.Array], new: dict[Place, jax.Array]) -> list[jax.Array]:
    """Leaves with some of their entries replaced."""
    by_leaf: dict[int, dict[int, jax.Array]] = {}
    for (leaf, entry), value in new.items():
        by_leaf.setdefault(leaf, {})[entry] = value
    result = list(leaves)
    for leaf, entries in by_leaf.items():
        old = leaves[leaf]
        flat = old.reshape(-1)
        numbers = [entries.get(i, flat[i]) for i in range(flat.shape[0])]
        result[leaf] = jnp.stack(numbers).reshape(old.shape)
    return result


def values_at(places: Places, numbers: Numbers, z: jax.Array) -> dict[Place, jax.Array]:
    """The entries at coordinates z, (m,)."""
    values = {}
    for k, entries in enumerate(places.entries):
        for i, place in enumerate(entries):
            values[place] = numbers.base[k][i] + numbers.slope[k][i] * z[k]
    return values


def leaves_at(places: Places, numbers: Numbers, part: P, z: jax.Array) -> P:
    """A pytree with the entries at coordinates z, (m,)."""
    new = replaced(jax.tree.leaves(part), values_at(places, numbers, z))
    return jax.tree.unflatten(jax.tree.structure(part), new)


def _entry(leaves: list[jax.Array], place: Place) -> jax.Array:
    return leaves[place[0]].reshape(-1)[place[1]]


def between(places: Places, numbers: Numbers, nominal: P, model: P, z: jax.Array) -> P:
    """p* of (U.1): the hull of the model's entries and those at z.

    Args:
      places, numbers: of the coordinates.
      nominal: the parameters of the scenario, a pytree.
      model: those of the model, p0, of the same structure.
      z: coordinates, (m,).
    """
    model_leaves = jax.tree.leaves(model)
    ends = values_at(places, numbers, z)
    for place in places.differing:
        ends.setdefault(place, _entry(jax.tree.leaves(nominal), place))
    new = {place: hull(_entry(model_leaves, place), end) for place, end in ends.items()}
    return jax.tree.unflatten(jax.tree.structure(model), replaced(model_leaves, new))


def _direction(model: P, entries: dict[Place, jax.Array]) -> P:
    zeros = [jnp.zeros(np.shape(x)) for x in jax.tree.leaves(model)]
    return jax.tree.unflatten(jax.tree.structure(model), replaced(zeros, entries))


def directions(places: Places, numbers: Numbers, model: P) -> list[P]:
    """The slopes of the parameters in each coordinate, pytrees as the model's parameters."""
    found = []
    for k, entries in enumerate(places.entries):
        slopes = {place: numbers.slope[k][i] for i, place in enumerate(entries)}
        found.append(_direction(model, slopes))
    return found


def fixed_difference(places: Places, numbers: Numbers, nominal: P, model: P) -> P | None:
    """p(r) - p0 of (U.1), a pytree as the model's parameters; None where it is zero.

    Entries that a coordinate addresses have their value at r.
    """
    if not places.differing:
        return None
    model_leaves = jax.tree.leaves(model)
    at_reference = values_at(places, numbers, numbers.reference)
    new = {}
    for place in places.differing:
        end = at_reference.get(place)
        if end is None:
            end = _entry(jax.tree.leaves(nominal), place)
        new[place] = end - _entry(model_leaves, place)
    return _direction(model, new)


def difference(places: Places, numbers: Numbers, nominal: P, model: P, z: jax.Array) -> P:
    """The difference p - p0 of (U.1) at coordinates z, (m,), a pytree as the model's parameters."""
    new: dict[Place, jax.Array] = {}
    for place in places.differing:
        new[place] = _entry(jax.tree.leaves(nominal), place) - _entry(jax.tree.leaves(model), place)
    at_reference = values_at(places, numbers, numbers.reference)
    for k, entries in enumerate(places.entries):
        away = z[k] - numbers.reference[k]
        for i, place in enumerate(entries):
            new[place] = numbers.slope[k][i] * away
            if place in places.differing:
                new[place] = new[place] + (
                    at_reference[place] - _entry(jax.tree.leaves(model), place)
                )
    return _direction(model, new)
