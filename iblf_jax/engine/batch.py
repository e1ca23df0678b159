"""A batch of runs, or a single run: its leaves, and the sequence from the start to the outcome.

`run_all` calls `initialize`, a `Stepper` and `finalize`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.engine.carry import Carry, Inputs, carry_without_accuracy, initial_carry
from iblf_jax.engine.linearization import (
    Linearization,
    LinearizationStep,
    fastest_modes,
    linearization_at,
    linearization_steps,
)
from iblf_jax.engine.outcome import Outcome, outcome_of
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.structural_constants import StructuralConstants
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.simulation import error_estimate
from iblf_jax.simulation.closed_loop import initial_state, perturbed_state
from iblf_jax.simulation.noise import NOISE_NAME, realised
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.stability import resolved_jacobian

if TYPE_CHECKING:
    from jax.tree_util import PyTreeDef


class Leaves(NamedTuple):
    """The leaves of a pytree in two groups: shared by all runs, and different for each run."""

    treedef: PyTreeDef
    is_per_run: tuple[bool, ...]
    """Whether each leaf of the pytree differs between runs."""
    shared: list[jax.Array]
    per_run: list[jax.Array]
    """The leaves that differ, with a leading batch axis."""

    @staticmethod
    def of(treedef: PyTreeDef, is_per_run: Sequence[bool], leaves: Sequence[jax.Array]) -> Leaves:
        """From all leaves of a pytree, in the order of the pytree."""
        groups: dict[bool, list[jax.Array]] = {False: [], True: []}
        for leaf, differs in zip(leaves, is_per_run, strict=True):
            groups[bool(differs)].append(leaf)
        return Leaves(treedef, tuple(is_per_run), groups[False], groups[True])

    def merge(self, shared: Sequence, per_run: Sequence) -> list:
        """The leaves of both groups in the order of the pytree."""
        sources = {False: iter(shared), True: iter(per_run)}
        return [next(sources[differs]) for differs in self.is_per_run]

    def unflatten(self, shared: Sequence, per_run: Sequence):
        """The pytree of one run, from its shared and its per-run leaves."""
        return jax.tree.unflatten(self.treedef, self.merge(shared, per_run))

    @property
    def first(self):
        """The pytree of the first run."""
        return self.unflatten(self.shared, [x[0] for x in self.per_run])


def split(inputs: Inputs, varied: Mapping[str, jax.Array]) -> Leaves:
    """The leaves of the inputs; the leaves that `varied` replaces in the scenario become per-run
    leaves.
    """
    before, treedef = jax.tree.flatten(inputs)
    if not varied:
        return Leaves.of(treedef, [False] * len(before), before)

    def replaced(values):
        leaves = {path: x for path, x in values.items() if path != NOISE_NAME}
        noise_key = inputs.noise_key
        if NOISE_NAME in values:
            noise_key = values[NOISE_NAME].astype(inputs.dt.dtype)
        scenario = with_parameters(inputs.scenario, leaves)
        if NOISE_NAME in values:
            scenario = realised(scenario, noise_key)
        return jax.tree.leaves(inputs._replace(scenario=scenario, noise_key=noise_key))

    # A leaf that no path replaces stays the same object, also under `vmap`.
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
    """The leaves of the `Inputs` of all runs."""
    runs: int | None
    """Number of runs; None for a single run, whose arrays have no run axis."""
    constants: StructuralConstants | None = None
    """The numbers of the scenario that are compiled in."""

    @staticmethod
    def of(
        inputs: Inputs,
        varied: Mapping[str, jax.Array] | None,
        constants: StructuralConstants | None = None,
    ) -> Batch:
        """A run for every entry of `varied` (path -> values, batch axis first), or one run."""
        if not varied:
            return Batch(split(inputs, {}), None, constants)
        runs = jax.tree.leaves(dict(varied))[0].shape[0]
        return Batch(split(inputs, varied), runs, constants)

    @property
    def shared_constants(self) -> tuple:
        """The structural constants among the shared numbers."""
        if self.constants is None:
            return ()
        leaves = self.leaves
        sizes = leaves.merge(
            [x.size for x in leaves.shared], [math.prod(x.shape[1:]) for x in leaves.per_run]
        )
        return self.constants.of_shared(leaves.is_per_run, sizes)

    @property
    def dtype(self):
        """The floating-point type."""
        return self.leaves.shared[-1].dtype

    def map_runs(self, function: Callable, *args: Any) -> Any:
        """`function(inputs, *args)` of every run; arguments and results have a leading run axis."""

        def one(per_run, *rest):
            return function(self.leaves.unflatten(self.leaves.shared, per_run), *rest)

        if self.runs is None:
            return one([], *args)
        if self.runs == 1:
            # `vmap` of one run costs an eighth of a first call: JAX batches what it has traced.
            only = jax.tree.map(lambda x: x[0], (self.leaves.per_run, *args))
            return jax.tree.map(lambda x: x[None], one(*only))
        return jax.vmap(one, axis_size=self.runs)(self.leaves.per_run, *args)


Stepper = Callable[[Any, Batch, Any, Any, int | None], tuple[Any, Any]]
"""Makes all steps of a batch: a function (step, batch, carry, steps, every) -> (carry after the
last step, records).

