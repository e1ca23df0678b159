"""Stage 3 of a run: lowers the step, builds its kernels, and falls back to what works.

    native   the scalar program of the step as C, built by a C++ compiler: SIMD, threads; CPU
    gpu      the same C as a CUDA kernel, built by NVRTC: one run per thread; NVIDIA GPUs
    vmap     `jax.lax.scan` over the step; any scenario and device

All backends give the same results.  `first_that_works` is the only function that falls back: to the
next executor where one is not available, and to the scan where a step cannot be lowered.  A
`BackendWarning` gives the reason once.

`plan_of_single_run` and `compiled_plan` depend on structures and shapes only.  They are cached,
because tracing a step takes longer than many a run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, kept_programs, notices
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import plan, registry, thresholds
from iblf_jax.engine.batch import Batch, Stepper, carry_shapes, linearization_batch
from iblf_jax.engine.carry import Inputs
from iblf_jax.engine.linearization import LinearizationStep, linearization_steps
from iblf_jax.engine.loops import kernel_stepper, program_of, scan
from iblf_jax.engine.plan import ExecutionPlan, choose_plan
from iblf_jax.engine.registry import Executor, Machine
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import (
    Program,
    Shapes,
    StoppedError,
    ToolchainError,
    UnsupportedError,
    jaxprs,
    stop_own_compilers,
    without_garbage_collection,
)
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.noise import needs_key, realised
from iblf_jax.simulation.scenario import Scenario

if TYPE_CHECKING:
    from jax.tree_util import PyTreeDef

    from iblf_jax.engine.carry import Step
    from iblf_jax.simulation.metrics import Fold


T = TypeVar("T")


class BackendWarning(UserWarning):
    """Runs are executed on another backend than the requested one, and why."""


WARNINGS = "backend warnings"
"""Topic of `CACHE` for the warnings that this process has shown."""


FAILED = "failed executors"
"""Topic of `CACHE` for executors that failed, by their name and the key of what they should run."""

OUT_OF_MEMORY = "RESOURCE_EXHAUSTED"
"""XLA's word for a lack of memory, which another executor does not change."""


def _warn_once(text: str) -> None:
    kept_programs.forbid(text)
    if CACHE.mark(WARNINGS, text):
        notices.warn(text, BackendWarning)


def first_that_works(
    execution: ExecutionPlan,
    attempt: Callable[[Executor], T],
    by_scan: Callable[[], T],
    key: Hashable = None,
) -> T:
    """The value of `attempt` for the first executor of a plan that works, else that of `by_scan`.

    A compiler that was stopped says nothing about the executor, so that the same executor is tried
    a second time.

    Args:
      execution: the plan.
      attempt: function of an executor; it raises ToolchainError if the executor is not available
        or XLA fails (`building`), and UnsupportedError if the executor cannot express the step.
      by_scan: function without arguments.
      key: what decides, with the executor, whether it works; this process does not try again what
        has failed for this key.  None to try it again in each call.

    Raises:
      StoppedError: the compiler was stopped twice, as at the end of the process.
    """
    for text in execution.warnings:
        _warn_once(text)
    names = [x for x in execution.backends if not CACHE.is_marked(FAILED, (x, key))]

    def mark(failed: Iterable[str]) -> None:
        for each in failed if key is not None else ():
            CACHE.mark(FAILED, (each, key))

    for name, following in itertools.pairwise((*names, "vmap")):
        try:
            return _attempted(attempt, registry.EXECUTORS[name])
        except StoppedError:
            raise
        except ToolchainError as error:
            mark([name])
            _warn_once(plan.unavailable_warning(name, error, following))
        except UnsupportedError as reason:
            mark(names)
            kept_programs.forbid(str(reason))
            if execution.reports_unsupported:
                _warn_once(plan.scan_warning(reason))
            break
    return by_scan()


def _attempted(attempt: Callable[[Executor], T], executor: Executor) -> T:
    """The value of an attempt, of a second one if the compiler was stopped in the first."""
    try:
        return attempt(executor)
    except StoppedError:
        return attempt(executor)


