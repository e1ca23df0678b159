"""The control law as scalar programs that a robot's computer runs: the start, and one sample of
velocity filter, observer and law.

A sample is `closed_loop.law_update` after the sensor's velocity filter.  The effects of an encoder
(counts, offset, noise) are those of the robot's own encoder.  The leaves of the scenario that the
programs read are the parameters that a user of the generated code can set.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from iblf_jax.control import controllers, observers
from iblf_jax.control.sensors import Ideal, Levels, Measurement
from iblf_jax.control.sensors._base import measurement_of
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, is_absent, leaf
from iblf_jax.engine import LOWERING_LIMITS
from iblf_jax.kernels import Program, Shapes, compile_step, written_out
from iblf_jax.simulation.closed_loop import discrete_observer, law_update, plant_input
from iblf_jax.simulation.levels import start_levels
from iblf_jax.simulation.sampling import SentCommand, nothing_sent
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants
from iblf_jax.world.references import Reference

S = TypeVar("S")


@component
class GivenReference(Reference):
    """A reference that is an input of every sample: q_d(s) = q_d + q_d' (s - t) + q_d" (s - t)^2 /
    2 + ...

    Args:
      t: time of the sample, () [s].
      q_d: reference there, () or (n,) [rad].
      dq_d: its velocity, () or (n,) [rad/s].
      ddq_d: its acceleration, () or (n,) [rad/s^2].
      further_d: its derivatives from the third on, (m, n) [1]; none if not given.
    """

    t: Leaf = leaf("s", shape="scalar")
    q_d: Leaf = leaf("rad")
    dq_d: Leaf = leaf("rad/s")
    ddq_d: Leaf = leaf("rad/s^2")
    further_d: Leaf = leaf("1", shape="level", default=None)

    def position(self, t: jax.Array) -> jax.Array:
        """q_d(t), (n,) [rad]."""
        s = t - self.t
        acceleration = self.ddq_d
        if self.further_d is not None:
            # The sum of 2 s^k/(k + 2)! times the derivative k + 2, from k = 1 on.
            further = jnp.zeros_like(self.further_d[0])
            for k in range(len(self.further_d), 0, -1):
                further = s * (1.0 / (k + 2)) * (self.further_d[k - 1] + further)
            acceleration = acceleration + further
        return self.q_d + s * (self.dq_d + 0.5 * s * acceleration)


class LawState(NamedTuple):
    """The internal state of the law between samples; the generated C calls it `memory`."""

    controller: controllers.State
    observer: observers.State
    velocity: tuple[Any, ...]
    """The states of the sensor's velocity filters."""
    sent: SentCommand | tuple[()] = ()
    """The `SentCommand` of a law with an event trigger."""


class SampleInputs(NamedTuple):
    """Inputs of the law at a sample; the reference's fields are empty if the reference is
    internal.
    """

    t: jax.Array
    q: jax.Array
    dq: jax.Array
    higher: jax.Array | tuple[()] = ()
    """Levels of the model from the third on, (r - 2, n); `()` for a model of two levels."""
    q_d: jax.Array | tuple[()] = ()
    dq_d: jax.Array | tuple[()] = ()
    ddq_d: jax.Array | tuple[()] = ()
    further_d: jax.Array | tuple[()] = ()
    """Derivatives of the reference from the third to the r-th, (r - 2, n)."""


class Outputs(NamedTuple):
    """Outputs of the law at a sample."""

    tau: jax.Array
    """Input of the plant, (n,): of a robot the torque [N m]."""
    alpha: jax.Array
    f_hat: jax.Array
    """Estimate of the observer: a torque (n,) [N m], or rates of the levels (r, n)."""
    outside: jax.Array
    guarded: jax.Array
    saturated: jax.Array
    infeasible: jax.Array


FLAGS = ("outside", "guarded", "saturated", "infeasible")
"""Fields of `Outputs` that are flags, in the order of their bits."""


def _with_reference(scenario: Scenario, inputs: SampleInputs) -> Scenario:
    """The scenario, with the reference of the inputs if these have one."""
    if isinstance(inputs.q_d, tuple):
        return scenario
    reference = GivenReference(inputs.t, inputs.q_d, inputs.dq_d, inputs.ddq_d)
    if not is_absent(inputs.further_d):
        reference = dataclasses.replace(reference, further_d=inputs.further_d)
    return dataclasses.replace(scenario, reference=reference)


def inputs_at_start(scenario: Scenario) -> SampleInputs:
    """The time 0 and the levels of the plant at the start that the law measures."""
    x = start_levels(scenario)[: scenario.loop.model.order]
    return SampleInputs(jnp.zeros((), x.dtype), *measurement_of(x))


