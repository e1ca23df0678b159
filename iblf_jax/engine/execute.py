"""Runs, batches and their derivatives, executed as `plan` decides.  The physics is written once,
for one run.

    scan     the step as it is: any scenario, any device; a user calls it "vmap"
    xla      the step's scalar program, one (batch,) array a number: any device, nothing needed but
    jax native   the same program as C, built by the system's compiler, SIMD over runs and threads:
    CPU gpu      the same C as a CUDA kernel, one run a thread, built by NVRTC: NVIDIA GPUs

All give the same results.  What a scalar program cannot express runs on scan, and what has no
compiler, or is for another device, on xla; a `BackendWarning` says why, once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, devices, notices
from iblf_jax.engine import gpu, native, plan, xla
from iblf_jax.engine.batch import Batch, Executor, begin, carry_shapes, end, run_all
from iblf_jax.engine.columns import numbers_of, outer_vectors, run_by_columns
from iblf_jax.engine.derivatives import Directions, Tangents, run_with_tangents
from iblf_jax.engine.executors import checkpointed, lowered_on, program_of, scan
from iblf_jax.engine.machine_function import length, machine_function
from iblf_jax.engine.mechanism import Mechanism, known_of
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.step import Carry, Inputs, Outcome, Probed, TimeStep
from iblf_jax.engine.waiting import wait_until_ready
from iblf_jax.kernels import (
    Program,
    Shapes,
    StoppedError,
    ToolchainError,
    UnsupportedError,
    stop_compilers,
    written_out,
)
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.scenario import Scenario

EXECUTORS = {"native": native, "gpu": gpu, "xla": xla}
"""What runs scalar programs."""


class BackendWarning(UserWarning):
    """A batch runs on another backend than was asked for, and why."""


_told: set[str] = set()


def _tell(text: str) -> None:
    if text not in _told:
        _told.add(text)
        notices.warn(text, BackendWarning)


def automatic() -> tuple[str, str | None]:
    """The backend that "auto" takes for what lowers, and why it is not a compiled one, in one line
    (None if it is).
    """
    best = plan.executors_for("auto", devices.platform())[0]
    if best == "xla":
        return best, f"no kernels are compiled for {devices.platform()}"
    reason = EXECUTORS[best].unavailable()
    return ("xla", reason) if reason else (best, None)


def _asked_for(backend: str) -> tuple[str, ...]:
    """The executors that lower a step, best first, for what the user asked for on this platform."""
    checks.one_of("backend", backend, plan.BACKENDS)
    platform = devices.platform()
    if backend in plan.COMPILED.values() and plan.COMPILED.get(platform) != backend:
        _tell(f"The {backend} backend is not for the default device, {platform}: running on xla.")
        backend = "xla"
    return plan.executors_for(backend, platform)


def _first_that_can(
    names: Sequence[str], run_on: Callable, on_scan: Callable, tell: Callable[[str], None]
) -> Any:
    """`run_on` the first of some names that can, or `on_scan()`."""
    for name in names:
        try:
            return run_on(name)
        except ToolchainError as error:
            tell(f"The {name} backend is not available ({error}): running on xla.")
        except UnsupportedError as reason:
            tell(_slower(reason))
            break
    return on_scan()


def _slower(reason: object) -> str:
    return f"This scenario runs on the vmap backend, several times slower: {reason}."


def with_fallback(backend: str, run_on: Callable, on_scan: Callable):
    """`run_on(name)` on the executor that was asked for, or the next one that can; `on_scan()` is
    scan.

    Args:
      backend: one of `plan.BACKENDS`.
      run_on: function of a name in EXECUTORS.
      on_scan: function without arguments.

    Raises:
      ValueError: an unknown backend.
    """
    return _first_that_can(_asked_for(backend), run_on, on_scan, _tell)


def inputs_of(
    scenario: Scenario, folds: Any, dt: jax.Array, run: RunRequest, noise: Any = None
) -> Inputs:
    """What a run is made from; `noise` is the key of a sampled loop's."""
    noise = (
        ()
        if scenario.sampling is None
        else jnp.zeros((4,), dt.dtype)
        if noise is None
        else noise.astype(dt.dtype)
    )
    steps: Any = np.asarray(run.steps, dt.dtype)
    return Inputs(scenario, folds, dt, steps, noise=noise)


