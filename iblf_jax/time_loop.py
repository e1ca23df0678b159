"""The time loop: one step of a run, and the run.

Time is scanned here, in `compact_loop` and in the kernels of `lowering`, and nowhere else; all of them make this step.  Per step: the
closed loop is evaluated once for record, metrics and the first stage of the integrator; a state that runs away is frozen at its last good
value and flagged, so that no NaN ever enters a batch or a gradient; the instant nearest to a bound is remembered, because the loop
is stiffest there.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax import accuracy
from iblf_jax.bounds import NARROWEST
from iblf_jax.closed_loop import LoopState, Sample, evaluate, initial_state, rate
from iblf_jax.integrators import combined, stage_slopes, tableau
from iblf_jax.results import Rollout
from iblf_jax.scenario import Scenario
from iblf_jax.stability import fastest_mode
from iblf_jax.status import VELOCITY_LIMIT, Status, flag

RECORDED = tuple(f.name for f in dataclasses.fields(Rollout) if f.name in Sample._fields and f.name != "dt")
"""Names of the quantities that a run records."""


class Nearest(NamedTuple):
    """The instant at which a joint was nearest to its bound."""

    xi: jax.Array
    t: jax.Array
    state: LoopState


class Carry(NamedTuple):
    """What goes from step to step."""

    state: LoopState
    accumulators: tuple
    status: jax.Array
    nearest: Nearest
    accuracy: accuracy.Accuracy


class Outcome(NamedTuple):
    """What the time loop returns."""

    records: Any
    metrics: dict[str, jax.Array]
    status: jax.Array
    fastest_mode: jax.Array


def sample_status(sample: Sample) -> jax.Array:
    """The flags that one sample raises, () int32."""
    narrowest = jnp.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
    margin = jnp.minimum(sample.q - sample.lower, sample.upper - sample.q)
    return (
        flag(jnp.any(~(margin > 0)), Status.BOUND_VIOLATED)
        | flag(jnp.any(narrowest < NARROWEST), Status.INFEASIBLE_REFERENCE)
        | flag(jnp.any(sample.guard_active), Status.GUARD_ACTIVE)
        | flag(jnp.any(sample.guard_active) & (sample.t > 0), Status.GUARD_STAYED)
        | flag(jnp.any(sample.saturated), Status.TORQUE_SATURATED)
        | flag(~jnp.isfinite(sample.V), Status.NOT_FINITE)
    )


def is_sound(state: LoopState) -> jax.Array:
    """Whether a state is finite and slow enough to be a robot's, () bool."""
    finite = jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(state)])
    return jnp.all(finite) & jnp.all(jnp.abs(state.dq) < VELOCITY_LIMIT)


def keep_if(condition, new, old):
    """`new` where the condition holds, leaf by leaf, else `old`."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def observed(folds, method: str, dt, index, slope: LoopState, sample: Sample, carry: Carry) -> Carry:
    """The carry with the rate and the sample of an instant folded in."""
    accumulators = tuple(fold.update(acc, sample) for fold, acc in zip(folds, carry.accumulators, strict=True))
    near = jnp.max(jnp.abs(jax.lax.stop_gradient(sample.xi)))
    here = Nearest(near, sample.t, jax.lax.stop_gradient(carry.state))
    nearest = keep_if(near > carry.nearest.xi, here, carry.nearest)
    estimate = accuracy.observed(carry.accuracy, method, dt, index, slope, sample.upper - sample.lower)
    return Carry(carry.state, accumulators, carry.status | sample_status(sample), nearest, estimate)


def advance(scenario: Scenario, folds, method: str, dt, carry: Carry, index, loop=evaluate) -> tuple[Carry, Sample]:
    """One step of the time loop: observe, integrate, freeze what runs away.  `loop` stands for `closed_loop.evaluate`."""
    t = index.astype(dt.dtype) * dt
    slope, sample = loop(scenario, t, carry.state, dt)
    carry = observed(folds, method, dt, index, slope, sample, carry)
    slopes = stage_slopes(method, lambda t, state: loop(scenario, t, state)[0], t, carry.state, dt, slope)
    carry = carry._replace(accuracy=accuracy.passed(carry.accuracy, method, slopes))
    return moved(carry, combined(method, carry.state, dt, slopes)), sample


def moved(carry: Carry, stepped: LoopState, moving: jax.Array | bool = True) -> Carry:
    """The carry at the next instant if `moving`, its state frozen if that ran away."""
    sound = is_sound(stepped) & (carry.status & int(Status.NOT_FINITE) == 0)
    state = keep_if(sound & moving, stepped, carry.state)
    return carry._replace(state=state, status=carry.status | flag(~sound & moving, Status.NOT_FINITE))


def start(scenario: Scenario, folds, method: str, dt) -> Carry:
    """The carry before the first step."""
    state, zero = initial_state(scenario), jnp.zeros_like(dt)
    _, first = evaluate(scenario, zero, state, dt)
    nearest = Nearest(-jnp.ones_like(dt), zero, jax.lax.stop_gradient(state))
    same, there = jax.lax.stop_gradient((scenario, state))
    rate_at = jax.vmap(lambda x: accuracy.numbers(rate(same, zero, accuracy.with_numbers(there, x))))
    estimate = accuracy.begin(method, rate_at, there)
    return Carry(state, tuple(fold.init(first) for fold in folds), jnp.int32(0), nearest, estimate)


def finish(scenario: Scenario, folds, method: str, dt, steps: int, carry: Carry) -> tuple[Carry, Sample, Outcome]:
    """The last sample, the folds' results and the verdict on the step."""
    carry, sample = observe_end(scenario, folds, method, dt, steps, carry)
    modes = jax.vmap(partial(fastest_mode, scenario))(*critical_instants(scenario, dt, steps, carry))
    return carry, sample, verdict(folds, method, dt, carry, modes)


