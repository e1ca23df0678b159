"""The checker for disturbance observers: the contracts are
`iblf_jax.observers.RobotObserver` and `Observer`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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
        receives_x = isinstance(observer, Observer)
        if model is not None:
            check_model(model, receives_x)
        else:
            joints = number_of_joints(findings, observer, n)
            model = plant_of(levels_of(observer), joints) if receives_x else arm_of(joints)
        check_joints_of(n, model, "model")
        if receives_x:
            model = plants.as_plant(model)
        model = in_dtype(model, "float64")
        n, t = model.n, jnp.asarray(0.7)
        fitted = fitted_to(in_dtype(observer, "float64"), n, "observer")
        case = _case(fitted, model, n)
        in_both_types(findings, _structure, fitted, t, case, model)

        def outputs(observer, t, case, model):
            state = observer.init(*case.start, model)
            rate = observer.derivative(t, *case.measured, case.tau, model, state)
            estimate = observer.estimate(t, *case.measured, model, state)
            return {"estimate": estimate} | leaves_by_name("derivative", rate)

        check_function(findings, outputs, fitted, (t, case, model))
        in_both_types(findings, _scan, fitted, t, case, model)


def check_model(model: Any, receives_x: bool) -> None:
    """Raises ValueError for a model that is no robot, or no robot and no plant in strict-feedback
    form.
    """
    if receives_x and plants.is_chain(model):
        checks.conforms("model", model, plants.Plant)
        return
    checks.conforms("model", model, Robot)


class Case(NamedTuple):
    """The arguments of an observer in a check."""

    start: tuple[jax.Array, ...]
    """At the start: (q, q'), or (x,)."""
    measured: tuple[jax.Array, ...]
    """At another time."""
    tau: jax.Array
    """The input, (n,)."""


def _case(observer: Any, model: Any, n: int) -> Case:
    """Random arguments for an observer of robots, or of plants in strict-feedback form."""
    rng = np.random.default_rng(3)
    if not isinstance(observer, Observer):
        q, dq, tau = jnp.asarray(rng.uniform(-1, 1, (3, n)))
        return Case((q, 0.5 * dq), (q, dq), tau)
    observer.check_model(model)
    x, tau = jnp.asarray(rng.uniform(-1, 1, (model.order, n))), jnp.asarray(rng.uniform(-1, 1, n))
    return Case((x.at[1].multiply(0.5),), (x,), tau)


def _structure(findings: Findings, observer, t, case: Case, model) -> None:
    receives_x = isinstance(observer, Observer)
    names = "x" if receives_x else "q, dq"
    state = shape_of(findings, f"init({names}, model)", observer.init, *case.start, model)
    label = f"estimate(t, {names}, model, state)"
    # The estimate has the shape of the torque of a robot, or of the state of a plant.
    shape = case.measured[0].shape
    call_has_shape(findings, label, observer.estimate, (t, *case.measured, model, state), shape)
    label = f"derivative(t, {names}, tau, model, state)"
    arguments = (t, *case.measured, case.tau, model, state)
    rate = shape_of(findings, label, observer.derivative, *arguments)
    same_structure(findings, label, rate, state)
    if receives_x and observer.completes:
        label = f"complete(t, {names}, model, state)"
        arguments = (t, *case.measured, model, state)
        call_has_shape(findings, label, observer.complete, arguments, shape)
    if observer_of_x(observer).advances:
        label = f"advance(t, {names}, tau, model, state, period)"
        arguments = (t, *case.measured, case.tau, model, state, jnp.asarray(1e-3, t.dtype))
        after = shape_of(findings, label, observer.advance, *arguments)
        same_structure(findings, label, after, state)


def _scan(findings: Findings, observer, t, case: Case, model) -> None:
    """Requires that the state keeps its structure and stays finite at a standstill."""

    def step(state, _):
        rate = observer.derivative(t, *case.measured, case.tau, model, state)
        state = jax.tree.map(lambda x, dx: x + 1e-3 * dx, state, rate)
        return state, observer.estimate(t, *case.measured, model, state)

    try:
        state, estimates = jax.jit(
            lambda: jax.lax.scan(step, observer.init(*case.measured, model), length=100)
        )()
    except TypeError as error:
        findings.add(f"its state does not keep its type in a scan ({first_line(error)})")
        return
    finite = all(np.all(np.isfinite(x)) for x in jax.tree.leaves((state, estimates)))
    findings.require(
        finite,
        "its state is not finite after 0.1 s at a standstill with a constant torque",
        "Look at the signs of its rate",
    )
