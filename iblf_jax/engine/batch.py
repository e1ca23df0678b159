"""A batch of runs, or one: which leaves differ between the runs, and the sequence from the start to
the outcome, whatever loop makes the steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.engine.carry import Carry, Inputs, start
from iblf_jax.engine.linearization import (
    Linearization,
    LinearizationStep,
    linearization_at,
    linearization_steps,
)
from iblf_jax.engine.machine_function import machine_function
from iblf_jax.engine.outcome import Outcome, outcome_of
from iblf_jax.engine.plan import PLAIN_LAYOUT, BatchLayout
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.structural_constants import StructuralConstants
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.simulation import error_estimate
from iblf_jax.simulation.closed_loop import initial_state, perturbed_state
from iblf_jax.simulation.noise import NOISE_NAME
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.stability import resolved_jacobian


class Leaves(NamedTuple):
    """The leaves of a pytree, in two groups: those that all runs share and those of each run."""

    treedef: Any
    is_per_run: tuple[bool, ...]
    """Of every leaf, whether it differs between runs."""
    shared: list[jax.Array]
    per_run: list[jax.Array]
    """With a leading batch axis."""

    @staticmethod
    def of(treedef: Any, is_per_run: Sequence[bool], leaves: Sequence[jax.Array]) -> Leaves:
        """From all leaves of a pytree, in its order."""
        groups: dict[bool, list[jax.Array]] = {False: [], True: []}
        for leaf, differs in zip(leaves, is_per_run, strict=True):
            groups[bool(differs)].append(leaf)
        return Leaves(treedef, tuple(is_per_run), groups[False], groups[True])

    def merged(self, shared: Sequence, per_run: Sequence) -> list:
        """Leaves of the two groups in the order of the pytree."""
        sources = {False: iter(shared), True: iter(per_run)}
        return [next(sources[differs]) for differs in self.is_per_run]

    def together(self, shared: Sequence, per_run: Sequence):
        """The pytree again, from one run's leaves."""
        return jax.tree.unflatten(self.treedef, self.merged(shared, per_run))

    @property
    def first(self):
        """The pytree of the first run."""
        return self.together(self.shared, [x[0] for x in self.per_run])


def split(inputs: Inputs, varied: Mapping[str, jax.Array]) -> Leaves:
    """The leaves of what runs are computed from: those that `varied` replaces in the scenario
    become one value a run.
    """
    before, treedef = jax.tree.flatten(inputs)
    if not varied:
        return Leaves.of(treedef, [False] * len(before), before)

    def replaced(values):
        leaves = {path: x for path, x in values.items() if path != NOISE_NAME}
        noise = inputs.noise
        if NOISE_NAME in values:
            noise = values[NOISE_NAME].astype(inputs.dt.dtype)
        scenario = with_parameters(inputs.scenario, leaves)
        return jax.tree.leaves(inputs._replace(scenario=scenario, noise=noise))

    # A leaf that no path replaces is the same object, which `vmap` hands on as it is.
    is_per_run: list[bool] = []

    def of_run(values):
        after = replaced(values)
        is_per_run[:] = [new is not old for new, old in zip(after, before, strict=True)]
        return [new for new, differs in zip(after, is_per_run, strict=True) if differs]

    per_run = jax.vmap(of_run)(dict(varied))
    shared = [x for x, differs in zip(before, is_per_run, strict=True) if not differs]
    return Leaves(treedef, tuple(is_per_run), shared, list(per_run))


class Batch(NamedTuple):
    """Runs that are stepped together."""

    leaves: Leaves
    """Of their `Inputs`."""
    runs: int | None
    """None: one run, and no array has a run axis."""
    layout: BatchLayout = PLAIN_LAYOUT
    """How its parts are compiled."""
    constants: StructuralConstants | None = None
    """Which numbers of the scenario are compiled in."""

    @staticmethod
    def of(
        inputs: Inputs,
        varied: Mapping[str, jax.Array] | None,
        layout: BatchLayout = PLAIN_LAYOUT,
        constants: StructuralConstants | None = None,
    ) -> Batch:
        """A run for every entry of `varied` (path -> values, batch axis first), or one run."""
        if not varied:
            return Batch(split(inputs, {}), None, layout, constants)
        runs = jax.tree.leaves(dict(varied))[0].shape[0]
        return Batch(split(inputs, varied), runs, layout, constants)

    @property
    def known(self) -> tuple:
        """What is known of the shared numbers."""
        if self.constants is None:
            return ()
        shapes = self.leaves.merged(
            [x.shape for x in self.leaves.shared], [x.shape[1:] for x in self.leaves.per_run]
        )
        return self.constants.of_shared(self.leaves.is_per_run, [math.prod(x) for x in shapes])

    @property
    def dtype(self):
        """The floating-point type."""
        return self.leaves.shared[-1].dtype

    def each(self, function: Callable, *args: Any) -> Any:
        """function(inputs, *args) for every run; arguments and results have the run axis first."""

        def one(per_run, *rest):
            return function(self.leaves.together(self.leaves.shared, per_run), *rest)

        if self.runs is None:
            return one([], *args)
        if self.layout.mapping == "map":
            return jax.lax.map(lambda each: one(*each), (self.leaves.per_run, *args))
        together = jax.vmap(one, axis_size=self.runs)
        if self.layout.machine_functions == "parts":
            together = machine_function(together)
        return together(self.leaves.per_run, *args)


