"""The start of a time step, for a law that acts continuously and for a sampled law.

A sampled law runs at the start of a step if its period has passed; its command arrives at the
actuator after the delay, within this step or a later one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.engine.carry import Carry, Inputs
from iblf_jax.engine.metric_folds import updated, weighed
from iblf_jax.engine.step_pieces import (
    LoopAlongStep,
    MetricSample,
    StepTimes,
    cond_or_zeros,
    step_times,
)
from iblf_jax.simulation import delays, discontinuities, sampling
from iblf_jax.simulation.closed_loop import run_sampled_law_if_due


class StepStart(NamedTuple):
    """What a step begins with."""

    along: LoopAlongStep
    times: StepTimes
    accumulators: tuple
    """After the sample before the law runs, where there is one."""
    metric_samples: tuple[MetricSample, ...]
    """That sample."""


def continuous_start(
    inputs: Inputs, carry: Carry, index: jax.Array, method: str, evaluate: Callable
) -> StepStart:
    """The start of a step of a loop whose law acts continuously."""
    times = step_times(inputs, index, method, None)
    number, commands = index.astype(inputs.dt.dtype), carry.state.delayed
    arriving = delays.arriving(inputs.scenario, method, inputs.dt, number, commands)
    along = LoopAlongStep(evaluate, inputs, carry.state, (), arriving)
    return StepStart(along, times, carry.accumulators, ())


def sampled_start(
    inputs: Inputs, carry: Carry, index: jax.Array, method: str, evaluate: Callable
) -> StepStart:
    """The start of a step of a sampled loop: its law runs where it is due, and commands arrive."""
    scenario, dt = inputs.scenario, inputs.dt
    schedule = checks.given(scenario.sampling)
    now = sampling.instant(schedule, dt, index)
    due = (now.phase == 0) & (index > 0)
    t = index.astype(dt.dtype) * dt
    state = run_sampled_law_if_due(scenario, t, carry.state, now, inputs.noise_key)
    commands = sampling.step_commands(schedule, dt, now, state.sampled.commands)
    before = sampling.arrival_before(schedule, dt, now)
    arrivals = None
    if before is not None:
        arrivals = ((commands.arrival * dt, commands.arrives), before)
    times = step_times(inputs, index, method, arrivals)
    along = LoopAlongStep(evaluate, inputs, state, (commands.first, commands.next))
    accumulators, metric_samples = _before_sample(along, carry, due, times)
    length = jnp.where(due, jnp.zeros_like(dt), times.previous_piece_length)
    times = times._replace(previous_piece_length=length)
    return StepStart(along, times, accumulators, metric_samples)


def _before_sample(
    along: LoopAlongStep, carry: Carry, due: jax.Array, times: StepTimes
) -> tuple[tuple, tuple[MetricSample, ...]]:
    """The accumulators after the sample just before the law runs, where it is due; and that sample.

    The law's signals, and without a delay the command, jump there.
    """
    folds, scenario, dt = along.inputs.folds, along.inputs.scenario, along.inputs.dt
    if not folds:
        return carry.accumulators, ()
    commands = carry.state.sampled.commands
    pending = along.state.sampled.commands
    schedule = checks.given(scenario.sampling)
    command = sampling.command_before(schedule, dt, commands, pending)
    t, previous_piece_length = times.span.start, times.previous_piece_length
    seen_at = (
        t
        if times.division.pieces[0].earliest is None
        else discontinuities.before_jumps(scenario.jump_times(), t)
    )

    def seen(accumulators):
        sample = along.evaluate(scenario, seen_at, carry.state, command)[1]
        sample = weighed(sample, t, 0.5 * previous_piece_length, jnp.zeros_like(dt))
        return updated(folds, accumulators, sample), sample

    after, sample = cond_or_zeros(due, seen, carry.accumulators)
    return after, (MetricSample(carry.accumulators, sample, due),)
