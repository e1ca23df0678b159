"""The unit cube of bounded perturbations, in which `ij.falsify` and
`ij.certificates.counterexample` search for the worst case.

Run i of a study draws u and has the values F^-1(u); a search takes the u itself, in [0, 1]^d, as
its unknown.  A search therefore considers the same perturbations as a study, within the bounds of
their distributions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation.paths import get, why_inadmissible
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.draws import Cases, Target, draw, sample_size, targets_of

MAX_BATCHES = 64
"""How often as many points as are wanted are drawn, to find admissible ones."""


@partial(jax.tree_util.register_dataclass, data_fields=["cases"], meta_fields=["targets", "shapes"])
@dataclasses.dataclass(frozen=True, eq=False)
class Cube:
    """The u of a scenario's perturbations; made by `bounded`."""

    cases: Cases
    targets: tuple[Target, ...]
    shapes: tuple[tuple[str, tuple[int, ...]], ...]
    """Path -> shape of its u."""

    @property
    def size(self) -> int:
        """Number of coordinates d."""
        return sum(int(np.prod(shape, dtype=int)) for _, shape in self.shapes)

    def values(self, u: jax.Array) -> dict[str, jax.Array]:
        """Path -> value at a point u, (d,)."""
        parts, at = {}, 0
        for path, shape in self.shapes:
            size = int(np.prod(shape, dtype=int))
            parts[path] = u[at : at + size].reshape(shape)
            at += size
        return draw(self.cases, self.targets, jnp.uint32(0), {}, parts)[1]

    def refused(self, u: np.ndarray) -> str:
        """Why a point cannot be run, in words; "" if it can."""
        return why_inadmissible(
            self.cases.scenario, _values(self, jnp.asarray(u, self.cases.scenario.initial.q.dtype))
        )

    def admissible_points(
        self, count: int, seed: Any, refused: Callable[[np.ndarray], str] | None = None
    ) -> np.ndarray:
        """Random points at which nothing is refused, (count, d); repeated where few were found.

        Args:
          count, seed: of the points.
          refused: why a point is no answer, in words; "" if it is one.  `Cube.refused` if not
            given.

        Raises:
          ValueError: no such point was found.
        """
        rng, found, reason = np.random.default_rng(seed), [], ""
        for _ in range(MAX_BATCHES):
            for point in rng.uniform(size=(count, self.size)):
                why = (refused or self.refused)(point)
                if not why:
                    found.append(point)
                reason = why or reason
            if len(found) >= count:
                break
        if not found:
            raise self.nothing(
                f"None of {MAX_BATCHES * count} random points is; the last: {reason} Narrow or move"
                " the ranges."
            )
        return np.resize(np.array(found), (count, self.size))

    def nothing(self, remedy: str) -> ValueError:
        """The error for perturbations in which there is nothing to look at."""
        ranges = {
            path: p.range(np.asarray(get(self.cases.scenario, path)))
            for path, p in self.cases.perturbations.items()
        }
        shown = {
            path: (np.asarray(low).tolist(), np.asarray(high).tolist())
            for path, (low, high) in ranges.items()
        }
        return checks.fail("perturbations", shown, "ranges with admissible values in them", remedy)


_values = jax.jit(Cube.values)


def bounded(scenario: Scenario, perturbations: Any, *, signs: bool = True) -> Cube:
    """The cube of a user's perturbations.

    Args:
      scenario: canonical.
      perturbations: path -> `factor`, `offset` or `value` of a distribution that has two ends.
      signs: whether ranges that reach beyond what a leaf may be are refused; their points are, in
        either case.

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
        Cases(scenario, by_path, jax.random.PRNGKey(0)),
        targets,
        tuple(sample_size(targets, by_path).items()),
    )
