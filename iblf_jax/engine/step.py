"""What a step of a run is: the one definition that every executor steps.

At each instant k = 0 ... T the closed loop is evaluated once for record, metrics and the first
stage of the integrator.  Where its right-hand side or its signals jump, a step is integrated in
pieces (`simulation.discontinuities`), and the metrics see the limits from both sides; a step
without a jump costs no more than the comparison.  A state that runs away is frozen at its last good
value and flagged, so that no NaN ever enters a batch or a gradient; the instant nearest to a bound
is remembered, because the loop is stiffest there.  The step from the last instant is not made: its
sample alone counts.

A step is a function (inputs, carry, index) -> (carry, records) of ONE run, and hashable: two steps
that are equal compile once.  `start` creates the carry before the first step, and `outcome_of`
computes the result after the last one. Neither evaluates the closed loop: its Jacobian, which both
need, is computed by steps, too (`LinearizationStep`).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Var
from jax.flatten_util import ravel_pytree

from iblf_jax.core.status import VELOCITY_LIMIT, Status, flag
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.switching import Loop, with_hybrid_derivative
from iblf_jax.simulation import discontinuities, error_estimate, integrators, sampling, stability
from iblf_jax.simulation.closed_loop import (
    LoopState,
    evaluate,
    initial_state,
    integrated_part,
    perturbed_rate,
    perturbed_state,
    run_sampled_law_if_due,
    with_integrated_part,
)
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import SIGNALS, Sample, has, speed_margin
from iblf_jax.world.bounds import NARROWEST


class Inputs(NamedTuple):
    """What a run is made from: its leaves are inputs of what is compiled, never constants (but see
    `engine.mechanism`).
    """

    scenario: Scenario
    folds: Any
    dt: jax.Array
    steps: jax.Array
    """(), a float: integers are not leaves of a scalar program."""
    noise: Any = ()
    """Of a sampled loop, the key of each run's noise (`noise.noise_key`)."""
    direction: Any = ()
    """Tangents of leaves, where a step takes them as data."""


class Nearest(NamedTuple):
    """The instant at which a joint was nearest to its bound."""

    xi: jax.Array
    t: jax.Array
    state: Any
    """What `closed_loop.perturbed_state` gives there."""


class Carry(NamedTuple):
    """What goes from step to step."""

    state: LoopState
    accumulators: tuple
    status: jax.Array
    nearest: Nearest
    accuracy: error_estimate.Accuracy


class Outcome(NamedTuple):
    """What the time loop returns."""

    records: Any
    metrics: dict[str, jax.Array]
    status: jax.Array
    fastest_mode: jax.Array


def sample_status(sample: Sample) -> jax.Array:
    """The flags that one sample raises, () int32."""
    margin = jnp.minimum(sample.q - sample.lower, sample.upper - sample.q)
    found = (
        flag(jnp.any(~(margin > 0)), Status.BOUND_VIOLATED)
        | flag(jnp.any(sample.guard_active), Status.GUARD_ACTIVE)
        | flag(jnp.any(sample.guard_active) & (sample.t > 0), Status.GUARD_STAYED)
        | flag(jnp.any(sample.saturated), Status.TORQUE_SATURATED)
        | flag(~jnp.isfinite(sample.V), Status.NOT_FINITE)
    )
    if not has(sample, "slack"):  # a filter keeps its bounds wherever the reference goes
        narrowest = jnp.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
        found |= flag(jnp.any(narrowest < NARROWEST), Status.INFEASIBLE_REFERENCE)
    for slack in ("slack", "region_slack"):
        if has(sample, slack):
            found |= flag(jnp.any(getattr(sample, slack) > 0), Status.FILTER_INFEASIBLE)
    if has(sample, "region_margin"):
        found |= flag(jnp.any(~(sample.region_margin > 0)), Status.REGION_VIOLATED)
    if not has(sample, "dq_lower"):
        return found
    found |= flag(jnp.any(~(speed_margin(sample, sample.dq) > 0)), Status.VELOCITY_VIOLATED)
    return found | flag(
        jnp.any(~(speed_margin(sample, sample.alpha) > NARROWEST)), Status.ALPHA_INFEASIBLE
    )


def is_valid(state: LoopState) -> jax.Array:
    """Whether a state is finite and slow enough to be a robot's, () bool."""
    slow = jnp.all(jnp.abs(state.dq) < VELOCITY_LIMIT)
    others = jax.tree.leaves((state.q, integrated_part(state)[2:]))
    return jnp.all(jnp.stack([slow, *(jnp.all(jnp.isfinite(x)) for x in others)]))