def inputs_of(
    scenario: Scenario,
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
    noise_key: jax.Array | None = None,
) -> Inputs:
    """The inputs of a run; `noise_key` is the key of its random numbers."""
    key: Any = ()
    if needs_key(scenario):
        key = jnp.zeros((4,), dt.dtype)
        if noise_key is not None:
            key = noise_key.astype(dt.dtype)
        scenario = realised(scenario, key)
    steps: Any = np.asarray(request.steps, dt.dtype)
    return Inputs(scenario, folds, dt, steps, noise_key=key)


def operations(inputs: Inputs) -> int:
    """Operations of one evaluation of the closed loop."""
    zero = jnp.zeros_like(inputs.dt)
    arguments = (inputs.scenario, zero, initial_state(inputs.scenario))
    return jaxprs.count_executed_operations(jax.make_jaxpr(evaluate)(*arguments))


def scan_of(inputs: Inputs) -> Stepper:
    """The scan of a closed loop: the stages of a long one are a loop."""
    return partial(scan, rolled=thresholds.rolls_stages(operations(inputs)))


def plan_of_batch(
    request: RunRequest, varied: Mapping[str, Any], machine: Machine
) -> ExecutionPlan:
    """The plan of a batch on a machine."""
    return choose_plan(request, len(next(iter(varied.values()))), machine)


@contextlib.contextmanager
def building() -> Iterator[None]:
    """Context manager of an attempt to run by an executor.  If its body raises, the compilers that
    this thread has started stop; those of other threads go on.

    A ToolchainError replaces an error of XLA, so that the next backend makes the run.  XLA does not
    tell whether it failed to compile, to load or to execute a program.  A run has no effect but its
    result, so that it may be made again after any of them.  A lack of memory remains an error.
    """
    try:
        yield
    except BaseException as error:
        stop_own_compilers()
        if isinstance(error, jax.errors.JaxRuntimeError) and OUT_OF_MEMORY not in str(error):
            first = str(error).strip().partition("\n")[0] or "no message"
            raise ToolchainError(f"XLA failed: {checks.one_line(first)}") from error
        raise


class StepProgram(NamedTuple):
    """A scalar program and the other arguments of `Executor.build`; static."""

    program: Program
    shared: int
    """How many numbers all runs share."""
    per_run: int
    """How many numbers differ between runs."""
    runs: int
    steps: int

    @staticmethod
    def of(step: Step, batch: Batch, carry: Any, steps: int) -> StepProgram:
        """The program of a step of a batch; raises UnsupportedError if it cannot be lowered."""
        shared, per_run = batch.leaves.shared, batch.leaves.per_run
        return StepProgram(
            program_of(step, batch, carry).program,
            Shapes.of(shared).size,
            Shapes.of(per_run, 1).size,
            batch.runs or 1,
            steps,
        )


def time_step_program(batch: Batch, request: RunRequest) -> StepProgram:
    """The program of a time step."""
    carry = carry_shapes(batch, request.method)
    return StepProgram.of(TimeStep.of(request), batch, carry, request.instants)


def start_build(executor: Executor, program: StepProgram) -> None:
    """Starts to compile a kernel in the background if the executor supports it."""
    if executor.start_build:
        executor.start_build(*program)


def run_by_executor(
    executor: Executor, batch: Batch, request: RunRequest, run: Callable[[Stepper, Batch], T]
) -> T:
    """`run(run_steps, batch)` with the `Stepper` of an executor.

    The longest kernel is built in the background at the same time, on another core.
    """
    if executor.start_build:
        start_build(executor, time_step_program(batch, request))
    with building():
        return run(kernel_stepper(executor), batch)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class _Static:
    """A value without arrays, as the output of a traced function."""

    value: object


@without_garbage_collection()
def on_shapes(function: Callable[..., T], shapes: object) -> T:
    """The value of a function that depends only on the shapes of its arrays.

    Args:
      function: function of one pytree of arrays; its value contains no arrays.
      shapes: pytree of `jax.ShapeDtypeStruct` in place of the arrays.
    """
    return jax.eval_shape(lambda arrays: _Static(function(arrays)), shapes).value


def shapes_of(leaves: list) -> tuple:
    """Shapes and types of arrays; hashable."""
    return tuple((x.shape, x.dtype) for x in leaves)


def tree_of_shapes(structure: PyTreeDef, shapes: tuple) -> Any:
    """A pytree of shapes and types (`shapes_of`) in place of arrays."""
    return jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes])


