"""The checker for disturbance observers: the contracts are
`iblf_jax.observers.RobotObserver` and `Observer`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.observers import Observer, RobotObserver
from iblf_jax.control.observers._base import contract_of
from iblf_jax.control.observers.none import observer_of_x
from iblf_jax.core import checks
from iblf_jax.testing._contract import (
    Findings,
    call_has_shape,
    check_function,
    examine,
    first_line,
    in_both_types,
    in_dtype,
    leaves_by_name,
    same_structure,
    shape_of,
    traced_methods,
)
from iblf_jax.testing.joints import (
    arm_of,
    check_joints_of,
    check_number,
    fitted_to,
    levels_of,
    number_of_joints,
    plant_of,
)
from iblf_jax.world import plants
from iblf_jax.world.robots import Robot


def check_observer(
    observer: Observer | RobotObserver, *, model: Any = None, n: int | None = None
) -> None:
    """Checks an observer: shapes, the state's structure, derivatives, float32, and a hundred steps
    of a scan.

    Args:
      observer: an instance.
      model: the robot that it knows, or the plant in strict-feedback form for an `Observer` of x;
        an arm of n joints if not given, or one with as many levels as its leaves have rows.
      n: number of joints, if no model is given; that of its leaves if not given, 2 if these are
        scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: a model that is no robot or plant, or has another number of joints than `n` or the
        leaves.
    """
    check_number(n)
    with examine(observer, "Observer", contract_of(observer)) as findings:
        if model is None:
            joints = number_of_joints(findings, observer, n)
            model = arm_of(joints)
            if isinstance(observer, Observer):
                model = plant_of(levels_of(observer), joints)
        elif isinstance(observer, Observer):
            plants.check_part("model", model)
        else:
            checks.conforms("model", model, Robot)
        check_joints_of(n, model, "model")
        plant = in_dtype(plants.as_plant(model), "float64")
        t = jnp.asarray(0.7)
        fitted = fitted_to(in_dtype(observer, "float64"), plant.n, "observer")
        fitted.check_model(plant)
        rng = np.random.default_rng(3)
        x = jnp.asarray(rng.uniform(-1, 1, (plant.order, plant.n)))
        u = jnp.asarray(rng.uniform(-1, 1, plant.n))
        in_both_types(findings, _structure, fitted, t, x, u, plant)
        method = traced_methods()
        derivative, estimate = method("derivative"), method("estimate")

        def outputs(observer, t, x, u, plant):
            of_x = observer_of_x(observer)
            state = of_x.init(_slower(x), plant)
            rate = derivative(of_x, t, x, u, plant, state)
            found = {"estimate": estimate(of_x, t, x, plant, state)}
            return found | leaves_by_name("derivative", rate)

        def scan(findings, observer, t, x, u, plant):
            of_x = observer_of_x(observer)

            def step(state, _):
                rate = derivative(of_x, t, x, u, plant, state)
                state = jax.tree.map(lambda value, slope: value + 1e-3 * slope, state, rate)
                return state, estimate(of_x, t, x, plant, state)

            _stays_finite(findings, lambda: jax.lax.scan(step, of_x.init(x, plant), length=100))

        check_function(findings, outputs, fitted, (t, x, u, plant))
        in_both_types(findings, scan, fitted, t, x, u, plant)


def _slower(x: jax.Array) -> jax.Array:
    """Another state, for the start."""
    scale = np.ones((len(x), 1), x.dtype)
    scale[1] = 0.5
    return x * scale


def _structure(findings: Findings, observer, t, x, u, plant) -> None:
    arguments, start, model, names = (x,), (_slower(x),), plant, "x"
    if isinstance(observer, RobotObserver):
        arguments, start, model, names = tuple(x), tuple(_slower(x)), plant.robot, "q, dq"
    state = shape_of(findings, f"init({names}, model)", observer.init, *start, model)
    label = f"estimate(t, {names}, model, state)"
    # The estimate has the shape of the torque of a robot, or of the state of a plant.
    shape = arguments[0].shape
    call_has_shape(findings, label, observer.estimate, (t, *arguments, model, state), shape)
    label = f"derivative(t, {names}, tau, model, state)"
    rate = shape_of(findings, label, observer.derivative, t, *arguments, u, model, state)
    same_structure(findings, label, rate, state)
    of_x = observer_of_x(observer)
    if of_x.completes:
        label = f"complete(t, {names}, model, state)"
        call_has_shape(findings, label, observer.complete, (t, *arguments, model, state), shape)
    if of_x.advances:
        label = f"advance(t, {names}, tau, model, state, period)"
        period = jnp.asarray(1e-3, t.dtype)
        after = shape_of(findings, label, observer.advance, t, *arguments, u, model, state, period)
        same_structure(findings, label, after, state)


def _stays_finite(findings: Findings, run: Callable[[], tuple[Any, Any]]) -> None:
    """Requires that the state keeps its structure and stays finite at a standstill.

    Args:
      findings: receives the problems.
      run: a scan, which returns the last state and the estimates.
    """
    try:
        state, estimates = jax.jit(run)()
    except TypeError as error:
        findings.add(f"its state does not keep its type in a scan ({first_line(error)})")
        return
    finite = all(np.all(np.isfinite(x)) for x in jax.tree.leaves((state, estimates)))
    findings.require(
        finite,
        "its state is not finite after 0.1 s at a standstill with a constant torque",
        "Look at the signs of its rate",
    )
