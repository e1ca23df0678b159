"""The state of the plant in the closed loop: its start, its motion, and what law and observer
receive of it.

Every plant is in strict-feedback form here, and its state is x, (r, n): `Scenario.loop` makes a
plant of order 2 of a robot, and parts of x of those that users wrote for q and q'.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.observers import Observer
from iblf_jax.control.sensors._base import Measurement, measurement_of
from iblf_jax.core import checks, programs, taylor
from iblf_jax.core.pytree import Absent, Pytree
from iblf_jax.simulation.initial import Initial
from iblf_jax.world import plants
from iblf_jax.world.plants import Plant
from iblf_jax.world.robots import at_time, friction_torque, inverse_dynamics
from iblf_jax.world.robots._base import forward_dynamics

if TYPE_CHECKING:
    from iblf_jax.simulation.scenario import Scenario

# --- the start ------------------------------------------------------------------------------------


def start_levels(scenario: Scenario) -> jax.Array:
    """The state of the plant at t = 0, (r, n).

    A start given by q and q' alone is in the steady state of the plant: the static equilibrium of a
    flexible joint, the current that holds gravity.
    """
    initial, plant = scenario.initial, scenario.loop.plant
    if plant.order == 2 or initial.higher is not None:
        return initial.x
    # Inside a trace the operations are part of the program that is traced.
    is_known = checks.is_concrete((plant, initial))
    start = _compiled_steady_start if is_known else _steady_start
    return start(plant, initial)  # type: ignore[no-any-return]


def _steady_start(plant: Plant, initial: Initial) -> jax.Array:
    """The steady state of a plant at q and q' of a start, (r, n)."""
    steady = plant.steady_levels(initial.q, initial.dq)
    return plants.state_of_levels(initial.q, initial.dq, steady)


_compiled_steady_start = programs.jit(_steady_start, options=programs.SHORTEST_TO_COMPILE)
"""One program: each of some thirty operations would be one."""


def levels_on_reference(scenario: Scenario, t: jax.Array) -> jax.Array:
    """The state of a plant that follows its reference exactly and without disturbance, (r, n)."""
    plant, position = scenario.loop.plant, scenario.reference.position
    curves = [taylor.in_time(position, t, plant.order - 1)]
    for level in range(1, plant.order):
        curves.append(_curve_of_next_level(plant, level, t, curves))
    return jnp.stack([curve[0] for curve in curves])


def _curve_of_next_level(plant: Plant, level: int, t: jax.Array, curves: list) -> list[jax.Array]:
    """The level above a level, with its derivatives, from those of the levels up to this one."""
    count = len(curves[-1]) - 1
    unknown = [jnp.zeros_like(curves[0][0])] * (plant.order - level)

    def above(t, known, rate):
        return plants.level_input(plant, level, t, jnp.stack([*known, *unknown]), rate)

    points = []
    for m, time in enumerate(taylor.curve_of_time(t, count)):
        known = [curve[m] for curve in curves]
        rate = curves[-1][m + 1]
        points.append((time, known, rate))
    return taylor.along(above, points)


def steady_input(scenario: Scenario, q: jax.Array) -> jax.Array:
    """The input with which an actuator starts, (n,): it balances the gravity of the model, and is 0
    for a plant that states no such input.

    A law of robots on another plant has a model without the plant's input: the input is then the
    one that balances the gravity of the plant.
    """
    found = stated_steady_input(scenario, q)
    return jnp.zeros_like(q) if found is None else found


def stated_steady_input(scenario: Scenario, q: jax.Array) -> jax.Array | None:
    """The `steady_input` of the model, or of the plant where only the model is a robot; None for a
    plant that states none.
    """
    plant, model, *_ = scenario.loop
    if model.is_robot and not plant.is_robot:
        model = plant
    return model.steady_input(q)  # type: ignore[no-any-return]