def executor_named(name: str) -> Executor:
    """The executor of scalar programs with this name."""
    return (
        lowered_on(native.run, native.pack, native.unpack)
        if name == "native"
        else lowered_on(EXECUTORS[name].run)
    )


def _nodes(name: str, program: Program) -> int:
    """How many an executor's compiler sees: XLA has no functions."""
    return len(written_out(program).nodes) if name == "xla" else program.size


def _lowered_batch(
    inputs: Inputs, varied: Mapping[str, jax.Array], run: RunRequest, nested: bool = False
) -> Batch:
    shape = plan.lowered_shape(
        devices.platform(), operations(inputs), len(next(iter(varied.values()))), nested
    )
    return Batch.of(inputs, varied, shape, run.constants)


def _program(batch: Batch, run: RunRequest) -> Program:
    """What a step of a run does."""
    return program_of(TimeStep.of(run), batch, carry_shapes(batch, run.method)).program


def _build_ahead(batch: Batch, run: RunRequest, program: Program) -> None:
    """Starts to build the longest kernel of a run, beside whatever else is made: compilers use one
    core.
    """
    sizes = Shapes.of(batch.leaves.shared).size, Shapes.of(batch.leaves.lane, 1).size
    native.ahead(program, *sizes, batch.runs or 1, run.steps + 1)


@contextlib.contextmanager
def _compilers_stop_with_it() -> Iterator[None]:
    """What fails, or is interrupted, leaves no compiler behind."""
    try:
        yield
    except BaseException:
        stop_compilers()
        raise


def run_lowered(
    name: str, batch: Batch, run: RunRequest, go: Callable[..., Any] | None = None
) -> Any:
    """All runs on an executor that lowers.

    Args:
      name: of the executor.
      batch, run: what to run.
      go: what is done, a function (executor, batch, run); `run_all` if not given.
    """
    if name == "native":
        _build_ahead(batch, run, _program(batch, run))
    with _compilers_stop_with_it():
        return (go or run_all)(executor_named(name), batch, run)


def operations(inputs: Inputs) -> int:
    """Of one evaluation of the closed loop."""
    zero = jnp.zeros_like(inputs.dt)
    return length(evaluate, inputs.scenario, zero, initial_state(inputs.scenario), zero)


def _shape(inputs: Inputs, runs: int | None, nested: bool) -> plan.Shape:
    """How the scan executor runs them."""
    return plan.scan_shape(devices.platform(), operations(inputs), runs, nested)


def _scanned(
    inputs: Inputs, varied: Mapping[str, jax.Array] | None, nested: bool, run: Callable
) -> Any:
    """`run(batch)` by the scan executor, as one machine function where that pays."""
    shape = _shape(inputs, len(next(iter(varied.values()))) if varied else None, nested)

    def whole(inputs, varied):
        return run(Batch.of(inputs, varied, shape))

    return (machine_function(whole) if shape.function == "whole" else whole)(
        inputs, dict(varied or {})
    )


def run_batch(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    folds: Any,
    dt: jax.Array,
    run: RunRequest,
    *,
    backend: str | None = None,
    nested: bool | None = None,
) -> Outcome:
    """Runs a scenario once for every entry of `varied`; call it inside `jit`.

    Args:
      scenario: the scenario that all runs share, canonical.
      varied: path -> values, batch axis first; each run replaces these leaves, and
        `sampling.NOISE_NAME`, the key of its noise.
      folds: the metrics.
      dt: time step, () [s].
      run: the request, static.
      backend: replaces that of the request.
      nested: replaces that of the request.

    Returns:
      An `Outcome` with a leading batch axis on every array.

    Raises:
      ValueError: an unknown backend.
    """
    run, backend, nested = _with_replaced(run, backend, nested)
    inputs = inputs_of(scenario, folds, dt, run)

    def run_on(name):
        return run_lowered(name, _lowered_batch(inputs, varied, run, nested), run)

    def on_scan():
        return _scanned(inputs, varied, nested, lambda batch: run_all(scan, batch, run))

    return with_fallback(backend, run_on, on_scan)


