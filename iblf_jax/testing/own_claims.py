"""The checks of what a law states of itself: the contract is `iblf_jax.controllers.LyapunovLaw`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates.own_law import REQUIRED
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.testing._contract import Findings, in_dtype, probe, shape_of

STATES = 16
"""States at which V and W have to be nonnegative."""
SPREAD = 0.3
"""rad and rad/s.  How far these states are from the reference."""


def check_claims(findings: Findings, scenario: Scenario) -> None:
    """Shapes, types and derivatives of V, W and T, and V >= 0, W >= 0 where the estimate is exact; nothing for a law that states none."""
    law: Any = scenario.controller
    stated = [name for name in REQUIRED if hasattr(law, name)]
    if not stated:
        return
    for name in REQUIRED:
        findings.require(
            name in stated, f"it has {stated[0]} and no {name}", "A law states both, or neither: iblf_jax.controllers.LyapunovLaw"
        )
    findings.stop_if_any()
    for dtype in ("float64", "float32"):
        _shapes(findings, in_dtype(scenario, dtype))
    findings.stop_if_any()
    t, q, dq, f_tilde = _near_the_reference(scenario, np.random.default_rng(5))
    setting = scenario.setting

    def outputs(law, t, q, dq, f_tilde, setting):
        own = law.init(q, dq, setting)
        return {name: getattr(law, name)(t, q, dq, f_tilde, setting, own) for name in REQUIRED}

    probe(findings, outputs, law, (t, q[0], dq[0], f_tilde, setting))

    @jax.jit
    def sums(q, dq):
        found = outputs(law, t, q, dq, jnp.zeros_like(q), setting)
        return jax.tree.map(jnp.sum, found)

    for name, values in jax.vmap(sums)(q, dq).items():
        lowest = float(jnp.min(values))
        remedy = "V and W are nonnegative, or the inequality V' <= -W + T says nothing"
        findings.require(lowest >= 0, f"{name} is {lowest:.3g} somewhere where f_tilde = 0", remedy)


def _near_the_reference(scenario: Scenario, rng: np.random.Generator) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """A time, and states and an error of the estimate there: (), (STATES, n), (STATES, n), (n,)."""
    t = jnp.asarray(0.7)
    tube = scenario.setting.tube(t)
    q, dq = jnp.asarray(rng.uniform(-SPREAD, SPREAD, (2, STATES, scenario.n)))
    width = jnp.minimum(tube.k_l, tube.k_u)
    return t, tube.q_d + jnp.clip(q, -0.9 * width, 0.9 * width), tube.dq_d + dq, jnp.linspace(0.1, 0.2, scenario.n)


def _shapes(findings: Findings, scenario: Scenario) -> None:
    law: Any = scenario.controller
    setting, q, dq = scenario.setting, scenario.initial.q, scenario.initial.dq
    t, zero = jnp.zeros((), q.dtype), jnp.zeros_like(q)
    own = law.init(q, dq, setting)
    calls: dict[str, tuple[Any, tuple]] = {
        f"{name}(t, q, dq, f_tilde, setting, state)": (getattr(law, name), (t, q, dq, zero, setting, own)) for name in REQUIRED
    }
    if hasattr(law, "disturbance_terms"):
        label = "disturbance_terms(t, q, dq, f_tilde, df, setting, state)"
        calls[label] = (law.disturbance_terms, (t, q, dq, zero, zero, setting, own))
    for label, (call, args) in calls.items():
        got = shape_of(findings, label, call, *args)
        if got is None:
            continue
        fits = hasattr(got, "shape") and got.shape in ((), q.shape)
        findings.require(fits, f"{label} gives {got}", f"It must be an array of shape () or {q.shape}, which is summed")
        remedy = "Make constants with the dtype of an argument, jnp.zeros_like(q)"
        findings.require(not fits or got.dtype == q.dtype, f"{label} gives {getattr(got, 'dtype', '')} for {q.dtype} arguments", remedy)
