"""The pieces of a time step: a step is divided where a jump lies within it.

A step without a jump has one piece.  The folds of the metrics see the limits of the sample from
both sides of each jump.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.pytree import is_absent
from iblf_jax.engine.carry import Inputs, StepOptions
from iblf_jax.engine.metric_folds import split_floats, updated, weighed
from iblf_jax.engine.status_flags import sample_status
from iblf_jax.engine.switching import SwitchedLoop, with_hybrid_derivative
from iblf_jax.simulation import discontinuities, error_estimate, integrators
from iblf_jax.simulation.closed_loop import (
    LoopState,
    evaluate,
    with_integrated_part,
    with_process_noise,
)
from iblf_jax.simulation.noise import with_noise_rates
from iblf_jax.simulation.signals import Sample


class MetricSample(NamedTuple):
    """A sample that the metrics count: one at each instant, and one-sided limits at jumps."""

    before: tuple
    """The accumulators of the metrics before the sample."""
    sample: Sample
    counts: jax.Array | bool
    """Whether the step has this sample, () bool; True for the sample of the instant."""


class StepTimes(NamedTuple):
    """The interval of a step, and its division into pieces."""

    span: discontinuities.Span
    division: discontinuities.Division
    previous_piece_length: jax.Array
    """Length of the last piece of the previous step, () [s]; 0 at the first instant."""
    restarts: jax.Array | None
    """Whether a jump lies in this step or in earlier ones that its error estimate uses, () bool;
    None in scenarios without jump times."""


def step_times(inputs: Inputs, index: jax.Array, method: str, arrivals: tuple | None) -> StepTimes:
    """The interval of the step that begins at an instant, and its division.

    Args:
      inputs: of the run.
      index: number of the instant, () int.
      method: the integrator.
      arrivals: when commands arrive in this step and in the one before, as
        `discontinuities.divide_step` takes them; None where none can.
    """
    times, dt, number = inputs.scenario.jump_times(), inputs.dt, index.astype(inputs.dt.dtype)
    start = number * dt
    end = start
    if times.size:
        end = (number + 1.0) * dt
    span = discontinuities.Span(start, end, dt, number < inputs.steps)
    here = last = None
    if arrivals is not None:
        here, last = arrivals
    before = discontinuities.Span((number - 1.0) * dt, start, dt)
    previous_piece_length = jnp.where(
        index > 0, discontinuities.last_piece_length(times, before, last), jnp.zeros_like(dt)
    )
    restarts = None
    if times.size and inputs.scenario.sampling is None:
        reach = error_estimate.steps_back(method)
        restarts = discontinuities.has_jump(times, (number - reach) * dt, span.end)
    division = discontinuities.divide_step(times, span, here)
    if inputs.scenario.process_noise is not None:
        pieces = with_noise_rates(inputs.scenario, inputs.noise_key, index, dt, division.pieces)
        division = division._replace(pieces=pieces)
    return StepTimes(span, division, previous_piece_length, restarts)


class LoopAlongStep(NamedTuple):
    """The closed loop along a step."""

    evaluate: Callable
    inputs: Inputs
    state: LoopState
    """At the instant, after what is due there."""
    commands: tuple
    """For a sampled law, the commands at the actuator before and after one arrives within the
    step."""
    arriving: Any = ()
    """The `ArrivingCommands` of a continuous loop whose input has a delay; `()` without one."""

    @property
    def jumps_with_law(self) -> bool:
        """Whether the input jumps at once where the command of the law does."""
        return self.inputs.scenario.sampling is None and is_absent(self.arriving)

    def at(
        self,
        piece: discontinuities.Piece,
        t: jax.Array,
        moved: LoopState,
        command: jax.Array | None = None,
    ) -> tuple[LoopState, Sample]:
        """Rate and sample within a piece of the step.

        Args:
          piece: of the step.
          t: time, () [s].
          moved: the `integrated_part` of the state.
          command: that arrives, (n,), where the input has a delay; that of the time t if not given.
        """
        scenario, time = self.inputs.scenario, discontinuities.stage_time(piece, t)
        state = with_integrated_part(self.state, moved)
        if command is None:
            command = self._command_at(piece, time)
        # JAX keys what it traced by the arguments as they are given, a None included.
        given = () if command is None else (command,)
        rate, sample = self.evaluate(scenario, time, state, *given)
        return with_process_noise(scenario, time, state, rate, piece.noise_rate), sample

    def _command_at(self, piece: discontinuities.Piece, time: jax.Array) -> jax.Array | None:
        """The command at the actuator at a time within a piece, (n,); None where it is that of the
        law at once.
        """
        if not is_absent(self.arriving):
            return self.arriving.at(time)
        if not self.commands:
            return None
        before, after = self.commands
        if isinstance(piece.command_arrived, bool):
            return after if piece.command_arrived else before
        return jnp.where(piece.command_arrived, after, before)


def integrate_piece(
    along: LoopAlongStep,
    piece: discontinuities.Piece,
    moved: LoopState,
    method: str,
    options: StepOptions,
) -> integrators.StepResult:
    """One step of the integrator over a piece, with the commands that arrive at its stages."""
    commands = None
    if not is_absent(along.arriving):
        times = [
            discontinuities.stage_time(piece, piece.begin + c * piece.length)
            for c in integrators.tableau(method).c
        ]
        commands = along.arriving.at_stages(times, piece.length)
    return integrators.step(
        method,
        lambda t, x, *command: along.at(piece, t, x, *command),
        piece.begin,
        moved,
        piece.length,
        rolled=options.rolled,
        inputs=commands,
    )


def across_jumps(
    along: LoopAlongStep,
    piece: discontinuities.Piece,
    before: LoopState,
    method: str,
    stepped: integrators.StepResult,
    before_sample: tuple,
    accumulators: tuple,
) -> tuple[integrators.StepResult, tuple]:
    """A piece of a step and the accumulators, with their derivatives across jumps of the command;
    values are unchanged.

    Args:
      along: the loop, whose law is not sampled and whose input has no delay.
      piece: of the step.
      before: state at its start.
      method: the integrator.
      stepped: the result of the integrator for this piece.
      before_sample, accumulators: of the folds, before and after the sample at its start.
    """
    inputs, dt = along.inputs, along.inputs.dt
    # No metric counts what comes after the end of a run.
    counts = piece.begin < (inputs.steps - 0.5) * dt

    def rate(t, state):
        time = discontinuities.stage_time(piece, t)
        slope, sample = evaluate(inputs.scenario, time, state)
        return with_process_noise(inputs.scenario, time, state, slope, piece.noise_rate), sample

    def gains_of(sample):
        def sums(weight):
            return split_floats(
                updated(inputs.folds, before_sample, dataclasses.replace(sample, dt=weight))
            )[0]

        gains = jax.jvp(sums, (dt,), (jnp.ones_like(dt),))[1]
        return [jnp.where(counts, gain, jnp.zeros_like(gain)) for gain in gains]

    floats, replaced = split_floats(accumulators)
    loop = SwitchedLoop(inputs.scenario, rate, gains_of)
    after, floats = with_hybrid_derivative(
        loop, method, piece.begin, before, piece.length, stepped, floats
    )
    return stepped._replace(state=after), replaced(floats)


class LaterPieces(NamedTuple):
    """The result of the pieces of a step after the first."""

    moved: LoopState
    """At the end of the step."""
    accumulators: tuple
    piece_slopes: list[tuple[jax.Array, list]]
    """Length [s] of each piece, and the slopes of its stages."""
    metric_samples: tuple[MetricSample, ...]
    status: jax.Array | None
    """The flags that its samples raise, () int32; None where there are none."""


def later_pieces(
    along: LoopAlongStep,
    pieces: tuple[discontinuities.Piece, ...],
    stepped: integrators.StepResult,
    accumulators: tuple,
    method: str,
    options: StepOptions,
) -> LaterPieces:
    """The pieces after the first, each with the samples before and after the jump at which it
    begins.
    """
    # These pieces are rare: their stages are a loop, which compiles in a fraction of the time.
    folds, none = along.inputs.folds, jnp.zeros_like(along.inputs.dt)
    moved, piece_slopes, metric_samples = stepped.state, [], []
    status = None
    if len(pieces) > 1:
        status = jnp.int32(0)
    for last, piece in itertools.pairwise(pieces):

        def further(kept, last=last, piece=piece):
            moved, accumulators, status = kept
            between: Any = ()
            left: Any = ()
            if folds:
                left = along.at(last, last.begin + last.length, moved)[1]
                left = weighed(left, piece.begin, 0.5 * last.length, none)
                between = accumulators = updated(folds, accumulators, left)
            made = integrate_piece(
                along, piece, moved, method, options._replace(rolled=not options.scalar)
            )
            right = weighed(made.aux, piece.begin, 0.5 * piece.length, none)
            accumulators = ()
            if folds:
                accumulators = updated(folds, between, right)
            if along.jumps_with_law:
                made, accumulators = across_jumps(
                    along, piece, moved, method, made, between, accumulators
                )
            return (made.state, accumulators, status | sample_status(right)), (
                made.slopes,
                left,
                between,
                right,
            )

        before = accumulators
        (moved, accumulators, status), (slopes, left, between, right) = cond_or_zeros(
            piece.exists, further, (moved, accumulators, status)
        )
        piece_slopes.append((piece.length, slopes))
        if folds:
            metric_samples += [
                MetricSample(before, left, piece.exists),
                MetricSample(between, right, piece.exists),
            ]
    return LaterPieces(moved, accumulators, piece_slopes, tuple(metric_samples), status)


def cond_or_zeros(condition: jax.Array, made: Callable, kept: Any) -> tuple[Any, Any]:
    """`made(kept)`, new values and anything else, where a condition holds; else the values as they
    are, and zeros.
    """
    shapes = jax.eval_shape(made, kept)[1]

    def otherwise(kept):
        return kept, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    return jax.lax.cond(condition, made, otherwise, kept)
