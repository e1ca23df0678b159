"""A batch of runs, or one: which leaves differ between the runs, and the way from the start to the
outcome, whatever steps them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.engine.machine_function import machine_function
from iblf_jax.engine.mechanism import Mechanism
from iblf_jax.engine.plan import Shape
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.step import (
    Carry,
    Inputs,
    Outcome,
    Probe,
    Probed,
    TimeStep,
    probe_steps,
    probed,
    start,
    verdict,
)
from iblf_jax.simulation import accuracy
from iblf_jax.simulation.closed_loop import initial_state, perturbed_state
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.sampling import NOISE_NAME
from iblf_jax.simulation.stability import resolved


class Leaves(NamedTuple):
    """The leaves of a pytree, told apart by whether they differ between runs."""

    treedef: Any
    is_lane: tuple[bool, ...]
    shared: list[jax.Array]
    lane: list[jax.Array]
    """With a leading batch axis."""

    def together(self, shared: Sequence, lane: Sequence):
        """The pytree again, from one run's leaves."""
        one, other = iter(shared), iter(lane)
        return jax.tree.unflatten(
            self.treedef, [next(other) if lane else next(one) for lane in self.is_lane]
        )

    @property
    def first(self):
        """The pytree of the first run."""
        return self.together(self.shared, [x[0] for x in self.lane])


def split(inputs: Inputs, varied: Mapping[str, jax.Array]) -> Leaves:
    """The leaves of what runs are made from: those that `varied` replaces in the scenario become
    one value a run.
    """
    before, treedef = jax.tree.flatten(inputs)

    def replaced(values):
        leaves = {path: x for path, x in values.items() if path != NOISE_NAME}
        noise = values[NOISE_NAME].astype(inputs.dt.dtype) if NOISE_NAME in values else inputs.noise
        return jax.tree.leaves(
            inputs._replace(scenario=with_parameters(inputs.scenario, leaves), noise=noise)
        )

    touched: list[bool] = []

    def look(values):
        after = replaced(values)
        touched[:] = [new is not old for new, old in zip(after, before, strict=True)]
        return [new for new, yes in zip(after, touched, strict=True) if yes]

    lane = jax.vmap(look)(dict(varied)) if varied else []
    touched = touched or [False] * len(before)
    return Leaves(
        treedef,
        tuple(touched),
        [x for x, yes in zip(before, touched, strict=True) if not yes],
        list(lane),
    )


TOGETHER = Shape("together", "none", False)


class Batch(NamedTuple):
    """Runs that are stepped together."""

    leaves: Leaves
    """Of their `Inputs`."""
    runs: int | None
    """None: one run, and no array has a run axis."""
    shape: Shape = TOGETHER
    """How its parts are compiled."""
    mechanism: Mechanism | None = None
    """What of the robots is compiled in."""

    @staticmethod
    def of(
        inputs: Inputs,
        varied: Mapping[str, jax.Array] | None,
        shape: Shape = TOGETHER,
        mechanism: Mechanism | None = None,
    ) -> Batch:
        """A run for every entry of `varied` (path -> values, batch axis first), or one run."""
        runs = jax.tree.leaves(dict(varied))[0].shape[0] if varied else None
        return Batch(split(inputs, varied or {}), runs, shape, mechanism)

    @property
    def known(self) -> tuple:
        """What is known of the shared numbers."""
        if self.mechanism is None:
            return ()
        one, other = iter(self.leaves.shared), iter(self.leaves.lane)
        sizes = [
            math.prod(next(other).shape[1:]) if lane else next(one).size
            for lane in self.leaves.is_lane
        ]
        return self.mechanism.of_shared(self.leaves.is_lane, sizes)

    @property
    def dtype(self):
        """The floating-point type."""
        return self.leaves.shared[-1].dtype

    def each(self, function: Callable, *args: Any) -> Any:
        """function(inputs, *args) for every run; arguments and results have the run axis first."""

        def one(lane, *rest):
            return function(self.leaves.together(self.leaves.shared, lane), *rest)

        if self.runs is None:
            return one([], *args)
        if self.shape.runs == "in turn":
            return jax.lax.map(lambda each: one(*each), (self.leaves.lane, *args))
        together = jax.vmap(one, axis_size=self.runs)
        return (machine_function(together) if self.shape.function == "parts" else together)(
            self.leaves.lane, *args
        )


Executor = Callable[[Any, Batch, Any, int, int | None], tuple[Any, Any]]
"""(step, batch, carry, steps, every) -> (the carry after all steps, what every `every`-th step
recorded, from the first on).

All arrays have the run axis first, records then the time axis; `every` is None where nothing is
recorded."""


