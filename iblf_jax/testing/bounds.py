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
from iblf_jax.testing._contract import Findings, at_each
from iblf_jax.world.bounds import Tube

XI = (-40.0, -1.0, -0.9995, -0.5, 0.0, 0.5, 0.9995, 1.0, 40.0)
"""Values of xi at which a law is evaluated; a run may reach any of them."""
NEAR, NEARER = 1e-4, 1e-10
"""Values of e2 at which the slope of the command is evaluated [rad/s]."""
INNER = 0.3
"""The xi at which that slope is evaluated."""
GROWTH = 3.0
"""Largest allowed growth of the slope between these values."""
TIME = 0.7
"""Time of the evaluation [s]."""
LABELS = ("the command", "its forward derivative", "its reverse derivative")


class Answer(NamedTuple):
    """The results of a law at a point, or at several points along a leading axis."""

    values: tuple[jax.Array, jax.Array, jax.Array]
    """Torque, alpha and V1."""
    forward: Any
    """Their derivatives along a direction."""
    reverse: Any
    """The derivatives of their sum by the law, the positions and the velocities."""
    inside: Any
    """Whether positions, velocities and alpha are inside their bounds, bool."""
    at_rest: Any
    """Whether e2 = 0 on some joint, bool."""
    limits: Any
    """The smallest and the largest velocity; () for a scenario without limits."""


def position_at(tube: Tube, xi: jax.Array) -> jax.Array:
    """The positions whose errors, normalised by the bound of their side, are xi, (n,)."""
    return tube.q_d + xi * jnp.where(xi > 0, tube.k_u, tube.k_l)


CommandOf = Callable[..., tuple[Command, Any]]
"""The command of a law, of (law, t, x, f_hat, context, state), as JAX has traced it."""


AnswersAt = Callable[..., Answer]
"""The results at some points, of (their xi, velocities, the direction of the derivatives)."""
ALL = (1.0, 1.0)
"""The direction in which the law, the positions and the velocities change."""
VELOCITIES = (0.0, 1.0)
"""The direction in which only the velocities change."""


def check_at_the_bounds(findings: Findings, scenario: Scenario, command_of: CommandOf) -> bool:
    """Requires that torque, V1 and their derivatives in both modes are finite inside the bounds.

    Returns:
      Whether they are finite beyond the bounds, too.
    """

    @jax.jit
    def answer(scenario, xi, dq, along):
        context, t, law = scenario.context, jnp.asarray(TIME), scenario.controller
        model, tube = scenario.loop.model, context.tube(t)
        _, rate, *others = levels_on_reference(scenario, t)
        # Not a number stands for the velocity of the reference.
        dq = jnp.where(jnp.isnan(dq), rate, dq)

        def functions(law, q, dq):
            """Torque, alpha and V1 without a disturbance; further levels are on the reference."""
            state = law_of_x(law).init(start_levels(scenario)[: model.order], context)
            x = jnp.stack([q, dq, *others[: model.order - 2]])
            f_hat = jnp.zeros(model.estimate_shape, q.dtype)
            found = command_of(law, t, x, f_hat, context, state)[0]
            return found.tau, found.alpha, found.V1

        # One program for all points and both modes: JAX differentiates once.
        point = (law, position_at(tube, xi), dq)
        values, linear = jax.linearize(functions, *point)
        rest, velocities = (jax.tree.map(jnp.ones_like, x) for x in (point[:2], dq))
        forward = linear(*jax.tree.map(lambda x: along[0] * x, rest), along[1] * velocities)
        ones = jax.tree.map(jnp.ones_like, values)
        reverse = jax.linear_transpose(linear, *point)(ones)
        limits: Any = context.speed_limits(t) if has_speed_limits(scenario) else ()
        inside = jnp.abs(xi) < 1.0
        for x in (dq, values[1]) if limits else ():
            outside = (x <= limits[0]) | (x >= limits[1])
            inside &= ~jnp.any(outside)
        at_rest = jnp.any(jnp.abs(dq - values[1]) < 1e-12)
        return Answer(values, forward, reverse, inside, at_rest, limits)

    def answers(xis, dqs, along=ALL):
        return at_each(lambda xi, dq: answer(scenario, xi, dq, np.array(along)), xis, dqs)

    n, xi = scenario.n, np.array(XI)
    along_positions = answers([*XI, INNER], np.full((len(XI) + 1, n), np.nan))
    *_, inner_alpha = along_positions.values[1]
    infinite = _infinite_in_e2(findings, answers, inner_alpha)
    of_positions = jax.tree.map(lambda rows: rows[:-1], along_positions)
    everywhere = _swept(findings, of_positions, "xi", infinite)
    if not has_speed_limits(scenario):
        return everywhere
    alpha = of_positions.values[1][XI.index(0.0)]
    low, high = (rows[0] for rows in of_positions.limits)
    dqs = alpha + xi[:, None] * np.where(xi[:, None] > 0, high - alpha, alpha - low)
    at_velocities = answers(np.zeros(len(XI)), dqs)
    return _swept(findings, at_velocities, "xi of the velocity", infinite) and everywhere


def _infinite_in_e2(findings: Findings, answers: AnswersAt, alpha: np.ndarray) -> bool:
    """Whether the slope of the torque grows without limit as e2 approaches 0; a finding if so.

    Args:
      findings: receives the problem.
      answers: the law at some points.
      alpha: the virtual velocity at xi = INNER.
    """
    dqs = [alpha + NEAR, alpha + NEARER]
    slopes = answers([INNER, INNER], dqs, VELOCITIES).forward[0]
    near, nearer = np.max(np.abs(slopes), axis=1)
    if not np.isfinite(near) or nearer <= GROWTH * near + 1.0:
        return False
    findings.add(
        "the derivative of the torque with respect to e2 = q' - alpha is infinite at e2 = 0 "
        f"(it is {near:.3g} N m s/rad at e2 = {NEAR:g} rad/s and {nearer:.3g} at {NEARER:g})",
        "Replace a power |e2|^a sign(e2) with a < 1 by e2 (e2^2 + delta^2)^((a - 1)/2) with a small"
        " delta",
    )
    return True


def _swept(findings: Findings, found: Answer, axis: str, infinite_in_e2: bool) -> bool:
    """Requires finite results inside the bounds along the positions ("xi") or the velocities.

    Returns:
      Whether the results are finite beyond the bounds, too.
    """
    xi = np.asarray(XI)
    beyond, V1 = np.zeros(xi.size, bool), found.values[2]
    is_finite = {}
    for label, tree in zip(LABELS, (found.values, found.forward, found.reverse), strict=True):
        rows = [x.reshape(xi.size, -1) for x in jax.tree.leaves(tree)]
        is_finite[label] = np.all([np.isfinite(x).all(axis=1) for x in rows], axis=0)
    remedy = (
        "Near the bound limit the slope (iblf_jax.barriers.guarded_error); a failed run must stay"
        " finite"
    )
    for label, finite in is_finite.items():
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
        np.all(V1[found.inside & is_finite[LABELS[0]]] >= 0),
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
