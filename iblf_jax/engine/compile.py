"""Stage 3 of a run: from a request and its plan to a program, a function of the inputs.

    native   the step's scalar program as C, built by a C++ compiler, SIMD and threads: CPU
    gpu      the same C as a CUDA kernel, one run a thread, built by NVRTC: NVIDIA GPUs
    vmap     the scan over the step as it is: any scenario, any device

All give the same results.  `first_that_works` is the only place that falls back from one executor
to the next: a scenario that no scalar program can express runs by the scan, and where an executor
is not available the next one runs it.  A `BackendWarning` says why, once.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import devices, notices
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import plan, registry, thresholds
from iblf_jax.engine.batch import Batch, StepLoop, carry_shapes, linearization_batch
from iblf_jax.engine.carry import Inputs
from iblf_jax.engine.linearization import LinearizationStep, linearization_steps
from iblf_jax.engine.loops import kernel_loop, program_of
from iblf_jax.engine.machine_function import count_operations, machine_function
from iblf_jax.engine.plan import BatchLayout, ExecutionPlan, Sizes, choose_plan
from iblf_jax.engine.registry import Executor, Machine
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import Program, Shapes, ToolchainError, UnsupportedError, stop_compilers
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.scenario import Scenario

T = TypeVar("T")


class BackendWarning(UserWarning):
    """Runs are executed on another backend than the requested one, and why."""


WARNINGS = "backend warnings"
"""Topic of the marks of the warnings that this process has shown."""


def _warn_once(text: str) -> None:
    if CACHE.mark(WARNINGS, text):
        notices.warn(text, BackendWarning)


def first_that_works(
    execution: ExecutionPlan, attempt: Callable[[Executor], T], by_scan: Callable[[], T]
) -> T:
    """`attempt` with the first executor of a plan that can, else `by_scan()`.

    Args:
      execution: the plan.
      attempt: function of an executor; it raises ToolchainError where the executor is not
        available, and UnsupportedError where it cannot express the step.
      by_scan: function without arguments.
    """
    for text in execution.notes:
        _warn_once(text)
    names = execution.backends
    for name, following in zip(names, (*names[1:], "vmap"), strict=False):
        try:
            return attempt(registry.EXECUTORS[name])
        except ToolchainError as error:
            _warn_once(plan.not_available(name, error, following))
        except UnsupportedError as reason:
            if execution.reports_unsupported:
                _warn_once(plan.slower_by_scan(reason))
            break
    return by_scan()


def inputs_of(
    scenario: Scenario, folds: Any, dt: jax.Array, request: RunRequest, noise: Any = None
) -> Inputs:
    """What a run is computed from; `noise` is the key of the noise of a sampled loop."""
    key: Any = ()
    if scenario.sampling is not None:
        key = jnp.zeros((4,), dt.dtype) if noise is None else noise.astype(dt.dtype)
    steps: Any = np.asarray(request.steps, dt.dtype)
    return Inputs(scenario, folds, dt, steps, noise=key)


def operations(inputs: Inputs) -> int:
    """Operations of one evaluation of the closed loop."""
    zero = jnp.zeros_like(inputs.dt)
    return count_operations(evaluate, inputs.scenario, zero, initial_state(inputs.scenario), zero)


def plan_of_batch(
    request: RunRequest, inputs: Inputs, varied: Mapping[str, Any], machine: Machine
) -> ExecutionPlan:
    """The plan of a batch on a machine."""
    runs = len(next(iter(varied.values())))
    return choose_plan(request, Sizes(operations(inputs), runs), machine)


def nested_batch(inputs: Inputs) -> Batch:
    """One run for the scan, which a caller may batch, differentiate or loop over."""
    layout = plan.scan_layout(devices.platform(), operations(inputs), None, nested=True)
    return Batch.of(inputs, None, layout)


def scanned(
    layout: BatchLayout, inputs: Inputs, varied: Mapping[str, jax.Array] | None, run: Callable
) -> Any:
    """`run(batch)` for a batch in a layout of the scan."""

    def complete(inputs: Inputs, varied: dict[str, jax.Array]) -> Any:
        return run(Batch.of(inputs, varied, layout))

    if layout.machine_functions == "loop":
        complete = machine_function(complete)
    return complete(inputs, dict(varied or {}))


@contextlib.contextmanager
def compilers_stopped_on_error() -> Iterator[None]:
    """What fails, or is interrupted, leaves no compiler behind."""
    try:
        yield
    except BaseException:
        stop_compilers()
        raise


class StepProgram(NamedTuple):
    """A scalar program and the arguments with which an executor builds its kernel; static."""

    program: Program
    shared: int
    """Numbers that all runs share."""
    per_run: int
    """Numbers that differ between runs."""
    runs: int
    steps: int

    @staticmethod
    def of(step: Any, batch: Batch, carry: Any, steps: int) -> StepProgram:
        """The program of a step of a batch; raises UnsupportedError where there is none."""
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
    return StepProgram.of(TimeStep.of(request), batch, carry, request.steps + 1)


def _linearization_program(batch: Batch, request: RunRequest) -> StepProgram:
    """The program that linearizes the closed loop at the start and at the end of a run."""
    batch, carry = linearization_batch(batch, request.method)
    steps = linearization_steps(batch.leaves.first.scenario)
    return StepProgram.of(LinearizationStep(), batch, carry, steps)


def start_build(executor: Executor, program: StepProgram) -> None:
    """Starts to compile a kernel in the background, where the executor can."""
    if executor.start_build:
        executor.start_build(*program)


def run_lowered(
    executor: Executor, batch: Batch, request: RunRequest, run: Callable[[StepLoop, Batch], T]
) -> T:
    """`run(loop, batch)` by an executor.

    The longest kernel is built in the background meanwhile: compilers use one core each.
    """
    if executor.start_build:
        start_build(executor, time_step_program(batch, request))
    with compilers_stopped_on_error():
        return run(kernel_loop(executor), batch)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class _Static:
    """A result of a trace that holds no arrays."""

    value: Any


def on_shapes(function: Callable[..., T], shapes: Any) -> T:
    """The value of a function of arrays of which it reads only shapes; the value holds no arrays.

    Args:
      function: of one pytree of arrays.
      shapes: pytree of `jax.ShapeDtypeStruct` in place of the arrays.
    """
    return jax.eval_shape(lambda arrays: _Static(function(arrays)), shapes).value


def shapes_of(leaves: list) -> tuple:
    """Shapes and types of arrays; hashable."""
    return tuple((x.shape, x.dtype) for x in leaves)


def _tree_of_shapes(structure: Any, shapes: tuple) -> Any:
    return jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes])


def structural_part(request: RunRequest) -> RunRequest:
    """The part of a request on which its kernels depend: of the number of steps whether it is
    large, and of the record whether there is one.
    """
    steps = thresholds.FEW_STEPS if request.steps >= thresholds.FEW_STEPS else 0
    return request._replace(steps=steps, record_every=request.record_every and 1)


# --- batches ---


@CACHE.memoised(64)
def compiled_plan(
    request: RunRequest, machine: Machine, structure: Any, shapes: tuple
) -> ExecutionPlan:
    """The plan of a batch, reduced to the first executor that can run it; its kernels are built.

    It depends on structure and shapes alone, and a trace takes longer than many a study.

    Args:
      request: structural part of the request.
      machine: where it runs.
      structure: of (scenario, varied, folds, dt).
      shapes: of their leaves.
    """
    arguments = _tree_of_shapes(structure, shapes)

    def choose(arguments: Any) -> ExecutionPlan:
        scenario, varied, folds, dt = arguments
        return plan_of_batch(request, inputs_of(scenario, folds, dt, request), varied, machine)

    def programs(arguments: Any) -> tuple[StepProgram, StepProgram]:
        scenario, varied, folds, dt = arguments
        inputs = inputs_of(scenario, folds, dt, request)
        batch = Batch.of(inputs, varied, execution.layout, request.constants)
        return _linearization_program(batch, request), time_step_program(batch, request)

    def build(executor: Executor) -> tuple[str, ...]:
        linearization, step = on_shapes(programs, arguments)
        start_build(executor, step)
        with compilers_stopped_on_error():
            executor.build(*linearization)
            executor.build(*step)
        return (executor.name,)

    execution = on_shapes(choose, arguments)
    return execution._replace(backends=first_that_works(execution, build, lambda: ()), notes=())


# --- single runs ---


class SingleRunPlan(NamedTuple):
    """How one run is executed; static."""

    execution: ExecutionPlan
    nodes: int
    """Of a step's program; 0 where it is not lowered."""


