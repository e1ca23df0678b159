"""What a robot's computer runs once a period, as scalar programs: the start, and a sample of
velocity filter, observer and law.

It is `closed_loop.law_update`, with the sensor's velocity filter before it.  What an encoder does to
a position (counts, offset, noise) the robot's own does.  Which leaves of the scenario the programs
read decides what a user of the generated code can set.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.sensors import Ideal, Measurement
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.engine import lowering_limits
from iblf_jax.kernels import Program, Shapes, compile_step, written_out
from iblf_jax.simulation.closed_loop import discrete_observer, law_update
from iblf_jax.simulation.scenario import Scenario


@component
class GivenReference:
    """A reference that is told at every sample: q_d(s) = q_d + q_d' (s - t) + q_d" (s - t)^2 / 2.

    Args:
      t: time of the sample, () [s].
      q_d: reference there, () or (n,) [rad].
      dq_d: its velocity, () or (n,) [rad/s].
      ddq_d: its acceleration, () or (n,) [rad/s^2].
    """

    t: Leaf = leaf("s", shape="scalar")
    q_d: Leaf = leaf("rad")
    dq_d: Leaf = leaf("rad/s")
    ddq_d: Leaf = leaf("rad/s^2")

    def position(self, t: jax.Array) -> jax.Array:
        """q_d(t), (n,) [rad]."""
        s = t - self.t
        return self.q_d + s * (self.dq_d + 0.5 * s * self.ddq_d)


class Memory(NamedTuple):
    """What goes from sample to sample."""

    controller: Any
    observer: Any
    velocity: Any


class Told(NamedTuple):
    """What the law is told at a sample; the reference's fields are empty where it is inside."""

    t: jax.Array
    q: jax.Array
    dq: jax.Array
    q_d: Any = ()
    dq_d: Any = ()
    ddq_d: Any = ()


class Outputs(NamedTuple):
    """What it answers."""

    tau: jax.Array
    alpha: jax.Array
    f_hat: jax.Array
    outside: jax.Array
    guarded: jax.Array
    saturated: jax.Array
    infeasible: jax.Array


FLAGS = ("outside", "guarded", "saturated", "infeasible")
"""Fields of `Outputs` that are flags, in the order of their bits."""


def _at(scenario: Scenario, told: Told) -> Scenario:
    """The scenario, with the reference that it is told if it is."""
    if isinstance(told.q_d, tuple):
        return scenario
    return dataclasses.replace(
        scenario, reference=GivenReference(told.t, told.q_d, told.dq_d, told.ddq_d)
    )


def start(scenario: Scenario, told: Told) -> tuple[Memory, jax.Array]:
    """The memory before the first sample, and the torque that holds the model still."""
    scenario, velocity = _at(scenario, told), _velocity(scenario)
    q, dq = told.q, told.dq
    observer = discrete_observer(scenario).init(q, dq, scenario.model)
    filtered = () if velocity is None else velocity.init(q, dq, scenario.sampling.period)  # type: ignore[union-attr]
    return Memory(
        scenario.controller.init(q, dq, scenario.context), observer, filtered
    ), scenario.model.gravity(q)


def sample(scenario: Scenario, told: Told, memory: Memory) -> tuple[Memory, Outputs]:
    """One sample: the memory at the next one, and what is said."""
    scenario, velocity, n = _at(scenario, told), _velocity(scenario), scenario.n
    dq, filtered = told.dq, ()
    if velocity is not None:
        assert scenario.sampling is not None
        normal = jnp.zeros((velocity.draws, n), told.q.dtype)
        dq, filtered = velocity.estimate(
            told.q, told.dq, normal, scenario.sampling.period, memory.velocity
        )
    answer = law_update(
        scenario, told.t, Measurement(told.q, dq), memory.controller, memory.observer
    )
    command, tube = answer.command, scenario.context.tube(told.t)
    infeasible = jnp.zeros((), bool)
    for slack in jax.tree.leaves((command.slack, command.region_slack)):
        infeasible |= jnp.any(slack > 0)
    said = Outputs(
        command.tau,
        command.alpha,
        answer.f_hat,
        ~jnp.all((told.q > tube.lower) & (told.q < tube.upper)),
        jnp.any(command.guard_active),
        jnp.any(command.saturated),
        infeasible,
    )
    return Memory(answer.controller, answer.observer, filtered), said