StepLoop = Callable[[Any, Batch, Any, int, int | None], tuple[Any, Any]]
"""The loop over all steps of a batch: a function (step, batch, carry, steps, every) -> (carry after
the last step, records of every `every`-th step from the first on).

All arrays have the run axis first, records then the time axis; `every` is None where nothing is
recorded."""


def _linearized(loop: StepLoop, batch: Batch, carry: Linearization) -> Linearization:
    """What a `LinearizationStep` of every run has found."""
    batch = _linearized_batch(batch)
    steps = linearization_steps(batch.leaves.first.scenario)
    return loop(LinearizationStep(), batch, carry, steps, None)[0]


def _linearized_batch(batch: Batch) -> Batch:
    """The batch with the inputs alone that a `LinearizationStep` reads, and without derivatives, so
    that one program of it serves all metrics and derivatives.
    """
    leaves = batch.leaves
    numbered: Inputs = jax.tree.unflatten(leaves.treedef, range(len(leaves.is_per_run)))
    kept, treedef = jax.tree.flatten(numbered._replace(folds=(), noise=(), direction=()))
    values = leaves.merged(leaves.shared, leaves.per_run)
    is_per_run = [leaves.is_per_run[i] for i in kept]
    constants = jax.lax.stop_gradient([values[i] for i in kept])
    return batch._replace(leaves=Leaves.of(treedef, is_per_run, constants))


def _initial_linearization(batch: Batch, method: str) -> Linearization:
    """The carry of a `LinearizationStep` at the start of every run."""

    def of_run(inputs):
        estimate = error_estimate.unresolved_signals(
            inputs.scenario, method, inputs.dt, inputs.steps
        )
        state = initial_state(inputs.scenario)
        watched = error_estimate.watched_indices(state).size
        return linearization_at(
            jnp.zeros_like(inputs.dt), perturbed_state(state), watched, estimate
        )

    return batch.each(of_run)


def linearization_batch(batch: Batch, method: str) -> tuple[Batch, Linearization]:
    """The batch of the `LinearizationStep`s of some runs, and the shapes of their carry."""
    return _linearized_batch(batch), jax.eval_shape(lambda: _initial_linearization(batch, method))


def initialize(loop: StepLoop, batch: Batch, method: str) -> tuple[Carry, Linearization]:
    """The carry before the first step, and what a `LinearizationStep` has found at the start."""
    found = _linearized(loop, batch, _initial_linearization(batch, method))

    def of_run(inputs, found):
        is_sampled = inputs.scenario.sampling is not None
        return start(inputs, method, resolved_jacobian(found.jacobian, is_sampled))

    return batch.each(of_run, found), found


def carry_shapes(batch: Batch, method: str) -> Carry:
    """Shapes and types of the carry."""

    def of_run(inputs):
        size = error_estimate.watched_indices(initial_state(inputs.scenario)).size
        return start(inputs, method, jnp.zeros((size, size), inputs.dt.dtype))

    return jax.eval_shape(lambda: batch.each(of_run))


def finalize(
    loop: StepLoop, batch: Batch, request: RunRequest, carry: Carry, at_start: Linearization
) -> Outcome:
    """The outcome after the last step, without records; `at_start` is the linearization there."""

    def critical_instants(inputs, carry):
        watched = at_start.jacobian.shape[-1]
        no_estimate = error_estimate.UnresolvedSignals(*[jnp.zeros_like(carry.accuracy.error)] * 3)
        nearest, end = carry.nearest, inputs.dt * inputs.steps
        instants = (
            linearization_at(nearest.t, nearest.state, watched, no_estimate),
            linearization_at(end, perturbed_state(carry.state), watched, no_estimate),
        )
        return jax.tree.map(lambda *xs: jnp.stack(xs), *instants)

    def outcome(inputs, carry, at_start, later):
        instants = jax.tree.map(lambda one, two: jnp.concatenate([one[None], two]), at_start, later)
        return outcome_of(inputs, request.method, carry, at_start.unresolved, instants)

    # Both instants of a run are linearized as two runs, by the program that linearized the start.
    per_run = [jnp.repeat(x, 2, axis=0) for x in batch.leaves.per_run]
    leaves = batch.leaves._replace(per_run=per_run)
    twice = batch._replace(leaves=leaves, runs=2 * (batch.runs or 1))
    instants = batch.each(critical_instants, carry)
    if batch.runs is None:
        later = _linearized(loop, twice, instants)
    else:
        in_a_row = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), instants)
        later = _linearized(loop, twice, in_a_row)
        later = jax.tree.map(lambda x: x.reshape(-1, 2, *x.shape[1:]), later)
    return batch.each(outcome, carry, at_start, later)


def run_all(loop: StepLoop, batch: Batch, request: RunRequest) -> Outcome:
    """All runs, from the start to the outcome."""
    outcome, records = run_step(loop, batch, TimeStep.of(request), request)
    if request.record_every is None:
        return outcome
    return outcome._replace(records=records)


def run_step(
    loop: StepLoop, batch: Batch, step: TimeStep, request: RunRequest
) -> tuple[Outcome, Any]:
    """All runs by a step that may record something else; the outcome, and the records apart."""
    carry, at_start = initialize(loop, batch, request.method)
    carry, records = loop(step, batch, carry, request.steps + 1, request.record_every)
    return finalize(loop, batch, request, carry, at_start), records