def _with_replaced(
    request: RunRequest, backend: str | None, nested: bool | None
) -> tuple[RunRequest, str, bool]:
    """The request with another backend and nesting where they are given, and these two."""
    backend = request.backend if backend is None else backend
    nested = request.nested if nested is None else nested
    return request._replace(backend=backend, nested=nested), backend, nested


class CompiledBatch(NamedTuple):
    """The program of a batch: a function of the inputs that is called inside `jit`.  Static."""

    request: RunRequest
    executor: str
    """The executor that runs the batch, "vmap" for the scan."""

    def __call__(
        self,
        scenario: Scenario,
        varied: Mapping[str, jax.Array],
        folds: Any,
        dt: jax.Array,
        *,
        record_every: int | None = None,
    ) -> Outcome:
        """Runs a scenario once for every entry of `varied`, as `run_batch` does.

        Args:
          scenario, varied, folds, dt: as `run_batch`.
          record_every: interval of the recorded instants; None for metrics only.
        """
        request = self.request._replace(record_every=record_every, backend=self.executor)
        return run_batch(scenario, varied, folds, dt, request)


def compile_batch(
    request: RunRequest,
    scenario: Scenario,
    varied: Mapping[str, Any],
    folds: Any,
    dt: jax.Array,
) -> CompiledBatch:
    """The program of a batch on the first executor that can run it; its kernels are built.

    Args:
      request: what is requested of each run.
      scenario, folds, dt: as `run_batch`.
      varied: path -> values or their shapes, batch axis first.

    Raises:
      ValueError: an unknown backend.
    """
    executor = chosen_backend(
        request.backend,
        scenario,
        varied,
        folds,
        dt,
        method=request.method,
        mechanism=request.constants,
    )
    return CompiledBatch(request, executor)


def run_one(
    scenario: Scenario,
    folds: Any,
    dt: jax.Array,
    run: RunRequest,
    *,
    backend: str | None = None,
    noise: Any = None,
) -> Outcome:
    """One run; do not batch or differentiate it from outside.

    Where it is lowered it is compiled in three parts, and only the one in the middle depends on the
    number of steps and what is recorded. A structure whose kernel could not be built is not tried
    again in this process.

    Args:
      scenario, folds, dt, run: as `run_batch`, of one run.
      backend: "native" or "gpu", which fall back with a warning; "xla"; or "auto", the one of the
        first two that is for this platform, where it can be built.  What is long or does not lower
        is, on "auto" and "xla", on scan, without a warning.
      noise: key of a sampled loop's noise.
    """
    backend = run.backend if backend is None else backend
    run = run._replace(backend="auto")  # the same programs for every word
    leaves, structure = jax.tree.flatten(inputs_of(scenario, folds, dt, run, noise))
    shapes = tuple((x.shape, x.dtype) for x in leaves)
    decisive = run._replace(
        steps=plan.NATIVE_FEW if run.steps >= plan.NATIVE_FEW else 0,
        record_every=run.record_every and 1,
    )
    around = run._replace(steps=0, record_every=None)
    names, shape, unsupported = _way_of_one(backend, decisive, automatic(), structure, shapes)

    def in_parts(name):
        way = Way(name, structure, shape)
        try:
            with _compilers_stop_with_it():
                carry, at_start = _before_steps(way, around, leaves)
                carry, records = _all_steps(way, run, leaves, carry)
                return _after_steps(way, around, leaves, carry, at_start)._replace(records=records)
        except ToolchainError as error:
            if not isinstance(error, StoppedError):
                _failed.add((name, structure, shapes))
            raise

    tell = _tell if backend in plan.COMPILED.values() else lambda text: None
    if unsupported:
        tell(_slower(unsupported))
    if _failed:
        names = tuple(name for name in names if (name, structure, shapes) not in _failed)
    outcome = _first_that_can(names, in_parts, lambda: _one_by_scan(structure, run, leaves), tell)
    wait_until_ready(outcome)
    return outcome


