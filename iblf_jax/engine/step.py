"""What a step of a run is: the one definition that every executor steps.

At each instant k = 0 ... T the closed loop is evaluated once for record, metrics and the first stage of the integrator; a state that
runs away is frozen at its last good value and flagged, so that no NaN ever enters a batch or a gradient; the instant nearest to a bound
is remembered, because the loop is stiffest there.  The step from the last instant is not made: its sample alone counts.

A step is a function (inputs, carry, index) -> (carry, records) of ONE run, and hashable: two steps that are equal compile once.  Before
the first and after the last step come `start` and `verdict`, which hold no evaluation of the closed loop; what they need of it, its
Jacobian, is stepped for too (`Probe`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax import accuracy, integrators, stability
from iblf_jax.bounds import NARROWEST
from iblf_jax.closed_loop import LoopState, Sample, evaluate, initial_state
from iblf_jax.results import Rollout
from iblf_jax.scenario import Scenario
from iblf_jax.status import VELOCITY_LIMIT, Status, flag

RECORDED = tuple(f.name for f in dataclasses.fields(Rollout) if f.name in Sample._fields and f.name != "dt")
"""Names of the quantities that a run records."""


class Run(NamedTuple):
    """What to run, whatever the scenario: static."""

    steps: int
    method: str = "rk4"
    record_every: int | None = None
    """Every so-many-th instant is recorded, from t = 0; None: metrics only."""


class Inputs(NamedTuple):
    """What a run is made from: its leaves are inputs of what is compiled, never constants."""

    scenario: Scenario
    folds: Any
    dt: jax.Array
    steps: jax.Array
    """(), a float: whole numbers are no leaves of a scalar program."""


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


def start(inputs: Inputs, method: str, jacobian: jax.Array) -> Carry:
    """The carry before the first step; accumulators begin with the first sample, and are blank until then.

    Args:
      inputs: of the run.
      method: the integrator.
      jacobian: the closed loop's at the start.
    """
    state, zero = initial_state(inputs.scenario), jnp.zeros_like(inputs.dt)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(_accumulators, inputs, state))
    there = jax.lax.stop_gradient(state)
    estimate = accuracy.begin(method, jax.lax.stop_gradient(jacobian), there)
    return Carry(state, blank, jnp.int32(0), Nearest(-jnp.ones_like(zero), zero, there), estimate)


def _accumulators(inputs: Inputs, state: LoopState) -> tuple:
    sample = evaluate(inputs.scenario, jnp.zeros_like(inputs.dt), state, inputs.dt)[1]
    return tuple(fold.init(sample) for fold in inputs.folds)


class Advanced(NamedTuple):
    """A step that was made."""

    carry: Carry
    """After it."""
    sample: Sample
    accumulators: tuple
    """Of the folds, before the sample."""


def advance(
    inputs: Inputs, carry: Carry, index: jax.Array, method: str, rolled: bool, piece: Callable, loop: Callable = evaluate
) -> Advanced:
    """One step: observe, integrate, freeze what runs away.

    Args:
      inputs, carry: of the run.
      index: number of the instant, () int.
      method: the integrator.
      rolled: its stages as a loop.
      piece: what is made of a function that is compiled on its own (`TimeStep`).
      loop: stands for `closed_loop.evaluate`.
    """
    scenario, _, dt, steps = inputs
    t, moving = index.astype(dt.dtype) * dt, index.astype(dt.dtype) < steps
    covered = jnp.where(moving, dt, jnp.zeros_like(dt))
    at = piece(loop)
    stepped = integrators.step(method, lambda t, state: at(scenario, t, state, covered), t, carry.state, dt, rolled=rolled)

    def folded_in(inputs, carry, index, moving, stepped):
        folds, dt, sample = inputs.folds, inputs.dt, stepped.first
        begun = keep_if(index > 0, carry.accumulators, tuple(fold.init(sample) for fold in folds))
        accumulators = tuple(fold.update(acc, sample) for fold, acc in zip(folds, begun, strict=True))
        near = jnp.max(jnp.abs(jax.lax.stop_gradient(sample.xi)))
        here = Nearest(near, sample.t, jax.lax.stop_gradient(carry.state))
        nearest = keep_if(near > carry.nearest.xi, here, carry.nearest)
        estimate = accuracy.observed(carry.accuracy, method, dt, index, stepped.slopes, sample.upper - sample.lower)

        status = carry.status | sample_status(sample)
        sound = is_sound(stepped.state) & (status & int(Status.NOT_FINITE) == 0)
        state = keep_if(sound & moving, stepped.state, carry.state)
        status |= flag(~sound & moving, Status.NOT_FINITE)
        return Advanced(Carry(state, accumulators, status, nearest, estimate), sample, begun)

    return piece(folded_in)(inputs, carry, index, moving, stepped)


def record_of(sample: Sample, state: LoopState):
    """What is kept of a sample, and the states of law and observer."""
    return {name: getattr(sample, name) for name in RECORDED}, state.controller, state.observer


@dataclasses.dataclass(frozen=True)
class TimeStep:
    """One step of a run."""

    method: str
    recorded: bool = False

    def __call__(self, inputs: Inputs, carry: Carry, index: jax.Array, *, rolled: bool, piece: Callable = lambda f: f):
        """The carry after the step, and what is recorded; `piece` makes of the closed loop a function of its own."""
        found = advance(inputs, carry, index, self.method, rolled, piece)
        return found.carry, record_of(found.sample, carry.state) if self.recorded else ()


class Probed(NamedTuple):
    """Two states whose surroundings are looked at; they stay as they are."""

    times: jax.Array
    states: jax.Array
    """(2, m)."""


@dataclasses.dataclass(frozen=True)
class Probe:
    """The closed loop's rates at the 4 m states around two of its states, one a step, from which their Jacobians come."""

    def __call__(self, inputs: Inputs, carry: Probed, index: jax.Array, *, rolled: bool, piece: Callable = lambda f: f):
        """The two states again, and a rate, (m,)."""
        whole = ravel_pytree(initial_state(inputs.scenario))[1]
        around = 2 * carry.states.shape[1]
        second = index >= around
        t, x = (jnp.where(second, pair[1], pair[0]) for pair in carry)
        moved = stability.moved(x, jnp.where(second, index - around, index))
        slope, _ = piece(evaluate)(inputs.scenario, t, whole(moved), jnp.zeros_like(inputs.dt))
        return carry, ravel_pytree(slope)[0]


