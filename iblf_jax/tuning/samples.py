"""Runs scenarios with several sets of gains on the same draws, for the report on a tuning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.status import UNTRUSTED, Status, has_flag
from iblf_jax.engine import RunRequest, report_runs_per_batch
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.draws import UncertainScenario, targets_of
from iblf_jax.studies.study import VIOLATED
from iblf_jax.studies.time_step import warn_of_step
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.options import TuningRunOptions
from iblf_jax.tuning.rollouts import Rollouts, draw_runs, fold_of, rollouts
from iblf_jax.tuning.runs import in_groups


class SampleRequest(NamedTuple):
    """What is run: a scenario whose tuned leaves differ, and the draws of its runs."""

    scenario: Scenario
    """With the nominal values of all leaves that are not tuned."""
    tuned: tuple[str, ...]
    """Paths of the tuned leaves."""
    objective: Objective
    """With scales and limits."""
    options: TuningRunOptions
    """Duration, integrator, executor and perturbations; the fields below replace the others."""
    dt: float
    runs: int
    seed: int
    """Of the draws."""
    batch: int = 1
    """Runs in a batch of the search's values, whose compiled program is used again."""
    nominal: bool = False
    """Whether the perturbed leaves keep their nominal values; they are replaced all the same, so
    that one kernel serves all runs."""


class Sample(NamedTuple):
    """The numbers of N runs with one set of gains that a report needs."""

    exact: np.ndarray
    """Each quantity of the objective, and minus the margin, (N, K + 1)."""
    torque: np.ndarray
    """The largest of each joint, (N, n)."""
    status: np.ndarray
    sampling_radius: np.ndarray
    """Spectral radius of the one-period map of each run, (N,); NaN for a continuous law."""
    admissible: np.ndarray
    """Whether the draws of the run were admissible; the others do not count, (N,)."""

    @property
    def margin(self) -> np.ndarray:
        """Of each run, (N,) [rad]."""
        return -self.exact[:, -1]

    def left_bounds(self) -> np.ndarray:
        """Whether each run left its bounds or diverged, (N,)."""
        return has_flag(self.status, VIOLATED)

    def is_untrusted(self) -> np.ndarray:
        """Whether each run diverged or was integrated unstably, (N,)."""
        return has_flag(self.status, UNTRUSTED)

    def is_sampled_too_slowly(self) -> np.ndarray:
        """Whether the sampled loop of each run is unstable, (N,)."""
        return has_flag(self.status, Status.SAMPLING_TOO_SLOW) & self.admissible

    def losses(self, objective: Objective) -> np.ndarray:
        """The value of each term in each run, (N, n_terms)."""
        columns = [t.value(jnp.asarray(self.exact[:, i])) for i, t in enumerate(objective.terms)]
        return np.stack([np.asarray(x) for x in columns], axis=1)

    def excess(self, objective: Objective, r: int) -> np.ndarray:
        """Excess of requirement r in each run, (N,); infinite in a run that diverged."""
        values = jnp.asarray(self.exact[:, len(objective.terms) + r])
        excess = np.asarray(objective.requirements[r].excess(values))
        diverged = has_flag(self.status, Status.NOT_FINITE) | np.isnan(excess)
        return np.where(diverged, np.inf, excess)

    def is_broken(self, objective: Objective, r: int) -> np.ndarray:
        """Whether each run violates requirement r, (N,)."""
        if objective.requirements[r].event == "violated":
            return self.left_bounds()
        return ~(self.excess(objective, r) < 0)


def is_random(options: TuningRunOptions) -> bool:
    """Whether the runs of a tuning were drawn: by perturbations, or several by the sensor's noise.

    Otherwise there is one run, the nominal one.
    """
    return bool(options.perturbations) or options.runs > 1


def sample_runs(request: SampleRequest, scenarios: Sequence[Scenario]) -> list[Sample]:
    """The runs of each scenario on the same draws, made by the program of a search's values.

    Several scenarios issue the warning of a time step that is too large, once for all runs.
    """
    scenario = canonical(request.scenario)
    dtype = scenario.initial.q.dtype
    count = request.runs
    cases, targets = uncertain_scenario(request)
    method = request.options.method
    steps = checks.whole_steps(request.options.duration, request.dt)
    backend = request.options.backend
    of_run = RunRequest.of(scenario, steps=steps, method=method, backend=backend)
    objective, step = jax.tree.map(lambda x: jnp.asarray(x, dtype), (request.objective, request.dt))
    fold = fold_of(objective, dtype, steps * step)
    points = {
        path: np.stack([np.asarray(paths.get(s, path), dtype) for s in scenarios])
        for path in request.tuned
    }
    index = np.tile(np.arange(count, dtype=np.uint32), len(scenarios))
    owner = np.repeat(np.arange(len(scenarios)), count)

    def run(rows: np.ndarray) -> tuple[Rollouts, jax.Array]:
        own = {path: x[owner[rows]] for path, x in points.items()}
        varied, admissible = draw_runs(
            cases, own, index[rows], targets=targets, nominal=request.nominal
        )
        return rollouts(scenario, varied, fold, step, request=of_run), admissible

    batch = report_runs_per_batch(len(owner) * steps, request.batch)
    found, admissible = in_groups(run, len(owner), batch)
    if len(scenarios) > 1:
        warn_of_step(found.status, found.fastest_mode, found.relative_error, request.dt, method)
    sample = Sample(found.exact, found.peak_torque, found.status, found.sampling_radius, admissible)
    return [Sample(*(x[owner == s] for x in sample)) for s in range(len(scenarios))]


def uncertain_scenario(request: SampleRequest) -> tuple[UncertainScenario, tuple]:
    """The scenario with its perturbations and the key of the draws, and the perturbed leaves."""
    scenario = canonical(request.scenario)
    dtype = scenario.initial.q.dtype
    targets, by_path = targets_of(scenario, request.options.perturbations or {})
    by_path = jax.tree.map(lambda x: jnp.asarray(x, dtype), by_path)
    key = jax.random.PRNGKey(int(request.seed))
    return UncertainScenario(scenario, by_path, key), targets