_failed: set[tuple] = set()
"""Executor, structure and shapes of the runs whose kernels could not be built."""


class Way(NamedTuple):
    """How one run is executed; static."""

    executor: str
    inputs: Any
    """The tree of the `Inputs`."""
    shape: plan.Shape

    def batch(self, leaves: list, run: RunRequest) -> Batch:
        """The run as a batch, which is what is lowered."""
        return _alone(jax.tree.unflatten(self.inputs, leaves), run, self.shape)


@lru_cache(maxsize=256)
def _way_of_one(
    backend: str, run: RunRequest, available: tuple[str, str | None], structure: Any, shapes: tuple
) -> tuple[tuple[str, ...], plan.Shape, str | None]:
    """The executors that one run is lowered for, best first; its shape; why it does not lower.  The
    first one's kernel is begun.

    All of it depends on structure and shapes, and the trace takes longer than many a run.  Of the
    run's length and record it counts whether there are few steps and whether there is a record.
    """

    def trace(leaves):
        inputs = jax.tree.unflatten(structure, leaves)
        platform, size = devices.platform(), operations(inputs)
        shape = plan.lowered_shape(platform, size, 1, nested=False)
        asked = backend in plan.COMPILED.values()
        compiled = (
            available[0] if backend == "auto" and available[0] in plan.COMPILED.values() else None
        )
        best = plan.executor_of_one_run(compiled, platform, size)
        names = _asked_for(backend) if asked else (best,) if best else ()
        if names:
            try:
                batch = _alone(inputs, run, shape)
                program = _program(batch, run)
                if not asked and not plan.lowers_one_run(names[0], _nodes(names[0], program)):
                    names = ()
                if names[:1] == ("native",):
                    _build_ahead(batch, run, program)
            except UnsupportedError as error:
                found.append(((), shape, str(error)))
                return
        found.append((names, shape, None))

    found: list[tuple[tuple[str, ...], plan.Shape, str | None]] = []
    jax.eval_shape(trace, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    return found[0]


def _alone(inputs: Inputs, run: RunRequest, shape: plan.Shape) -> Batch:
    """One run as a batch, which is what is lowered."""
    return Batch.of(inputs, {"initial.q": inputs.scenario.initial.q[None]}, shape, run.constants)


@partial(jax.jit, static_argnums=(0, 1))
def _before_steps(way: Way, run: RunRequest, leaves: list) -> tuple[Carry, Probed]:
    return begin(executor_named(way.executor), way.batch(leaves, run), run.method)


@partial(jax.jit, static_argnums=(0, 1))
def _steps(way: Way, run: RunRequest, leaves: list, carry: Carry) -> tuple[Carry, Any]:
    carry, records = executor_named(way.executor)(
        TimeStep.of(run), way.batch(leaves, run), carry, run.steps + 1, run.record_every
    )
    return carry, None if run.record_every is None else jax.tree.map(lambda x: x[0], records)


def _all_steps(way: Way, run: RunRequest, leaves: list, carry: Carry) -> tuple[Carry, Any]:
    """All steps of one run, in calls that are short enough for Python to see Ctrl-C between them;
    the numbers are those of one call.
    """
    steps = run.steps + 1
    if way.executor != "native" or steps * plan.LONGEST_ONE_RUN["native"] <= plan.NATIVE_UNSEEN:
        return _steps(way, run, leaves, carry)
    stretch = plan.native_stretch(_nodes_of(way, run, leaves), steps, run.record_every)
    if stretch == steps:
        return _steps(way, run, leaves, carry)
    parts = []
    for first in range(0, steps, stretch):
        part = run._replace(steps=min(stretch, steps - first))
        carry, records = _stretch(way, part, leaves, carry, np.int32(first))
        jax.block_until_ready(carry)
        parts.append(records)
    if run.record_every is None:
        return carry, None
    return carry, jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *parts)