def observe_end(scenario: Scenario, folds, method: str, dt, steps: int, carry: Carry) -> tuple[Carry, Sample]:
    """The carry and the sample after the last step."""
    slope, sample = evaluate(scenario, dt * steps, carry.state, jnp.zeros_like(dt))
    carry = observed(folds, method, dt, steps, slope, sample, carry)
    return carry._replace(accuracy=accuracy.between_stages(scenario, carry.accuracy, method, dt, steps)), sample


def critical_instants(scenario: Scenario, dt, steps: int, carry: Carry) -> tuple[jax.Array, LoopState]:
    """Times and states, stacked, at which the loop's modes are measured: the start, where a joint was nearest to its bound, the end."""
    end = dt * steps
    times = jnp.stack([jnp.zeros_like(end), carry.nearest.t, end])
    states = jax.tree.map(lambda *xs: jnp.stack(xs), initial_state(scenario), carry.nearest.state, carry.state)
    return jax.lax.stop_gradient((times, states))


def verdict(folds, method: str, dt, carry: Carry, modes: jax.Array) -> Outcome:
    """The folds' results and the accuracy, and the status with the verdict on the step, given the measured modes [1/s]."""
    mode = jnp.max(jnp.where(jnp.isfinite(modes), modes, 0.0))
    status = carry.status | flag(dt * mode > tableau(method).stability, Status.STEP_TOO_LARGE)
    status |= flag(~(carry.accuracy.relative <= accuracy.TOLERANCE), Status.INACCURATE)
    metrics = accuracy.results(carry.accuracy)
    for fold, acc in zip(folds, carry.accumulators, strict=True):
        metrics |= fold.finish(acc)
    return Outcome(None, metrics, status, mode)


def record_of(sample: Sample, state: LoopState):
    """What is kept of a sample, and the states of law and observer."""
    return {name: getattr(sample, name) for name in RECORDED}, state.controller, state.observer


def scan_steps(scenario: Scenario, folds, dt, *, steps: int, record_every: int | None, method: str) -> Outcome:
    """The whole time loop for one run.

    Records are stacked every `record_every` steps; with None there are none, and memory does not grow with time.
    """
    advance_one = partial(advance, scenario, folds, method, dt)

    def recorded(carry, index):
        state = carry.state
        carry, sample = advance_one(carry, index)
        return carry, record_of(sample, state)

    def unrecorded(carry, index):
        return advance_one(carry, index)[0], None

    def block(carry, index):
        carry, record = recorded(carry, index)
        return jax.lax.scan(unrecorded, carry, index + jnp.arange(1, record_every))[0], record

    carry = start(scenario, folds, method, dt)
    if record_every is None:
        carry, _ = jax.lax.scan(unrecorded, carry, jnp.arange(steps))
        return finish(scenario, folds, method, dt, steps, carry)[2]
    blocks, rest = divmod(steps, record_every)
    carry, records = jax.lax.scan(recorded if record_every == 1 else block, carry, record_every * jnp.arange(blocks))
    if rest:
        last = record_of(evaluate(scenario, dt * (blocks * record_every), carry.state, dt)[1], carry.state)
        carry, _ = jax.lax.scan(unrecorded, carry, blocks * record_every + jnp.arange(rest))
    carry, sample, outcome = finish(scenario, folds, method, dt, steps, carry)
    if not rest:
        last = record_of(sample, carry.state)
    records = jax.tree.map(lambda many, one: jnp.concatenate([many, one[None]]), records, last)
    return outcome._replace(records=records)