def keep_if(condition, new, old):
    """`new` where the condition holds, leaf by leaf, else `old`."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def start(inputs: Inputs, method: str, jacobian: jax.Array) -> Carry:
    """The carry before the first step; accumulators that begin with something of the first sample
    are blank until then.

    Args:
      inputs: of the run.
      method: the integrator.
      jacobian: what a `LinearizationStep` has found at the start.
    """
    state, zero = initial_state(inputs.scenario), jnp.zeros_like(inputs.dt)
    blank = _begun(inputs.folds, _blank_sample(inputs, state))
    constant, jacobian = jax.lax.stop_gradient((state, jacobian))
    if inputs.scenario.sampling is not None:
        jacobian = stability.per_time(jax.lax.stop_gradient(inputs.scenario), constant, jacobian)
    estimate = error_estimate.begin(method, jacobian, constant)
    return Carry(
        state,
        blank,
        jnp.int32(0),
        Nearest(-jnp.ones_like(zero), zero, perturbed_state(constant)),
        estimate,
    )


def _blank_sample(inputs: Inputs, state: LoopState) -> Sample:
    """A sample of zeros."""
    shapes = jax.eval_shape(evaluate, inputs.scenario, inputs.dt, state, inputs.dt)[1]
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


def _begun(folds: Any, sample: Sample) -> tuple:
    """The accumulators before a first sample."""
    return tuple(fold.init(sample) for fold in folds)


def _begun_at(index: jax.Array, folds: Any, sample: Sample, accumulators: tuple) -> tuple:
    """The accumulators before an instant: begun with its sample if it is the first.

    What does not depend on the sample was begun by `start`, and costs no choice in every step.
    """
    closed, shapes = jax.make_jaxpr(_begun, return_shape=True)(folds, sample)
    depends = set(closed.jaxpr.invars[-len(jax.tree.leaves(sample)) :])
    for equation in closed.jaxpr.eqns:
        if not depends.isdisjoint(x for x in equation.invars if isinstance(x, Var)):
            depends.update(equation.outvars)
    chosen = jax.tree.unflatten(
        jax.tree.structure(shapes),
        [isinstance(x, Var) and x in depends for x in closed.jaxpr.outvars],
    )

    def of_first(depends_on_sample, new, old):
        if not depends_on_sample:
            return old
        return jnp.where(index > 0, old, new)

    return jax.tree.map(
        of_first,
        chosen,
        _begun(folds, sample),
        accumulators,
    )


class Node(NamedTuple):
    """A sample that the folds see."""

    before: tuple
    """Accumulators of the folds before it."""
    sample: Sample
    counts: Any
    """Whether there is such a sample, () bool; True for that of the instant."""


class Advanced(NamedTuple):
    """One step of a run, its samples folded in."""

    carry: Carry
    """After it."""
    nodes: tuple[Node, ...]
    """That of the instant first, whatever the order in time."""
    state: LoopState
    """At the instant, after what is due there."""

    @property
    def sample(self) -> Sample:
        """That of the instant."""
        return self.nodes[0].sample


def _as_it_is(function: Callable) -> Callable:
    return function


class StepOptions(NamedTuple):
    """How the code of a step is generated for an executor; the numbers do not depend on it."""

    rolled: bool = False
    """Whether the stages of the integrator are a loop."""
    piece: Callable = _as_it_is
    """Applied to every part of the step that is compiled as a function of its own."""
    scalar: bool = False
    """Whether the step becomes a scalar program, in which equal numbers are computed once."""


def is_derivative(step: Any) -> bool:
    """Whether a step computes derivatives; steps without such an attribute do not."""
    return getattr(step, "is_derivative", False)


class _Moment(NamedTuple):
    """Where a step is in time, and how it is divided."""

    span: discontinuities.Span
    division: discontinuities.Division
    behind: jax.Array
    """How long before the instant the last piece of the step before begins, () [s]; 0 at the first
    instant."""
    restarts: Any
    """Whether a jump lies in this step, or among those whose rates tell of its error, () bool; None
    in scenarios without jump times."""


class _Loop(NamedTuple):
    """The closed loop along a step."""

    evaluate: Callable
    inputs: Inputs
    state: LoopState
    """At the instant, after what is due there."""
    torques: tuple
    """Where the law is sampled, what arrives at the actuator: before a command arrives within the
    step, and after."""

    def at(
        self, piece: discontinuities.Piece, t: jax.Array, moved: LoopState
    ) -> tuple[LoopState, Sample]:
        """Rate and sample within a piece of the step."""
        torque = self.torques
        if torque and isinstance(piece.arrived, bool):
            torque = (torque[int(piece.arrived)],)
        elif torque:
            torque = (jnp.where(piece.arrived, torque[1], torque[0]),)
        return self.evaluate(
            self.inputs.scenario,
            discontinuities.stage_time(piece, t),
            with_integrated_part(self.state, moved),
            self.inputs.dt,
            *torque,
        )


def _moment(inputs: Inputs, index: jax.Array, method: str, arrivals: tuple | None) -> _Moment:
    """Where the step from an instant is in time.

    Args:
      inputs: of the run.
      index: number of the instant, () int.
      method: the integrator.
      arrivals: when commands arrive in this step and in the one before, as
        `discontinuities.divided` takes them; None where none can.
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
    behind = jnp.where(
        index > 0, discontinuities.since_last(times, before, last), jnp.zeros_like(dt)
    )
    restarts = None
    if times.size and inputs.scenario.sampling is None:
        reach = error_estimate.steps_back(method)
        restarts = discontinuities.within(times, (number - reach) * dt, span.end)
    return _Moment(span, discontinuities.divided(times, span, here), behind, restarts)


