"""Studies: many runs of a scenario, and statistics over them.

    functions    compare (laws), monte_carlo (random parameters), sweep (a grid of parameters),
                 sensitivity (which parameter matters), time_step (the largest valid one)
    request      options: what to run, where and how; study_setup: the checked arguments and the
                 compiled program; designs, draws, sweep_points: which parameters case i has
    execution    blocks: the one compiled shape, in this process; workers: on an executor;
                 execution: chooses between the two; interrupt: Ctrl-C
    store        store_config, store: a sweep on disk that survives a kill
    results      comparison, study, dataset (the table of a sweep); statistics, summaries
    search       perturbation_cube: the cases as a box, for gradient-based search
    rare events  rare_events: probabilities of rare failures, for `ij.failure_probability`

The public functions are those of `iblf_jax`; `distributions` has those of parameters.  The names
below are options and errors of the functions.
"""

from typing import TYPE_CHECKING

from iblf_jax.core.first_use import on_first_use as _on_first_use

if TYPE_CHECKING:
    from iblf_jax.studies.options import Design as Design
    from iblf_jax.studies.options import LocalExecutor as LocalExecutor
    from iblf_jax.studies.options import StoreOptions as StoreOptions
    from iblf_jax.studies.workers import WorkerError as WorkerError
    from iblf_jax.studies.workers import initialize_worker as initialize_worker

_ON_FIRST_USE = {
    "Design": ("iblf_jax.studies.options", "Design"),
    "StoreOptions": ("iblf_jax.studies.options", "StoreOptions"),
    "LocalExecutor": ("iblf_jax.studies.options", "LocalExecutor"),
    "WorkerError": ("iblf_jax.studies.workers", "WorkerError"),
    "initialize_worker": ("iblf_jax.studies.workers", "initialize_worker"),
}
"""Public name -> (module, attribute): imported when first used, so that `import iblf_jax` stays
quick."""
__getattr__, __dir__ = _on_first_use(__name__, _ON_FIRST_USE)