def _levels(inputs: SampleInputs) -> jax.Array:
    """The levels of the model that the inputs have, (r, n)."""
    return Measurement(inputs.q, inputs.dq, inputs.higher).x


def start(scenario: Scenario, inputs: SampleInputs) -> tuple[LawState, jax.Array]:
    """The state before the first sample, and the input that keeps the model at rest."""
    scenario = _with_reference(scenario, inputs)
    loop, x = scenario.loop, _levels(inputs)
    controller = loop.law.init(x, scenario.context)
    observer = discrete_observer(scenario).init(x, loop.model)
    period = scenario.sampling.period  # type: ignore[union-attr]
    filtered = tuple(
        velocity.init(x[row - 1], x[row], period) for row, velocity in velocity_filters(scenario)
    )
    balance = loop.model.steady_input(x[0])
    if balance is None:  # a model that states none
        balance = jnp.zeros_like(x[0])
    elif isinstance(scenario.controller, controllers.WithDrive):
        balance = scenario.controller.voltage(balance, jnp.zeros_like(x[0]))
    sent: SentCommand | tuple[()] = ()
    if scenario.sampling.trigger is not None:  # type: ignore[union-attr]
        sent = nothing_sent(balance)
    return LawState(controller, observer, filtered, sent), balance


def sample(scenario: Scenario, inputs: SampleInputs, state: LawState) -> tuple[LawState, Outputs]:
    """One sample: the state for the next sample, and the outputs."""
    scenario = _with_reference(scenario, inputs)
    period = scenario.sampling.period  # type: ignore[union-attr]
    levels = list(_levels(inputs))
    filtered = []
    for (row, velocity), before in zip(velocity_filters(scenario), state.velocity, strict=True):
        normal = jnp.zeros((velocity.draws, scenario.n), inputs.q.dtype)
        levels[row], after = velocity.estimate(levels[row - 1], levels[row], normal, period, before)
        filtered.append(after)
    measured = measurement_of(jnp.stack(levels))
    update = law_update(scenario, inputs.t, measured, state.controller, state.observer, state.sent)
    output = update.output
    tube = scenario.context.tube(inputs.t)
    infeasible = jnp.zeros((), bool)
    for slack in jax.tree.leaves((output.slack, output.region_slack)):
        infeasible |= jnp.any(slack > 0)
    outputs = Outputs(
        plant_input(output),
        output.alpha,
        update.estimate,
        ~jnp.all((inputs.q > tube.lower) & (inputs.q < tube.upper)),
        jnp.any(output.guard_active),
        jnp.any(output.saturated),
        infeasible,
    )
    return LawState(update.controller, update.observer, tuple(filtered), update.sent), outputs


def bounds_at(scenario: Scenario, inputs: SampleInputs) -> tuple[jax.Array, jax.Array]:
    """The lower and the upper bounds of the positions at the time of a sample, (n,) each [rad]."""
    tube = _with_reference(scenario, inputs).context.tube(inputs.t)
    return tube.lower, tube.upper


class VelocityFilter(NamedTuple):
    """A velocity filter of the sensor."""

    row: int
    """Of x, (r, n), that it computes from the row before."""
    velocity: Any


def velocity_filters(scenario: Scenario) -> list[VelocityFilter]:
    """The velocity filters of the sensor for the levels of the model."""
    order = plants.order_of(scenario.model)
    parts = [(0, scenario.sensor)]
    if isinstance(scenario.sensor, Levels):
        parts = [(span.levels.start, span.part) for span in scenario.sensor.spans()]
    filters = [VelocityFilter(row + 1, part.velocity) for row, part in parts]
    return [x for x in filters if x.velocity is not None and x.row < order]


def _check_sensor(scenario: Scenario) -> None:
    """Raises ValueError for a sensor, or a part of one, of which only the robot has the reading."""
    parts = {"scenario.sensor": scenario.sensor}
    if isinstance(scenario.sensor, Levels):
        spans = enumerate(scenario.sensor.spans())
        parts = {f"scenario.sensor.parts[{i}]": span.part for i, span in spans}
    for name, part in parts.items():
        has_level = part.levels == 1
        if has_level or isinstance(part, Ideal) or part.velocity is not None:
            continue
        expected = "one with a field `velocity`, sensors.Levels or sensors.Ideal()"
        remedy = "The velocity filter computes q' from q."
        raise checks.fail(name, type(part).__name__, expected, remedy)


