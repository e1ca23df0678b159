"""A step of the complete closed loop as a scalar program: robot, disturbance, sensor, law, observer
and actuator, with the steps of `simulate`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.attributes import attributes
from iblf_jax.core.families import is_default
from iblf_jax.deployment.control_law import as_floats, of_floats, program_of
from iblf_jax.deployment.signal_units import one_unit, rate_units
from iblf_jax.engine import Inputs, StepOptions, advance, initial_carry
from iblf_jax.kernels import Program
from iblf_jax.simulation import error_estimate
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.noise import has_noise
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants


class LoopOutput(NamedTuple):
    """An output of a step, n numbers."""

    name: str
    unit: str
    signal: str
    """The name in `Sample`."""
    row: int | None = None
    """The row of a signal with one row a level; None for a signal of n numbers."""


def loop_outputs(scenario: Scenario) -> tuple[LoopOutput, ...]:
    """The outputs of a step, at its start, besides the status."""
    plant, model, *_ = scenario.loop
    units = [one_unit(unit) for unit in plants.units_of(plant)]
    found = [
        LoopOutput("q", units[0], "q"),
        LoopOutput("dq", units[1], "dq"),
        LoopOutput("tau", units[-1], "tau"),
        LoopOutput("e1", units[0], "e1"),
        LoopOutput("q_d", units[0], "q_d"),
        LoopOutput("lower", units[0], "lower"),
        LoopOutput("upper", units[0], "upper"),
    ]
    found += [LoopOutput(f"x_{i + 1}", units[i], "x", i) for i in range(2, len(units) - 1)]
    if not model.uncertain_levels:
        found.append(LoopOutput("f", "N m", "disturbance"))
        found.append(LoopOutput("f_hat", "N m", "disturbance_estimate"))
        return tuple(found)
    known = [one_unit(unit) for unit in plants.units_of(model)]
    for name, signal in (("d", "disturbance"), ("d_hat", "disturbance_estimate")):
        rates = rate_units(name, known)
        found += [LoopOutput(x, unit, signal, i) for i, (x, unit) in enumerate(rates.items())]
    return tuple(found)


class Shape(NamedTuple):
    """What a page draws of the plant at an instant, in d = 2 or 3 dimensions [m]."""

    points: jax.Array
    """Base, joints and tip, (n + 1, d), or the corners of an outline, (k, 2)."""
    desired: jax.Array
    """The same where the plant is at its reference."""
    limits: jax.Array | tuple[()]
    """Ends of each link while its joint is at its lower and at its upper bound, (n, 2, 2); empty
    in space and of an outline."""


def shape_of(
    plant: plants.Plant, q: jax.Array, q_d: jax.Array, lower: jax.Array, upper: jax.Array
) -> Shape | None:
    """The shape of a plant at positions, a reference and bounds, (n,) each; None for a plant that
    is not drawn.
    """
    has_outline = not is_default(plant.outline, plants.Plant.outline)
    draw: Callable[[jax.Array], Any] = plant.outline
    if not has_outline:
        if plant.robot is None:
            return None
        draw = plant.robot.skeleton
    points = draw(q)
    if points is None:
        return None
    if has_outline or points.shape[1] != 2:
        return Shape(points, draw(q_d), ())

    def end(joint: int, position: jax.Array) -> Any:
        """The end of a joint's link, (2,), at another position of the joint."""
        return draw(q.at[joint].set(position))[joint + 1]

    pairs = [jnp.stack([end(k, lower[k]), end(k, upper[k])]) for k in range(q.shape[0])]
    return Shape(points, draw(q_d), jnp.stack(pairs))


UNLIMITED_STEPS = 2.0**52
"""Number of steps that stands for a run without an end."""


class RunSettings(NamedTuple):
    """The inputs of a run besides its scenario."""

    dt: jax.Array
    noise: jax.Array | tuple[()]
    """The key of a sensor's noise, (4,); empty without noise."""


class Loop(NamedTuple):
    """The programs of a closed loop; leaves of the scenario are shared, numbers of `RunSettings`
    are per-run leaves.
    """

    start: Program
    """Its results are the carry before the first step."""
    step: Program
    """Its carry is state and status; its results are `loop_outputs`, the status and the shape, all
    at the start of the step."""
    carry_size: int
    """Number of floating-point numbers in the carry."""
    shape: Shape | None
    """The shapes of the arrays of `Shape`; None if the step computes none."""


def loop_program(scenario: Scenario, method: str, *, has_shape: bool = False) -> Loop:
    """The programs of a scenario's closed loop.

    Args:
      scenario: canonical.
      method: the integrator.
      has_shape: whether a step also computes what is drawn of the plant.

    Raises:
      UnsupportedError: the loop cannot be lowered; the message states the reason.
    """
    dtype = scenario.initial.q.dtype
    key = jnp.zeros((4,), dtype)
    run_settings = RunSettings(jnp.zeros((), dtype), ())
    if has_noise(scenario):
        run_settings = run_settings._replace(noise=key)
    like = (initial_state(scenario), jnp.int32(0))

    def first(scenario, run_settings, carry, index):
        return (), as_floats((initial_state(scenario), jnp.int32(0)), dtype)

    def step(scenario, run_settings, carry, index):
        state, status = of_floats(carry, like)
        noise = run_settings.noise
        if not has_noise(scenario) and scenario.sampling is not None:
            noise = key
        inputs = Inputs(scenario, (), run_settings.dt, jnp.asarray(UNLIMITED_STEPS, dtype), noise)
        size = error_estimate.watched_indices(state).size
        before = initial_carry(inputs, method, jnp.zeros((size, size), dtype))
        before = before._replace(state=state, status=status)
        done = advance(inputs, before, index, method, StepOptions(scalar=True))
        values = []
        for output in loop_outputs(scenario):
            value = attributes(done.sample, [output.signal])[output.signal]
            values.append(value if output.row is None else value[output.row])
        outputs = (*values, done.carry.status.astype(dtype))
        if has_shape:
            one = done.sample
            outputs += (shape_of(scenario.loop.plant, one.q, one.q_d, one.lower, one.upper),)
        return as_floats((done.carry.state, done.carry.status), dtype), outputs

    shape = None
    if has_shape:
        vectors = [scenario.initial.q] * 4
        shape = jax.eval_shape(lambda *each: shape_of(scenario.loop.plant, *each), *vectors)
    carry = as_floats(like, dtype)
    start_program = program_of(first, scenario, run_settings, ())
    step_program = program_of(step, scenario, run_settings, carry)
    size = sum(x.size for x in jax.tree.leaves(carry))
    return Loop(start_program, step_program, size, shape)