def _weighed(sample: Sample, t: jax.Array, weight: jax.Array, step: jax.Array) -> Sample:
    """A sample with its time, its weight in integrals, and the time since the instant before."""
    return dataclasses.replace(sample, t=t, dt=weight, step=step)


def _updated(folds: Any, accumulators: tuple, sample: Sample) -> tuple:
    """The accumulators after a sample."""
    return tuple(fold.update(acc, sample) for fold, acc in zip(folds, accumulators, strict=True))


def advance(
    inputs: Inputs,
    carry: Carry,
    index: jax.Array,
    method: str,
    options: StepOptions,
    loop: Callable = evaluate,
) -> Advanced:
    """One step: observe, integrate piece by piece, freeze what runs away.

    Args:
      inputs, carry: of the run.
      index: number of the instant, () int.
      method: the integrator.
      options: how its code is generated.
      loop: stands for `closed_loop.evaluate`.
    """
    begin = _continuous_start
    if inputs.scenario.sampling is not None:
        begin = _sampled_start
    start = begin(inputs, carry, index, method, options.piece(loop))
    along, moment, state = start.along, start.moment, start.along.state
    first = moment.division.pieces[0]
    stepped = _integrated(along, first, integrated_part(state), method, options)
    ahead = jnp.where(moment.span.counts, first.length, jnp.zeros_like(inputs.dt))
    step = jnp.where(index > 0, inputs.dt, jnp.zeros_like(inputs.dt))
    sample = _weighed(stepped.first, moment.span.start, 0.5 * (moment.behind + ahead), step)
    begun, accumulators = options.piece(_observed)(inputs, index, start.accumulators, sample)
    if inputs.scenario.sampling is None:
        stepped, accumulators = _across_jumps(
            along, first, state, method, stepped, begun, accumulators
        )
    later = _later_pieces(along, moment.division.pieces, stepped, accumulators, method, options)
    parts = [(first.length, stepped.slopes), *later.parts]
    after, status, nearest, estimate = options.piece(partial(_concluded, method))(
        inputs,
        carry,
        index,
        sample,
        parts,
        (with_integrated_part(state, later.moved), later.status),
        state,
        moment.span.counts,
        moment.restarts,
        moment.division.overfull,
    )
    nodes = (Node(begun, sample, True), *start.nodes, *later.nodes)
    return Advanced(Carry(after, later.accumulators, status, nearest, estimate), nodes, state)


class _Start(NamedTuple):
    """What a step begins with."""

    along: _Loop
    moment: _Moment
    accumulators: tuple
    """After the sample before the law runs, where there is one."""
    nodes: tuple[Node, ...]
    """That sample."""


def _continuous_start(
    inputs: Inputs, carry: Carry, index: jax.Array, method: str, evaluated: Callable
) -> _Start:
    """The start of a step of a loop whose law acts continuously."""
    moment = _moment(inputs, index, method, None)
    return _Start(_Loop(evaluated, inputs, carry.state, ()), moment, carry.accumulators, ())


