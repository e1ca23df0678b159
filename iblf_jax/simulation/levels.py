"""Levels of the plant in the closed loop: what each part of a scenario receives of the state.

A robot has the levels q and q'.  A plant in strict-feedback form of order r has further levels,
`higher`, (r - 2, n), which is `()` for a robot.  Parts that users wrote for robots receive q and
q', the robot inside the plant and the torque on its joints; parts for plants receive x, (r, n).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.controllers._base import state_of_levels
from iblf_jax.control.observers import NoObserver
from iblf_jax.control.sensors._base import Measurement
from iblf_jax.core import taylor
from iblf_jax.core.linalg import solve_spd
from iblf_jax.core.pytree import unwrapped
from iblf_jax.world import plants
from iblf_jax.world.robots import at_time, friction_torque, inverse_dynamics, momentum

# --- the start ------------------------------------------------------------------------------------


def start_levels(scenario: Any) -> tuple[jax.Array, jax.Array, Any]:
    """The levels q and q', (n,), and those from the third on, (r - 2, n), at t = 0; `()` in their
    place for a plant of order 2.

    A start given by q and q' alone is in the steady state of the plant: the static equilibrium of a
    flexible joint, the current that holds gravity.
    """
    initial, plant = scenario.initial, scenario.plant
    if plants.order_of(plant) == 2:
        return initial.q, initial.dq, ()
    if initial.higher is not None:
        return initial.q, initial.dq, initial.higher
    return initial.q, initial.dq, plant.steady_levels(initial.q, initial.dq)


def levels_on_reference(scenario: Any, t: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
    """The levels of a plant that follows its reference exactly and without disturbance: q and q',
    (n,), and those from the third on, (r - 2, n), or None for a plant of order 2.
    """
    plant, position = scenario.plant, scenario.reference.position
    if not plants.is_chain(plant):
        tube = scenario.context.tube(t)
        return tube.q_d, tube.dq_d, None
    order = plant.order
    curves = [taylor.in_time(position, t, order - 1)]
    for level in range(1, order):
        curves.append(_curve_of_next_level(plant, level, t, curves))
    x = jnp.stack([curve[0] for curve in curves])
    if order == 2:
        return x[0], x[1], None
    return x[0], x[1], x[2:]


def _curve_of_next_level(plant: Any, level: int, t: jax.Array, curves: list) -> list[jax.Array]:
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


def steady_input(scenario: Any, q: jax.Array) -> jax.Array:
    """The input with which an actuator starts, (n,): it balances the gravity of the model, and is 0
    for a plant that states no such input.

    A law of robots on another plant has a model without the plant's input: the input is then the
    one that balances the gravity of the plant.
    """
    if not plants.is_chain(scenario.model) and not plants.is_chain(scenario.plant):
        return scenario.model.gravity(q)  # type: ignore[no-any-return]
    stated = stated_steady_input(scenario, q)
    return jnp.zeros_like(q) if stated is None else stated


def stated_steady_input(scenario: Any, q: jax.Array) -> jax.Array | None:
    """The `steady_input` of the model, or of the plant where the model is a robot; None for a plant
    that states none.
    """
    model: plants.Plant = scenario.model
    if not plants.is_chain(model):
        model = scenario.plant
    return model.steady_input(q)


# --- law and sensor -----------------------------------------------------------------------------


def model_state(scenario: Any, q: jax.Array, dq: jax.Array, higher: Any) -> jax.Array:
    """The levels that the model has, (r, n), from those of the plant or of a measurement."""
    order = plants.order_of(scenario.model)
    if order == 2:
        return state_of_levels(q, dq, ())
    return state_of_levels(q, dq, higher[: order - 2])


def law_state(scenario: Any, q: jax.Array, dq: jax.Array, higher: Any) -> tuple[jax.Array, ...]:
    """The state as the law receives it: (q, q'), or (x,)."""
    if unwrapped(scenario.controller).receives_x:
        return (model_state(scenario, q, dq, higher),)
    return q, dq


def sensor_state(scenario: Any, q: jax.Array, dq: jax.Array, higher: Any) -> tuple[jax.Array, ...]:
    """The state as the sensor receives it: (q, q'), or (x,)."""
    if scenario.sensor.receives_x:
        return (state_of_levels(q, dq, higher),)
    return q, dq


# --- observer -------------------------------------------------------------------------------------


def observer_initial(scenario: Any, observer: Any, q: jax.Array, dq: jax.Array, higher: Any) -> Any:
    """The state of an observer at the start."""
    if observer.receives_x:
        plant = plants.as_plant(scenario.model)
        return observer.init(model_state(scenario, q, dq, higher), plant)
    return observer.init(q, dq, _observed_robot(scenario))


def observer_estimate(
    scenario: Any, observer: Any, t: jax.Array, q: jax.Array, dq: jax.Array, higher: Any, state: Any
) -> jax.Array:
    """The estimate that the law receives: the torque f_hat, (n,) [N m], or d_hat, (r, n)."""
    if observer.receives_x:
        x, plant = model_state(scenario, q, dq, higher), plants.as_plant(scenario.model)
        d_hat: jax.Array = observer.estimate(t, x, plant, state)
        if unwrapped(scenario.controller).receives_x:
            return d_hat
        return estimate_as_torque(scenario.model, q, d_hat)
    if plants.is_chain(scenario.model) and isinstance(observer, NoObserver):
        return jnp.zeros((scenario.model.order, *q.shape), q.dtype)
    estimate: jax.Array = observer.estimate(t, q, dq, _observed_robot(scenario), state)
    return estimate


def estimate_shape(scenario: Any) -> tuple[int, ...]:
    """The shape of the estimate that a law without an observer receives: (n,), or (r, n) for a
    model in strict-feedback form.
    """
    if plants.is_chain(scenario.model):
        return scenario.model.order, scenario.n
    return (scenario.n,)


def observer_arguments(
    scenario: Any,
    observer: Any,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    higher: Any,
    u: jax.Array,
    state: Any,
) -> tuple:
    """The arguments of `Observer.derivative` and `advance`, given the input u of the model."""
    if observer.receives_x:
        x = model_state(scenario, q, dq, higher)
        return t, x, u, plants.as_plant(scenario.model), state
    if plants.is_chain(scenario.model) and not isinstance(observer, NoObserver):
        x = model_state(scenario, q, dq, higher)
        model: Any = scenario.model
        u = model.joint_torque(x, u)
    return t, q, dq, u, _observed_robot(scenario), state


def completed(
    scenario: Any, observer: Any, t: jax.Array, measured: Measurement, state: Any
) -> Measurement:
    """The levels that the law receives: those of a measurement, with the estimates of an observer
    in the place of the levels that it does not read.
    """
    if not observer.completes:
        return measured
    q, dq, higher = measured
    x = model_state(scenario, q, dq, higher)
    x = observer.complete(t, x, plants.as_plant(scenario.model), state)
    if len(x) == 2:
        # The plant may have more levels than the model; they remain those of the sensor.
        return Measurement(x[0], x[1], higher)
    return Measurement(x[0], x[1], x[2:])


class EstimatedLevels(NamedTuple):
    """The levels that a law receives from an observer that completes a measurement."""

    x_hat: jax.Array
    """The levels, measured or estimated, (r, n)."""
    level_error: jax.Array
    """x_hat less the levels of the plant at the same instant, (r, n)."""
    limit_excess: Any
    """Of `Observer`, () [1]; `()` where the estimates have no limits."""


def estimated_levels(
    scenario: Any,
    observer: Any,
    t: jax.Array,
    reading: Measurement,
    known: Measurement,
    true: Measurement,
    state: Any,
) -> EstimatedLevels | tuple[()]:
    """The levels that a law receives, with their error; `()` for an observer that estimates none.

    Args:
      scenario: its model has the levels.
      observer: as the loop runs it.
      t: time, () [s].
      reading: the measurement.
      known: the same, with the estimates of the observer.
      true: the levels of the plant.
      state: of the observer.
    """
    if not observer.completes:
        return ()
    x_hat = model_state(scenario, *known)
    error = x_hat - model_state(scenario, *true)
    x = model_state(scenario, *reading)
    excess = observer.limit_excess(t, x, plants.as_plant(scenario.model), state)
    return EstimatedLevels(x_hat, error, excess)


def _observed_robot(scenario: Any) -> Any:
    """The model as observers of robots receive it: the robot, or the robot inside the model; the
    model itself where there is none, for `NoObserver`, which does not use it.
    """
    robot = plants.robot_of(scenario.model)
    if robot is None:
        return scenario.model
    return robot


# --- motion of the plant --------------------------------------------------------------------------


class Motion(NamedTuple):
    """The rate of the plant's state."""

    dq: jax.Array
    """Rate of the first level, (n,)."""
    ddq: jax.Array
    """Rate of the second level, (n,)."""
    higher: Any
    """Rates of the other levels, (r - 2, n); `()` for a robot."""


def motion(
    scenario: Any, t: jax.Array, q: jax.Array, dq: jax.Array, higher: Any, u: jax.Array
) -> Motion:
    """The rate of the plant's state under the input u, (n,)."""
    if not plants.is_chain(scenario.plant):
        return _robot_motion(scenario, t, q, dq, u)
    plant = scenario.plant.at(t)
    x, model = state_of_levels(q, dq, higher), scenario.model
    robot = plants.robot_of(plant)
    disturbance = scenario.disturbance
    if robot is None:
        friction = plant.friction_torque(x)
        torque: jax.Array | float = 0.0 if friction is None else friction
        u = u + disturbance.torque(t, q, dq, plant, model)
    else:
        known = plants.robot_of(model)
        torque = disturbance.torque(t, q, dq, robot, known) + friction_torque(robot, dq)
    rate = plants.flow(plant, t, x, u, torque)
    added = disturbance.rates(t, x, plant, model)
    if added is not None:
        rate = rate + added
    if len(rate) == 2:
        return Motion(rate[0], rate[1], ())
    return Motion(rate[0], rate[1], rate[2:])


def _robot_motion(
    scenario: Any, t: jax.Array, q: jax.Array, dq: jax.Array, tau: jax.Array
) -> Motion:
    """The rate of q and q' of a robot."""
    ddq = acceleration(scenario, t, q, dq, tau)
    x = jnp.stack([q, dq])
    added = scenario.disturbance.rates(t, x, scenario.plant, scenario.model)
    if added is None:
        return Motion(dq, ddq, ())
    return Motion(dq + added[0], ddq + added[1], ())


def acceleration(
    scenario: Any, t: jax.Array, q: jax.Array, dq: jax.Array, tau: jax.Array
) -> jax.Array:
    """Acceleration of a robot under the torque `tau`, (n,) [rad/s^2]."""
    plant = at_time(scenario.plant, t)
    external = scenario.disturbance.torque(t, q, dq, plant, scenario.model)
    applied = tau + external + friction_torque(plant, dq)
    return solve_spd(plant.mass_matrix(q), applied - plant.coriolis(q, dq, dq) - plant.gravity(q))


def torque_needed(
    scenario: Any, t: jax.Array, q: jax.Array, dq: jax.Array, ddq: jax.Array
) -> jax.Array:
    """The torque for which a robot has the acceleration `ddq`, (n,) [N m]: the inverse of
    `acceleration`.
    """
    plant = at_time(scenario.plant, t)
    external = scenario.disturbance.torque(t, q, dq, plant, scenario.model)
    passive = external + friction_torque(plant, dq)
    return inverse_dynamics(plant, q, dq, dq, ddq) - passive


# --- the uncertain term ---------------------------------------------------------------------------


def uncertain_term(
    scenario: Any,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    higher: Any,
    moved: Motion,
    u: jax.Array,
) -> jax.Array:
    """d_1 ... d_r of the model, (r, n): x' less the flow of the model under the input u."""
    model = scenario.model
    x = model_state(scenario, q, dq, higher)
    rate = model_state(scenario, moved.dq, moved.ddq, moved.higher)
    return rate - plants.flow(model, t, x, u)


def estimate_as_rates(scenario: Any, x: jax.Array, estimate: jax.Array) -> jax.Array:
    """An estimate as d_hat, (r, n): M0^-1 f_hat in the second level for a torque f_hat."""
    if estimate.ndim == 2:
        return estimate
    return plants.torque_as_rates(plants.as_plant(scenario.model), x, estimate)


def estimate_as_torque(model: Any, q: jax.Array, estimate: jax.Array) -> jax.Array:
    """An estimate as the torque f_hat, (n,) [N m], of a model that is a robot: M0 d_hat_2."""
    if estimate.ndim == 1:
        return estimate
    return momentum(model, q, estimate[1])
