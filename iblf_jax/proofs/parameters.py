"""The uncertain parameters that a user gives, as coordinates of a proof."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.proofs.uncertainty import Numbers, Place, Places
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import targets_of

SUPPORTED_PARTS = ("plant", "disturbance")
"""Parts of a scenario whose parameters may be uncertain."""


class Uncertain(NamedTuple):
    """The uncertain coordinates of a problem."""

    places: Places
    numbers: Numbers
    low: np.ndarray
    high: np.ndarray
    names: tuple[str, ...]
    """Path of the entry of each coordinate, or of all its entries, joined by " and "."""
    paths: tuple[tuple[str, ...], ...]
    """Paths of the entries of each coordinate."""

    @property
    def entries(self) -> list[str]:
        """Paths of all entries."""
        return [path for together in self.paths for path in together]

    def values(self, z: Sequence[float] | np.ndarray) -> dict[str, float]:
        """Path -> value of the entries at coordinates."""
        values = {}
        for k, names in enumerate(self.paths):
            for i, name in enumerate(names):
                base, slope = float(self.numbers.base[k][i]), float(self.numbers.slope[k][i])
                values[name] = base + slope * float(z[k])
        return values

    def scales(self) -> dict[str, tuple[float, float]]:
        """Path of each uncertain entry -> its least and its greatest value."""
        low, high = self.values(self.low), self.values(self.high)
        return {name: (min(low[name], high[name]), max(low[name], high[name])) for name in low}


def uncertain_coordinates(
    scenario: Scenario, parameters: Mapping[str, Perturbation], disturbance_rate: ArrayLike | None
) -> Uncertain:
    """The coordinates of parameters that a user gives.

    Raises:
      ValueError: not a mapping of intervals, a path that is unknown, overlaps another or is not one
        of the plant or the disturbance, an interval that reaches inadmissible values.
    """
    example = '{"plant.mass[1]": ij.factor(ij.interval(0.97, 1.03))}'
    checks.mapping("parameters", parameters, example)
    separate = {
        path.strip(): perturbation
        for group, perturbation in parameters.items()
        for path in str(group).split(",")
    }
    for path in separate:
        if path.split(".")[0].split("[")[0] not in SUPPORTED_PARTS:
            expected = "a parameter of the plant or the disturbance, such as plant.mass"
            remedy = "Law and observer know their model and gains exactly."
            raise checks.fail("parameters: path", path, expected, remedy)
    targets_of(scenario, separate, "parameters", intervals=True)
    index = _places_of_entries(scenario)
    entries, bases, slopes, references, low, high, names = [], [], [], [], [], [], []
    for group, perturbation in parameters.items():
        for together in _entries_together(scenario, str(group), perturbation):
            values = [float(np.asarray(paths.get(scenario, path))) for path in together]
            ends = _ends(scenario, str(group), together[0], perturbation)
            base, slope, reference = _line(perturbation.kind, values)
            entries.append(tuple(index[path] for path in together))
            bases.append(jnp.asarray(base))
            slopes.append(jnp.asarray(slope))
            references.append(reference)
            low.append(ends[0])
            high.append(ends[1])
            names.append(tuple(together))
    rates = np.zeros(0)
    if disturbance_rate is not None:
        n = scenario.n
        rates = np.asarray(checks.as_floats("disturbance_rate", disturbance_rate), float)
        if rates.shape not in ((), (n,)) or not np.all(np.isfinite(rates)) or np.any(rates < 0):
            expected = f"one number >= 0, or {n}, in N m/s"
            raise checks.fail("disturbance_rate", disturbance_rate, expected)
        rates = np.broadcast_to(rates, (n,))
    references += [0.0] * len(rates)
    low, high = [*low, *(-rates)], [*high, *rates]
    labels = [" and ".join(x) for x in names]
    labels += [f"disturbance_rate[{i}]" for i in range(len(rates))]
    numbers = Numbers(tuple(bases), tuple(slopes), jnp.asarray(references, float))
    places = Places(tuple(entries), _differing(scenario, entries, numbers), len(rates))
    return Uncertain(
        places, numbers, np.array(low, float), np.array(high, float), tuple(labels), tuple(names)
    )


def _entries_of(scenario: Scenario, path: str) -> list[str]:
    """The paths of the numbers at a path, with the number of a row in place of its name."""
    shape = np.shape(paths.get(scenario, path))
    indices = itertools.product(*map(range, shape))
    (tokens,) = paths.places(scenario, path)
    numbered = "".join(map(paths.written, tokens)).removeprefix(".")
    return [numbered + "".join(f"[{i}]" for i in index) for index in indices]


def _entries_together(
    scenario: Scenario, group: str, perturbation: Perturbation
) -> list[list[str]]:
    """The entries of paths that vary together, for each coordinate."""
    columns = [_entries_of(scenario, path.strip()) for path in group.split(",")]
    if perturbation.shared:
        return [[entry for column in columns for entry in column]]
    if len({len(column) for column in columns}) > 1:
        expected = "paths with equally many numbers"
        remedy = "With shared=True all of them vary together."
        raise checks.fail("parameters: path", group, expected, remedy)
    return [list(row) for row in zip(*columns, strict=True)]


def _ends(
    scenario: Scenario, group: str, entry: str, perturbation: Perturbation
) -> tuple[float, float]:
    """The ends of z for an entry of a path."""
    first = group.split(",")[0].strip()
    shape = np.shape(paths.get(scenario, first))
    k = _entries_of(scenario, first).index(entry)
    low, high = (np.broadcast_to(x, shape).ravel()[k] for x in perturbation.distribution.support())
    return float(low), float(high)


def _line(kind: str, values: list[float]) -> tuple[list[float], list[float], float]:
    """Base and slope of the entries with these nominal values, and z of the nominal values."""
    if kind == "factor":
        return [0.0] * len(values), values, 1.0
    if kind == "offset":
        return values, [1.0] * len(values), 0.0
    return [0.0] * len(values), [1.0] * len(values), values[0]


def _places_of_entries(scenario: Scenario) -> dict[str, Place]:
    """Path of each number of plant and disturbance -> its place among the leaves."""
    found: dict[str, Place] = {}
    parts = (scenario.plant, scenario.disturbance)
    keyed, _ = jax.tree_util.tree_flatten_with_path(parts)
    for leaf, (keys, value) in enumerate(keyed):
        name = SUPPORTED_PARTS[keys[0].idx] + jax.tree_util.keystr(keys[1:])
        for entry, index in enumerate(np.ndindex(np.shape(value))):
            found[name + "".join(f"[{i}]" for i in index)] = (leaf, entry)
    return found


def _differing(
    scenario: Scenario, entries: list[tuple[Place, ...]], numbers: Numbers
) -> tuple[Place, ...]:
    """The entries that differ from those that the law knows.

    An entry of a coordinate is compared at the coordinate's reference value: entries that a `value`
    sets together have one value there, although their nominal values may differ.
    """
    at_reference: dict[Place, float] = {}
    for k, together in enumerate(entries):
        at = numbers.base[k] + numbers.slope[k] * numbers.reference[k]
        at_reference |= dict(zip(together, np.asarray(at).tolist(), strict=True))
    actual = jax.tree.leaves((scenario.plant, scenario.disturbance))
    model_leaves = jax.tree.leaves((scenario.model, scenario.disturbance))
    found = []
    for leaf, pair in enumerate(zip(actual, model_leaves, strict=True)):
        values, expected = (np.ravel(np.asarray(x)).tolist() for x in pair)
        for entry, value in enumerate(values):
            place = (leaf, entry)
            if at_reference.get(place, value) != expected[entry]:
                found.append(place)
    return tuple(found)