def _nodes_of(way: Way, run: RunRequest, leaves: list) -> int:
    """Nodes of a step's program, which is traced once."""
    shapes = tuple((x.shape, x.dtype) for x in leaves)
    return _nodes_by_structure(
        way, run._replace(steps=0, record_every=run.record_every and 1), shapes
    )


@lru_cache(maxsize=256)
def _nodes_by_structure(way: Way, run: RunRequest, shapes: tuple) -> int:
    found = list[int]()
    jax.eval_shape(
        lambda leaves: found.append(_program(way.batch(leaves, run), run).size),
        [jax.ShapeDtypeStruct(*x) for x in shapes],
    )
    return found[0]


@partial(jax.jit, static_argnums=(0, 1))
def _stretch(
    way: Way, run: RunRequest, leaves: list, carry: Carry, first: jax.Array
) -> tuple[Carry, Any]:
    """`run.steps` steps of one run from step `first` on, by the kernel for many steps."""
    executor = lowered_on(partial(native.run, first=first, narrow=True), native.pack, native.unpack)
    carry, records = executor(
        TimeStep.of(run), way.batch(leaves, run), carry, run.steps, run.record_every
    )
    return carry, None if run.record_every is None else jax.tree.map(lambda x: x[0], records)


@partial(jax.jit, static_argnums=(0, 1))
def _after_steps(
    way: Way, run: RunRequest, leaves: list, carry: Carry, at_start: Probed
) -> Outcome:
    return jax.tree.map(
        lambda x: x[0],
        end(executor_named(way.executor), way.batch(leaves, run), run, carry, at_start),
    )


@partial(jax.jit, static_argnums=(0, 1))
def _one_by_scan(structure: Any, run: RunRequest, leaves: list) -> Outcome:
    return _scanned(
        jax.tree.unflatten(structure, leaves), None, False, lambda batch: run_all(scan, batch, run)
    )


def run_for_reverse(
    scenario: Scenario, folds: Any, dt: jax.Array, run: RunRequest, noise: jax.Array | None = None
) -> Outcome:
    """One run for reverse mode: few states are in memory at a time; `run` records nothing."""
    inputs = inputs_of(scenario, folds, dt, run, noise)
    return run_all(checkpointed, Batch.of(inputs, None, _shape(inputs, None, True)), run)


def run_from(
    scenario: Scenario, dt: jax.Array, carry: Any, *, step: Any, steps: int = 1
) -> tuple[Any, Any]:
    """A step of a kind of its own, made `steps` times from each of many states.

    Args:
      scenario: what all share, canonical.
      dt: time step, () [s].
      carry: the states, as the step takes them, (R, ...).
      step: a function (inputs, carry, index, form) -> (carry, records) of one run, hashable.
      steps: how many.

    Returns:
      The carry after the last, (R, ...), and what every step recorded, (R, steps, ...).
    """
    return _run_from(
        scenario,
        dt,
        carry,
        step=step,
        run=RunRequest(steps, constants=known_of(scenario) if automatic()[0] != "xla" else None),
    )


@partial(jax.jit, static_argnames=("step", "run"))
def _run_from(
    scenario: Scenario, dt: jax.Array, carry: Any, *, step: Any, run: RunRequest
) -> tuple[Any, Any]:
    inputs, steps = inputs_of(scenario, (), dt, run), run.steps
    batch = Batch.of(inputs, None, plan.STATES, run.constants)._replace(
        runs=jax.tree.leaves(carry)[0].shape[0]
    )
    name = automatic()[0]
    if name != "xla" and operations(inputs) <= plan.LONG_EVALUATION:
        try:
            return executor_named(name)(step, batch, carry, steps, 1)
        except (UnsupportedError, ToolchainError):
            pass
    return scan(step, batch, carry, steps, 1)


