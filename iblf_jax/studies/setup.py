"""What a study was asked for, checked once and ready to run in blocks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.engine import RunRequest, check_backend
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.metrics import Fold, as_folds
from iblf_jax.simulation.sampling import check_step
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.blocks import (
    Results,
    StudyInputs,
    StudyRun,
    _execute,
    block_size,
    compile_study,
)
from iblf_jax.studies.designs import split, unit_points
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import Cases, Lanes, sample_size, targets_of


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class StudySetup:
    """A study's arguments.  Cases are numbered: case = point * runs + run, with one point unless it
    is a sweep.
    """

    study_run: StudyRun = dataclasses.field(metadata={"static": True})
    shared: StudyInputs
    perturbations: dict[str, Perturbation]
    """As the user gave them."""
    seed: int = dataclasses.field(metadata={"static": True})
    runs: int = dataclasses.field(metadata={"static": True})
    """Runs at each point."""
    sampler: str = dataclasses.field(default="independent", metadata={"static": True})
    replicates: int = dataclasses.field(default=1, metadata={"static": True})
    designed: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Path -> uniform numbers of every run, for samplers with a design."""
    points: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Path -> value at every point of a sweep."""

    @property
    def cases(self) -> int:
        """Number of cases: points times runs."""
        return number_of_cases(self.runs, self.points)

    @cached_property
    def shapes(self) -> Results:
        """Shapes and types of what a block leaves."""
        block = partial(
            _execute, study_run=self.study_run, record_every=None
        )  # as `run_blocks` calls it, so that it is traced once
        return jax.eval_shape(block, self.shared, self.lanes(np.arange(block_size())))

    @property
    def bytes_a_case(self) -> float:
        """Memory that the results of a case take."""
        return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(self.shapes)) / block_size()

    def lanes(self, cases: np.ndarray) -> Lanes:
        """What differs between these cases; cases past the last one repeat it."""
        return lanes_of(cases, self.runs, self.points, self.designed)


def prepare(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    runs: int,
    seed: int,
    *,
    duration: float,
    dt: float,
    method: str,
    metrics: Sequence[Fold] | None,
    backend: str,
    sampler: str = "independent",
    replicates: int = 1,
    points: Mapping[str, np.ndarray] | None = None,
) -> StudySetup:
    """Checks the arguments that studies share and puts together what their blocks need."""
    tableau(method)
    check_backend(backend)
    steps = checks.whole_steps(duration, dt)
    seed, scenario = checks.seed(seed), canonical(scenario)
    check_step(scenario, dt)
    targets, by_path = targets_of(scenario, perturbations)
    dtype = scenario.initial.q.dtype
    folds = as_folds(metrics, dtype, scenario)
    by_path, step = jax.tree.map(lambda x: jnp.asarray(x, dtype), (by_path, dt))
    designed: dict[str, Any] = {}
    if sampler != "independent":
        shapes = sample_size(targets, by_path)
        dimension = sum(int(np.prod(shape, dtype=int)) for shape in shapes.values())
        designed = split(unit_points(sampler, dimension, runs, replicates, seed), shapes, dtype)
    request = RunRequest.of(scenario, steps=steps, method=method, backend=backend)
    shared = StudyInputs(Cases(scenario, by_path, jax.random.PRNGKey(seed)), folds, step)
    points = dict(points or {})
    first_block = lanes_of(np.arange(block_size()), runs, points, designed)
    return StudySetup(
        compile_study(targets, request, shared, first_block),
        shared,
        dict(perturbations),
        seed,
        runs,
        sampler,
        replicates,
        designed,
        points,
    )


def number_of_cases(runs: int, points: Mapping[str, np.ndarray]) -> int:
    """Cases of a study: points times runs."""
    if not points:
        return runs
    return runs * len(next(iter(points.values())))


def lanes_of(
    cases: np.ndarray,
    runs: int,
    points: Mapping[str, np.ndarray],
    designed: Mapping[str, np.ndarray],
) -> Lanes:
    """What differs between these cases; cases past the last one repeat it."""
    point, run = np.divmod(np.minimum(cases, number_of_cases(runs, points) - 1), runs)
    return Lanes(
        run.astype(np.uint32),
        {path: values[point] for path, values in points.items()},
        {path: u[run] for path, u in designed.items()},
    )
