"""The checker for tracking laws: the contract is `iblf_jax.controllers.Controller`."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers import Command, Controller
from iblf_jax.core import notices
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import VIOLATED, Status
from iblf_jax.engine.simulate import simulate
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.testing._contract import (
    Findings,
    examine,
    has_shape,
    in_dtype,
    probe,
    same_structure,
    shape_of,
)
from iblf_jax.testing.bounds import check_at_the_bounds
from iblf_jax.testing.joints import check_scenario, scenario_for
from iblf_jax.testing.own_claims import check_claims
from iblf_jax.world.bounds import Bounds, Constant

SHORT_RUN = 0.1
"""s."""
SPEED = 2.0
"""rad/s.  Bounds of the velocities for a law that needs some."""


def check_law(
    law: Any, *, scenario: Scenario | None = None, n: int | None = None
) -> tuple[str, ...]:
    """Checks a tracking law: shapes, the state's structure, derivatives, float32, finite inside its
    bounds, a short closed loop.

    Args:
      law: an instance.
      scenario: to try it in; if not given the paper's simulation, or one like it for as many joints
        as the law is for.
      n: number of joints, if no scenario is given; found from its leaves if not given, 2 if these
        are scalars.

    Returns:
      Remarks, such as that the law is undefined beyond its bounds, where many published laws are;
      an empty tuple if there are none.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: a scenario that is none, or has another number of joints than `n`.
    """
    check_scenario(scenario, n)
    with examine(law, "Controller", Controller) as findings:
        base = in_dtype(scenario_for(findings, law, scenario, n), "float64")
        watched = base.velocity_bounds
        if watched is None and getattr(unwrapped(law), "needs_velocity_bounds", False):
            watched = Bounds(lower=Constant(-SPEED), upper=Constant(SPEED))
        try:
            base = in_dtype(
                dataclasses.replace(base, controller=law, velocity_bounds=watched), "float64"
            )
        except ValueError as error:
            findings.add(f"it does not go into a Scenario ({error})")
            findings.stop_if_any()
        for dtype in ("float64", "float32"):
            _structure(findings, in_dtype(base, dtype))
        findings.stop_if_any()
        t = jnp.asarray(0.7)
        tube = base.context.tube(t)
        q, dq = tube.q_d + 0.3 * tube.k_u, tube.dq_d - 0.2
        f_hat = jnp.linspace(0.1, 0.2, base.n)

        def outputs(law, t, q, dq, f_hat, context):
            command, rate = law.command(t, q, dq, f_hat, context, law.init(q, dq, context))
            named = {f"its state's rate, leaf {i}": x for i, x in enumerate(jax.tree.leaves(rate))}
            return {"tau": command.tau, "alpha": command.alpha, "V1": command.V1, **named}

        probe(findings, outputs, base.controller, (t, q, dq, f_hat, base.context))
        check_claims(findings, base)
        is_defined_beyond = check_at_the_bounds(findings, base)
        findings.stop_if_any()
        _closed_loop(findings, in_dtype(base, "float32"), is_defined_beyond)
    return tuple(findings.remarks)


def _structure(findings: Findings, scenario: Scenario) -> None:
    law, context, q, dq = (
        scenario.controller,
        scenario.context,
        scenario.initial.q,
        scenario.initial.dq,
    )
    t, kind = jnp.zeros((), q.dtype), f" ({q.dtype})"
    state = shape_of(findings, "init(q, dq, context)" + kind, law.init, q, dq, context)
    if state is None:
        return
    label = "command(t, q, dq, f_hat, context, state)" + kind
    answer = shape_of(findings, label, law.command, t, q, dq, jnp.zeros_like(q), context, state)
    if answer is None:
        return
    if not (isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], Command)):
        findings.add(
            f"{label} gives {type(answer).__name__}",
            "It must be a pair (Command, rate of the state)",
        )
        return
    command, rate = answer
    for name in ("tau", "alpha", "V1"):
        ok = has_shape(findings, f"Command.{name}{kind}", getattr(command, name), q.shape)
        remedy = "Make constants with the dtype of an argument, jnp.zeros_like(q)"
        if ok:
            got = getattr(command, name).dtype
            findings.require(
                got == q.dtype, f"Command.{name} is {got} for {q.dtype} arguments", remedy
            )
    for name in ("guard_active", "saturated"):
        has_shape(findings, f"Command.{name}{kind}", getattr(command, name), q.shape, jnp.bool_)
    same_structure(findings, "the rate that command returns" + kind, rate, state)


def _closed_loop(findings: Findings, scenario: Scenario, is_defined_beyond: bool) -> None:
    """A short run in float32, where a state that changes its type is an error."""
    try:
        with notices.muted():
            run = simulate(scenario, duration=SHORT_RUN, dt=1e-3, record_every=10, metrics=())
    except (TypeError, ValueError) as error:
        findings.add(
            f"it does not run in a closed loop ({type(error).__name__}:"
            f" {str(error).splitlines()[0]})"
        )
        return
    left = int(run.status) & int(VIOLATED | Status.ALPHA_INFEASIBLE)
    if left and not is_defined_beyond:
        findings.remark(
            "the closed loop of the check left the bounds, beyond which the law is undefined",
            "Try it in a scenario of its own",
        )
        return
    lost = int(run.status) & int(Status.NOT_FINITE) and not int(run.status) & int(
        Status.STEP_TOO_LARGE
    )
    findings.require(
        not lost,
        f"the arm ran away within {SHORT_RUN} s of the closed loop",
        "Look at the signs of the feedback",
    )
    finite = all(np.all(np.isfinite(x)) for x in (run.q, run.dq, run.tau, run.V))
    findings.require(finite, "the closed loop gave numbers that are not finite")
