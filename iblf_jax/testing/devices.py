"""The checkers for sensors and actuators: the contracts are `iblf_jax.sensors.Sensor` and `iblf_jax.actuators.Actuator`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.actuators import Actuator
from iblf_jax.core import checks
from iblf_jax.sensors import Sensor
from iblf_jax.simulation.scenario import fit_joints
from iblf_jax.testing._contract import Findings, examine, has_shape, in_dtype, probe, same_structure, shape_of


def check_sensor(sensor: Any, *, n: int = 2) -> None:
    """Checks a sensor: shapes, the state's structure, derivatives, float32.

    Args:
      sensor: an instance.
      n: joints.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: no number of joints.
    """
    n = checks.positive_integer("n", n, most=checks.MOST_JOINTS)
    with examine(sensor, "Sensor", Sensor) as findings:
        fitted = fit_joints(in_dtype(sensor, "float64"), n, "sensor")
        rng = np.random.default_rng(3)
        q, dq = jnp.asarray(rng.uniform(-1, 1, (2, n)))
        normal, period = jnp.asarray(rng.normal(size=(fitted.draws, n))), jnp.asarray(1e-3)
        for dtype in ("float64", "float32"):
            _measures(findings, *in_dtype((fitted, q, dq, normal, period), dtype))
        findings.stop_if_any()

        def outputs(sensor, q, dq, normal, period):
            sensor = getattr(sensor, "unrounded", sensor)
            measured, state = sensor.measure(q, dq, normal, period, sensor.init(q, dq, period))
            return {"q": measured.q, "dq": measured.dq, **{f"state, leaf {i}": x for i, x in enumerate(jax.tree.leaves(state))}}

        probe(findings, outputs, fitted, (q, dq, normal, period))


def _measures(findings: Findings, sensor, q, dq, normal, period) -> None:
    kind = f" ({q.dtype})"
    state = shape_of(findings, "init(q, dq, period)" + kind, sensor.init, q, dq, period)
    label = "measure(q, dq, normal, period, state)" + kind
    found = None if state is None else shape_of(findings, label, sensor.measure, q, dq, normal, period, state)
    if found is None:
        return
    measured, after = found
    has_shape(findings, label + ", q", measured.q, q.shape)
    has_shape(findings, label + ", dq", measured.dq, q.shape)
    same_structure(findings, label + ", state", after, state)


def check_actuator(actuator: Any, *, n: int = 2) -> None:
    """Checks an actuator: shapes, the state's structure, derivatives, float32, and that it starts at the torque that it is told.

    Args:
      actuator: an instance.
      n: joints.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: no number of joints.
    """
    n = checks.positive_integer("n", n, most=checks.MOST_JOINTS)
    with examine(actuator, "Actuator", Actuator) as findings:
        fitted = fit_joints(in_dtype(actuator, "float64"), n, "actuator")
        asked, dq = jnp.asarray(np.random.default_rng(3).uniform(-0.1, 0.1, (2, n)))
        for dtype in ("float64", "float32"):
            _delivers(findings, *in_dtype((fitted, asked, dq), dtype))
        findings.stop_if_any()

        def outputs(actuator, asked, dq):
            delivered = actuator.deliver(asked, dq, actuator.init(0.9 * asked))
            return {"tau": delivered.tau, **{f"rate, leaf {i}": x for i, x in enumerate(jax.tree.leaves(delivered.rate))}}

        probe(findings, outputs, fitted, (asked, dq))
        at_rest = fitted.deliver(asked, jnp.zeros_like(asked), fitted.init(asked))
        moved = sum((jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(at_rest.rate)), jnp.zeros(()))
        still = np.allclose(at_rest.tau, asked) and float(moved) < 1e-9
        findings.require(still, "started at a small torque that it is asked for at a standstill, it does not keep it", "Look at `init`")


def _delivers(findings: Findings, actuator, asked, dq) -> None:
    kind = f" ({asked.dtype})"
    state = shape_of(findings, "init(tau)" + kind, actuator.init, asked)
    label = "deliver(asked, dq, state)" + kind
    found = None if state is None else shape_of(findings, label, actuator.deliver, asked, dq, state)
    if found is None:
        return
    has_shape(findings, label + ", tau", found.tau, asked.shape)
    has_shape(findings, label + ", limited", found.limited, asked.shape, jnp.bool_)
    same_structure(findings, label + ", rate", found.rate, state)