def _sampled_start(
    inputs: Inputs, carry: Carry, index: jax.Array, method: str, evaluated: Callable
) -> _Start:
    """The start of a step of a sampled loop: its law runs where it is due, and commands arrive."""
    scenario, dt = inputs.scenario, inputs.dt
    assert scenario.sampling is not None
    now = sampling.instant(scenario.sampling, dt, index)
    due = (now.phase == 0) & (index > 0)
    t = index.astype(dt.dtype) * dt
    state = run_sampled_law_if_due(scenario, t, carry.state, now, inputs.noise)
    arriving = sampling.arriving(scenario.sampling, dt, now, state.sampled.commands)
    before = sampling.arrival_before(scenario.sampling, dt, now)
    arrivals = None
    if before is not None:
        arrivals = ((arriving.place * dt, arriving.changes), before)
    moment = _moment(inputs, index, method, arrivals)
    along = _Loop(evaluated, inputs, state, (arriving.torque, arriving.next))
    accumulators, nodes = _before_sample(along, carry, due, moment)
    behind = jnp.where(due, jnp.zeros_like(dt), moment.behind)
    return _Start(along, moment._replace(behind=behind), accumulators, nodes)


def _observed(
    inputs: Inputs, index: jax.Array, accumulators: tuple, sample: Sample
) -> tuple[tuple, tuple]:
    """The accumulators before and after the sample of an instant."""
    begun = _begun_at(index, inputs.folds, sample, accumulators)
    return begun, _updated(inputs.folds, begun, sample)


def _concluded(
    method: str,
    inputs: Inputs,
    carry: Carry,
    index: jax.Array,
    sample: Sample,
    parts: list,
    later: tuple[LoopState, Any],
    before: LoopState,
    goes_on: jax.Array,
    restarts: Any,
    overfull: Any,
) -> tuple[LoopState, jax.Array, Nearest, error_estimate.Accuracy]:
    """State, status, nearest instant and accuracy after a step; a state that runs away is frozen.

    Args:
      method: the integrator.
      inputs, carry: of the run.
      index: number of the instant, () int.
      sample: of the instant.
      parts: lengths and slopes of the pieces of the step.
      later: the state at the end of the step, and the flags raised within it.
      before: the state at its start.
      goes_on: whether the step is made, () bool.
      restarts, overfull: of `_Moment` and its division.
    """
    near = jnp.max(jnp.abs(jax.lax.stop_gradient(sample.xi)))
    here = Nearest(near, sample.t, jax.lax.stop_gradient(perturbed_state(before)))
    nearest = keep_if(near > carry.nearest.xi, here, carry.nearest)
    is_sampled = inputs.scenario.sampling is not None
    width = sample.upper - sample.lower
    estimate = error_estimate.update(
        carry.accuracy, method, inputs.dt, index, parts, width, is_sampled, restarts, overfull
    )
    after, raised = later
    status = carry.status | sample_status(sample)
    if raised is not None:
        status = status | raised
    valid = is_valid(after) & (status & int(Status.NOT_FINITE) == 0)
    status |= flag(~valid & goes_on, Status.NOT_FINITE)
    return keep_if(valid & goes_on, after, before), status, nearest, estimate


def _across_jumps(
    along: _Loop,
    piece: discontinuities.Piece,
    before: LoopState,
    method: str,
    stepped: integrators.Stepped,
    begun: tuple,
    accumulators: tuple,
) -> tuple[integrators.Stepped, tuple]:
    """A piece of a step and the accumulators, with their derivatives across jumps of the command;
    values stay as they are.

    Args:
      along: the loop, whose law is not sampled.
      piece: of the step.
      before: state at its start.
      method: the integrator.
      stepped: what the integrator has made of it.
      begun, accumulators: of the folds, before and after the sample at its start.
    """
    inputs, dt = along.inputs, along.inputs.dt
    counts = (
        piece.begin < (inputs.steps - 0.5) * dt
    )  # no metric counts what comes after the end of a run

    def rate(t, state):
        return evaluate(inputs.scenario, discontinuities.stage_time(piece, t), state, dt)

    def gains_of(sample):
        def sums(weight):
            weighed = dataclasses.replace(sample, dt=weight)
            return _split_floats(_updated(inputs.folds, begun, weighed))[0]

        gains = jax.jvp(sums, (sample.dt,), (jnp.ones_like(sample.dt),))[1]
        return [jnp.where(counts, gain, jnp.zeros_like(gain)) for gain in gains]

    floats, replaced = _split_floats(accumulators)
    loop = Loop(inputs.scenario, rate, gains_of)
    after, floats = with_hybrid_derivative(
        loop, method, piece.begin, before, piece.length, stepped, floats
    )
    return stepped._replace(state=after), replaced(floats)


