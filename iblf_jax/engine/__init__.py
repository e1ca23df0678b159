"""The engine: from a request for runs to numbers, in five stages.

    stage      a single run                          a batch
    request    `RunRequest.of`                       `RunRequest.of`
    plan       `plan.choose_plan`                    `plan.choose_plan`
    program    `compile.plan_of_single_run`          `compile_batch`
    outcome    `single_run.run_one`: an `Outcome`    `CompiledBatch` or `run_batch`: an `Outcome`
    result     `run_rollout`: a `Rollout`            of the caller, such as a `Study`

The later functions call the earlier ones: `run_rollout` and `run_batch` need only a request.
`time_step` defines a time step, `loops` has the loops over all steps, `registry` lists the
executors, and `thresholds` has the limits that the plan applies.  Modules outside this folder
import from here; `simulate`, `explain`, `recommended_period` and the step sizes have modules of
their own.
"""

from iblf_jax.engine.batch_in_parts import run_batch_in_parts as run_batch_in_parts
from iblf_jax.engine.carry import Inputs as Inputs
from iblf_jax.engine.carry import Step as Step
from iblf_jax.engine.carry import StepOptions as StepOptions
from iblf_jax.engine.carry import initial_carry as initial_carry
from iblf_jax.engine.compile import BackendWarning as BackendWarning
from iblf_jax.engine.derivatives import Outer as Outer
from iblf_jax.engine.derivatives import Tangents as Tangents
from iblf_jax.engine.execute import CompiledBatch as CompiledBatch
from iblf_jax.engine.execute import compile_batch as compile_batch
from iblf_jax.engine.execute import run_batch as run_batch
from iblf_jax.engine.execute import run_batch_jvp as run_batch_jvp
from iblf_jax.engine.execute import run_batch_vjp as run_batch_vjp
from iblf_jax.engine.execute import step_states as step_states
from iblf_jax.engine.metric_folds import folded as folded
from iblf_jax.engine.outcome import Outcome as Outcome
from iblf_jax.engine.registry import uses_host_compiler as uses_host_compiler
from iblf_jax.engine.request import RunRequest as RunRequest
from iblf_jax.engine.request import check_backend as check_backend
from iblf_jax.engine.runs import Runs as Runs
from iblf_jax.engine.runs import takes_runs as takes_runs
from iblf_jax.engine.simulate import run_rollout as run_rollout
from iblf_jax.engine.sizes import STUDY_MEMORY as STUDY_MEMORY
from iblf_jax.engine.sizes import block_size as block_size
from iblf_jax.engine.sizes import block_size_in_memory as block_size_in_memory
from iblf_jax.engine.sizes import blocks_in_flight as blocks_in_flight
from iblf_jax.engine.sizes import cases_per_unit as cases_per_unit
from iblf_jax.engine.sizes import points_per_batch as points_per_batch
from iblf_jax.engine.sizes import report_runs_per_batch as report_runs_per_batch
from iblf_jax.engine.sizes import starts_per_batch as starts_per_batch
from iblf_jax.engine.sizes import whole_blocks as whole_blocks
from iblf_jax.engine.status_flags import sample_status as sample_status
from iblf_jax.engine.thresholds import LOWERING_LIMITS as LOWERING_LIMITS
from iblf_jax.engine.thresholds import MAX_FORWARD_NUMBERS as MAX_FORWARD_NUMBERS
from iblf_jax.engine.thresholds import differentiates_forward as differentiates_forward
from iblf_jax.engine.time_step import advance as advance
from iblf_jax.engine.waiting import wait_until_ready as wait_until_ready
