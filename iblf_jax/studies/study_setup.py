"""The request of a study: its arguments, checked once, and the program that its blocks run.

Cases are numbered, case = point * runs + run, with one point unless the study is a sweep.  What all
cases share is traced (`SharedInputs`); what differs between them is made for the cases of one block
(`PreparedStudy.inputs_of`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.engine import CompiledBatch, block_size, compile_batch
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.metrics import Fold, as_folds
from iblf_jax.simulation.noise import noise_values
from iblf_jax.simulation.scenario import Scenario, canonical, fitted_to_step
from iblf_jax.studies.designs import designed_numbers
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import (
    CaseInputs,
    Target,
    UncertainScenario,
    case_inputs,
    draw,
    draw_shapes,
    replaced_leaves,
    targets_of,
)
from iblf_jax.studies.options import RunOptions

MANY_RUNS = 10_000_000
"""From here on the memory of the results is computed before the program is compiled; this takes
0.2 s of a processor, and the program several seconds."""


class StudyProgram(NamedTuple):
    """The program that computes a block of a study; static."""

    targets: tuple[Target, ...]
    """The leaves that are drawn."""
    batch: CompiledBatch
    """The program of the runs, on the executor that was chosen."""


class SharedInputs(NamedTuple):
    """The inputs that all runs of a study share; traced."""

    uncertain: UncertainScenario
    folds: tuple[Fold, ...]
    dt: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class PreparedStudy:
    """A study whose arguments are checked and whose program is chosen."""

    program: StudyProgram = dataclasses.field(metadata={"static": True})
    shared: SharedInputs
    perturbations: dict[str, Perturbation]
    """As the user gave them."""
    options: RunOptions = dataclasses.field(metadata={"static": True})
    designed: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Path -> uniform numbers of every run, for samplers with a design."""
    points: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Path -> value at every point of a sweep."""
    numbers: np.ndarray | None = None
    """Number of each run, which its noise depends on; its position if not given."""

    @property
    def cases(self) -> int:
        """Number of cases: points times runs."""
        counts = [len(values) for values in self.points.values()]
        return self.options.runs * next(iter(counts), 1)

    @property
    def scenario(self) -> Scenario:
        """The nominal scenario, canonical."""
        return self.shared.uncertain.scenario

    @property
    def dt(self) -> float:
        """Time step [s], in the type of the scenario."""
        return float(self.shared.dt)

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.options.steps * self.dt

    @property
    def backend(self) -> str:
        """The backend that was chosen: "native", "gpu" or "vmap", not "auto"."""
        return self.program.batch.backend

    def inputs_of(self, cases: np.ndarray) -> CaseInputs:
        """The inputs of these cases; numbers beyond the last case repeat it."""
        cases = np.minimum(cases, self.cases - 1)
        inputs = case_inputs(cases, self.options.runs, self.points, self.designed)
        if self.numbers is None:
            return inputs
        return inputs._replace(index=self.numbers[cases % self.options.runs])


def drawn_leaves(
    targets: tuple[Target, ...], shared: SharedInputs, inputs: CaseInputs
) -> tuple[dict[str, Any], dict[str, Any], jax.Array]:
    """The leaves that the runs of a block replace, the draws, and whether each is admissible."""

    def draw_case(case: CaseInputs):
        used, drawn, admissible = draw(shared.uncertain, targets, case.index, case.points, case.u)
        scenario = shared.uncertain.scenario
        noise = noise_values(scenario, shared.uncertain.key, case.index)
        return replaced_leaves(scenario, case.points, used) | noise, drawn, admissible

    # Without the barrier XLA fuses the random numbers into every operation of the run, and
    # compiles for 18 s instead of 5 s.
    return jax.lax.optimization_barrier(jax.vmap(draw_case)(inputs))


_shapes_of_draws = jax.jit(drawn_leaves, static_argnums=0)
"""`drawn_leaves`, which JAX traces once for all studies of one structure."""


def prepare(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    options: RunOptions,
    metrics: Sequence[Fold] | None,
    points: Mapping[str, np.ndarray] | None = None,
    *,
    in_memory: bool = False,
) -> PreparedStudy:
    """Checks the scenario, its perturbations and the metrics, and compiles the program of blocks.

    Args:
      scenario, perturbations, metrics: as `monte_carlo`.
      options: checked.
      points: path -> value at every point of a sweep, (P, ...).
      in_memory: the results of all runs will be in memory: many runs are refused at once if they do
        not fit.

    Raises:
      ValueError: an argument that is not valid.
    """
    scenario = fitted_to_step(canonical(scenario), options.dt)
    request = options.request(scenario)
    targets, by_path = targets_of(scenario, perturbations)
    dtype = scenario.initial.q.dtype
    folds = as_folds(metrics, dtype, scenario)
    by_path, dt = jax.tree.map(lambda x: jnp.asarray(x, dtype), (by_path, options.dt))
    designed: dict[str, np.ndarray] = {}
    if options.sampler != "independent":
        designed = designed_numbers(
            options.sampler,
            draw_shapes(targets, by_path),
            options.runs,
            options.replicates,
            options.seed,
            dtype,
        )
    shared = SharedInputs(
        UncertainScenario(scenario, by_path, jax.random.PRNGKey(options.seed)), folds, dt
    )
    points = dict(points or {})
    inputs = case_inputs(np.zeros(block_size(), int), options.runs, points, designed)
    varied, drawn, _ = _shapes_of_draws.eval_shape(targets, shared, inputs)
    if in_memory and options.runs >= MANY_RUNS:
        bytes_each = bytes_of(drawn) / block_size() + _bytes_of_metrics(scenario, folds)
        checks.fits_memory("runs", options.runs, bytes_each)
    batch = compile_batch(request, scenario, varied, folds, dt)
    program = StudyProgram(targets, batch)
    return PreparedStudy(program, shared, dict(perturbations), options, designed, points)


def _bytes_of_metrics(scenario: Scenario, folds: Sequence[Fold]) -> int:
    """Memory that the metrics of one run take, without compiling anything."""

    def metrics(scenario: Scenario) -> list[Any]:
        start = jnp.zeros_like(scenario.initial.q[0])
        sample = evaluate(scenario, start, initial_state(scenario))[1]
        return [fold.finish(fold.init(sample)) for fold in folds]

    return bytes_of(jax.eval_shape(metrics, scenario))


def bytes_of(shapes: Any) -> int:
    """Memory that arrays of these shapes and types take [bytes]."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(shapes))
