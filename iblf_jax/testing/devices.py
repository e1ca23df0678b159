"""The checkers for sensors and actuators: the contracts are `iblf_jax.sensors.Sensor` and
`iblf_jax.actuators.Actuator`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from iblf_jax.control.actuators import Actuator, Delivered
from iblf_jax.control.sensors import Measurement, Sensor
from iblf_jax.testing._contract import (
    Findings,
    examine,
    has_shape,
    in_dtype,
    probe,
    same_structure,
    shape_of,
)
from iblf_jax.testing.joints import check_number, fitted_to, number_of_joints

SMALL_TORQUES = (0.1, 1e-3)
"""N m.  Sizes of the torques that an actuator has to deliver at a standstill; one is enough."""
POWERS = (0, 1, 2, 3, 4, 5, -1, -2, -3)
INPUT_SCALES = np.asarray([sign * 10.0**power for power in POWERS for sign in (1, -1)])
"""Inputs per torque from which the input that delivers a torque is searched, in any unit."""
NEWTON_STEPS = 20
DELIVERED = 1e-6
"""Relative error at which a torque counts as delivered."""
RUNAWAY = 1e-6
"""A real part above this share of the largest eigenvalue is a state that grows by itself."""


def check_sensor(sensor: Any, *, n: int | None = None) -> None:
    """Checks a sensor: shapes, the state's structure, derivatives, float32.

    Args:
      sensor: an instance.
      n: number of joints; found from its leaves if not given, 2 if these are scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: no number of joints, or one that its leaves do not have.
    """
    check_number(n)
    with examine(sensor, "Sensor", Sensor) as findings:
        n = number_of_joints(findings, sensor, n)
        fitted = fitted_to(in_dtype(sensor, "float64"), n, "sensor")
        rng = np.random.default_rng(3)
        q, dq = jnp.asarray(rng.uniform(-1, 1, (2, n)))
        normal, period = jnp.asarray(rng.normal(size=(fitted.draws, n))), jnp.asarray(1e-3)
        for dtype in ("float64", "float32"):
            _measures(findings, *in_dtype((fitted, q, dq, normal, period), dtype))
        findings.stop_if_any()

        def outputs(sensor, q, dq, normal, period):
            sensor = getattr(sensor, "unrounded", sensor)
            measured, state = sensor.measure(q, dq, normal, period, sensor.init(q, dq, period))
            return {
                "q": measured.q,
                "dq": measured.dq,
                **{f"state, leaf {i}": x for i, x in enumerate(jax.tree.leaves(state))},
            }

        probe(findings, outputs, fitted, (q, dq, normal, period))


def _measures(findings: Findings, sensor, q, dq, normal, period) -> None:
    kind = f" ({q.dtype})"
    state = shape_of(findings, "init(q, dq, period)" + kind, sensor.init, q, dq, period)
    label = "measure(q, dq, normal, period, state)" + kind
    found = (
        None
        if state is None
        else shape_of(findings, label, sensor.measure, q, dq, normal, period, state)
    )
    if found is None:
        return
    is_pair = isinstance(found, tuple) and len(found) == 2 and isinstance(found[0], Measurement)
    if not is_pair:
        remedy = "It must be a pair (iblf_jax.sensors.Measurement(q, dq), next state)"
        findings.add(f"{label} gives {type(found).__name__}", remedy)
        return
    measured, after = found
    has_shape(findings, label + ", q", measured.q, q.shape)
    has_shape(findings, label + ", dq", measured.dq, q.shape)
    same_structure(findings, label + ", state", after, state)


def check_actuator(actuator: Any, *, n: int | None = None) -> None:
    """Checks an actuator: shapes, the state's structure, derivatives, float32, and that it starts
    at the torque of `init`.

    Its input need not be a torque.  From the state that `init(tau)` returns, at a standstill, some
    input, in whatever unit, must make it deliver tau; and at that input its state must not grow.

    Args:
      actuator: an instance.
      n: number of joints; found from its leaves if not given, 2 if these are scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: no number of joints, or one that its leaves do not have.
    """
    check_number(n)
    with examine(actuator, "Actuator", Actuator) as findings:
        n = number_of_joints(findings, actuator, n)
        fitted = fitted_to(in_dtype(actuator, "float64"), n, "actuator")
        asked, dq = jnp.asarray(np.random.default_rng(3).uniform(-0.1, 0.1, (2, n)))
        for dtype in ("float64", "float32"):
            _delivers(findings, *in_dtype((fitted, asked, dq), dtype))
        findings.stop_if_any()

        def outputs(actuator, asked, dq):
            delivered = actuator.deliver(asked, dq, actuator.init(0.9 * asked))
            return {
                "tau": delivered.tau,
                **{f"rate, leaf {i}": x for i, x in enumerate(jax.tree.leaves(delivered.rate))},
            }

        probe(findings, outputs, fitted, (asked, dq))
        _starts_at_its_torque(findings, fitted, asked / jnp.max(jnp.abs(asked)))


def _delivers(findings: Findings, actuator, asked, dq) -> None:
    kind = f" ({asked.dtype})"
    state = shape_of(findings, "init(tau)" + kind, actuator.init, asked)
    label = "deliver(asked, dq, state)" + kind
    found = None if state is None else shape_of(findings, label, actuator.deliver, asked, dq, state)
    if found is None:
        return
    if not all(hasattr(found, field) for field in Delivered._fields):
        remedy = "It must be an iblf_jax.actuators.Delivered(tau, limited, rate)"
        findings.add(f"{label} gives {type(found).__name__}", remedy)
        return
    has_shape(findings, label + ", tau", found.tau, asked.shape)
    has_shape(findings, label + ", limited", found.limited, asked.shape, jnp.bool_)
    same_structure(findings, label + ", rate", found.rate, state)


def _starts_at_its_torque(findings: Findings, actuator: Any, direction: jax.Array) -> None:
    """From `init(tau)` some input delivers tau at a standstill, and keeps the state from
    growing.
    """
    for size in SMALL_TORQUES:
        torque = size * direction
        state = actuator.init(torque)
        found = _input_that_delivers(actuator, torque, state)
        if found is not None:
            growth = _growth(actuator, found, state)
            remedy = "Look at the sign of its rate"
            problem = f"its state grows by itself at a constant input, with {growth:.3g} 1/s"
            findings.require(growth <= 0, problem, remedy)
            return
    delivered = np.asarray(actuator.deliver(torque, jnp.zeros_like(torque), state).tau)
    findings.add(
        f"from init({np.asarray(torque)}) at a standstill no input makes it deliver that torque;"
        f" commanded to, it gives {delivered} N m",
        "`init` must return the state in which the actuator delivers the torque",
    )


def _input_that_delivers(actuator: Any, torque: jax.Array, state: Any) -> jax.Array | None:
    """An input, in any unit, at which a state delivers a torque at a standstill, by Newton's
    method.

    None if no start leads to one.
    """

    @jax.jit
    def shortfalls(inputs):
        def shortfall(asked):
            return actuator.deliver(asked, jnp.zeros_like(asked), state).tau - torque

        return jax.vmap(shortfall)(inputs), jax.vmap(jax.jacfwd(shortfall))(inputs)

    # The torque itself comes first: most actuators take one.
    inputs = INPUT_SCALES[:, None] * np.asarray(torque)
    for _ in range(NEWTON_STEPS):
        missing, slopes = map(np.asarray, shortfalls(inputs))
        errors = np.max(np.abs(missing), axis=1) / np.max(np.abs(np.asarray(torque)))
        delivers = np.flatnonzero(errors <= DELIVERED)
        if delivers.size:
            return jnp.asarray(inputs[delivers[0]])
        finite = np.isfinite(missing).all(axis=1) & np.isfinite(slopes).all(axis=(1, 2))
        steps = [
            np.linalg.lstsq(slope, short, rcond=None)[0]
            for slope, short in zip(slopes[finite], missing[finite], strict=True)
        ]
        if not steps or not np.any(steps):
            return None
        inputs = inputs.copy()
        inputs[finite] -= steps
    return None


def _growth(actuator: Any, asked: jax.Array, state: Any) -> float:
    """How fast the state grows by itself at a constant input at a standstill, 1/s; 0 if not at
    all.
    """
    flat, rebuild = ravel_pytree(state)
    if flat.size == 0:
        return 0.0

    def rate(flat):
        return ravel_pytree(actuator.deliver(asked, jnp.zeros_like(asked), rebuild(flat)).rate)[0]

    eigenvalues = np.linalg.eigvals(np.asarray(jax.jit(jax.jacfwd(rate))(flat)))
    fastest = float(np.max(np.real(eigenvalues)))
    return fastest if fastest > RUNAWAY * float(np.max(np.abs(eigenvalues))) else 0.0
