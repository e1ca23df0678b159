"""The definition of a time step, which every executor makes.

At each instant k = 0 ... T the closed loop is evaluated once; this sample serves the record, the
metrics and the first stage of the integrator.  Where the right-hand side or the signals jump, the
step is integrated in pieces (`step_pieces`), and the metrics see the limits from both sides; a step
without a jump costs no more than the comparison.  A state that diverges is frozen at its last valid
value and flagged, so that no NaN enters a batch or a gradient.  The carry keeps the instant nearest
to a bound, because the loop is stiffest there.  At the last instant the loop is evaluated, but not
integrated.

A step is a function (inputs, carry, index) -> (carry, records) of ONE run.  It is hashable, and
equal steps are compiled once.  `carry.initial_carry` creates the carry before the first step, and
`outcome.outcome_of` computes the result after the last one.  Neither evaluates the closed loop:
`linearization` computes the Jacobian that both need, also in steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.attributes import attributes
from iblf_jax.core.pytree import is_absent
from iblf_jax.core.status import Status, flag
from iblf_jax.engine.carry import Carry, Inputs, Nearest, Step, StepOptions, tree_where
from iblf_jax.engine.metric_folds import initialised_at, updated, weighed
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.status_flags import has_no_input, is_valid, sample_status
from iblf_jax.engine.step_pieces import (
    LoopAlongStep,
    MetricSample,
    StepTimes,
    across_jumps,
    integrate_piece,
    later_pieces,
)
from iblf_jax.engine.step_start import continuous_start, sampled_start
from iblf_jax.simulation import (
    closed_loop,
    delays,
    discontinuities,
    error_estimate,
    error_growth,
    sampling,
)
from iblf_jax.simulation.closed_loop import (
    LoopState,
    integrated_part,
    perturbed_state,
    with_integrated_part,
)
from iblf_jax.simulation.noise import distances, with_extremes
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import FIELDS, Sample
from iblf_jax.world import plants


@dataclasses.dataclass(frozen=True)
class TimeStep(Step):
    """One step of a run."""

    method: str
    record: Callable | None = None
    """Function (folds, what `advance` found) of an instant."""

    @staticmethod
    def of(request: RunRequest) -> TimeStep:
        """The step of a run."""
        if request.record_every is None:
            return TimeStep(request.method)
        return TimeStep(request.method, recorded)

    def __call__(self, inputs: Inputs, carry: Carry, index: jax.Array, options: StepOptions):
        """The carry after the step, and what is recorded."""
        found = advance(inputs, carry, index, self.method, options)
        if self.record is None:
            return found.carry, ()
        return found.carry, self.record(inputs.folds, found)


class StepOutput(NamedTuple):
    """What one step of a run gives."""

    carry: Carry
    """After the step, its samples folded into the metrics."""
    metric_samples: tuple[MetricSample, ...]
    """The sample of the instant comes first, whatever the order in time."""
    state: LoopState
    """At the instant, after the law has run if it is due."""

    @property
    def sample(self) -> Sample:
        """The sample of the instant."""
        return self.metric_samples[0].sample


def advance(
    inputs: Inputs,
    carry: Carry,
    index: jax.Array,
    method: str,
    options: StepOptions,
    evaluate: Callable = closed_loop.evaluate,
) -> StepOutput:
    """One step: evaluates the closed loop, updates the metrics, integrates piece by piece, and
    freezes a state that diverges.

    Args:
      inputs, carry: of the run.
      index: number of the instant, () int.
      method: the integrator.
      options: how the code of the step is generated.
      evaluate: replaces `closed_loop.evaluate`.
    """
    if inputs.scenario.sampling is None:
        start = continuous_start(inputs, carry, index, method, evaluate)
    else:
        start = sampled_start(inputs, carry, index, method, evaluate)
    along, times = start.along, start.times
    state = along.state
    first = times.division.pieces[0]
    stepped = integrate_piece(along, first, integrated_part(state), method, options)
    if not is_absent(along.arriving):
        commands = [slope.command for slope in stepped.slopes]
        along = along._replace(arriving=along.arriving.with_commands_of_step(commands))
    ahead = jnp.where(times.span.in_run, first.length, jnp.zeros_like(inputs.dt))
    step = jnp.where(index > 0, inputs.dt, jnp.zeros_like(inputs.dt))
    sample = weighed(
        stepped.aux, times.span.start, 0.5 * (times.previous_piece_length + ahead), step
    )
    walls = distances(inputs.scenario, sample)
    sample = with_extremes(
        inputs.scenario, inputs.noise_key, index, inputs.dt, sample, state.x, carry.distances, walls
    )
    before_sample = initialised_at(index, inputs.folds, sample, start.accumulators)
    accumulators = updated(inputs.folds, before_sample, sample)
    if along.jumps_with_law:
        stepped, accumulators = across_jumps(
            along, first, state, method, stepped, before_sample, accumulators
        )
    later = later_pieces(along, times.division.pieces, stepped, accumulators, method, options)
    piece_slopes = [(first.length, stepped.slopes), *later.piece_slopes]
    state_after = with_integrated_part(state, later.moved)
    if not is_absent(along.arriving):
        state_after, piece_slopes = _with_commands(
            along, method, times.division.pieces, state_after, piece_slopes
        )
    in_run = times.span.in_run
    status = carry.status | sample_status(sample)
    if later.status is not None:
        status = status | later.status
    after, status = _frozen_if_invalid(
        inputs.scenario, state, state_after, piece_slopes, status, in_run
    )
    nearest = _nearest_to_bound(carry.nearest, sample, state)
    accuracy = carry.accuracy
    if inputs.scenario.process_noise is None:
        accuracy = _updated_accuracy(
            method, inputs, carry, index, piece_slopes, state, sample.upper - sample.lower, times
        )
    metric_samples = (
        MetricSample(before_sample, sample, True),
        *start.metric_samples,
        *later.metric_samples,
    )
    return StepOutput(
        Carry(after, later.accumulators, status, nearest, accuracy, walls), metric_samples, state
    )


def _with_commands(
    along: LoopAlongStep,
    method: str,
    pieces: tuple[discontinuities.Piece, ...],
    after: LoopState,
    piece_slopes: list,
) -> tuple[LoopState, list]:
    """The state after a step, which keeps the commands of the step for a delayed input; and the
    pieces of the step, whose slopes no longer contain the commands.
    """
    of_pieces = [
        delays.PieceCommands(piece.begin, length, piece.exists, [slope.command for slope in slopes])
        for piece, (length, slopes) in zip(pieces, piece_slopes, strict=True)
    ]
    commands = delays.with_step(along.state.delayed, method, along.arriving, of_pieces)
    without_commands = [
        (length, [slope._replace(command=()) for slope in slopes])
        for length, slopes in piece_slopes
    ]
    return after._replace(delayed=commands), without_commands


def _nearest_to_bound(before: Nearest, sample: Sample, state: LoopState) -> Nearest:
    """The instant nearest to a bound so far, with that of a sample and its state."""
    near = jnp.max(jnp.abs(jax.lax.stop_gradient(sample.xi)))
    here = Nearest(near, sample.t, jax.lax.stop_gradient(perturbed_state(state)))
    return tree_where(near > before.xi, here, before)


def _updated_accuracy(
    method: str,
    inputs: Inputs,
    carry: Carry,
    index: jax.Array,
    piece_slopes: list,
    state: LoopState,
    width: jax.Array,
    times: StepTimes,
) -> error_estimate.Accuracy:
    """The estimate of the accuracy after a step.

    Args:
      method: the integrator.
      inputs, carry: of the run.
      index: number of the instant, () int.
      piece_slopes: lengths and slopes of the pieces of the step.
      state: at the start of the step.
      width: of the tube, (n,) [rad].
      times: of the step.
    """
    accuracy = error_estimate.update(
        carry.accuracy,
        method,
        inputs.dt,
        index,
        piece_slopes,
        width,
        inputs.scenario.sampling is not None,
        times.restarts,
        times.division.too_many_jumps,
        error_growth.rounds_continuously(inputs.scenario),
    )
    if is_absent(accuracy.error_growth):
        return accuracy
    grown = _grown_error(method, inputs, carry, index, piece_slopes, state, width)
    return accuracy._replace(error_growth=grown)


def _frozen_if_invalid(
    scenario: Scenario,
    before: LoopState,
    after: LoopState,
    piece_slopes: list,
    status: jax.Array,
    in_run: jax.Array,
) -> tuple[LoopState, jax.Array]:
    """State and status after a step; a state that diverges is frozen, as is one at the end of a
    run.

    Args:
      scenario: the scenario.
      before, after: the state at the start and at the end of the step.
      piece_slopes: lengths and slopes of the pieces of the step.
      status: with the flags of its samples, () int32.
      in_run: whether the run goes on after the instant, () bool.
    """
    plant = scenario.loop.plant
    valid = is_valid(after, plants.speed_limit(plant)) & (status & int(Status.NOT_FINITE) == 0)
    status |= flag(~valid & in_run, Status.NOT_FINITE)
    if plant.loses_input:
        lost, *later = [has_no_input(slope) for _, slopes in piece_slopes for slope in slopes]
        if later:
            # The later stages of the last instant lie beyond the end of the run.
            lost |= jnp.any(jnp.stack(later)) & in_run
        status |= flag(lost, Status.SINGULAR_GAIN)
    return tree_where(valid & in_run, after, before), status


def _grown_error(
    method: str,
    inputs: Inputs,
    carry: Carry,
    index: jax.Array,
    piece_slopes: list,
    state: LoopState,
    width: jax.Array,
) -> error_growth.ErrorGrowth:
    """The error after a step of a loop whose feedback is interrupted; arguments as
    `_updated_accuracy`.
    """
    scenario, dt = inputs.scenario, inputs.dt
    now = None
    if scenario.sampling is not None:
        now = sampling.instant(scenario.sampling, dt, index)
    local_error = error_estimate.local_error_of_state(
        method, piece_slopes, partial(error_growth.rate_at_end, scenario, dt, index, now, state)
    )
    return error_growth.update(
        carry.accuracy.error_growth,
        scenario,
        dt,
        index,
        now,
        inputs.noise_key,
        carry.state,
        state,
        local_error,
        width,
    )


class Record(NamedTuple):
    """What a run keeps of an instant; the states have the names of the fields of a `Rollout`."""

    signals: dict[str, Any]
    controller_state: Any
    observer_state: Any
    actuator_state: Any
    measured: Any


def recorded(folds: Any, found: StepOutput) -> Record:
    """The signals of an instant, the states of law, observer and actuator, and what a sampled law
    received.
    """
    state, measured = found.state, ()
    if not is_absent(state.sampled):
        measured = state.sampled.received
    signals = attributes(found.sample, FIELDS)
    return Record(signals, state.controller, state.observer, state.actuator, measured)


POSITIONS = ("t", "q", "e1", "lower", "upper", "q_d")
"""Signals of `positions`."""


def positions(folds: Any, found: StepOutput) -> dict[str, jax.Array]:
    """The time, and the positions of an instant with their errors, bounds and reference."""
    return attributes(found.sample, POSITIONS)


def samples_of_step(scenario: Scenario) -> int:
    """How many samples the folds see of a step at most: `StepOutput.metric_samples`."""
    arrives = scenario.sampling is not None and scenario.sampling.queue > 0
    cuts = min(scenario.jump_times().size, discontinuities.MAX_CUTS) + arrives
    return 1 + (scenario.sampling is not None) + 2 * cuts
