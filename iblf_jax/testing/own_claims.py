"""The checks of a law's own claims: the contract is `iblf_jax.controllers.LyapunovLaw`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates.claims.own import METHODS, stated_methods, states_disturbance_terms
from iblf_jax.certificates.terms import receives_q_dq
from iblf_jax.control.controllers import Law
from iblf_jax.control.controllers._base import law_of_x
from iblf_jax.core.attributes import attributes, has_members
from iblf_jax.simulation.levels import start_levels
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.testing._contract import Findings, check_function, in_both_types, shape_of

STATES = 16
"""Number of states at which V and W must be nonnegative."""
SPREAD = 0.3
"""Largest distance of these states from the reference [rad] and [rad/s]."""


def check_claims(findings: Findings, scenario: Scenario) -> None:
    """Checks V, W and T of a law that states a claim: shapes, types, derivatives, and V, W >= 0.

    The inequalities are tested with an exact estimate, f_tilde = 0.
    """
    law: Any = scenario.controller
    stated = stated_methods(law)
    if not stated:
        return
    remedy = "A law states both, or neither: iblf_jax.controllers.LyapunovLaw"
    for name in METHODS:
        findings.require(name in stated, f"it has {stated[0]} and no {name}", remedy)
    findings.stop_if_any()
    in_both_types(findings, _shapes, scenario)
    context, model = scenario.context, scenario.loop.model
    t, rng = jnp.asarray(0.7), np.random.default_rng(5)
    tube = context.tube(t)
    # States near the reference, (STATES, n) each.
    q, dq = jnp.asarray(rng.uniform(-SPREAD, SPREAD, (2, STATES, scenario.n)))
    width = 0.9 * jnp.minimum(tube.k_l, tube.k_u)
    q, dq = tube.q_d + jnp.clip(q, -width, width), tube.dq_d + dq
    f_tilde = jnp.broadcast_to(jnp.linspace(0.1, 0.2, scenario.n), _shape_of_error(scenario))

    def outputs(law, t, x, f_tilde, context):
        of_x = law_of_x(law)
        own = of_x.init(x, context)
        return {
            name: method(t, x, f_tilde, context, own)
            for name, method in attributes(of_x, METHODS).items()
        }

    start = start_levels(scenario)[: model.order]
    first = start.at[0].set(q[0]).at[1].set(dq[0])
    check_function(findings, outputs, law, (t, first, f_tilde, context))

    @jax.jit
    def sums(q, dq):
        x = start.at[0].set(q).at[1].set(dq)
        found = outputs(law, t, x, jnp.zeros_like(f_tilde), context)
        return jax.tree.map(jnp.sum, found)

    for name, values in jax.vmap(sums)(q, dq).items():
        lowest = float(jnp.min(values))
        remedy = "V and W are nonnegative, or the inequality V' <= -W + T bounds nothing"
        findings.require(lowest >= 0, f"{name} is {lowest:.3g} somewhere where f_tilde = 0", remedy)


def _shape_of_error(scenario: Scenario) -> tuple[int, ...]:
    """The shape of the error of the estimate that `certify` passes to the law."""
    model = scenario.loop.model
    return model.estimate_shape if receives_q_dq(scenario) else (model.order, model.n)


def _shapes(findings: Findings, scenario: Scenario) -> None:
    law: Any = scenario.controller
    context, model = scenario.context, scenario.loop.model
    x = start_levels(scenario)[: model.order]
    q, t, zero = x[0], jnp.zeros((), x.dtype), jnp.zeros(_shape_of_error(scenario), x.dtype)
    measured, names = ((x[0], x[1]), "q, dq, f_tilde")
    if isinstance(law, Law):
        measured, names = (x,), "x, d_tilde"  # type: ignore[assignment]
    own = law.init(*measured, context)
    arguments: tuple[Any, ...] = (t, *measured, zero, context, own)
    for name, method in attributes(law, METHODS).items():
        label = f"{name}(t, {names}, context, state)"
        _is_summable(findings, label, shape_of(findings, label, method, *arguments), q)
    if states_disturbance_terms(law):
        label = f"disturbance_terms(t, {names}, rate, context, state)"
        arguments = (t, *measured, zero, zero, context, own)
        _is_summable(
            findings, label, shape_of(findings, label, law.disturbance_terms, *arguments), q
        )


def _is_summable(findings: Findings, label: str, got: Any, like: jax.Array) -> None:
    """Requires that a method returns one number, or one per joint, of the arguments' type."""
    fits = has_members(got, "shape") and got.shape in ((), like.shape)
    remedy = f"It must be an array of shape () or {like.shape}, which is summed"
    if not findings.require(fits, f"{label} gives {got}", remedy):
        return
    remedy = "Make constants with the dtype of an argument, jnp.zeros_like(q)"
    same = got.dtype == like.dtype
    findings.require(same, f"{label} gives {got.dtype} for {like.dtype} arguments", remedy)
