"""The checkers for sensors and actuators: the contracts are `iblf_jax.sensors.Sensor` and
`iblf_jax.actuators.Actuator`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpy.typing import ArrayLike

from iblf_jax.control.actuators import Actuator, Delivered
from iblf_jax.control.sensors import Measurement, Sensor
from iblf_jax.control.sensors._base import contract_of
from iblf_jax.core import checks
from iblf_jax.core.attributes import has_members
from iblf_jax.testing._contract import (
    Findings,
    check_function,
    has_shape,
    in_both_types,
    leaves_by_name,
    same_structure,
    shape_of,
)
from iblf_jax.testing.joints import DEFAULT_LEVELS, examine_joints

SMALL_TORQUES = (0.1, 1e-3)
"""Torques, one of which an actuator must deliver at a standstill [N m]."""
POWERS = (0, 1, 2, 3, 4, 5, -1, -2, -3)
INPUT_SCALES = np.asarray([sign * 10.0**power for power in POWERS for sign in (1, -1)])
"""Initial guesses of the input per torque, in any unit, for the search of the input that delivers a
torque."""
NEWTON_STEPS = 20
DELIVERED = 1e-6
"""Relative error below which a torque counts as delivered."""
UNSTABLE = 1e-6
"""Share of the largest eigenvalue above which a real part means an unstable state."""


def check_sensor(sensor: object, *, n: int | None = None) -> None:
    """Checks a sensor: shapes, the state's structure, derivatives, float32.

    A `Sensor` of x is checked with its `order` levels, 4 if it has no such property.

    Args:
      sensor: an instance.
      n: number of joints; that of its leaves if not given, 2 if these are scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: `n` is not a number of joints, or not that of the leaves.
    """
    with examine_joints(sensor, contract_of(sensor), n, "sensor") as (findings, fitted, joints):
        rng = np.random.default_rng(3)
        # A random state as the sensor receives it: (q, q'), or (x,).
        if isinstance(fitted, Sensor):
            order = fitted.order or DEFAULT_LEVELS
            given = (jnp.asarray(rng.uniform(-1, 1, (order, joints))),)
        else:
            given = tuple(jnp.asarray(rng.uniform(-1, 1, (2, joints))))
        normal, period = jnp.asarray(rng.normal(size=(fitted.draws, joints))), jnp.asarray(1e-3)
        in_both_types(findings, _measures, fitted, given, normal, period)

        def outputs(sensor, given, normal, period):
            sensor = sensor.unrounded
            measured, state = sensor.measure(*given, normal, period, sensor.init(*given, period))
            found = leaves_by_name("further levels", measured.higher)
            return found | {"q": measured.q, "dq": measured.dq} | leaves_by_name("state", state)

        check_function(findings, outputs, fitted, (given, normal, period))


def _measures(findings: Findings, sensor, given, normal, period) -> None:
    names = "q, dq" if len(given) == 2 else "x"
    q = given[0] if len(given) == 2 else given[0][0]
    state = shape_of(findings, f"init({names}, period)", sensor.init, *given, period)
    label = f"measure({names}, normal, period, state)"
    found = shape_of(findings, label, sensor.measure, *given, normal, period, state)
    is_pair = isinstance(found, tuple) and len(found) == 2 and isinstance(found[0], Measurement)
    remedy = "It must be a pair (iblf_jax.sensors.Measurement(q, dq), next state)"
    findings.result_is(is_pair, label, found, remedy)
    measured, after = found
    has_shape(findings, label + ", q", measured.q, q.shape)
    has_shape(findings, label + ", dq", measured.dq, q.shape)
    if len(given) == 1 and len(given[0]) > 2:
        has_shape(findings, label + ", higher", measured.higher, given[0][2:].shape)
    same_structure(findings, label + ", state", after, state)


def check_actuator(
    actuator: object, *, n: int | None = None, torques: tuple[ArrayLike, ArrayLike] | None = None
) -> None:
    """Checks an actuator: shapes, the state's structure, derivatives, float32, and the initial
    torque.

    The input of an actuator may have any unit.  Derivatives and the initial torque are those of the
    property `smooth`, if it has one.  In the state `init(tau)` at a standstill, some
    input must deliver tau, and the state must be stable at this input.

    Args:
      actuator: an instance.
      n: number of joints; that of its leaves if not given, 2 if these are scalars.
      torques: the smallest and the largest torque that it delivers at a standstill, two numbers or
        two (n,), such as (0.0, 5.0) for one that delivers positive torques only; a small range
        around 0 if not given.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: `n` is not a number of joints, or not that of the leaves, or `torques` is not an
        increasing pair.
    """
    ends = torques
    if torques is None:
        ends = (-SMALL_TORQUES[0], SMALL_TORQUES[0])
    expected = "a pair (smallest, largest) of numbers"
    if not isinstance(ends, tuple | list) or len(ends) != 2:
        raise checks.fail("torques", ends, expected)
    low, high = (np.asarray(checks.as_floats("torques", side), float) for side in ends)
    if not np.all(low < high):
        raise checks.fail("torques", ends, expected)
    with examine_joints(actuator, Actuator, n, "actuator") as (findings, fitted, joints):
        shares, dq = np.random.default_rng(3).uniform(-0.1, 0.1, (2, joints))
        # The shares of the range are between 0.1 and 0.9.
        command, dq = jnp.asarray(low + (0.5 + 4.0 * shares) * (high - low)), jnp.asarray(dq)
        in_both_types(findings, _delivers, fitted, command, dq)

        def outputs(actuator, command, dq):
            actuator = actuator.smooth
            delivered = actuator.deliver(command, dq, actuator.init(0.9 * command))
            return {"tau": delivered.tau} | leaves_by_name("rate", delivered.rate)

        check_function(findings, outputs, fitted, (command, dq))
        tested = [command]
        if torques is None:
            shares = np.asarray(command) / np.max(np.abs(command))
            tested = [jnp.asarray(size * shares) for size in SMALL_TORQUES]
        _starts_at_its_torque(findings, fitted.smooth, tested)


def _delivers(findings: Findings, actuator, command, dq) -> None:
    state = shape_of(findings, "init(tau)", actuator.init, command)
    label = "deliver(command, dq, state)"
    found = shape_of(findings, label, actuator.deliver, command, dq, state)
    remedy = "It must be an iblf_jax.actuators.Delivered(tau, limited, rate)"
    findings.result_is(has_members(found, *Delivered._fields), label, found, remedy)
    has_shape(findings, label + ", tau", found.tau, command.shape)
    has_shape(findings, label + ", limited", found.limited, command.shape, jnp.bool_)
    same_structure(findings, label + ", rate", found.rate, state)


def _starts_at_its_torque(findings: Findings, actuator: Actuator, torques: list[jax.Array]) -> None:
    """Requires that in the state `init(tau)` some input delivers tau at a standstill, for one of
    some torques, and that the state is stable at this input.
    """
    for torque in torques:
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
        f" commanded to, it gives {delivered}",
        "`init` must return the state in which the actuator delivers the torque; for an actuator"
        " that cannot deliver this one, give the range, check_actuator(actuator, torques=(low,"
        " high))",
    )


def _input_that_delivers(actuator: Actuator, torque: jax.Array, state: Any) -> jax.Array | None:
    """An input, in any unit, at which a state delivers a torque at a standstill, by Newton's
    method; None if no initial guess converges.
    """

    @jax.jit
    def shortfalls(inputs):
        def shortfall(command):
            return actuator.deliver(command, jnp.zeros_like(command), state).tau - torque

        return jax.vmap(shortfall)(inputs), jax.vmap(jax.jacfwd(shortfall))(inputs)

    # The first guess is the torque, because it is the input of most actuators.
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


def _growth(actuator: Actuator, command: jax.Array, state: Any) -> float:
    """Growth rate of the state at a constant input at a standstill [1/s]; 0 if it is stable."""
    flat, rebuild = ravel_pytree(state)
    if flat.size == 0:
        return 0.0

    def rate(flat):
        delivered = actuator.deliver(command, jnp.zeros_like(command), rebuild(flat))
        return ravel_pytree(delivered.rate)[0]

    eigenvalues = np.linalg.eigvals(np.asarray(jax.jit(jax.jacfwd(rate))(flat)))
    fastest = float(np.max(np.real(eigenvalues)))
    if fastest <= UNSTABLE * float(np.max(np.abs(eigenvalues))):
        return 0.0
    return fastest
