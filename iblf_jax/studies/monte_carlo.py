"""Monte-Carlo studies: many runs of one scenario with parameters drawn at random.

Only the results of the metrics are kept of each run, so memory does not grow with the length of a
run; any run can be looked at again in full with `study.replay(i)`.

Workers of one's own (`multiprocessing`) are to be started by `spawn` or `forkserver`: a `fork` of a
process in which JAX has run hangs.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import bar
from iblf_jax.engine import STUDY_MEMORY
from iblf_jax.simulation.accuracy import RELATIVE
from iblf_jax.simulation.metrics import Fold
from iblf_jax.simulation.sampling import has_noise
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies import distributed
from iblf_jax.studies.blocks import Results, block_size, checked_how, run_blocks
from iblf_jax.studies.designs import MOST_RUNS, check_sampler
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.recommended import tell_of_step
from iblf_jax.studies.setup import prepare
from iblf_jax.studies.study import Study


@notices.each_warning_once
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
    chunk: int | None = None,
    memory: float = STUDY_MEMORY,
    devices: Sequence[jax.Device] | None = None,
    progress: bool | None = None,
) -> Study:
    """Runs a scenario many times with parameters drawn at random.

        run i:  u = uniform(fold_in(fold_in(key(seed), i), crc32(path))),   leaf =
          perturbation(nominal, F^-1(u))

    The results of run i depend on the seed and on i only: not on `runs`, `chunk`, the devices or
      the processes.  They are
    bit-identical on one backend and one version of JAX.  A perturbed run whose start or reference
    lies outside its bounds is no error: its status says so.  In a job of several processes
      (`iblf_jax.distributed`) each computes its share and all get the study.

    Args:
      scenario: what to run, of n joints.
      perturbations: path -> `factor`, `offset` or `value` of a distribution; there may be none
        where a sensor has noise.  A vector leaf gets an independent draw for each entry; `robot.`
        paths change plant and model alike.
      runs: number of runs N.
      duration: length of a run [s], a whole number of steps.
      dt: time step [s]; `recommended_dt(scenario, perturbations=...)` says which will do.
      seed: whole number that fixes all draws.
      method: "rk4", "heun" or "euler".
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      sampler: "independent", "latin_hypercube" or "sobol".
      replicates: number of independent designs that a Latin hypercube or Sobol study is made of.
      backend: "auto", "native", "gpu", "xla" or "vmap".
      chunk: runs in flight on the devices at a time; from `memory` if not given.  It changes no
        result.
      memory: bytes that runs in flight may take.
      devices: devices to use; all of this process if not given.
      progress: a progress bar; shown where somebody watches if not given.

    Returns:
      A `Study`: metrics, status and samples of every run, run axis first.

    Raises:
      ValueError: bad arguments; the message names the field, the value and the remedy.

    Source: design of this package.
    """
    how = checked_how(chunk, memory, devices)
    runs = checks.positive_integer("runs", runs, most=MOST_RUNS)
    replicates = check_sampler(sampler, runs, replicates)
    if (
        isinstance(perturbations, Mapping)
        and not perturbations
        and not (isinstance(scenario, Scenario) and has_noise(scenario))
    ):
        raise checks.fail(
            "perturbations",
            perturbations,
            "at least one perturbation",
            "Without any all runs are the same: use ij.simulate.",
        )
    timing: dict[str, Any] = {"duration": duration, "dt": dt, "method": method}
    setup = prepare(
        scenario,
        perturbations,
        runs,
        seed,
        metrics=metrics,
        backend=backend,
        sampler=sampler,
        replicates=replicates,
        **timing,
    )
    checks.fits("runs", runs, setup.bytes_a_case)
    results, blocks = None, range(-(-runs // block_size()))
    mine = distributed.share(blocks) or [0]
    begin = time.monotonic()
    sizes = {block: min(block_size(), runs - block * block_size()) for block in mine}
    with bar(progress, sum(sizes.values())) as shown:
        for block, part in run_blocks(setup.study_run, setup.shared, setup.lanes, mine, **how):
            results = _stored(results, part, block, runs)
            shown.update(sizes[block])
    results = distributed.gather_rows(
        results, blocks, block_size(), (time.monotonic() - begin) / len(mine)
    )
    tell_of_step(results.status, results.fastest_mode, results.metrics[RELATIVE], float(dt), method)
    return Study.of(setup, results)


def _stored(results: Results | None, part: Results, block: int, runs: int) -> Results:
    """`results`, made at the first call, with the runs of a block written in."""
    if results is None:
        results = jax.tree.map(lambda x: np.zeros((runs, *x.shape[1:]), x.dtype), part)
    first, size = block * block_size(), block_size()
    size = min(size, runs - first)

    def write(whole, piece):
        whole[first : first + size] = piece[:size]
        return whole

    return jax.tree.map(write, results, part)