def _velocity(scenario: Scenario) -> Any:
    """What makes velocities of positions; None where the law is told them."""
    return None if isinstance(scenario.sensor, Ideal) else scenario.sensor.velocity  # type: ignore[attr-defined]


class ControlLaw(NamedTuple):
    """The programs of a scenario's law; leaves of the scenario are shared, numbers of `Told` are a
    lane's.
    """

    start: Program
    """Of `start`; its samples are the memory and the torque."""
    sample: Program
    """Of `sample`; it carries the memory, and its samples are `Outputs`."""
    memory: tuple[str, ...]
    """What each number of the memory is."""
    reads_velocity: bool
    """Whether q' is an input."""


def control_law(scenario: Scenario, told_reference: bool) -> ControlLaw:
    """The programs of the law of a scenario that is sampled, in the type of its numbers.

    Args:
      scenario: canonical.
      told_reference: the reference is told at every sample; else it is inside.

    Raises:
      ValueError: a sensor whose velocity filter is not known.
      UnsupportedError: the law does not lower; the message says why.
    """
    if not isinstance(scenario.sensor, Ideal) and not hasattr(scenario.sensor, "velocity"):
        kind = type(scenario.sensor).__name__
        raise checks.fail(
            "scenario.sensor",
            kind,
            "one with a field `velocity`, or sensors.Ideal()",
            "It says how q' follows from q.",
        )
    told = told_at(jnp.zeros((), scenario.initial.q.dtype), scenario.initial.q, told_reference)
    dtype = told.q.dtype
    like = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(start, scenario, told)[0]
    )
    memory = as_floats(like, dtype)

    def first(scenario, told, carry, index):
        memory, tau = start(scenario, told)
        return (), (as_floats(memory, dtype), tau)

    def one(scenario, told, carry, index):
        memory, said = sample(scenario, told, of_floats(carry, like))
        return as_floats(memory, dtype), said

    begin, step = program_of(first, scenario, told, ()), program_of(one, scenario, told, memory)
    reads = any(
        node.op == "per_run" and 1 + scenario.n <= node.value < 1 + 2 * scenario.n
        for node in step.nodes
    )
    return ControlLaw(begin, step, number_names(memory), reads)


def as_floats(memory: Any, dtype: Any) -> Any:
    """A memory whose numbers are all of one type: whole numbers and flags as 0.0, 1.0, ..."""
    return jax.tree.map(lambda x: x.astype(dtype), memory)


def of_floats(memory: Any, like: Any) -> Any:
    """What `as_floats` was given, of the types of `like`."""
    return jax.tree.map(
        lambda x, y: x > 0.5 if y.dtype == bool else x.astype(y.dtype), memory, like
    )


def told_at(t: jax.Array, q: jax.Array, told_reference: bool) -> Told:
    """A place for what the law is told, of the right shapes."""
    return Told(t, q, q, *((q, q, q) if told_reference else ()))


def program_of(function: Callable, scenario: Scenario, given: Any, carry: Any) -> Program:
    """The scalar program of `function(scenario, given, carry, index) -> (carry, results)`, written
    out.

    Args:
      function: what is computed.
      scenario: its leaves are the program's shared numbers.
      given: a pytree of arrays or their shapes, a lane's numbers.
      carry: one, what goes from call to call.

    Raises:
      UnsupportedError: it does not lower; the message says why.
    """
    trees = [jax.tree.structure(x) for x in (scenario, given, carry)]

    def on_leaves(shared, lane, carried, index):
        parts = [
            jax.tree.unflatten(tree, x)
            for tree, x in zip(trees, (shared, lane, carried), strict=True)
        ]
        after, results = function(*parts, index)
        return jax.tree.leaves(after), jax.tree.leaves(results)

    dtype = np.dtype(scenario.initial.q.dtype)
    shared, per_run, carried = (Shapes.of(jax.tree.leaves(x)) for x in (scenario, given, carry))
    step = compile_step(on_leaves, dtype, shared, per_run, carried, lowering_limits())
    return written_out(step.program)


def number_names(tree: Any) -> tuple[str, ...]:
    """What each number of a pytree of arrays is, "observer.p[1]"."""
    names = list[str]()
    for path, x in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path).lstrip(".")
        names += [name + "".join(f"[{i}]" for i in place) for place in np.ndindex(x.shape)]
    return tuple(names)
