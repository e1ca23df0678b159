"""The unit cube of bounded perturbations, in which `ij.falsify` and
`ij.certificates.counterexample` search for the worst case.

Run i of a study draws u and has the values F^-1(u); a search takes the u itself, in [0, 1]^d, as
its unknown.  A search therefore considers the same perturbations as a study, within the bounds of
their distributions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation.paths import get, why_inadmissible
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.draws import Target, UncertainScenario, draw, draw_shapes, targets_of

if TYPE_CHECKING:
    from iblf_jax.studies.distributions import Perturbation


MAX_BATCHES = 64
"""Batches of random points that are drawn at most in the search for admissible ones."""


@partial(
    jax.tree_util.register_dataclass, data_fields=["uncertain"], meta_fields=["targets", "shapes"]
)
@dataclasses.dataclass(frozen=True, eq=False)
class Cube:
    """The unit cube of the u of a scenario's perturbations; made by `unit_cube`."""

    uncertain: UncertainScenario
    targets: tuple[Target, ...]
    shapes: tuple[tuple[str, tuple[int, ...]], ...]
    """Path -> shape of its u."""

    @property
    def size(self) -> int:
        """Number of coordinates d."""
        return sum(int(np.prod(shape, dtype=int)) for _, shape in self.shapes)

    def numbers(self, u: jax.Array) -> dict[str, jax.Array]:
        """Name of the draws -> the coordinates of points u, (..., d), that are theirs."""
        parts, at = {}, 0
        for path, shape in self.shapes:
            size = int(np.prod(shape, dtype=int))
            parts[path] = u[..., at : at + size].reshape((*u.shape[:-1], *shape))
            at += size
        return parts

    def values(self, u: jax.Array) -> dict[str, jax.Array]:
        """Path -> value at a point u, (d,)."""
        return draw(self.uncertain, self.targets, jnp.uint32(0), {}, self.numbers(u))[1]

    def why_inadmissible(self, u: np.ndarray) -> str:
        """Why a point cannot be run; "" if it can."""
        return why_inadmissible(
            self.uncertain.scenario,
            _values(self, jnp.asarray(u, self.uncertain.scenario.initial.q.dtype)),
        )

    def admissible_points(
        self, count: int, seed: Any, rejection: Callable[[np.ndarray], str] | None = None
    ) -> np.ndarray:
        """Random accepted points, (count, d); repeated where fewer than `count` were found.

        Args:
          count, seed: of the points.
          rejection: returns why a point is rejected, or "" for an accepted one;
            `Cube.why_inadmissible` if not given.

        Raises:
          ValueError: no such point was found.
        """
        rng, found, reason = np.random.default_rng(seed), [], ""
        for _ in range(MAX_BATCHES):
            for point in rng.uniform(size=(count, self.size)):
                why = (rejection or self.why_inadmissible)(point)
                if not why:
                    found.append(point)
                reason = why or reason
            if len(found) >= count:
                break
        if not found:
            raise self.no_admissible_point(
                f"None of {MAX_BATCHES * count} random points is; the last: {reason} Narrow or move"
                " the ranges."
            )
        return np.resize(np.array(found), (count, self.size))

    def no_admissible_point(self, remedy: str) -> ValueError:
        """The error for perturbations without an admissible point."""
        ranges = {
            path: p.range(np.asarray(get(self.uncertain.scenario, path)))
            for path, p in self.uncertain.perturbations.items()
        }
        shown = {
            path: (np.asarray(low).tolist(), np.asarray(high).tolist())
            for path, (low, high) in ranges.items()
        }
        return checks.fail("perturbations", shown, "ranges with admissible values in them", remedy)


_values = jax.jit(Cube.values)


def unit_cube(
    scenario: Scenario, perturbations: Mapping[str, Perturbation], *, signs: bool = True
) -> Cube:
    """The cube of a user's perturbations.

    Args:
      scenario: canonical.
      perturbations: path -> `factor`, `offset` or `value` of a distribution that has two ends.
      signs: whether to refuse ranges that contain inadmissible values of a leaf.  Points with
        such values are rejected in either case.

    Raises:
      ValueError: nothing that varies, a distribution without ends, or as `draws.targets_of`.
    """
    targets, by_path = targets_of(scenario, perturbations, signs=signs)
    if not targets:
        raise checks.fail(
            "perturbations",
            perturbations,
            "at least one perturbation",
            "Say what may vary, and between which limits.",
        )
    for target in targets:
        distribution = by_path[target.path].distribution
        if not all(np.all(np.isfinite(end)) for end in distribution.support()):
            raise checks.fail(
                f"perturbations[{target.source!r}]",
                distribution,
                "a bounded distribution",
                "Use ij.uniform(low, high).",
            )
    by_path = jax.tree.map(lambda x: jnp.asarray(x, scenario.initial.q.dtype), by_path)
    return Cube(
        UncertainScenario(scenario, by_path, jax.random.PRNGKey(0)),
        targets,
        tuple(draw_shapes(targets, by_path).items()),
    )