def _split_floats(tree: Any) -> tuple[list[jax.Array], Callable]:
    """The floating-point numbers of a tree, and the function that puts others in their place."""
    leaves, treedef = jax.tree.flatten(tree)
    places = [i for i, x in enumerate(leaves) if jnp.issubdtype(jnp.result_type(x), jnp.floating)]

    def replaced(floats):
        new = list(leaves)
        for i, x in zip(places, floats, strict=True):
            new[i] = x
        return jax.tree.unflatten(treedef, new)

    return [leaves[i] for i in places], replaced


def _integrated(
    along: _Loop, piece: discontinuities.Piece, moved: LoopState, method: str, options: StepOptions
) -> integrators.Stepped:
    """One step of the integrator over a piece."""
    return integrators.step(
        method,
        lambda t, x: along.at(piece, t, x),
        piece.begin,
        moved,
        piece.length,
        rolled=options.rolled,
    )


def _before_sample(
    along: _Loop, carry: Carry, due: jax.Array, moment: _Moment
) -> tuple[tuple, tuple[Node, ...]]:
    """The accumulators after the sample just before the law runs, where it is due; and that sample.

    The law's signals, and without a delay the torque, jump there.
    """
    folds, scenario, dt = along.inputs.folds, along.inputs.scenario, along.inputs.dt
    if not folds:
        return carry.accumulators, ()
    commands = carry.state.sampled.commands
    pending = along.state.sampled.commands
    schedule: Any = scenario.sampling
    torque = sampling.torque_before(schedule, dt, commands, pending)
    t, behind = moment.span.start, moment.behind
    seen_at = (
        t
        if moment.division.pieces[0].earliest is None
        else discontinuities.before_jumps(scenario.jump_times(), t)
    )

    def seen(accumulators):
        sample = along.evaluate(scenario, seen_at, carry.state, dt, torque)[1]
        sample = _weighed(sample, t, 0.5 * behind, jnp.zeros_like(dt))
        return _updated(folds, accumulators, sample), sample

    after, sample = _if(due, seen, carry.accumulators)
    return after, (Node(carry.accumulators, sample, due),)


def _if(condition: jax.Array, made: Callable, kept: Any) -> tuple[Any, Any]:
    """`made(kept)`, new values and anything else, where a condition holds; else the values as they
    are, and zeros.
    """
    shapes = jax.eval_shape(made, kept)[1]

    def otherwise(kept):
        return kept, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    return jax.lax.cond(condition, made, otherwise, kept)


class _Later(NamedTuple):
    """What the pieces of a step after the first give."""

    moved: LoopState
    """At the end of the step."""
    accumulators: tuple
    parts: list[tuple[jax.Array, list]]
    """Length [s] of each piece, and the slopes of its stages."""
    nodes: tuple[Node, ...]
    status: Any
    """The flags that its samples raise, () int32; None where there are none."""


def _later_pieces(
    along: _Loop,
    pieces: tuple[discontinuities.Piece, ...],
    stepped: integrators.Stepped,
    accumulators: tuple,
    method: str,
    options: StepOptions,
) -> _Later:
    """The pieces after the first, each with the samples before and after the jump at which it
    begins.
    """
    # These pieces are rare: their stages are a loop, which compiles in a fraction of the time.
    folds, none = along.inputs.folds, jnp.zeros_like(along.inputs.dt)
    moved, parts, nodes = stepped.state, [], []
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
                left = _weighed(left, piece.begin, 0.5 * last.length, none)
                between = accumulators = _updated(folds, accumulators, left)
            made = _integrated(
                along, piece, moved, method, options._replace(rolled=not options.scalar)
            )
            right = _weighed(made.first, piece.begin, 0.5 * piece.length, none)
            accumulators = ()
            if folds:
                accumulators = _updated(folds, between, right)
            if along.inputs.scenario.sampling is None:
                made, accumulators = _across_jumps(
                    along, piece, moved, method, made, between, accumulators
                )
            return (made.state, accumulators, status | sample_status(right)), (
                made.slopes,
                left,
                between,
                right,
            )

        before = accumulators
        (moved, accumulators, status), (slopes, left, between, right) = _if(
            piece.made, further, (moved, accumulators, status)
        )
        parts.append((piece.length, slopes))
        if folds:
            nodes += [Node(before, left, piece.made), Node(between, right, piece.made)]
    return _Later(moved, accumulators, parts, tuple(nodes), status)