def single_batch(inputs: Inputs, request: RunRequest, layout: BatchLayout) -> Batch:
    """One run as a batch, which is what is lowered."""
    start = {"initial.q": inputs.scenario.initial.q[None]}
    return Batch.of(inputs, start, layout, request.constants)


@CACHE.memoised(256)
def plan_of_single_run(
    request: RunRequest, machine: Machine, structure: Any, shapes: tuple
) -> SingleRunPlan:
    """How one run is executed; the kernel of the first executor is being built on return.

    It depends on structure and shapes alone, and a trace takes longer than many a run.

    Args:
      request: structural part of the request.
      machine: where it runs.
      structure: of the `Inputs`.
      shapes: of their leaves.
    """
    inputs = _tree_of_shapes(structure, shapes)
    sizes = Sizes(on_shapes(operations, inputs), None)
    execution = choose_plan(request, sizes, machine)
    if not execution.backends:
        return SingleRunPlan(execution, 0)

    def program(inputs: Inputs) -> StepProgram:
        return time_step_program(single_batch(inputs, request, execution.layout), request)

    try:
        step = on_shapes(program, inputs)
        nodes = step.program.size
        execution = choose_plan(request, sizes._replace(nodes=nodes), machine)
        if execution.backends:
            start_build(registry.EXECUTORS[execution.backend], step)
        return SingleRunPlan(execution, nodes)
    except UnsupportedError as reason:
        sizes = sizes._replace(unsupported=str(reason))
        return SingleRunPlan(choose_plan(request, sizes, machine), 0)
