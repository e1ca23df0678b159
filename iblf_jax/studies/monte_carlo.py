"""Monte-Carlo studies: many runs of one scenario with parameters drawn at random.

Of each run only the results of its metrics are kept, so memory does not grow with the length of a
run.  `study.replay(i)` computes the full trajectory of one run again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor

import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import announced, bar
from iblf_jax.engine import takes_runs
from iblf_jax.simulation.error_growth import errors_by_step
from iblf_jax.simulation.metrics import Fold
from iblf_jax.simulation.noise import has_noise
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.stability import RADIUS
from iblf_jax.studies.blocks import case_bytes
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.execution import run_all_cases
from iblf_jax.studies.options import LocalExecutor, RunOptions, executor_of
from iblf_jax.studies.study import Study
from iblf_jax.studies.study_setup import prepare
from iblf_jax.studies.time_step import warn_of_sampling, warn_of_step


@notices.each_warning_once
@checks.known_keywords
@announced("compiling the program of a study")
@takes_runs
def monte_carlo(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    *,
    runs: int,
    duration: float,
    dt: float = 1e-3,
    seed: int = 0,
    method: str = "rk4",
    metrics: Sequence[Fold] | None = None,
    sampler: str = "independent",
    replicates: int = 1,
    backend: str = "auto",
    executor: LocalExecutor | Executor | None = None,
    progress: bool | None = None,
) -> Study:
    """Runs a scenario many times with parameters drawn at random.

        run i:  u = uniform(fold_in(fold_in(key(seed), i), crc32(path))),
                leaf = perturbation(nominal, F^-1(u))

    The results of run i depend on the seed and on i only: not on `runs`, the devices or the
    executor.  They are bit-identical on one backend and one version of JAX.  A perturbed run whose
    start or reference lies outside its bounds is no error: its status reports it.

    Args:
      scenario: what to run, of n joints.
      perturbations: path -> `factor`, `offset` or `value` of a distribution; there may be none
        where a sensor has noise.  A vector leaf gets an independent draw for each entry; `robot.`
        paths change plant and model alike.
      runs: number of runs N.
      duration: length of a run [s], a whole number of steps.
      dt: time step [s]; `recommended_dt(scenario, perturbations=...)` finds one.
      seed: whole number that fixes all draws.
      method: "rk4", "heun" or "euler".
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      sampler: "independent", "latin_hypercube" or "sobol".
      replicates: number of independent designs that a Latin hypercube or Sobol study is made of.
      backend: "auto", "native", "gpu" or "vmap".
      executor: where the runs are computed: any `concurrent.futures.Executor`, such as a Dask
        client's `get_executor()` or a process pool; or an `ij.studies.LocalExecutor` with devices
        and a limit of memory.  None for this process and all its devices.
      progress: a progress bar; by default it is shown on a terminal.
      runs_as: an `ij.Runs`, in place of its fields.

    Returns:
      A `Study`: metrics, status and samples of every run, run axis first.

    Raises:
      ValueError: bad arguments; the message names the field, the value and the remedy.
      ij.studies.WorkerError: a worker of the executor was lost, or has other versions or settings
        than this process.

    Source: design of this package.
    """
    executor = executor_of(executor)
    options = RunOptions(
        duration, dt, method, backend, seed, runs=runs, sampler=sampler, replicates=replicates
    )
    is_empty = isinstance(perturbations, Mapping) and not perturbations
    if is_empty and not (isinstance(scenario, Scenario) and has_noise(scenario)):
        remedy = "Without any all runs are the same: use ij.simulate."
        raise checks.fail("perturbations", perturbations, "at least one perturbation", remedy)
    prepared = prepare(scenario, perturbations, options, metrics, in_memory=True)
    checks.fits_memory("runs", options.runs, case_bytes(prepared))
    with bar(progress, options.runs) as shown:
        results = run_all_cases(prepared, executor, shown.update)
    errors = np.asarray(errors_by_step(results.metrics))
    warn_of_step(results.status, results.fastest_mode, errors, options.dt, method)
    warn_of_sampling(results.status, results.metrics.get(RADIUS))
    return Study.of(prepared, results)
