"""Tests of a law inside, at and beyond its bounds.

The law must be finite inside.  If it is undefined beyond the bounds, the checker returns a remark.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers import Command
from iblf_jax.control.controllers._base import law_of_x
from iblf_jax.simulation.levels import has_speed_limits, levels_on_reference, start_levels
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.testing._contract import Findings
from iblf_jax.world.bounds import Tube

XI = (-40.0, -1.0, -0.9995, -0.5, 0.0, 0.5, 0.9995, 1.0, 40.0)
"""Values of xi at which a law is evaluated; a run may reach any of them."""
NEAR, NEARER = 1e-4, 1e-10
"""Values of e2 at which the slope of the command is evaluated [rad/s]."""
GROWTH = 3.0
"""Largest allowed growth of the slope between these values."""
TIME = 0.7
"""Time of the evaluation [s]."""
LABELS = ("the command", "its forward derivative", "its reverse derivative")


class Points(NamedTuple):
    """The results of a law at some points, one entry per point."""

    finite: dict[str, np.ndarray]
    """By label, whether all numbers are finite, bool."""
    inside: np.ndarray
    """Whether positions, velocities and alpha are inside their bounds, bool."""
    at_rest: np.ndarray
    """Whether e2 = 0 on some joint, bool."""
    V1: np.ndarray


def position_at(tube: Tube, xi: jax.Array) -> jax.Array:
    """The positions whose errors, normalised by the bound of their side, are xi, (n,)."""
    return tube.q_d + xi * jnp.where(xi > 0, tube.k_u, tube.k_l)


CommandOf = Callable[..., tuple[Command, Any]]
"""The command of a law, of (law, t, x, f_hat, context, state), as JAX has traced it."""


def check_at_the_bounds(findings: Findings, scenario: Scenario, command_of: CommandOf) -> bool:
    """Requires that torque, V1 and their derivatives in both modes are finite inside the bounds.

    Returns:
      Whether they are finite beyond the bounds, too.
    """

    @jax.jit
    def command(scenario, law, q, dq):
        """Torque, alpha and V1 without a disturbance; further levels are those on the reference."""
        context, t, model = scenario.context, jnp.asarray(TIME), scenario.loop.model
        state = law_of_x(law).init(start_levels(scenario)[: model.order], context)
        x = jnp.stack([q, dq, *levels_on_reference(scenario, t)[2 : model.order]])
        f_hat = jnp.zeros(model.estimate_shape, q.dtype)
        found = command_of(law, t, x, f_hat, context, state)[0]
        return found.tau, found.alpha, found.V1

    infinite = _infinite_in_e2(findings, scenario, command)
    everywhere = _swept(findings, scenario, command, "xi", infinite)
    if not has_speed_limits(scenario):
        return everywhere
    of_velocity = _swept(findings, scenario, command, "xi of the velocity", infinite)
    return of_velocity and everywhere


AtPoint = Callable[..., tuple[jax.Array, jax.Array, jax.Array]]
"""Torque, alpha and V1, of (scenario, law, q, dq)."""


def _infinite_in_e2(findings: Findings, scenario: Scenario, command: AtPoint) -> bool:
    """Whether the slope of the torque grows without limit as e2 approaches 0; a finding if so."""

    @jax.jit
    def slope(scenario, e2):
        law, tube = scenario.controller, scenario.context.tube(jnp.asarray(TIME))
        q = tube.q_d + 0.3 * tube.k_u
        dq = levels_on_reference(scenario, jnp.asarray(TIME))[1]
        alpha = command(scenario, law, q, dq)[1]
        one = jnp.ones_like(alpha)
        return jax.jvp(lambda dq: command(scenario, law, q, dq)[0], (alpha + e2,), (one,))[1]

    near, nearer = (
        float(np.max(np.abs(slope(scenario, jnp.asarray(e2))))) for e2 in (NEAR, NEARER)
    )
    if not np.isfinite(near) or nearer <= GROWTH * near + 1.0:
        return False
    findings.add(
        "the derivative of the torque with respect to e2 = q' - alpha is infinite at e2 = 0 "
        f"(it is {near:.3g} N m s/rad at e2 = {NEAR:g} rad/s and {nearer:.3g} at {NEARER:g})",
        "Replace a power |e2|^a sign(e2) with a < 1 by e2 (e2^2 + delta^2)^((a - 1)/2) with a small"
        " delta",
    )
    return True


def _swept(
    findings: Findings, scenario: Scenario, command: AtPoint, axis: str, infinite_in_e2: bool
) -> bool:
    """Requires finite results inside the bounds along the positions ("xi") or the velocities.

    Returns:
      Whether the results are finite beyond the bounds, too.
    """
    found, xi = _at_points(scenario, command, axis), np.asarray(XI)
    beyond = np.zeros(xi.size, bool)
    remedy = (
        "Near the bound limit the slope (iblf_jax.barriers.guarded_error); a failed run must stay"
        " finite"
    )
    for label, finite in found.finite.items():
        beyond |= ~finite & ~found.inside
        bad = ~finite & found.inside
        if label != LABELS[0] and infinite_in_e2:
            bad &= ~found.at_rest
        if np.array_equal(xi[bad], [0.0]) and label != LABELS[0]:
            smooth = (
                "Replace a root, a norm or a power below 1 of an error by a smooth function, for"
                " example |e| by (e^2 + delta^2)^(1/2)"
            )
            findings.add(f"{label} is not finite where the error is 0", smooth)
            continue
        findings.require(
            not np.any(bad),
            f"{label} is not finite at {axis} = {_listed(xi[bad])}, inside the bounds",
            remedy,
        )
    findings.require(
        np.all(found.V1[found.inside & found.finite[LABELS[0]]] >= 0),
        "V1 is negative somewhere",
        "V1 is a Lyapunov function; a law without one returns zeros",
    )
    if np.any(beyond):
        what = "bound" if axis == "xi" else "velocity bound"
        findings.remark(
            f"the law is undefined beyond the {what}: it or its derivative is not finite at {axis}"
            f" = {_listed(xi[beyond])}",
            "A run that leaves the bounds stops there with the flag NOT_FINITE; with"
            " iblf_jax.barriers.guarded_error it would continue",
        )
    return not np.any(beyond)


def _listed(xi: np.ndarray) -> str:
    return ", ".join(f"{x:g}" for x in xi)


def _at_points(scenario: Scenario, command: AtPoint, axis: str) -> Points:
    """The law at all XI along an axis."""

    @jax.jit
    def answers(scenario, xis):
        def at(xi):
            law, context, t = scenario.controller, scenario.context, jnp.asarray(TIME)
            tube = context.tube(t)
            q, dq = levels_on_reference(scenario, t)[:2]
            limits: Any = context.speed_limits(t) if has_speed_limits(scenario) else ()
            if axis == "xi":
                q = position_at(tube, xi)
            else:
                alpha = command(scenario, law, q, dq)[1]
                dq = alpha + xi * jnp.where(xi > 0, limits[1] - alpha, alpha - limits[0])

            def functions(law, q, dq):
                return command(scenario, law, q, dq)

            point = (law, q, dq)
            values, forward = jax.jvp(functions, point, jax.tree.map(jnp.ones_like, point))
            reverse = jax.vjp(functions, *point)[1](jax.tree.map(jnp.ones_like, values))
            inside = jnp.abs(xi) < 1.0
            for x in (dq, values[1]) if limits else ():
                outside = (x <= limits[0]) | (x >= limits[1])
                inside &= ~jnp.any(outside)
            at_rest = jnp.any(jnp.abs(dq - values[1]) < 1e-12)
            return (values, forward, reverse), inside, at_rest

        return jax.vmap(at)(xis)

    trees, inside, at_rest = answers(scenario, jnp.asarray(XI))
    finite = {}
    for label, tree in zip(LABELS, trees, strict=True):
        rows = [np.asarray(x).reshape(len(XI), -1) for x in jax.tree.leaves(tree)]
        finite[label] = np.all([np.isfinite(x).all(axis=1) for x in rows], axis=0)
    return Points(finite, np.asarray(inside), np.asarray(at_rest), np.asarray(trees[0][2]))
