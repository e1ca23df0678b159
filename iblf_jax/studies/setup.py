"""The request of a study: its arguments, checked once, and the program that its blocks run.

Cases are numbered, case = point * runs + run, with one point unless the study is a sweep.  What all
cases share is traced (`SharedInputs`); what differs between them is made for the cases of one block
(`PreparedStudy.inputs_of`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.engine import CompiledBatch, RunRequest, block_size, compile_batch
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.metrics import Fold, as_folds
from iblf_jax.simulation.noise import noise_of
from iblf_jax.simulation.scenario import Scenario, canonical, check_step
from iblf_jax.studies.designs import split, unit_points
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import CaseInputs, Cases, Target, draw, merge, sample_size, targets_of


class StudyProgram(NamedTuple):
    """What every block of a study computes; static."""

    targets: tuple[Target, ...]
    """The leaves that are drawn."""
    batch: CompiledBatch
    """The program of the runs, on the executor that was chosen."""

    @property
    def steps(self) -> int:
        """Time steps of a run."""
        return self.batch.request.steps

    @property
    def method(self) -> str:
        """The integrator."""
        return self.batch.request.method


class SharedInputs(NamedTuple):
    """What all runs of a study share; traced."""

    cases: Cases
    folds: Any
    dt: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class PreparedStudy:
    """A study whose arguments are checked and whose program is chosen."""

    program: StudyProgram = dataclasses.field(metadata={"static": True})
    shared: SharedInputs
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
        counts = [len(values) for values in self.points.values()]
        return self.runs * next(iter(counts), 1)

    def inputs_of(self, cases: np.ndarray) -> CaseInputs:
        """What differs between these cases; numbers past the last case repeat it."""
        return _inputs(np.minimum(cases, self.cases - 1), self.runs, self.points, self.designed)


def _inputs(
    cases: np.ndarray,
    runs: int,
    points: Mapping[str, np.ndarray],
    designed: Mapping[str, np.ndarray],
) -> CaseInputs:
    point, run = np.divmod(cases, runs)
    return CaseInputs(
        run.astype(np.uint32),
        {path: values[point] for path, values in points.items()},
        {path: u[run] for path, u in designed.items()},
    )


def drawn_leaves(
    targets: tuple[Target, ...], shared: SharedInputs, inputs: CaseInputs
) -> tuple[dict[str, Any], dict[str, Any], jax.Array]:
    """The leaves that the runs of a block replace, the draws, and whether they were admissible."""

    def one(case: CaseInputs):
        made, drawn, admissible = draw(shared.cases, targets, case.index, case.points, case.u)
        scenario = shared.cases.scenario
        noise = noise_of(scenario, shared.cases.key, case.index)
        return merge(scenario, case.points, made) | noise, drawn, admissible

    # Without the barrier XLA fuses the random numbers into every operation of the run, and
    # compiles for 18 s instead of 5 s.
    return jax.lax.optimization_barrier(jax.vmap(one)(inputs))


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
) -> PreparedStudy:
    """Checks the arguments that studies share, and compiles the program of their blocks.

    Args:
      scenario, perturbations, runs, seed, duration, dt, method, metrics, backend, sampler,
        replicates: as `monte_carlo`.
      points: path -> value at every point of a sweep, (P, ...).

    Raises:
      ValueError: an argument that is not valid.
    """
    tableau(method)
    steps = checks.whole_steps(duration, dt)
    seed = checks.seed(seed)
    scenario = canonical(scenario)
    request = RunRequest.of(scenario, steps=steps, method=method, backend=backend)
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
    shared = SharedInputs(Cases(scenario, by_path, jax.random.PRNGKey(seed)), folds, step)
    points = dict(points or {})
    first_cases = np.zeros(block_size(), int)
    inputs = _inputs(first_cases, runs, points, designed)
    return PreparedStudy(
        StudyProgram(targets, _compiled(request, targets, shared, inputs)),
        shared,
        dict(perturbations),
        seed,
        runs,
        sampler,
        replicates,
        designed,
        points,
    )


def _compiled(
    request: RunRequest, targets: tuple[Target, ...], shared: SharedInputs, inputs: CaseInputs
) -> CompiledBatch:
    """The program of a block on the first executor that can run it."""
    varied, _, _ = jax.eval_shape(partial(drawn_leaves, targets), shared, inputs)
    return compile_batch(request, shared.cases.scenario, varied, shared.folds, shared.dt)