def structural_part(request: RunRequest) -> RunRequest:
    """The request with only what its kernels depend on: whether there are at least FEW_STEPS steps,
    and whether anything is recorded.
    """
    part = request._replace(steps=0, assessed=True)
    if request.steps >= thresholds.FEW_STEPS:
        part = part._replace(steps=thresholds.FEW_STEPS)
    if request.record_every is not None:
        part = part._replace(record_every=1)
    return part


# --- batches ---


@CACHE.memoised(64)
def compiled_plan(
    request: RunRequest, machine: Machine, structure: PyTreeDef, shapes: tuple
) -> ExecutionPlan:
    """The plan of a batch with only the first executor that can run it, whose kernels are built.

    Args:
      request: `structural_part` of the request.
      machine: the machine that runs the batch.
      structure: tree structure of (scenario, varied, folds, dt).
      shapes: shapes of their leaves (`shapes_of`).

    Raises:
      StoppedError: as `first_that_works`; a plan without an executor would be kept.
    """
    arguments = tree_of_shapes(structure, shapes)

    def programs(arguments: Any) -> tuple[StepProgram, StepProgram]:
        scenario, varied, folds, dt = arguments
        inputs = inputs_of(scenario, folds, dt, request)
        batch = Batch.of(inputs, varied, request.constants)
        # A run is linearized at its start and at its end.
        twice, carry = linearization_batch(batch, request.method)
        steps = linearization_steps(twice.leaves.first.scenario)
        linearization = StepProgram.of(LinearizationStep(), twice, carry, steps)
        return linearization, time_step_program(batch, request)

    def build(executor: Executor) -> tuple[str, ...]:
        linearization, step = on_shapes(programs, arguments)
        start_build(executor, step)
        with building():
            executor.build(*linearization)
            executor.build(*step)
        return (executor.name,)

    def built(executor: Executor) -> tuple[str, ...]:
        """As `build`.  In a later process the kernels are those that the kept program names."""
        parts = ("kernels of a batch", executor.name, request, machine, structure, shapes)
        return kept_programs.computed_once(partial(build, executor), *parts)

    execution = plan_of_batch(request, arguments[1], machine)
    return execution._replace(backends=first_that_works(execution, built, lambda: ()), warnings=())


# --- single runs ---


class SingleRunPlan(NamedTuple):
    """The plan of one run; static."""

    execution: ExecutionPlan
    nodes: int
    """Nodes of the scalar program of a step; 0 if it is not lowered."""


def single_batch(inputs: Inputs, request: RunRequest) -> Batch:
    """A batch of one run: executors need a run axis, so the start is its per-run leaf."""
    start = {"initial.q": inputs.scenario.initial.q[None]}
    return Batch.of(inputs, start, request.constants)


@CACHE.memoised(256)
def plan_of_single_run(
    request: RunRequest, machine: Machine, structure: PyTreeDef, shapes: tuple
) -> SingleRunPlan:
    """The plan of one run; the first executor has started to build the kernel of the step, unless
    an earlier process has made the plan.

    Args:
      request: `structural_part` of the request.
      machine: the machine that runs it.
      structure: tree structure of the `Inputs`.
      shapes: shapes of their leaves (`shapes_of`).
    """
    return kept_programs.computed_once(
        partial(_plan_of_single_run, request, machine, structure, shapes),
        *("plan of a single run", request, machine, structure, shapes),
    )


def _plan_of_single_run(
    request: RunRequest, machine: Machine, structure: PyTreeDef, shapes: tuple
) -> SingleRunPlan:
    """As `plan_of_single_run`."""
    inputs = tree_of_shapes(structure, shapes)
    execution = choose_plan(request, None, machine)
    if not execution.backends:
        return SingleRunPlan(execution, 0)

    def program(inputs: Inputs) -> StepProgram:
        return time_step_program(single_batch(inputs, request), request)

    try:
        step = on_shapes(program, inputs)
        execution = plan.within_node_limit(execution, request, step.program.size)
        if execution.backends:
            start_build(registry.EXECUTORS[execution.backend], step)
        return SingleRunPlan(execution, step.program.size)
    except UnsupportedError as reason:
        return SingleRunPlan(plan.scan_only(execution, reason), 0)
