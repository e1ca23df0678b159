"""Stage 4 of a run: executes batches, their derivatives, and steps from many states.

The functions are called inside `jit`.  Each of them takes a request and inputs, makes the plan and
returns the output.  `compile_batch` makes the plan beforehand and returns a `CompiledBatch`, which
is called any number of times.  `simulate` uses `single_run.run_one` instead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import programs
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import registry
from iblf_jax.engine.adjoint import Cotangents, ReverseRun
from iblf_jax.engine.batch import (
    Batch,
    Stepper,
    carry_shapes,
    carry_without_linearization,
    jacobians,
    run_all,
    split,
)
from iblf_jax.engine.carry import Inputs
from iblf_jax.engine.columns import (
    numbers_of,
    outer_vectors,
    run_by_columns,
    step_of_values,
)
from iblf_jax.engine.compile import (
    building,
    compiled_plan,
    first_that_works,
    inputs_of,
    on_shapes,
    operations,
    plan_of_batch,
    run_by_executor,
    scan_of,
    shapes_of,
    structural_part,
    tree_of_shapes,
)
from iblf_jax.engine.derivatives import (
    DerivativeSizes,
    Directions,
    Tangents,
    choose_derivatives,
    run_with_tangents,
)
from iblf_jax.engine.linearization import jacobian_carry
from iblf_jax.engine.loops import checkpointed, kernel_stepper, program_of, scan
from iblf_jax.engine.outcome import Outcome
from iblf_jax.engine.plan import ExecutionPlan, plan_of_jacobians, plan_of_states
from iblf_jax.engine.registry import Availability, Executor
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.structural_constants import constants_of
from iblf_jax.engine.time_step import TimeStep, positions
from iblf_jax.simulation.closed_loop import LoopState
from iblf_jax.simulation.scenario import Scenario

if TYPE_CHECKING:
    from jax.tree_util import PyTreeDef

    from iblf_jax.simulation.metrics import Fold

T = TypeVar("T")


def run_batch(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
) -> Outcome:
    """Runs a scenario once for every entry of `varied`; call it inside `jit`.

    Args:
      scenario: the scenario that all runs share, canonical.
      varied: path -> values, batch axis first; each run replaces these leaves, and
        `noise.NOISE_NAME`, the key of its noise.
      folds: the metrics.
      dt: time step, () [s].
      request: the request; static.

    Returns:
      An `Outcome` with a leading batch axis on every array.

    Raises:
      ValueError: an unknown backend.
    """
    inputs = inputs_of(scenario, folds, dt, request)
    execution = plan_of_batch(request, varied, registry.machine())
    return first_that_works(
        execution,
        lambda executor: _run_by_executor(executor, inputs, varied, request),
        lambda: _run_by_scan(inputs, varied, request),
    )


def _run_by_executor(
    executor: Executor, inputs: Inputs, varied: Mapping[str, jax.Array], request: RunRequest
) -> Outcome:
    """Runs a batch by an executor."""

    def run(run_steps: Stepper, batch: Batch) -> Outcome:
        return run_all(run_steps, batch, request)

    batch = Batch.of(inputs, varied, request.constants)
    return run_by_executor(executor, batch, request, run)


def _run_by_scan(inputs: Inputs, varied: Mapping[str, jax.Array], request: RunRequest) -> Outcome:
    """Runs a batch by the scan."""
    return run_all(scan_of(inputs), Batch.of(inputs, varied), request)


class CompiledBatch(NamedTuple):
    """The program of a batch, a function of the inputs to call inside `jit`; static.

    The program is that of one executor or of the scan: it is `first_that_works` that falls back, so
    that a program that is kept on the disk is the one that its key states.
    """

    request: RunRequest
    execution: ExecutionPlan
    """The plan, whose `backends` holds the executor that runs the batch; empty for the scan."""

    @property
    def backend(self) -> str:
        """The backend on which the batch runs: "native", "gpu" or "vmap"."""
        return self.execution.backend

    def first_that_works(self, call: Callable[[CompiledBatch], T]) -> T:
        """The value of `call` for this batch, or for that of the scan if the executor fails; call
        it outside of `jit`.

        Args:
          call: function of a batch, which compiles its program.
        """

        def attempt(executor: Executor) -> T:
            with building():
                return call(self)

        def by_scan() -> T:
            return call(self._replace(execution=self.execution._replace(backends=())))

        return first_that_works(self.execution, attempt, by_scan)

    def __call__(
        self,
        scenario: Scenario,
        varied: Mapping[str, jax.Array],
        folds: tuple[Fold, ...],
        dt: jax.Array,
    ) -> Outcome:
        """Runs a scenario once for every entry of `varied`, as `run_batch` does.

        Args:
          scenario, varied, folds, dt: as `run_batch`.

        Raises:
          ToolchainError: the executor is not available.
          UnsupportedError: the executor cannot express the step.
        """
        request = self.request._replace(record_every=None)
        inputs = inputs_of(scenario, folds, dt, request)
        if not self.execution.backends:
            return _run_by_scan(inputs, varied, request)
        return _run_by_executor(registry.EXECUTORS[self.backend], inputs, varied, request)

    def stepper(self, inputs: Inputs, varied: Mapping[str, jax.Array]) -> tuple[Stepper, Batch]:
        """What makes the steps of these runs, and the runs."""
        if not self.execution.backends:
            return scan_of(inputs), Batch.of(inputs, varied)
        batch = Batch.of(inputs, varied, self.request.constants)
        return kernel_stepper(registry.EXECUTORS[self.backend]), batch

    def positions(
        self,
        scenario: Scenario,
        varied: Mapping[str, jax.Array],
        dt: jax.Array,
        record_every: int,
    ) -> dict[str, jax.Array]:
        """The positions, errors and bounds of the same runs (`time_step.positions`), (runs, T, ...)
        each.  Without metrics, status and assessment of the step, less is compiled.

        Args:
          scenario, varied, dt: as `run_batch`.
          record_every: interval of the recorded instants.

        Raises:
          ToolchainError, UnsupportedError: as a call.
        """
        request = self.request._replace(record_every=record_every)
        inputs = inputs_of(scenario, (), dt, request)
        step = TimeStep(request.method, positions)
        run_steps, batch = self.stepper(inputs, varied)
        carry = carry_without_linearization(batch, request.method)
        return run_steps(step, batch, carry, request.instants, record_every)[1]


def compile_batch(
    request: RunRequest,
    scenario: Scenario,
    varied: Mapping[str, Any],
    folds: tuple[Fold, ...],
    dt: jax.Array,
) -> CompiledBatch:
    """Builds the kernels of a batch with the first executor that can run it.

    Args:
      request: the request.
      scenario, folds, dt: as `run_batch`.
      varied: path -> values or their shapes, batch axis first.

    Raises:
      ValueError: an unknown backend.
    """
    leaves, structure = jax.tree.flatten((scenario, dict(varied), folds, dt))
    part = structural_part(request._replace(record_every=None))
    execution = compiled_plan(part, registry.machine(), structure, shapes_of(leaves))
    return CompiledBatch(request, execution)


def run_batch_jvp(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    directions: Mapping[str, Any],
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
) -> Tangents:
    """Runs a batch and differentiates it along P directions in the space of leaves, in one pass;
    call it inside `jit`.

    Args:
      scenario, varied, folds, dt: as `run_batch`.
      directions: path -> (P, *shape of the leaf), concrete numbers, the same for every run:
        direction p changes each of these leaves by its p-th row.  `{"controller.K2": np.eye(2)}`
        differentiates with respect to each entry of a gain of two joints.
      request: the request; static.  On "auto" `choose_derivatives` selects the method; a requested
        executor computes all tangents of a run in one kernel.

    Returns:
      The outcome, name -> (batch, P, *shape) for every metric that is a float, and the Gauss-Newton
      matrices (batch, P, P) of the folds that offer `curvature`.

    Raises:
      ValueError: an unknown backend or path.
    """
    inputs = inputs_of(scenario, folds, dt, request)
    along = Directions.of(directions)
    execution = plan_of_batch(request, varied, registry.machine())

    def attempt(executor: Executor) -> Tangents:
        batch = Batch.of(inputs, varied, request.constants)
        method = "together"
        if request.backend == "auto":
            method = choose_derivatives(_derivative_sizes(executor, batch, along, request))
        if method == "scan":
            return by_scan()
        if method == "one per run":
            return run_by_columns(kernel_stepper(executor), batch, along, request)
        return run_with_tangents(kernel_stepper(executor), batch, along, request)

    def by_scan() -> Tangents:
        return run_with_tangents(scan_of(inputs), Batch.of(inputs, varied), along, request)

    return first_that_works(execution, attempt, by_scan)


def _derivative_sizes(
    executor: Executor, batch: Batch, along: Directions, request: RunRequest
) -> DerivativeSizes:
    """The sizes that decide how an executor computes tangents."""
    carry = carry_shapes(batch, request.method)
    step = step_of_values(batch.leaves.first.folds, request.method)
    nodes = program_of(step, batch, carry).program.size

    def count_kept_numbers() -> int:
        samples = request.instants * (batch.runs or 1)
        return numbers_of(batch.leaves.first, outer_vectors) * along.tangents * samples

    return DerivativeSizes(
        count_kept_numbers,
        nodes_together=nodes * (1 + along.tangents),
        nodes_per_operation=nodes / operations(batch.leaves.first),
        max_nodes=executor.limits.derivative_nodes,
    )


Pullback = Callable[[dict[str, jax.Array]], dict[str, jax.Array]]
"""From the derivatives of a loss by metrics, by name, to those by leaves, by path."""


def run_batch_vjp(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    by: Collection[str],
    metrics: Collection[str],
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
) -> tuple[Outcome, Pullback]:
    """Runs a batch, and prepares its gradients in reverse mode by any number of leaves; call it
    inside `jit`.

    Args:
      scenario, varied, folds, dt: as `run_batch`.
      by: the paths of `varied` by which the runs are differentiated.
      metrics: names of the metrics that are differentiated.
      request: the request, without records; static.

    Returns:
      The outcome, and a function from the derivatives of a loss by these metrics, name -> (batch,
      ...), to its derivatives by the leaves at `by`, path -> (batch, ...).

    Raises:
      ValueError: an unknown backend or path.
    """
    inputs = inputs_of(scenario, folds, dt, request)
    execution = plan_of_batch(request, varied, registry.machine())
    numbers = {path: varied[path] for path in by}

    def attempt(executor: Executor) -> tuple[Outcome, Pullback]:
        batch = Batch.of(inputs, varied, request.constants)
        places = tuple(np.flatnonzero(split(inputs, numbers).is_per_run).tolist())
        run = ReverseRun(executor, batch, places, request)
        if not run.is_supported():
            return by_scan()
        with building():
            run.start_build(metrics)
            outcome, stored = run.forward()

        def leaves_of(numbers: dict[str, jax.Array]) -> list[jax.Array]:
            leaves = split(inputs, {**varied, **numbers})
            merged = leaves.merge(leaves.shared, leaves.per_run)
            return [merged[place] for place in places]

        def pullback(slopes: dict[str, jax.Array]) -> dict[str, jax.Array]:
            gradient = run.backward(stored, Cotangents(slopes))
            return jax.vjp(leaves_of, numbers)[1](gradient)[0]

        return outcome, pullback

    def by_scan() -> tuple[Outcome, Pullback]:
        # The derivative contains the step six times: with the stages of the integrator as a loop,
        # the gradient of 8 runs of 500 steps of the paper's loop by 226 weights of a network
        # compiles in 12 s instead of 22 s of processor time, and takes the same time afterwards.
        run_steps = partial(checkpointed, rolled=True)

        def run(numbers: dict[str, jax.Array]) -> tuple[dict[str, jax.Array], Outcome]:
            outcome = run_all(run_steps, Batch.of(inputs, {**varied, **numbers}), request)
            return {name: outcome.metrics[name] for name in metrics}, outcome

        _, pullback, outcome = jax.vjp(run, numbers, has_aux=True)
        return outcome, lambda slopes: pullback(slopes)[0]

    return first_that_works(execution, attempt, by_scan)


def step_states(
    scenario: Scenario, dt: jax.Array, carry: Any, *, step: Any, steps: int = 1
) -> tuple[Any, Any]:
    """Makes some steps from each of many states.

    Args:
      scenario: the scenario that all states share, canonical.
      dt: time step, () [s].
      carry: the states, as the step takes them, (R, ...).
      step: hashable function (inputs, carry, index, options) -> (carry, records) of one run.
      steps: number of steps.

    Returns:
      The carry after the last step, (R, ...), and the records of every step, (R, steps, ...).
    """
    request = RunRequest(steps)
    if registry.default_backend().reason is None:
        request = request._replace(constants=constants_of(scenario))
    return _step_states(scenario, dt, carry, step=step, request=request)


@programs.jit(static_argnames=("step", "request"))
def _step_states(
    scenario: Scenario, dt: jax.Array, carry: Any, *, step: Any, request: RunRequest
) -> tuple[Any, Any]:
    inputs = inputs_of(scenario, (), dt, request)
    runs = jax.tree.leaves(carry)[0].shape[0]
    batch = Batch.of(inputs, None, request.constants)._replace(runs=runs)
    execution = plan_of_states(operations(inputs), registry.default_backend())

    def by(run_steps: Stepper) -> tuple[Any, Any]:
        return run_steps(step, batch, carry, request.steps, 1)

    by_scan = partial(by, partial(scan, rolled=True))
    return first_that_works(execution, lambda executor: by(kernel_stepper(executor)), by_scan)


def sampled_jacobians(scenario: Scenario, times: jax.Array, states: LoopState) -> jax.Array:
    """The derivatives of `closed_loop.perturbed_rate` of a sampled loop at many states, by the
    kernel that linearizes runs; studies build the same one.

    Args:
      scenario: canonical, with a sampling.
      times: of the states, (R,) [s].
      states: (R, ...).

    Returns:
      (R, m, m), as `stability.jacobian`.
    """
    request = RunRequest(0)
    backend = registry.default_backend()
    if backend.reason is None:
        request = request._replace(constants=constants_of(scenario))
    leaves, structure = jax.tree.flatten((scenario, times, states))
    shapes = shapes_of(leaves)

    def by(name: str) -> jax.Array:
        return _sampled_jacobians(scenario, times, states, backend=name, request=request)

    def attempt(executor: Executor) -> jax.Array:
        with building():
            return by(executor.name)

    execution = _plan_of_jacobians(request, backend, structure, shapes)
    key = (sampled_jacobians, request, structure, shapes)
    return first_that_works(execution, attempt, partial(by, "vmap"), key)


@CACHE.memoised(64)
def _plan_of_jacobians(
    request: RunRequest, backend: Availability, structure: PyTreeDef, shapes: tuple
) -> ExecutionPlan:
    """The plan of `sampled_jacobians`, for the structure of its arguments and the shapes of their
    leaves.
    """

    def count(arguments: tuple[Scenario, jax.Array, LoopState]) -> int:
        scenario, times, _ = arguments
        return operations(inputs_of(_with_short_queue(scenario), (), times[0], request))

    return plan_of_jacobians(lambda: on_shapes(count, tree_of_shapes(structure, shapes)), backend)


def _with_short_queue(scenario: Scenario) -> Scenario:
    """A sampled loop with at most one command in transit.  They have no influence on a derivative,
    and their number would make another kernel.
    """
    sampling: Any = scenario.sampling
    sampling = dataclasses.replace(sampling, queue=min(sampling.queue, 1))
    return dataclasses.replace(scenario, sampling=sampling)


@programs.jit(
    static_argnames=("backend", "request"), options=programs.SHORTEST_TO_COMPILE, kept=True
)
def _sampled_jacobians(
    scenario: Scenario, times: jax.Array, states: LoopState, *, backend: str, request: RunRequest
) -> jax.Array:
    """As `sampled_jacobians`, by the executor of this name or by the scan."""
    scenario = _with_short_queue(scenario)
    inputs = inputs_of(scenario, (), times[0], request)
    starts = {"initial.q": jnp.repeat(scenario.initial.q[None], len(times), axis=0)}
    batch = Batch.of(inputs, starts, request.constants)
    carry = jax.vmap(partial(jacobian_carry, scenario))(times, states)
    run_steps: Stepper = partial(scan, rolled=True)
    if backend in registry.EXECUTORS:
        run_steps = kernel_stepper(registry.EXECUTORS[backend])
    return jacobians(run_steps, batch, carry)
