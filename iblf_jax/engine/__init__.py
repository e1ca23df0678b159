"""The engine: from a request for runs to numbers, in five stages.

    request = RunRequest.of(scenario, steps=..., method=..., backend=...)     checked once
    plan    = choose_plan(request, sizes, machine)      which executors, and how a batch is laid out
    program = compile_batch(request, scenario, varied, folds, dt)     the first executor that works
    output  = program(scenario, varied, folds, dt)      an `Outcome`: records, metrics, status flags
    result  = run_rollout(...)                          a `Rollout`: named, with units, plotted

`registry` lists the executors, `loops` the loops over all steps of a batch, and `thresholds` the
sizes with which the plan compares.  Modules outside this folder import from here; `simulate`,
`explain`, `recommended_period` and the step sizes have modules of their own.
"""

from iblf_jax.engine.compile import BackendWarning as BackendWarning
from iblf_jax.engine.derivatives import Outer as Outer
from iblf_jax.engine.derivatives import Tangents as Tangents
from iblf_jax.engine.execute import CompiledBatch as CompiledBatch
from iblf_jax.engine.execute import compile_batch as compile_batch
from iblf_jax.engine.execute import run_batch as run_batch
from iblf_jax.engine.execute import run_batch_jvp as run_batch_jvp
from iblf_jax.engine.execute import run_for_reverse as run_for_reverse
from iblf_jax.engine.execute import run_from as run_from
from iblf_jax.engine.metric_folds import folded as folded
from iblf_jax.engine.outcome import Outcome as Outcome
from iblf_jax.engine.request import RunRequest as RunRequest
from iblf_jax.engine.request import check_backend as check_backend
from iblf_jax.engine.simulate import run_rollout as run_rollout
from iblf_jax.engine.sizes import STUDY_MEMORY as STUDY_MEMORY
from iblf_jax.engine.sizes import block_size as block_size
from iblf_jax.engine.sizes import blocks_in_flight as blocks_in_flight
from iblf_jax.engine.sizes import fresh_together as fresh_together
from iblf_jax.engine.sizes import starts_together as starts_together
from iblf_jax.engine.sizes import sweep_unit as sweep_unit
from iblf_jax.engine.sizes import values_together as values_together
from iblf_jax.engine.sizes import whole_blocks as whole_blocks
from iblf_jax.engine.status_flags import sample_status as sample_status
from iblf_jax.engine.thresholds import FORWARD_MOST as FORWARD_MOST
from iblf_jax.engine.thresholds import LOWERING_LIMITS as LOWERING_LIMITS
from iblf_jax.engine.thresholds import differentiates_forward as differentiates_forward
from iblf_jax.engine.waiting import wait_until_ready as wait_until_ready