def _probed(executor: Executor, batch: Batch, carry: Probed) -> Probed:
    """What a `Probe` of every run has found."""
    leaves = _without_folds(batch.leaves)
    shared, lane = jax.lax.stop_gradient((leaves.shared, leaves.lane))
    batch = batch._replace(leaves=leaves._replace(shared=shared, lane=lane))
    steps = probe_steps(leaves.first.scenario)
    return executor(Probe(), batch, carry, steps, None)[0]


def _without_folds(leaves: Leaves) -> Leaves:
    """The leaves of inputs without what a `Probe` does not read: one program of it serves all
    metrics and derivatives.
    """
    places: Inputs = jax.tree.unflatten(leaves.treedef, range(len(leaves.is_lane)))
    kept, treedef = jax.tree.flatten(places._replace(folds=(), noise=(), direction=()))
    shared, lane = iter(leaves.shared), iter(leaves.lane)
    values = [next(lane if is_lane else shared) for is_lane in leaves.is_lane]
    is_lane = tuple(leaves.is_lane[i] for i in kept)
    return Leaves(
        treedef,
        is_lane,
        [values[i] for i in kept if not leaves.is_lane[i]],
        [values[i] for i in kept if leaves.is_lane[i]],
    )


def begin(executor: Executor, batch: Batch, method: str) -> tuple[Carry, Probed]:
    """The carry before the first step, and what a `Probe` has found at the start."""

    def around(inputs):
        unseen = accuracy.unresolved_signals(inputs.scenario, method, inputs.dt, inputs.steps)
        state = initial_state(inputs.scenario)
        return probed(
            jnp.zeros_like(inputs.dt),
            perturbed_state(state),
            accuracy.watched_indices(state).size,
            unseen,
        )

    found = _probed(executor, batch, batch.each(around))
    return (
        batch.each(
            lambda inputs, found: start(
                inputs, method, resolved(found.jacobian, inputs.scenario.sampling is not None)
            ),
            found,
        ),
        found,
    )


def carry_shapes(batch: Batch, method: str) -> Carry:
    """Shapes and types of the carry."""

    def one(inputs):
        size = accuracy.watched_indices(initial_state(inputs.scenario)).size
        return start(inputs, method, jnp.zeros((size, size), inputs.dt.dtype))

    return jax.eval_shape(lambda: batch.each(one))


def end(
    executor: Executor, batch: Batch, run: RunRequest, carry: Carry, at_start: Probed
) -> Outcome:
    """The outcome after the last step, without records; `at_start` is what a `Probe` has found
    there.
    """

    def critical(inputs, carry):
        instants = (
            (carry.nearest.t, carry.nearest.around),
            (inputs.dt * inputs.steps, perturbed_state(carry.state)),
        )
        watched, nothing = (
            at_start.jacobian.shape[-1],
            accuracy.UnresolvedSignals(*[jnp.zeros_like(carry.accuracy.error)] * 3),
        )
        return jax.tree.map(
            lambda *xs: jnp.stack(xs), *(probed(*instant, watched, nothing) for instant in instants)
        )

    def judged(inputs, carry, at_start, later):
        instants = jax.tree.map(lambda one, two: jnp.concatenate([one[None], two]), at_start, later)
        return verdict(inputs, run.method, carry, at_start.unseen, instants)

    # Both instants of a run are probed as two runs, by the program that probed the start.
    lane = [jnp.repeat(x, 2, axis=0) for x in batch.leaves.lane]
    twice = batch._replace(leaves=batch.leaves._replace(lane=lane), runs=2 * (batch.runs or 1))
    apart = batch.each(critical, carry)
    if batch.runs is None:
        later = _probed(executor, twice, apart)
    else:
        later = _probed(executor, twice, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), apart))
        later = jax.tree.map(lambda x: x.reshape(-1, 2, *x.shape[1:]), later)
    return batch.each(judged, carry, at_start, later)


def run_all(executor: Executor, batch: Batch, run: RunRequest) -> Outcome:
    """All runs, from the start to the outcome."""
    outcome, records = run_step(executor, batch, TimeStep.of(run), run)
    return outcome if run.record_every is None else outcome._replace(records=records)


def run_step(
    executor: Executor, batch: Batch, step: TimeStep, run: RunRequest
) -> tuple[Outcome, Any]:
    """All runs by a step that may record something else; the outcome, and the records apart."""
    carry, at_start = begin(executor, batch, run.method)
    carry, records = executor(step, batch, carry, run.steps + 1, run.record_every)
    return end(executor, batch, run, carry, at_start), records