def run_batch_jvp(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    directions: Mapping[str, Any],
    folds: Any,
    dt: jax.Array,
    run: RunRequest,
    *,
    backend: str | None = None,
    nested: bool | None = None,
) -> Tangents:
    """Values of a batch and their derivatives along P directions in the space of leaves, in one
    pass; call it inside `jit`.

    Args:
      scenario, varied, folds, dt, run, nested: as `run_batch`.
      backend: as `run_batch`; "auto" makes those of long programs (many joints and directions),
        which take minutes to compile, one run a direction.
      directions: path -> (P, *shape of the leaf), concrete numbers, the same for every run:
        direction p moves each of these leaves along its p-th row.  For the derivative by each entry
        of one gain of two joints: `{"controller.K2": np.eye(2)}`.

    Returns:
      The outcome, name -> (batch, P, *shape) for every metric that is a float, and the Gauss-Newton
      matrices (batch, P, P) of the folds that offer `curvature`.

    Raises:
      ValueError: an unknown backend or path.
    """
    run, backend, nested = _with_replaced(run, backend, nested)
    inputs, along = inputs_of(scenario, folds, dt, run), Directions.of(directions)

    def run_on(name):
        batch = _lowered_batch(inputs, varied, run, nested)
        if backend == "auto":
            program, _ = program_of(TimeStep(run.method), batch, carry_shapes(batch, run.method))
            if not plan.lowers_derivatives(name, _nodes(name, program), along.tangents):
                kept = (
                    numbers_of(inputs, outer_vectors)
                    * along.tangents
                    * (run.steps + 1)
                    * (batch.runs or 1)
                )
                by_columns = name in plan.COMPILED.values() and plan.keeps_columns(1, kept)
                return (
                    run_by_columns(executor_named(name), batch, along, run)
                    if by_columns
                    else on_scan()
                )
        return run_with_tangents(executor_named(name), batch, along, run)

    def on_scan():
        return _scanned(
            inputs, varied, nested, lambda batch: run_with_tangents(scan, batch, along, run)
        )

    return with_fallback(backend, run_on, on_scan)


def chosen_backend(
    backend: str,
    scenario: Scenario,
    varied: Mapping[str, Any],
    folds: Any,
    dt: jax.Array,
    *,
    method: str,
    mechanism: Mechanism | None = None,
) -> str:
    """The backend that a batch will run on, fallbacks and their warnings included; builds the
    kernels if it is a compiled one.

    Args:
      backend, scenario, folds, dt, method, mechanism: as `run_batch`, and its `run`.
      varied: path -> values or their shapes, batch axis first.

    Returns:
      "gpu", "native", "xla" or "vmap".

    Raises:
      ValueError: an unknown backend.
    """
    flat, structure = jax.tree.flatten((scenario, dict(varied), folds, dt))
    run = RunRequest(1, method, constants=mechanism)
    return _chosen_backend(
        backend, run, automatic(), structure, tuple((x.shape, x.dtype) for x in flat)
    )


def _up_to_the_end(executor: Executor, batch: Batch, run: RunRequest) -> Any:
    """What needs programs of a batch: the verdict at the end takes none of its own."""
    carry, _ = begin(executor, batch, run.method)
    return executor(TimeStep.of(run), batch, carry, run.steps + 1, None)


def _judge_for_xla(
    step: Any, batch: Batch, carry: Any, steps: int, every: int | None
) -> tuple[Any, Any]:
    """An executor that makes the program and goes no further: XLA has nothing to build ahead."""
    xla.compilable(program_of(step, batch, carry).program)
    return carry, ()


@lru_cache(maxsize=64)
def _chosen_backend(
    backend: str, run: RunRequest, available: tuple[str, str | None], structure: Any, shapes: tuple
) -> str:
    """`chosen_backend` by structure and shapes, on which alone it depends: the trace takes longer
    than many a study.
    """

    def trace(leaves):
        scenario, varied, folds, dt = jax.tree.unflatten(structure, leaves)

        def run_on(name):
            batch = _lowered_batch(inputs_of(scenario, folds, dt, run), varied, run)
            if name == "xla":
                _up_to_the_end(_judge_for_xla, batch, run)
            else:
                run_lowered(name, batch, run, go=_up_to_the_end)
            return name

        found.append(with_fallback(backend, run_on, lambda: "vmap"))

    found: list[str] = []
    jax.eval_shape(trace, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    return found[-1]
