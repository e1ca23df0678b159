"""The checker for disturbance observers: the contract is `iblf_jax.observers.Observer`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.observers import Observer
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
    number_of_joints,
)
from iblf_jax.world.robots import Robot


def check_observer(observer: Any, *, model: Any = None, n: int | None = None) -> None:
    """Checks an observer: shapes, the state's structure, derivatives, float32, and a hundred steps
    of a scan.

    Args:
      observer: an instance.
      model: the robot that it knows; an arm of n joints if not given.
      n: number of joints, if no model is given; that of its leaves if not given, 2 if these are
        scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: a model that is no robot, or has another number of joints than `n` or the leaves.
    """
    check_number(n)
    if model is not None:
        checks.conforms("model", model, Robot)
    with examine(observer, "Observer", Observer) as findings:
        if model is None:
            model = arm_of(number_of_joints(findings, observer, n))
        check_joints_of(n, model, "model")
        model = in_dtype(model, "float64")
        n, t = model.n, jnp.asarray(0.7)
        fitted = fitted_to(in_dtype(observer, "float64"), n, "observer")
        q, dq, tau = jnp.asarray(np.random.default_rng(3).uniform(-1, 1, (3, n)))
        in_both_types(findings, _structure, fitted, t, q, dq, tau, model)

        def outputs(observer, t, q, dq, tau, model):
            state = observer.init(q, 0.5 * dq, model)
            rate = observer.derivative(t, q, dq, tau, model, state)
            estimate = observer.estimate(t, q, dq, model, state)
            return {"estimate": estimate} | leaves_by_name("derivative", rate)

        check_function(findings, outputs, fitted, (t, q, dq, tau, model))
        in_both_types(findings, _scan, fitted, t, q, dq, tau, model)


def _structure(findings: Findings, observer, t, q, dq, tau, model) -> None:
    state = shape_of(findings, "init(q, dq, model)", observer.init, q, dq, model)
    label = "estimate(t, q, dq, model, state)"
    call_has_shape(findings, label, observer.estimate, (t, q, dq, model, state), q.shape)
    label = "derivative(t, q, dq, tau, model, state)"
    rate = shape_of(findings, label, observer.derivative, t, q, dq, tau, model, state)
    same_structure(findings, label, rate, state)


def _scan(findings: Findings, observer, t, q, dq, tau, model) -> None:
    """Requires that the state keeps its structure and stays finite at a standstill."""

    def step(state, _):
        rate = observer.derivative(t, q, dq, tau, model, state)
        state = jax.tree.map(lambda x, dx: x + 1e-3 * dx, state, rate)
        return state, observer.estimate(t, q, dq, model, state)

    try:
        state, estimates = jax.jit(
            lambda: jax.lax.scan(step, observer.init(q, dq, model), length=100)
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
