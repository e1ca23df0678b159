"""The checker for barriers: the contract is `iblf_jax.barriers.Barrier`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.barriers import Barrier
from iblf_jax.control.controllers import LawContext
from iblf_jax.testing._contract import (
    Findings,
    at_each,
    call_has_shape,
    check_function,
    has_shape,
    in_dtype,
    traced_methods,
)
from iblf_jax.testing.bounds import position_at
from iblf_jax.testing.joints import examine_joints, scenario_of
from iblf_jax.world.bounds import Tube

XI = (
    -40.0,
    -3.0,
    -1.0 - 1e-9,
    -1.0,
    -1.0 + 1e-9,
    -0.9,
    -0.3,
    -1e-9,
    0.0,
    1e-9,
    0.3,
    0.9,
    1.0 - 1e-9,
    1.0,
    1.0 + 1e-9,
    3.0,
    40.0,
)
"""Values of xi at which every barrier is evaluated: far outside, at and near the bound, inside, at
and near zero."""

FUNCTIONS = {
    "value": "value(tube, q)",
    "slope": "slope(tube, q)",
    "virtual_velocity": "virtual_velocity(tube, q, k1, o)",
}
"""The functions of a barrier, and what messages call them."""
TIMES = (0.0, 1.0, 2.5, 4.0)
APART = (0.3, -0.2)
"""Values of xi of the joints where it is tested that none of them acts on another."""


def check_barrier(barrier: object, *, n: int | None = None) -> None:
    """Checks a barrier: shapes, derivatives, float32; finite everywhere; s = dV1/dq; V1 decays
    along alpha.

        V1(e1 = 0) = 0,   V1 >= 0,   s = dV1/dq,   s e1 >= 0,
        s alpha + dV1/dt <= 0 inside the bound,
        s alpha + dV1/dt <= -decay_rate V1,   |xi| <= xi_bound(V1), if the barrier claims them

    Args:
      barrier: an instance.
      n: number of joints; that of its leaves if not given, 2 if these are scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: `n` is not a number of joints, or not that of the leaves.
    """
    with examine_joints(barrier, Barrier, n, "barrier") as (findings, fitted, joints):
        guard = fitted.guard
        findings.require(
            isinstance(guard, float) and (0 < guard < 1 or guard == -math.inf),
            f"guard is {guard!r}",
            "It must be a static float between 0 and 1, or minus infinity if no guard is needed",
        )
        findings.require(
            isinstance(fitted.uses_o, bool),
            f"uses_o is {fitted.uses_o!r}",
            "It must be a bool of the class, uses_o: ClassVar[bool]",
        )
        findings.stop_if_any()
        context = in_dtype(scenario_of(joints), "float64").context
        k1 = jnp.asarray(np.resize([2.0, 3.0], joints))
        o = jnp.asarray(np.resize([0.1, 0.2], joints)) if fitted.uses_o else None
        tube = context.tube(jnp.asarray(1.0))
        q = tube.q_d + np.resize([0.2, -0.15], joints)
        functions = _functions()
        arguments = (fitted, tube, q, k1, o)
        for name, label in FUNCTIONS.items():
            call_has_shape(findings, label, functions[name], arguments, (joints,))
        findings.stop_if_any()

        def outputs(*args):
            return {FUNCTIONS[name]: function(*args) for name, function in functions.items()}

        check_function(findings, outputs, fitted, arguments[1:])
        numbers_at = _numbers_at(functions, fitted, context, k1, o)
        for i, direction in enumerate(np.eye(joints)):
            numbers = numbers_at(TIMES[1], np.resize(APART, joints), direction)
            for name in functions:
                findings.require(
                    np.all(np.delete(numbers[f"d{name}"], i) == 0.0),
                    f"{name} mixes joints",
                    "The law needs a barrier that acts on every joint separately",
                )
        for t in TIMES:
            rows = [np.full(joints, x) for x in XI]
            numbers = at_each(lambda xi, t=t: numbers_at(t, xi, np.ones(joints)), rows)
            _at_every_xi(findings, numbers, fitted.guard)
            _claims(findings, fitted, k1, numbers)
        _grows_without_bound(findings, fitted, context)


Functions = dict[str, Callable[..., jax.Array]]
"""The three functions of a barrier by name, of (barrier, tube, q, k1, o)."""


def _functions() -> Functions:
    """The functions of a barrier as JAX has traced them."""
    method = traced_methods()
    return {
        "value": lambda barrier, tube, q, k1, o: method("value")(barrier, tube, q),
        "slope": lambda barrier, tube, q, k1, o: method("slope")(barrier, tube, q),
        "virtual_velocity": method("virtual_velocity"),
    }


def _numbers_at(
    functions: Functions,
    barrier: Barrier,
    context: LawContext,
    k1: jax.Array,
    o: jax.Array | None,
) -> Callable[..., dict[str, Any]]:
    """A compiled function of (t, xi, direction of q): the functions of a barrier, their derivatives
    along the direction in both modes, the rate of V1 along q' = alpha, and what the barrier claims.
    """

    @jax.jit
    def at(barrier, context, t, xi, direction):
        tube: Tube = context.tube(t)
        q = position_at(tube, xi)
        found = {"xi": tube.xi(q)}
        for name, function in functions.items():

            def of_q(q, function=function):
                return function(barrier, tube, q, k1, o)

            found[name], linear = jax.linearize(of_q, q)
            found[f"d{name}"] = linear(direction)
            (found[f"r{name}"],) = jax.linear_transpose(linear, q)(direction)
        found["decay"] = jax.jvp(
            lambda t, q: functions["value"](barrier, context.tube(t), q, k1, o),
            (t, q),
            (jnp.ones_like(t), found["virtual_velocity"]),
        )[1]
        return found | {
            "error": q - tube.q_d,
            "ratio": barrier.error_over_slope(tube, q),
            "bound": barrier.xi_bound(found["value"], tube),
        }

    return lambda *arguments: at(barrier, context, *arguments)


def _at_every_xi(findings: Findings, got: dict[str, np.ndarray], guard: float) -> None:
    xi = np.asarray(XI)[:, None] + 0 * got["xi"]
    remedy = (
        "Evaluate at iblf_jax.barriers.guarded_error; remove singularities at e1 = 0 by a double"
        " jnp.where"
    )
    prefixes = {"": "", "d": "the forward derivative of ", "r": "the reverse derivative of "}
    for prefix, text in prefixes.items():
        for name in FUNCTIONS:
            bad = ~np.isfinite(got[prefix + name])
            if np.any(bad):
                findings.add(f"{text}{name} is not finite at xi = {xi[bad][0]:.12g}", remedy)
        findings.stop_if_any()
    zero = np.abs(xi) == 0
    is_zero = np.all(np.abs(got["value"][zero]) < 1e-12)
    findings.require(is_zero, "V1 is not 0 at e1 = 0", "Subtract its value there")
    findings.require(np.all(np.abs(got["slope"][zero]) < 1e-12), "the slope is not 0 at e1 = 0")
    findings.require(
        np.all(got["value"] >= 0),
        "V1 is negative somewhere",
        "A Lyapunov function is >= 0; continue it along the tangent beyond the guard",
    )
    inward = np.sign(xi) * got["slope"] >= 0
    findings.require(
        np.all(inward),
        "the slope points outward somewhere",
        "tau = ... - slope must point inward, also beyond the bound",
    )
    # At the edge of the guard both one-sided derivatives are correct; points near it are left out.
    clear = np.abs(np.abs(xi) - (1 - guard)) > 1e-3 * guard
    off = np.abs(got["dvalue"] - got["slope"]) / np.maximum(1.0, np.abs(got["slope"]))
    worst = float(np.max(off[clear]))
    remedy = "Beyond the guard V1 must continue along its tangent: V1(e) + slope(e) (e1 - e)"
    findings.require(worst < 1e-8, f"the slope is not dV1/dq (relative error {worst:.2g})", remedy)
    inside = np.abs(xi) < 1 - 2 * guard
    growth = float(np.max(got["decay"][inside]))
    findings.require(
        growth <= 1e-9,
        f"V1 grows at rate {growth:.3g} along q' = alpha",
        "alpha must make slope . alpha + dV1/dt negative",
    )


def _grows_without_bound(findings: Findings, barrier: Any, context: LawContext) -> None:
    """Requires that V1 of a barrier with a guard has no limit at the bound.

    V1 is evaluated at three distances from the bound, each a tenth of the one before. Where it has
    a limit, its increments fall with the distance or a power of it; those of a logarithm are equal.
    """
    try:
        sharp = dataclasses.replace(barrier, guard=SMALL_GUARD)
    except (TypeError, ValueError):  # Its class takes no guard.
        sharp = barrier
    nearest = 2.0 * max(sharp.guard, SMALL_GUARD)
    if sharp.guard == -math.inf or 100.0 * nearest >= 1.0:
        return
    inside = 1.0 - nearest * np.array([100.0, 10.0, 1.0])

    @jax.jit
    def value(sharp, context, t, xi):
        tube = context.tube(t)
        return sharp.value(tube, position_at(tube, xi))

    for t in TIMES:
        rows = at_each(lambda xi, t=t: value(sharp, context, t, xi), [*inside, *-inside])
        V1 = rows.reshape(2, 3, -1)
        before, last = np.diff(V1, axis=1).swapaxes(0, 1)
        findings.require(
            np.all(last > LEAST_INCREMENT * before),
            f"V1 is finite at the bound: it is {V1[:, -1].max():.4g} at |xi| = {inside[-1]:.9g}",
            "A barrier grows without bound as |xi| -> 1, or a disturbance carries the joint across;"
            " a V1 that does not states guard = -math.inf",
        )


SMALL_GUARD = 1e-7
LEAST_INCREMENT = 0.6
"""Least ratio of two increments of V1, each over a tenth of the distance from the bound of the one
before: 1 for a logarithm, 0.32 for a square root, 0.1 for a function with a slope at the bound."""


def _claims(
    findings: Findings, barrier: Barrier, k1: jax.Array, numbers: dict[str, np.ndarray]
) -> None:
    """Tests the claims of the barrier about V1 at every xi, if it states any."""
    rate = barrier.decay_rate(k1)
    if rate is not None:
        has_shape(findings, "decay_rate(k1)", rate, k1.shape)
    xi, V1, slope, decay = (numbers[name] for name in ("xi", "value", "slope", "decay"))
    error, ratio, bound = (numbers[name] for name in ("error", "ratio", "bound"))
    within = np.abs(xi) < min(1 - 2 * barrier.guard, 1.0)
    if rate is not None:
        excess = float(np.max((decay + np.asarray(rate) * V1)[within]))
        findings.require(
            excess <= 1e-9,
            f"V1' + decay_rate V1 reaches {excess:.3g} along q' = alpha",
            "Claim a smaller rate, or None",
        )
    if ratio is not None:
        off = np.max(np.abs(ratio * slope - error)[within])
        remedy = "It is e1/s inside the bound, in a form without 0/0 at e1 = 0"
        findings.require(
            off < 1e-9, f"error_over_slope times the slope is not e1 (off by {off:.2g})", remedy
        )
        findings.require(
            np.all(np.isfinite(ratio)), "error_over_slope is not finite somewhere", remedy
        )
    if bound is not None:
        kept = (np.abs(xi) <= bound * (1 + 1e-9) + 1e-12)[within]
        findings.require(
            np.all(kept),
            "|xi| is beyond xi_bound(V1, tube)",
            "It must hold wherever V1 <= V; return None for no claim",
        )
