"""The time loop for long closed loops, and the choice between the two.

An arm of seven joints has ten thousand operations an evaluation, and the plain loop holds several of them: compiling is then what takes
the time.  Here the closed loop is there once, as a piece of its own (`one_function`).
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax import accuracy
from iblf_jax.closed_loop import evaluate, initial_state
from iblf_jax.integrators import stages
from iblf_jax.one_function import as_one_function, is_long
from iblf_jax.scenario import Scenario
from iblf_jax.stability import fastest_mode_by_differences
from iblf_jax.time_loop import Carry, Nearest, Outcome, critical_instants, keep_if, moved, observed, record_of, scan_steps, verdict

_evaluate_once = jax.jit(evaluate)
"""`closed_loop.evaluate` as a call that stays one: copied to where it is called, a long loop takes longer to trace."""


def is_for(scenario: Scenario, dt) -> bool:
    """Whether the closed loop is so long that it is for `run_compactly`."""
    return is_long(_evaluate_once, scenario, jnp.zeros_like(dt), initial_state(scenario), dt)


def run_compactly(scenario: Scenario, folds, dt, *, steps: int, record_every: int | None, method: str, alone: bool = False) -> Outcome:
    """As `time_loop.scan_steps`, for a closed loop of so many operations that compiling is what takes the time.

    The closed loop is there once, in a loop over the stages of the integrator, and where it is differentiated, start and end.  So the
    sample at the end is that of a step that is not made, and the accumulators begin with the first sample.  `alone` says that nobody
    will batch it from outside: then its pieces become machine functions.
    """
    piece = as_one_function if alone else lambda function: function
    every = min(record_every or 1, steps + 1)
    state, zero = initial_state(scenario), jnp.zeros_like(dt)
    shapes = jax.eval_shape(_evaluate_once, scenario, zero, state, dt)
    _, whole_sample = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes[1]))
    _, whole = ravel_pytree(state)
    weights = tuple(jnp.asarray(w, dt.dtype) for w in stages(method))

    @piece
    def loop(scenario, t, x, covered):
        return tuple(ravel_pytree(part)[0] for part in _evaluate_once(scenario, t, whole(x), covered))

    @piece
    def after(carry, record, index, sample, slopes, stepped):
        sample, slopes = whole_sample(sample), [whole(k) for k in slopes]
        begun = carry._replace(accumulators=keep_if(index > 0, carry.accumulators, tuple(fold.init(sample) for fold in folds)))
        seen = observed(folds, method, dt, index, slopes[0], sample, begun)
        seen = seen._replace(accuracy=accuracy.passed(seen.accuracy, method, slopes))
        there = moved(seen, whole(stepped), index < steps)
        record = keep_if(index % every == 0, record_of(sample, carry.state), record) if record_every else None
        return keep_if(index <= steps, there, carry), record

    def one(carried, index):
        carry, record = carried
        t, x = index.astype(dt.dtype) * dt, ravel_pytree(carry.state)[0]
        covered = jnp.where(index < steps, dt, zero)

        def stage(slope_and_sum, weights):
            (k, total), (c, a, b) = slope_and_sum, weights
            k, sample = loop(scenario, t + c * dt, x + dt * (a * k), covered)
            return (k, total + b * k), (k, sample)

        (_, total), (slopes, samples) = jax.lax.scan(stage, (jnp.zeros_like(x), jnp.zeros_like(x)), weights)
        return after(carry, record, index, samples[0], slopes, x + dt * total), None

    def block(carried, first):
        carried, _ = jax.lax.scan(one, carried, first + jnp.arange(every))
        return carried, carried[1]

    blank = jax.eval_shape(lambda sample: tuple(fold.init(sample) for fold in folds), shapes[1])
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), blank)
    same, there = jax.lax.stop_gradient((scenario, state))

    def rate_at(x):
        return accuracy.numbers(whole(loop(same, zero, ravel_pytree(accuracy.with_numbers(there, x))[0], zero)[0]))

    estimate = accuracy.begin(method, partial(jax.lax.map, rate_at), there)
    carry = Carry(state, blank, jnp.int32(0), Nearest(-jnp.ones_like(dt), zero, there), estimate)
    record = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(record_of, shapes[1], state)) if record_every else None
    (carry, _), records = jax.lax.scan(block, (carry, record), every * jnp.arange(steps // every + 1))
    carry = carry._replace(accuracy=accuracy.between_stages(scenario, carry.accuracy, method, dt, steps))
    times, states = critical_instants(scenario, dt, steps, carry)

    def mode(instant):
        t, state = instant
        return fastest_mode_by_differences(lambda x: loop(scenario, t, x, zero)[0], ravel_pytree(state)[0])

    modes = jax.lax.map(mode, (times, states))
    return verdict(folds, method, dt, carry, modes)._replace(records=records)


def run(scenario: Scenario, folds, dt, *, steps: int, record_every: int | None, method: str, alone: bool = False) -> Outcome:
    """The whole time loop for one run, pure and unchecked.

    Records are stacked every `record_every` steps; with None there are none, and memory does not grow with time.  `alone` says that
    nobody will batch it from outside, so that it, or its pieces, may become machine functions.
    """
    if is_for(scenario, dt):
        return run_compactly(scenario, folds, dt, steps=steps, record_every=record_every, method=method, alone=alone)
    one = partial(scan_steps, steps=steps, record_every=record_every, method=method)
    return (as_one_function(one) if alone else one)(scenario, folds, dt)


def stepped(scenario: Scenario, t: jax.Array, state, dt: jax.Array, method: str):
    """The state one step later.  As `integrators.step`, but a loop over the stages: the vector field is compiled once."""
    x, whole = ravel_pytree(state)

    def stage(slope_and_sum, weights):
        (k, total), (c, a, b) = slope_and_sum, weights
        k, _ = ravel_pytree(evaluate(scenario, t + c * dt, whole(x + dt * (a * k)))[0])
        return (k, total + b * k), None

    weights = tuple(jnp.asarray(w, x.dtype) for w in stages(method))
    (_, total), _ = jax.lax.scan(stage, (jnp.zeros_like(x), jnp.zeros_like(x)), weights)
    return whole(x + dt * total)


@partial(jax.jit, static_argnames=("length", "method"))
def onward(scenario: Scenario, first: jax.Array, states, dt: jax.Array, *, length: int, method: str):
    """The states before each of `length` steps, (R, length, ...), and after the last, from R states at the steps `first`, (R,)."""

    def one(state, index):
        return stepped(scenario, index.astype(dt.dtype) * dt, state, dt, method), state

    def row(first, state):
        last, before = jax.lax.scan(one, state, first + jnp.arange(length, dtype=first.dtype))
        return before, last

    return jax.vmap(row)(first, states)
