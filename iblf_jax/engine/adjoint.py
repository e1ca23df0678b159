"""Reverse mode by kernels: gradients of a batch of runs by any number of leaves.

With a step x' = f(x, p), the cotangents l of the state and the gradient g by the leaves p follow
backwards in time:

    l = (df/dx)^T l',      g = g' + (df/dp)^T l'.

This is a step as any other (`AdjointStep`), which an executor lowers and compiles.  It reads the
state x of its instant, so a gradient takes three passes:

1. The run, which stores the carry at the start of every segment (`RecordingStep`).
2. From the last segment on, the steps of a segment once more, of which every carry is recorded.
3. The adjoint steps of this segment, backwards over the records.

With segments of about sqrt(steps) steps, the memory grows as the square root of their number.  Each
run has a gradient of its own, which does not depend on the runs beside it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.status import Status
from iblf_jax.engine import thresholds
from iblf_jax.engine.batch import Batch, carry_shapes, finalize, initialize
from iblf_jax.engine.carry import (
    Carry,
    Inputs,
    Step,
    StepOptions,
    carry_without_accuracy,
    tree_where,
)
from iblf_jax.engine.columns import float_metrics, floats_of
from iblf_jax.engine.compile import operations
from iblf_jax.engine.derivatives import floats_of_carry
from iblf_jax.engine.linearization import Linearization
from iblf_jax.engine.loops import kernel_stepper, program_of, rows_of_leaves
from iblf_jax.engine.outcome import Outcome
from iblf_jax.engine.registry import Executor
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import Packed, Program, Shapes

if TYPE_CHECKING:
    from jax.tree_util import PyTreeDef


class Form(NamedTuple):
    """The structure of the carry of one run; hashable."""

    treedef: PyTreeDef
    shapes: Shapes

    @staticmethod
    def of(carry: object) -> Form:
        """Of a carry with a leading run axis."""
        leaves, treedef = jax.tree.flatten(carry)
        return Form(treedef, Shapes.of(leaves, 1))

    def carry_shapes(self, runs: int) -> Any:
        """The shapes of the carry of so many runs."""
        structs = [
            jax.ShapeDtypeStruct((runs, *shape), dtype) for shape, dtype in self.shapes.items
        ]
        return jax.tree.unflatten(self.treedef, structs)

    def as_floats(self, dtype: np.dtype) -> Shapes:
        """The shapes of the leaves, all of them floats."""
        return Shapes(tuple((shape, np.dtype(dtype)) for shape, _ in self.shapes.items))

    def from_floats(self, leaves: Sequence[jax.Array]) -> Any:
        """The carry of one run, from leaves that are all floats."""
        types = [dtype for _, dtype in self.shapes.items]
        typed = [x.astype(dtype) for x, dtype in zip(leaves, types, strict=True)]
        return jax.tree.unflatten(self.treedef, typed)


@dataclasses.dataclass(frozen=True)
class RecordingStep(Step):
    """A step that records the carry before it, as one vector of floats."""

    step: TimeStep

    def __call__(self, inputs: Inputs, carry: Carry, index: jax.Array, options: StepOptions):
        """The carry after the step, and the one before it."""
        after, _ = self.step(inputs, carry, index, options)
        numbers = [jnp.ravel(x).astype(inputs.dt.dtype) for x in jax.tree.leaves(carry)]
        return after, jnp.concatenate(numbers)


class Adjoint(NamedTuple):
    """The carry of an `AdjointStep`."""

    cotangent: list[jax.Array]
    """l, of the floats of the carry."""
    gradient: list[jax.Array]
    """g, by each leaf."""


@dataclasses.dataclass(frozen=True)
class AdjointStep(Step):
    """The adjoint of a step of one run.  The first one is that of the last instant.

    A run that diverges keeps its last valid state.  The derivatives of a step that it does not make
    need not be finite; such a step contributes nothing.
    """

    step: TimeStep
    places: tuple[int, ...]
    """Indices of the leaves of the inputs by which the run is differentiated."""
    form: Form
    """Of the carry of the step."""
    recorded: tuple[int, ...] = ()
    """Indices of the floats of a record that have cotangents."""
    is_derivative: ClassVar[bool] = True

    def __call__(
        self,
        inputs: Inputs,
        carry: Adjoint,
        index: jax.Array,
        options: StepOptions,
        series: list[jax.Array],
    ):
        """The adjoint before the step; nothing is recorded.

        Args:
          inputs: of the run.
          carry: the adjoint after the step.
          index: number of the adjoint step.
          options: of the step.
          series: the leaves of the carry before the step, as floats, and the cotangents of what it
            records.
        """
        size = len(self.form.shapes.items)
        floats, replaced = floats_of_carry(self.form.from_floats(series[:size]))
        instant = inputs.steps.astype(index.dtype) - index
        leaves = jax.tree.leaves(inputs)

        def made(parameters, floats):
            moved = with_leaves(inputs, self.places, parameters)
            after, record = self.step(moved, replaced(floats), instant, options)
            found = floats_of(record)
            return (floats_of_carry(after)[0], [found[i] for i in self.recorded]), after.status

        parameters = [leaves[place] for place in self.places]
        _, pullback, status = jax.vjp(made, parameters, floats, has_aux=True)
        by_leaves, cotangent = pullback((carry.cotangent, series[size:]))
        is_made = status & int(Status.NOT_FINITE) == 0
        total = sum(map(jnp.sum, [*cotangent, *by_leaves]), jnp.zeros_like(inputs.dt))
        counts = is_made | jnp.isfinite(total)
        by_leaves = tree_where(counts, by_leaves, jax.tree.map(jnp.zeros_like, by_leaves))
        gradient = jax.tree.map(jnp.add, carry.gradient, by_leaves)
        return Adjoint(tree_where(counts, cotangent, carry.cotangent), gradient), ()


def with_leaves(inputs: Inputs, places: Sequence[int], values: Sequence[jax.Array]) -> Inputs:
    """The inputs with other leaves at some places."""
    leaves, treedef = jax.tree.flatten(inputs)
    for place, value in zip(places, values, strict=True):
        leaves[place] = value
    return jax.tree.unflatten(treedef, leaves)


class Cotangents(NamedTuple):
    """Derivatives of a loss by what runs return, with a leading run axis."""

    metrics: Mapping[str, jax.Array]
    """By name; metrics without one do not contribute."""
    records: Mapping[int, jax.Array] = {}
    """By the index of a float of the records, (runs, samples, ...)."""


class ReverseRun(NamedTuple):
    """Runs that are differentiated in reverse mode by an executor."""

    executor: Executor
    """It accepts a series."""
    batch: Batch
    places: tuple[int, ...]
    """Indices of the leaves of the inputs by which the runs are differentiated."""
    request: RunRequest

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.batch.runs or 1

    def is_supported(self) -> bool:
        """Whether the executor differentiates the runs in reverse mode."""
        if not self.executor.accepts_series:
            return False
        if self.request.backend != "auto":
            return True
        method = self.request.method
        step = program_of(TimeStep(method), self.batch, carry_shapes(self.batch, method))
        nodes = step.program.size
        if nodes > thresholds.MAX_NODES_PER_OPERATION * operations(self.batch.leaves.first):
            return False
        limit = self.executor.limits.derivative_nodes
        return thresholds.is_within(thresholds.ADJOINT_NODES * nodes, limit)

    def forward(self) -> tuple[Outcome, Stored]:
        """The outcome, without records, and what the way back needs."""
        stored, at_start = self.stored()
        run_steps = kernel_stepper(self.executor)
        return finalize(run_steps, self.batch, self.request, stored.carry, at_start), stored

    def stored(self) -> tuple[Stored, Linearization]:
        """What the way back needs, and the linearization at the start."""
        run_steps = kernel_stepper(self.executor)
        before, at_start = initialize(run_steps, self.batch, self.request.method)
        form = Form.of(before)
        segment = self.segment(form)
        packed = self.executor.pack(
            jax.tree.leaves(before), form.shapes, self.batch.dtype, self.runs
        )
        program = self.recording_program(form)
        after, (carries,) = self.runner()(program, packed, self.request.instants, segment)
        leaves = self.executor.unpack(after, form.shapes, self.runs)
        return Stored(jax.tree.unflatten(form.treedef, leaves), carries), at_start

    def backward(self, stored: Stored, cotangents: Cotangents) -> list[jax.Array]:
        """The gradient of every run by each leaf, (runs, ...)."""
        adjoint = self.batch.map_runs(self._end, stored.carry, cotangents.metrics)
        records = cotangents.records
        form = Form.of(stored.carry)
        recording = self.recording_program(form)
        program = self.adjoint_program(form, adjoint, records)
        run, steps, segment = self.runner(), self.request.instants, self.segment(form)

        def of_segment(after: Packed, number: jax.Array | int, count: int) -> Packed:
            first = number * segment
            numbers = stored.carries[number]  # as a `RecordingStep` has recorded them
            is_float = np.asarray([kind == "f" for kind in form.shapes.kinds()])
            start = Packed(numbers[is_float], numbers[~is_float].astype(jnp.int32))
            _, (series,) = run(recording, start, count, 1, first=first)
            if records:
                series = jnp.concatenate([series, self._of_records(records, first, count)], axis=1)
            return run(program, after, count, None, first=steps - first - count, series=series)[0]

        flat, treedef = jax.tree.flatten(adjoint)
        shapes = Shapes.of(flat, 1)
        packed = self.executor.pack(flat, shapes, self.batch.dtype, self.runs)
        segments = checks.ceil_div(steps, segment)
        packed = of_segment(packed, segments - 1, steps - (segments - 1) * segment)
        packed, _ = jax.lax.scan(
            lambda after, number: (of_segment(after, number, segment), None),
            packed,
            jnp.arange(segments - 1, dtype=jnp.int32),
            reverse=True,
        )
        unpacked = self.executor.unpack(packed, shapes, self.runs)
        return self.batch.map_runs(self._start, jax.tree.unflatten(treedef, unpacked))

    def start_build(self, metrics: Collection[str]) -> None:
        """Lowers both programs, and starts to compile the longer one in the background.

        Args:
          metrics: names of the metrics that will have cotangents.

        Raises:
          UnsupportedError: a step cannot be lowered.
        """
        carry = carry_shapes(self.batch, self.request.method)
        form = Form.of(carry)
        self.recording_program(form)

        def adjoint(carry: Carry) -> Adjoint:
            found = self.batch.map_runs(float_metrics, carry)
            return self.batch.map_runs(self._end, carry, {name: found[name] for name in metrics})

        program = self.adjoint_program(form, jax.eval_shape(adjoint, carry), {})
        leaves = self.batch.leaves
        sizes = Shapes.of(leaves.shared).size, Shapes.of(leaves.per_run, 1).size
        if self.executor.start_build:
            steps = self.request.instants
            self.executor.start_build(program, *sizes, self.runs, steps, form.shapes.size)

    def segment(self, form: Form) -> int:
        """Steps of a segment."""
        size = form.shapes.size * self.runs * self.batch.dtype.itemsize
        return thresholds.segment_steps(self.request.instants, size)

    def runner(self) -> Callable:
        """`executor.run` for the leaves of the batch, which are packed once: a function (program,
        carry, steps, every, **options).
        """
        bytes_of_runs = self.runs * self.batch.dtype.itemsize
        short = thresholds.uses_short_vector(bytes_of_runs, self.request.instants)
        rows = rows_of_leaves(self.executor, self.batch)

        def run(program: Program, carry: Packed, steps: int, every: int | None, **options: Any):
            return self.executor.run(
                program, *rows, carry, steps, every, short_vector=short, **options
            )

        return run

    def recording_program(self, form: Form) -> Program:
        """The program of the step, which records its carry."""
        step = RecordingStep(TimeStep(self.request.method))
        return program_of(step, self.batch, form.carry_shapes(self.runs)).program

    def adjoint_program(self, form: Form, adjoint: Adjoint, records: Mapping) -> Program:
        """The program of an adjoint step, for cotangents of these records."""
        step = TimeStep(self.request.method)
        if records:
            step = TimeStep.of(self.request)
        series = form.as_floats(self.batch.dtype).items + Shapes.of(list(records.values()), 2).items
        reversed_step = AdjointStep(step, self.places, form, tuple(records))
        return program_of(reversed_step, self.batch, adjoint, Shapes(series)).program

    def _parameters(self, inputs: Inputs) -> list[jax.Array]:
        """The leaves of one run by which it is differentiated."""
        leaves = jax.tree.leaves(inputs)
        return [leaves[place] for place in self.places]

    def _end(self, inputs: Inputs, carry: Carry, cotangents: Mapping[str, jax.Array]) -> Adjoint:
        """The adjoint of one run after its last step."""
        floats, replaced = floats_of_carry(carry)

        def metrics(parameters, floats):
            moved = with_leaves(inputs, self.places, parameters)
            found = float_metrics(moved, replaced(floats))
            return {name: found[name] for name in cotangents}

        _, pullback = jax.vjp(metrics, self._parameters(inputs), floats)
        gradient, cotangent = pullback(dict(cotangents))
        return Adjoint(cotangent, gradient)

    def _start(self, inputs: Inputs, adjoint: Adjoint) -> list[jax.Array]:
        """The gradient of one run, from its adjoint before the first step."""

        def floats_at_start(parameters):
            moved = with_leaves(inputs, self.places, parameters)
            return floats_of_carry(carry_without_accuracy(moved, self.request.method))[0]

        _, pullback = jax.vjp(floats_at_start, self._parameters(inputs))
        (by_start,) = pullback(adjoint.cotangent)
        return jax.tree.map(jnp.add, adjoint.gradient, by_start)

    def _of_records(
        self, records: Mapping[int, jax.Array], first: jax.Array | int, count: int
    ) -> jax.Array:
        """The cotangents of what `count` steps record, (steps, numbers, runs)."""
        every = self.request.record_every or 1
        index = first + jnp.arange(count, dtype=jnp.int32)

        def of_steps(x: jax.Array) -> jax.Array:
            rows = x[:, index // every].reshape(self.runs, count, -1).transpose(1, 2, 0)
            return jnp.where((index % every == 0)[:, None, None], rows, 0.0)

        return jnp.concatenate([of_steps(x) for x in records.values()], axis=1)


class Stored(NamedTuple):
    """What a run stores for the way back."""

    carry: Carry
    """After the last step."""
    carries: jax.Array
    """Before the first step of every segment, (segments, numbers, runs)."""
