"""`pareto`: the front of two objectives, tracking against effort say, by a family of scalarisations that runs as one batch.

Point j minimises a weighted sum of the logarithms of the two objectives,

    w_j log a + (1 - w_j) log b,      w_j evenly between 0 and 1 (ends left out),

which does not depend on their scales and reaches further into a front that is not convex than a weighted sum does.  Every trial of
every point that kept its bounds is a candidate: the front is what no other one beats in both.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.progress import bar
from iblf_jax.engine.plan import FORWARD_MOST, differentiates_forward
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.designs import check_seed
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.tuning._tune import build, make_method, way_in
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.optimise import CountedProblem, Loop
from iblf_jax.tuning.parameters import Block, Tunable, names_of, values_at
from iblf_jax.tuning.problem import NUMBERS_A_RUN
from iblf_jax.tuning.robust import Risk

MOST_WEIGHT = 0.95


@dataclasses.dataclass(frozen=True, eq=False)
class Front:
    """Gains of which none is beaten by another one in both objectives, from low a to low b."""

    labels: tuple[str, str]
    objectives: np.ndarray
    """(a, b) of each point, (P, 2), relative to the start's unless they have scales of their own."""
    x: np.ndarray
    """Gains of each point, (P, p), in their units."""
    names: tuple[str, ...]
    tried: np.ndarray
    """(a, b) of every valid trial, (N, 2)."""
    first: np.ndarray
    """(a, b) at the start, (2,)."""
    start: Scenario
    blocks: tuple[Block, ...]
    z: np.ndarray
    seconds: float

    def __len__(self) -> int:
        return len(self.x)

    def scenario(self, index: int) -> Scenario:
        """The scenario with the gains of one point.

        Args:
          index: its number, in the order of `objectives`.

        Raises:
          ValueError: no such point (an IndexError too).
        """
        z = self.z[checks.entry("index", index, len(self), "points")]
        return with_parameters(self.start, values_at(self.blocks, jnp.asarray(z)))

    def plot(self, **options):
        """Figure of the front.  Options as `plotting.pareto`."""
        from iblf_jax import plotting

        return plotting.pareto(self, **options)

    def __repr__(self) -> str:
        ends = ", ".join(f"{name} {x.min():.4g} to {x.max():.4g}" for name, x in zip(self.labels, self.objectives.T, strict=True))
        return f"Front({len(self)} points of {len(self.tried)} trials; {ends})"


def non_dominated(points: np.ndarray) -> np.ndarray:
    """Indices of the points (N, 2) that no other one beats, by growing first coordinate."""
    order = np.lexsort((points[:, 1], points[:, 0]))
    best = np.minimum.accumulate(np.concatenate([[np.inf], points[order, 1][:-1]]))
    return order[points[order, 1] < best]


def pareto(
    scenario: Scenario,
    parameters: Sequence[str | Tunable],
    objectives: tuple[Objective, Objective],
    *,
    duration: float,
    dt: float = 1e-3,
    points: int = 8,
    iterations: int = 20,
    perturbations: Mapping[str, Perturbation] | None = None,
    runs: int = 1,
    seed: int = 0,
    risk: str | Risk = "mean",
    method: str = "rk4",
    backend: str = "auto",
    tolerance: float = 1e-5,
    progress: bool | None = None,
) -> Front:
    """The front of two objectives over some leaves of a scenario.

        point j:  minimise w_j log a + (1 - w_j) log b

    Args:
      scenario, parameters, duration, dt, perturbations, runs, seed, risk, method, backend, tolerance: as `tune`.
      objectives: two of `iblf_jax.objectives`, of one plain term each; requirements of either hold for all points.
      points: scalarisations, in one batch.
      iterations: steps of each at most.
      progress: a progress bar; shown where somebody watches if not given.

    Returns:
      A `Front`.

    Raises:
      ValueError: not two objectives of one term, or as `tune`.

    Source: design of this package.
    """
    began = time.perf_counter()
    points, seed = checks.positive_integer("points", points), check_seed(seed)
    iterations = checks.positive_integer("iterations", iterations, most=checks.MOST_STEPS)
    tolerance, pair = checks.positive_number("tolerance", tolerance, "1", zero=True), _pair(objectives)
    timing = {"duration": duration, "dt": dt, "method": method, "backend": backend}
    problem = build(scenario, parameters, pair, perturbations, runs, seed, risk, timing, scalarisation="log", mode="forward")
    if not differentiates_forward(len(problem.box.z)):
        raise checks.fail("parameters", f"{len(problem.box.z)} numbers", f"at most {FORWARD_MOST} for a front", "Tie or leave out some.")
    checks.fits("points", points, 8.0 * len(problem.box.z) * NUMBERS_A_RUN)
    z = np.repeat(problem.box.z[None], points, axis=0)
    share = np.linspace(1 - MOST_WEIGHT, MOST_WEIGHT, points) if points > 1 else np.array([0.5])
    lanes = problem.lanes(z)._replace(weights=jnp.asarray(np.stack([share, 1 - share], axis=1), problem.shared.dt.dtype))
    loop = Loop(
        CountedProblem(problem.formulation, problem.shared, lanes, "forward"),
        make_method("newton", problem.box, iterations, tolerance, 0.1, problem.limits, problem.runs),
        z,
    )
    loop.rescue = partial(way_in, problem, seed)
    with bar(progress, iterations, unit="steps") as shown:
        loop.run(iterations, tolerance=tolerance, patience=iterations, on_step=lambda _: shown.update(1))
    return _front(problem, loop, time.perf_counter() - began)


def _pair(objectives: Any) -> Objective:
    fine = isinstance(objectives, tuple | list) and len(objectives) == 2 and all(isinstance(o, Objective) for o in objectives)
    if not fine or any(len(o.terms) != 1 or o.terms[0].shape != "plain" for o in objectives):
        raise checks.fail(
            "objectives", objectives, "two objectives of one plain term each", "Such as (ij.objectives.tracking(), ij.objectives.effort())."
        )
    return objectives[0] + objectives[1]


def _front(problem, loop: Loop, seconds: float) -> Front:
    history = {name: np.stack(x) for name, x in loop.history.items()}
    kept = history["valid"] & (history["margin"] > 0) & (np.max(np.maximum(history["excess"], 0.0), axis=-1, initial=0.0) <= 0)
    if not np.any(kept):
        raise checks.fail(
            "objectives", "no trial that keeps bounds and requirements", "at least one", "Loosen them, or tune to them first."
        )
    tried, z = history["terms"][kept], history["z"][kept]
    front = non_dominated(tried)
    blocks, start = problem.formulation.blocks, problem.shared.cases.scenario
    log = np.concatenate([np.full(b.size, b.log) for b in blocks])
    x = np.where(log, np.exp(np.where(log, z[front], 0.0)), z[front])
    labels = tuple(t.name for t in problem.shared.objective.terms)
    first = jax.tree.map(np.asarray, history["terms"][0, 0])
    return Front(labels, tried[front], x, tuple(names_of(blocks)), tried, first, start, blocks, z[front], seconds)
