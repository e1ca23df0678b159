"""The points of a sweep: a full grid of values, or a random or Latin-hypercube design over
distributions.

A grid has one dimension a path, and its points are numbered with the last path running fastest.  A
design has the one dimension "point"; point j draws as run j of a study does (`draws`), from a key
of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.designs import MAX_RUNS, designed_numbers
from iblf_jax.studies.distributions import Perturbation, is_distribution, value
from iblf_jax.studies.draws import (
    CaseInputs,
    Target,
    UncertainScenario,
    case_inputs,
    check_paths,
    draw,
    draw_shapes,
    targets_of,
)

MAX_DIMS = 60
"""NumPy's arrays have 64; runs and joints come on top."""
DESIGNS = ("grid", "random", "latin_hypercube")
POINT = "point"
_SALT = 0x706F696E
"""Makes the draws of a design independent of those of the runs."""


class Points(NamedTuple):
    """The points of a sweep."""

    dims: dict[str, int]
    """Dimension -> size; P is their product."""
    along: dict[str, str]
    """Path -> the dimension that it varies along."""
    axis_values: dict[str, np.ndarray]
    """Path -> its values along that dimension, (size,) or (size, ...)."""
    values: dict[str, np.ndarray]
    """Path -> its value at every point, (P,) or (P, ...)."""


def make_points(
    scenario: Scenario, grid: Any, design: str, points: int | None, seed: int
) -> Points:
    """The points of a sweep, checked against the scenario.

    Raises:
      ValueError: an unknown or overlapping path, values of a wrong shape, type or sign, a design
        that does not fit the grid.
    """
    checks.one_of("design", design, DESIGNS)
    if not isinstance(grid, Mapping):
        raise checks.fail("grid", grid, 'a mapping such as {"controller.K2": [10, 20, 40]}')
    check_paths(scenario, grid, "grid")
    if design == "grid":
        if points is not None:
            raise checks.fail(
                "points",
                points,
                "none with a grid",
                'A grid has as many as it has; or take design="latin_hypercube".',
            )
        return _grid(scenario, grid)
    return _design(
        scenario, grid, design, checks.positive_integer("points", points, most=MAX_RUNS), seed
    )


def _grid(scenario: Scenario, grid: Mapping[str, Any]) -> Points:
    axis_values = {path: _axis_values(scenario, path, values) for path, values in grid.items()}
    dims = {path: len(values) for path, values in axis_values.items()}
    if len(dims) > MAX_DIMS:
        raise checks.fail(
            "grid", f"{len(dims)} paths", f"at most {MAX_DIMS}, as many dimensions as an array has"
        )
    total = math.prod(dims.values())
    checks.fits_memory(
        "points of the grid",
        total,
        sum(8.0 * (2 + values[0].size) for values in axis_values.values()),
    )
    places = np.indices(tuple(dims.values())).reshape(len(dims), total)
    values = {path: axis_values[path][place] for path, place in zip(dims, places, strict=True)}
    return Points(dims, {path: path for path in grid}, axis_values, values)


def _axis_values(scenario: Scenario, path: str, values: object) -> np.ndarray:
    """The values of one path of a grid, (m,) for numbers that fill the leaf, or (m, ...) for whole
    leaves.
    """
    name = f"grid[{path!r}]"
    if isinstance(values, Perturbation) or is_distribution(values):
        raise checks.fail(
            name,
            values,
            "a list of values",
            'Distributions go with design="random" or "latin_hypercube".',
        )
    shape = np.shape(paths.get(scenario, path))
    array = np.asarray(checks.as_floats(name, values)).astype(scenario.initial.q.dtype)
    if array.ndim == 0 or array.shape[1:] not in ((), shape) or len(array) == 0:
        raise checks.fail(
            name, array, f"a list of numbers{f' or of arrays of shape {shape}' if shape else ''}"
        )
    checks.check_values(name, array, paths.sign_at(scenario, path))
    if len(np.unique(array, axis=0)) < len(array):
        raise checks.fail(name, array, "values that differ", "Remove the repeated ones.")
    return array


def _design(
    scenario: Scenario, grid: Mapping[str, Any], design: str, count: int, seed: int
) -> Points:
    if not grid:
        raise checks.fail("grid", dict(grid), f'at least one distribution for design="{design}"')
    perturbations = {path: _perturbation(path, given) for path, given in grid.items()}
    targets, by_path = targets_of(scenario, perturbations, "grid")
    dtype = scenario.initial.q.dtype
    by_path = jax.tree.map(lambda x: x.astype(dtype), by_path)
    designed: dict[str, np.ndarray] = {}
    checks.fits_memory(
        "points", count, 3 * 8.0 * (1 + sum(math.prod(target.shape) for target in targets))
    )
    if design == "latin_hypercube":
        designed = designed_numbers(
            design, draw_shapes(targets, by_path), count, 1, seed, dtype, _SALT
        )
    key = jax.random.fold_in(jax.random.PRNGKey(seed), _SALT)
    values = _draw_points(UncertainScenario(scenario, by_path, key), targets, count, designed)
    return Points({POINT: count}, dict.fromkeys(values, POINT), values, values)


def _perturbation(path: str, given: Any) -> Perturbation:
    if isinstance(given, Perturbation):
        return given
    if not is_distribution(given):
        raise checks.fail(
            f"grid[{path!r}]",
            given,
            "a distribution, such as ij.uniform(10, 40)",
            'Lists of values go with design="grid".',
        )
    return value(given)


def _draw_points(
    uncertain: UncertainScenario,
    targets: tuple[Target, ...],
    count: int,
    designed: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    inputs = case_inputs(np.arange(count), count, {}, designed)

    def draw_point(point: CaseInputs):
        _, drawn, admissible = draw(uncertain, targets, point.index, point.points, point.u)
        return drawn, admissible

    drawn, admissible = jax.jit(jax.vmap(draw_point))(inputs)
    if not np.all(admissible):
        bad = int(np.argmin(np.asarray(admissible)))
        shown = {path: np.asarray(x[bad]).tolist() for path, x in drawn.items()}
        raise checks.fail(
            f"grid: point {bad}",
            shown,
            "admissible values",
            "Choose distributions that stay inside the leaf's range.",
        )
    return {path: np.asarray(x) for path, x in drawn.items()}