def recorded(folds: Any, found: Advanced):
    """What a run keeps of an instant: the sample, and the states of law and observer."""
    state, measured = found.state, ()
    if state.sampled:
        measured = state.sampled.measured
    states = (
        state.controller,
        state.observer,
        state.actuator,
        measured,
    )
    return {name: getattr(found.sample, name) for name in SIGNALS}, *states


def samples_of_step(scenario: Scenario) -> int:
    """How many samples the folds see of a step at most: `Advanced.nodes`."""
    arrives = scenario.sampling is not None and scenario.sampling.queue > 0
    cuts = min(scenario.jump_times().size, discontinuities.MAX_CUTS) + arrives
    return 1 + (scenario.sampling is not None) + 2 * cuts


@dataclasses.dataclass(frozen=True)
class TimeStep:
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


class Linearization(NamedTuple):
    """The carry of a `LinearizationStep`: a state around which the closed loop is linearized.

    The state does not change, so what it decides is computed once.
    """

    time: jax.Array
    state: jax.Array
    """(m,)."""
    growth: stability.Growth
    """Of the power iteration."""
    jacobian: jax.Array
    """By the numbers that `error_estimate` watches, by differences of three sizes,
    (3, m', m') [1/s]; `stability.resolved` makes one of them."""
    unresolved: error_estimate.UnresolvedSignals
    """Of the run; its torque is turned into what it accelerates, as that takes the robot's mass
    matrix."""


@dataclasses.dataclass(frozen=True)
class LinearizationStep:
    """The closed loop's derivative along one direction after the other.

    The directions are at first the unit vectors of the numbers that `error_estimate` watches.
    Where these are the complete state, the modes follow from them; otherwise a power iteration adds
    more directions.
    """

    def __call__(
        self, inputs: Inputs, carry: Linearization, index: jax.Array, options: StepOptions
    ):
        """The carry after the step; nothing is recorded."""
        start = initial_state(inputs.scenario)
        watched, x = error_estimate.watched_indices(start), carry.state
        as_state = ravel_pytree(perturbed_state(start))[1]
        iteration = index - 3 * watched.size
        count = jnp.asarray(watched.size, index.dtype)
        level = jax.lax.div(index, count)
        number = index - level * count
        rank = np.full(x.size, -1, index.dtype)
        rank[watched] = np.arange(watched.size)
        unit = (jnp.asarray(rank) == number).astype(x.dtype)
        direction = jnp.where(iteration < 0, unit, carry.growth.direction)

        def rate_at(y):
            return ravel_pytree(
                perturbed_rate(inputs.scenario, carry.time, as_state(y), inputs.dt, options.piece)
            )[0]

        plant = as_state(x)
        if inputs.scenario.sampling is not None:
            plant = plant.plant
        rooms = stability.largest_difference_sizes(inputs.scenario, carry.time, plant, x.size)
        room = jnp.where(
            iteration < 0, jnp.sum(rooms * unit), jnp.asarray(stability.THIRD_SIZE, x.dtype)
        )
        sizes = stability.difference_sizes(x, direction, room)
        widest = level == 2
        if (
            len(watched) < x.size
        ):  # a power iteration follows, across infinite slopes by the widest differences
            widest |= (iteration >= 0) & jnp.any(
                stability.is_steep(carry.jacobian, inputs.scenario.sampling is not None)
            )
        size = jnp.where(
            widest, sizes[2], jnp.where((level == 1) & (iteration < 0), sizes[1], sizes[0])
        )
        w, growth = stability.directional_derivative(rate_at, x, direction, size), carry.growth
        if len(watched) < x.size:
            growth = keep_if(iteration < 0, growth, stability.grown(growth, w, iteration))
        columns = jnp.arange(watched.size, dtype=index.dtype) == number
        chosen = (jnp.arange(3, dtype=index.dtype) == level)[:, None, None] & columns
        jacobian = jnp.where(chosen, jnp.stack([w[i] for i in watched])[:, None], carry.jacobian)
        unresolved = keep_if(
            index == 0,
            error_estimate.with_acceleration(inputs.scenario, carry.unresolved),
            carry.unresolved,
        )
        return Linearization(carry.time, x, growth, jacobian, unresolved), ()