def has_speed_limits(scenario: Scenario) -> bool:
    """Whether the bounds of the second level are those of a robot's velocities, which may follow
    q_d'.
    """
    return scenario.bounds[1] is not None and scenario.loop.plant.reference_levels == 2


# --- law and observer -----------------------------------------------------------------------------


def with_estimates(
    scenario: Scenario, observer: Observer, t: jax.Array, measured: Measurement, state: Pytree
) -> Measurement:
    """The levels that the law receives: those of a measurement, with the estimates of an observer
    in the place of the levels that it does not read.
    """
    if not observer.completes:
        return measured
    model = scenario.loop.model
    x = checks.given(observer.complete(t, measured.x[: model.order], model, state))
    if len(x) > 2:
        return measurement_of(x)
    # The plant may have more levels than the model; they remain those of the sensor.
    return measured._replace(q=x[0], dq=x[1])


class EstimatedLevels(NamedTuple):
    """The levels that a law receives from an observer that completes a measurement."""

    x_hat: jax.Array
    """The levels, measured or estimated, (r, n)."""
    level_error: jax.Array
    """x_hat less the levels of the plant at the same instant, (r, n)."""
    limit_excess: jax.Array | Absent
    """Of `Observer`, () [1]; `()` where the estimates have no limits."""


def estimated_levels(
    scenario: Scenario,
    observer: Observer,
    t: jax.Array,
    reading: Measurement,
    received: Measurement,
    true: jax.Array,
    state: Pytree,
) -> EstimatedLevels | tuple[()]:
    """The levels that a law receives, with their error; `()` for an observer that estimates none.

    Args:
      scenario: its model has the levels.
      observer: as the loop runs it.
      t: time, () [s].
      reading: the measurement.
      received: the same, with the estimates of the observer.
      true: the levels of the plant, (r, n).
      state: of the observer.
    """
    if not observer.completes:
        return ()
    model = scenario.loop.model
    x_hat = received.x[: model.order]
    excess = observer.limit_excess(t, reading.x[: model.order], model, state)
    return EstimatedLevels(x_hat, x_hat - true[: model.order], excess)


# --- motion of the plant --------------------------------------------------------------------------


def motion(scenario: Scenario, t: jax.Array, x: jax.Array, u: jax.Array) -> jax.Array:
    """The rate x' of the plant's state under the input u, (r, n)."""
    given = scenario.plant.at(t)
    plant = plants.as_plant(given)
    q, dq = x[0], x[1]
    external = disturbance_torque(scenario, t, q, dq)
    if plant.robot is None:
        friction = plant.friction_torque(x)
        torque: jax.Array | float = 0.0 if friction is None else friction
        u = u + external
    else:
        torque = external + friction_torque(plant.robot, dq)
    rate = plants.flow(plant, t, x, u, torque)
    added = scenario.disturbance.rates(t, x, given, scenario.model)
    return rate if added is None else rate + added


def disturbance_torque(scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array) -> jax.Array:
    """The torque of the disturbance, (n,).  It receives plant and model as
    `plants.robot_or_plant`.
    """
    plant, model = map(plants.robot_or_plant, (scenario.plant.at(t), scenario.model))
    return scenario.disturbance.torque(t, q, dq, plant, model)


def acceleration(
    scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array, tau: jax.Array
) -> jax.Array:
    """Acceleration of a robot under the torque `tau`, (n,) [rad/s^2]."""
    plant = at_time(scenario.plant, t)
    applied = tau + disturbance_torque(scenario, t, q, dq) + friction_torque(plant, dq)
    return forward_dynamics(plant, q, dq, applied)


def torque_needed(
    scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array, ddq: jax.Array
) -> jax.Array:
    """The torque for which a robot has the acceleration `ddq`, (n,) [N m]: the inverse of
    `acceleration`.
    """
    plant = at_time(scenario.plant, t)
    passive = disturbance_torque(scenario, t, q, dq) + friction_torque(plant, dq)
    return inverse_dynamics(plant, q, dq, dq, ddq) - passive