The first step and every `every`-th one after it are recorded; None records nothing.  All arrays
have a leading run axis, which the time axis of the records follows."""


def _linearized(run_steps: Stepper, batch: Batch, carry: Linearization) -> Linearization:
    """The linearization of every run, after all `LinearizationStep`s."""
    batch = _linearized_batch(batch)
    steps = linearization_steps(batch.leaves.first.scenario)
    carry, columns = run_steps(LinearizationStep(), batch, carry, steps, 1)
    return carry.with_columns(columns)


def _linearized_batch(batch: Batch) -> Batch:
    """The batch with only the inputs that a `LinearizationStep` reads, and without derivatives, so
    that the same program serves all metrics and derivatives.
    """
    leaves = batch.leaves
    indices: Inputs = jax.tree.unflatten(leaves.treedef, range(len(leaves.is_per_run)))
    kept, treedef = jax.tree.flatten(indices._replace(folds=(), noise_key=(), direction=()))
    values = leaves.merge(leaves.shared, leaves.per_run)
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

    return batch.map_runs(of_run)


def linearization_batch(batch: Batch, method: str) -> tuple[Batch, Linearization]:
    """The batch and the shapes of the carry of the `LinearizationStep`s of a batch."""
    return _linearized_batch(batch), jax.eval_shape(lambda: _initial_linearization(batch, method))


def initialize(run_steps: Stepper, batch: Batch, method: str) -> tuple[Carry, Linearization]:
    """The carry before the first step, and the linearization at the start."""
    at_start = _linearized(run_steps, batch, _initial_linearization(batch, method))

    def of_run(inputs, at_start):
        is_sampled = inputs.scenario.sampling is not None
        return initial_carry(inputs, method, resolved_jacobian(at_start.jacobian, is_sampled))

    return batch.map_runs(of_run, at_start), at_start


def carry_without_linearization(batch: Batch, method: str) -> Carry:
    """The carry before the first step, with an error estimate that has no meaning."""
    return batch.map_runs(lambda inputs: carry_without_accuracy(inputs, method))


def carry_shapes(batch: Batch, method: str) -> Carry:
    """Shapes and types of the carry of a `TimeStep`."""
    return jax.eval_shape(lambda: carry_without_linearization(batch, method))


def finalize(
    run_steps: Stepper, batch: Batch, request: RunRequest, carry: Carry, at_start: Linearization
) -> Outcome:
    """The outcome after the last step, without records; `at_start` is the linearization at the
    start of the run.
    """

    def at_nearest_and_end(inputs, carry):
        watched = at_start.jacobian.shape[-1]
        error = carry.accuracy.error
        no_estimate = error_estimate.UnresolvedSignals.zero(error.size, error.dtype)
        nearest = carry.nearest
        end = inputs.dt * inputs.steps
        pair = (
            linearization_at(nearest.t, nearest.state, watched, no_estimate),
            linearization_at(end, perturbed_state(carry.state), watched, no_estimate),
        )
        return jax.tree.map(lambda *xs: jnp.stack(xs), *pair)

    def outcome(inputs, carry, at_start, instants, modes):
        unresolved = at_start.unresolved
        return outcome_of(inputs, request, carry, unresolved, instants, modes)

    # The two instants of a run are linearized as two runs, by the program of the start.
    per_run = [jnp.repeat(x, 2, axis=0) for x in batch.leaves.per_run]
    leaves = batch.leaves._replace(per_run=per_run)
    doubled = batch._replace(leaves=leaves, runs=2 * (batch.runs or 1))
    pairs = batch.map_runs(at_nearest_and_end, carry)
    if batch.runs is None:
        pairs = _linearized(run_steps, doubled, pairs)
    else:
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), pairs)
        flat = _linearized(run_steps, doubled, flat)
        pairs = jax.tree.map(lambda x: x.reshape(-1, 2, *x.shape[1:]), flat)
    axis = 0 if batch.runs is None else 1
    instants = jax.tree.map(
        lambda x, xs: jnp.concatenate([jnp.expand_dims(x, axis), xs], axis), at_start, pairs
    )
    modes = fastest_modes(batch.leaves.first.scenario, instants)
    return batch.map_runs(outcome, carry, at_start, instants, modes)


def run_all(run_steps: Stepper, batch: Batch, request: RunRequest) -> Outcome:
    """The outcome of all runs, whose steps a `Stepper` makes."""
    outcome, records = run_step(run_steps, batch, TimeStep.of(request), request)
    if request.record_every is None:
        return outcome
    return outcome._replace(records=records)


def run_step(
    run_steps: Stepper, batch: Batch, step: TimeStep, request: RunRequest
) -> tuple[Outcome, Any]:
    """The outcome without records, and the records, of all runs by a given step."""
    carry, at_start = initialize(run_steps, batch, request.method)
    carry, records = run_steps(step, batch, carry, request.instants, request.record_every)
    return finalize(run_steps, batch, request, carry, at_start), records


def jacobians(run_steps: Stepper, batch: Batch, carry: Linearization) -> jax.Array:
    """The Jacobian of every run at the state of its carry (`linearization.jacobian_carry`),
    (B, m', m') [1/s].
    """
    is_sampled = batch.leaves.first.scenario.sampling is not None
    return resolved_jacobian(_linearized(run_steps, batch, carry).jacobian, is_sampled)