def linearization_steps(scenario: Scenario) -> int:
    """Steps of a `LinearizationStep`."""
    state = initial_state(scenario)
    watched = error_estimate.watched_indices(state).size
    if watched == ravel_pytree(perturbed_state(state))[0].size:
        return 3 * watched
    return 3 * watched + stability.POWER_ITERATIONS


def fastest_mode(scenario: Scenario, found: Linearization) -> jax.Array:
    """The mode that a `LinearizationStep` has found, () [1/s]: of what a step integrates."""
    jacobian = stability.resolved(found.jacobian, scenario.sampling is not None)
    if scenario.sampling is not None:
        size = ravel_pytree(integrated_part(initial_state(scenario)))[0].size
        return stability.growth_rate_by(jacobian[:size, :size])
    is_complete = len(jacobian) == found.state.size
    if is_complete:
        return stability.growth_rate_by(jacobian)
    return stability.growth_rate(found.growth)


def linearization_at(
    time: jax.Array, state: Any, watched: int, unresolved: error_estimate.UnresolvedSignals
) -> Linearization:
    """The carry of a `LinearizationStep` at a state, as `perturbed_state` gives it, of which
    `error_estimate` watches so many numbers.
    """
    x = ravel_pytree(state)[0]
    return jax.lax.stop_gradient(
        Linearization(
            time,
            x,
            stability.growth_start(x),
            jnp.zeros((3, watched, watched), x.dtype),
            unresolved,
        )
    )


def finished(folds: Any, accumulators: tuple) -> dict[str, jax.Array]:
    """The results of all folds."""
    found: dict[str, jax.Array] = {}
    for fold, acc in zip(folds, accumulators, strict=True):
        found |= fold.finish(acc)
    return found


def folded(folds: Any, samples: Sample) -> dict[str, jax.Array]:
    """The results of all folds over a run that is over, its samples with time first."""
    first = jax.tree.map(lambda x: x[0], samples)
    return finished(
        folds,
        jax.lax.scan(
            lambda acc, sample: (_updated(folds, acc, sample), None), _begun(folds, first), samples
        )[0],
    )


def outcome_of(
    inputs: Inputs,
    method: str,
    carry: Carry,
    unresolved: error_estimate.UnresolvedSignals,
    instants: Linearization,
) -> Outcome:
    """The folds' results and the accuracy, and the status with the verdict on the step.

    Args:
      inputs: of the run.
      method: the integrator.
      carry: after the last step.
      unresolved: what a `LinearizationStep` has found for the run.
      instants: what it has found at some of them.
    """
    estimate = error_estimate.with_unresolved(carry.accuracy, unresolved)
    modes = jax.vmap(partial(fastest_mode, inputs.scenario))(instants)
    mode = jnp.max(jnp.where(jnp.isfinite(modes), modes, 0.0))
    limit = integrators.tableau(method).stability
    status = carry.status | flag(inputs.dt * mode > limit, Status.STEP_TOO_LARGE)
    # A column is at least as long as the mode that it alone would make.
    steepest = jnp.sum(jnp.abs(instants.jacobian[:, 0]), axis=-2)
    steep = stability.is_steep(instants.jacobian, inputs.scenario.sampling is not None) & (
        inputs.dt * steepest > limit
    )
    status |= flag(~(estimate.relative <= error_estimate.TOLERANCE), Status.INACCURATE)
    suffers = status & int(Status.STEP_TOO_LARGE | Status.INACCURATE) != 0
    status |= flag(jnp.any(steep) & suffers, Status.INFINITE_SLOPE)
    metrics = error_estimate.results(estimate)
    if inputs.scenario.sampling is not None:
        maps = jax.vmap(partial(stability.period_map, inputs.scenario, carry.state))(
            stability.resolved(instants.jacobian, sampled=True)
        )
        radii = jax.lax.stop_gradient(jax.vmap(stability.spectral_radius)(maps))
        metrics[stability.RADIUS] = jnp.max(jnp.where(jnp.isfinite(radii), radii, 0.0))
        status |= flag(metrics[stability.RADIUS] > 1.0, Status.SAMPLING_TOO_SLOW)
    metrics |= finished(inputs.folds, carry.accumulators)
    return Outcome(None, metrics, status, mode)