class ControlLaw(NamedTuple):
    """The programs of a scenario's law; they share the leaves of the scenario and read
    `SampleInputs` as per-run leaves.
    """

    start: Program
    """The program of `start`; its results are the state and the input of the plant."""
    sample: Program
    """The program of `sample`; its carry is the state, and its results are `Outputs`."""
    state_names: tuple[str, ...]
    """Names of the numbers of the state."""
    unread: tuple[int, ...]
    """The levels, counted from 1, that a sample does not read; only the start does."""
    estimate_size: int
    """Numbers of the observer's estimate."""
    bounds: Program
    """The program of `bounds_at`; its results are the lower and the upper bounds."""


def control_law(scenario: Scenario, external_reference: bool) -> ControlLaw:
    """The programs of the law of a sampled scenario, with the floating-point type of its leaves.

    Args:
      scenario: canonical.
      external_reference: whether the reference is an input; otherwise it is a function of t.

    Raises:
      ValueError: a sensor whose velocity filter is not known.
      UnsupportedError: the law cannot be lowered; the message states the reason.
    """
    _check_sensor(scenario)
    q = scenario.initial.q
    dtype = q.dtype
    inputs = inputs_at_start(scenario)
    if external_reference:
        inputs = inputs._replace(q_d=q, dq_d=q, ddq_d=q, further_d=inputs.higher)
    shapes, _ = jax.eval_shape(start, scenario, inputs)
    like = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    state = as_floats(like, dtype)

    def start_step(scenario, inputs, carry, index):
        state, tau = start(scenario, inputs)
        return (), (as_floats(state, dtype), tau)

    def sample_step(scenario, inputs, carry, index):
        state, outputs = sample(scenario, inputs, of_floats(carry, like))
        return as_floats(state, dtype), outputs

    def bounds_step(scenario, inputs, carry, index):
        return (), bounds_at(scenario, inputs)

    start_program = program_of(start_step, scenario, inputs, ())
    sample_program = program_of(sample_step, scenario, inputs, state)
    bounds_program = program_of(bounds_step, scenario, inputs, ())
    # The levels follow the time, n numbers each.
    levels = {
        (node.value - 1) // scenario.n + 1 for node in sample_program.nodes if node.op == "per_run"
    }
    unread = tuple(i for i in range(2, plants.order_of(scenario.model) + 1) if i not in levels)
    estimate = jax.eval_shape(sample, scenario, inputs, like)[1].f_hat
    names = number_names(state)
    return ControlLaw(start_program, sample_program, names, unread, estimate.size, bounds_program)


def as_floats(state: S, dtype: DTypeLike) -> S:
    """The state as floats of one type; integers and flags become 0.0, 1.0, ..."""
    return jax.tree.map(lambda x: x.astype(dtype), state)


def of_floats(state: S, like: S) -> S:
    """The inverse of `as_floats`, with the types of `like`."""

    def converted(x: jax.Array, kind: jax.Array) -> jax.Array:
        if kind.dtype == bool:
            return x > 0.5
        return x.astype(kind.dtype)

    return jax.tree.map(converted, state, like)


def program_of(function: Callable, scenario: Scenario, given: object, carry: object) -> Program:
    """The scalar program of `function(scenario, given, carry, index) -> (carry, results)`.

    Args:
      function: the function to lower.
      scenario: its leaves are the program's shared numbers.
      given: a pytree of arrays or their shapes, the per-run leaves.
      carry: a pytree of the same kind, carried from call to call.

    Raises:
      UnsupportedError: the function cannot be lowered; the message states the reason.
    """
    trees = [jax.tree.structure(x) for x in (scenario, given, carry)]

    def on_leaves(shared, per_run, carried, index):
        parts = [
            jax.tree.unflatten(tree, x)
            for tree, x in zip(trees, (shared, per_run, carried), strict=True)
        ]
        after, results = function(*parts, index)
        return jax.tree.leaves(after), jax.tree.leaves(results)

    dtype = np.dtype(scenario.initial.q.dtype)
    shared, per_run, carried = (Shapes.of(jax.tree.leaves(x)) for x in (scenario, given, carry))
    step = compile_step(on_leaves, dtype, shared, per_run, carried, LOWERING_LIMITS)
    return written_out(step.program)


def number_names(tree: object) -> tuple[str, ...]:
    """Names of the numbers of a pytree of arrays, such as "observer.p[1]"."""
    names = list[str]()
    for path, x in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path).lstrip(".")
        names += [name + "".join(f"[{i}]" for i in place) for place in np.ndindex(x.shape)]
    return tuple(names)