def probed(times: list[jax.Array], states: list[LoopState]) -> Probed:
    """The carry of a `Probe` of two states."""
    return jax.lax.stop_gradient(Probed(jnp.stack(times), jnp.stack([ravel_pytree(x)[0] for x in states])))


def jacobians(carry: Probed, rates: jax.Array) -> jax.Array:
    """The closed loop's Jacobians at two states, (2, m, m) [1/s], from the rates (4 m, m) of a `Probe`."""
    return jax.vmap(stability.jacobian_from)(carry.states, rates.reshape(2, -1, rates.shape[-1]))


def verdict(inputs: Inputs, run: Run, carry: Carry, modes: jax.Array) -> Outcome:
    """The folds' results and the accuracy, and the status with the verdict on the step, given the measured modes [1/s]."""
    estimate = accuracy.between_stages(inputs.scenario, carry.accuracy, run.method, inputs.dt, run.steps)
    mode = jnp.max(jnp.where(jnp.isfinite(modes), modes, 0.0))
    status = carry.status | flag(inputs.dt * mode > integrators.tableau(run.method).stability, Status.STEP_TOO_LARGE)
    status |= flag(~(estimate.relative <= accuracy.TOLERANCE), Status.INACCURATE)
    metrics = accuracy.results(estimate)
    for fold, acc in zip(inputs.folds, carry.accumulators, strict=True):
        metrics |= fold.finish(acc)
    return Outcome(None, metrics, status, mode)
