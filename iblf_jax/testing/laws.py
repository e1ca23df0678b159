"""The checker for tracking laws: the contracts are `iblf_jax.controllers.RobotLaw` and `Law`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.barriers import Quadratic
from iblf_jax.control.controllers import Command, Law, TrackingLaw, WithDrive
from iblf_jax.control.controllers._base import contract_of, law_of_x
from iblf_jax.core import notices
from iblf_jax.core.pytree import field_values, unwrapped
from iblf_jax.core.status import VIOLATED, Status
from iblf_jax.engine.simulate import simulate
from iblf_jax.simulation.levels import levels_on_reference, start_levels
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.testing._contract import (
    Findings,
    check_function,
    examine,
    first_line,
    has_shape,
    in_both_types,
    in_dtype,
    leaves_by_name,
    same_structure,
    shape_of,
)
from iblf_jax.testing.bounds import check_at_the_bounds
from iblf_jax.testing.joints import check_scenario, scenario_for
from iblf_jax.testing.own_claims import check_claims
from iblf_jax.world.bounds import Bounds, Constant

SHORT_RUN = 0.1
"""Duration of the closed-loop test [s]."""
SPEED = 2.0
"""Bound of the velocities for a law that needs one [rad/s]."""


def check_law(
    law: Any, *, scenario: Scenario | None = None, n: int | None = None
) -> tuple[str, ...]:
    """Checks a tracking law: shapes, the state's structure, derivatives, float32, finite values
    inside the bounds, the class attributes `gains` and `uses_observer`, and a short closed loop.

    A law inside a `WithDrive` runs on the plant that this contains.

    Args:
      law: an instance.
      scenario: the scenario of the closed loop; if not given the paper's simulation, or a similar
        one for the number of joints of the law.  A law for plants of order > 2 needs one.
      n: number of joints, if no scenario is given; that of its leaves if not given, 2 if these
        are scalars.

    Returns:
      Remarks, for example that the law is undefined beyond its bounds, as many published laws are;
      an empty tuple if there are none.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: not a Scenario, or one with another number of joints than `n`.
    """
    check_scenario(scenario, n)
    with examine(law, "TrackingLaw", contract_of(law)) as findings:
        base = in_dtype(scenario_for(findings, law, scenario, n), "float64")
        bounds, inner = base.bounds, unwrapped(law)
        keeps_second = any(not isinstance(x, Quadratic) for x in inner.barriers[1:2])
        if bounds[1] is None and (inner.needs_velocity_bounds or keeps_second):
            second = Bounds(lower=Constant(-SPEED), upper=Constant(SPEED))
            bounds = (bounds[0], second, *bounds[2:])
        plant: Any = law.drive if isinstance(law, WithDrive) else base.plant
        try:
            base = dataclasses.replace(
                base, controller=law, bounds=bounds, plant=plant, model=base.model
            )
            base = in_dtype(base, "float64")
            unwrapped(law).check_start(base.context)
        except ValueError as error:
            findings.stop(f"a Scenario does not accept it ({error})")
        in_both_types(findings, _structure, base)
        t = jnp.asarray(0.7, float)
        tube = base.context.tube(t)
        model = base.loop.model
        _, dq, *others = levels_on_reference(base, t)
        x = jnp.stack([tube.q_d + 0.3 * tube.k_u, dq - 0.2, *others])[: model.order]
        f_hat = jnp.broadcast_to(jnp.linspace(0.1, 0.2, base.n), model.estimate_shape)

        # JAX keeps what it has traced of a command; all checks transform that.
        @jax.jit
        def command_of(law, *arguments):
            return law_of_x(law).command(*arguments)

        def outputs(law, t, x, f_hat, context):
            state = law_of_x(law).init(x, context)
            command, rate = command_of(law, t, x, f_hat, context, state)
            rates = leaves_by_name("its state's rate", rate)
            found = {"tau": command.tau, "alpha": command.alpha, "V1": command.V1}
            return found | leaves_by_name("input", command.input) | rates

        arguments = (t, x, f_hat, base.context)
        compiled = check_function(findings, outputs, base.controller, arguments)
        _declarations(findings, compiled, base.controller, arguments)
        check_claims(findings, base)
        is_defined_beyond = check_at_the_bounds(findings, base, command_of)
        findings.stop_if_any()
        _closed_loop(findings, in_dtype(base, "float32"), is_defined_beyond)
    return tuple(findings.remarks)


def _declarations(
    findings: Findings,
    outputs: Callable[[Any], dict[str, jax.Array]],
    law: TrackingLaw,
    arguments: tuple[Any, ...],
) -> None:
    """Requires that the class attributes `gains` and `uses_observer` fit the fields and the
    command.
    """
    inner = unwrapped(law)
    gains = inner.gains
    if gains is not TrackingLaw.gains:
        names = tuple(field_values(inner))
        unknown = [name for name in gains if name not in names]
        findings.require(
            not unknown,
            f"gains = {gains!r} has names that are no field: {', '.join(map(repr, unknown))}",
            f"Its fields are {', '.join(names)}",
        )
    if law.uses_observer:
        return
    t, x, f_hat, context = arguments
    with_estimate = outputs((law, t, x, f_hat, context))
    without = outputs((law, t, x, jnp.zeros_like(f_hat), context))
    changed = [name for name, x in with_estimate.items() if not np.array_equal(x, without[name])]
    findings.require(
        not changed,
        f"uses_observer is False, but {', '.join(changed)} depends on f_hat",
        "Remove the attribute; `compare` runs such a law without an observer",
    )


def _structure(findings: Findings, scenario: Scenario) -> None:
    law: Any = scenario.controller
    context, model = scenario.context, scenario.loop.model
    x = start_levels(scenario)[: model.order]
    q, t = x[0], jnp.zeros((), x.dtype)
    measured, names = ((x,), "x") if isinstance(law, Law) else ((x[0], x[1]), "q, dq")
    state = shape_of(findings, f"init({names}, context)", law.init, *measured, context)
    label = f"command(t, {names}, f_hat, context, state)"
    f_hat = jnp.zeros(model.estimate_shape, q.dtype)
    answer = shape_of(findings, label, law.command, t, *measured, f_hat, context, state)
    is_pair = isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], Command)
    findings.result_is(is_pair, label, answer, "It must be a pair (Command, rate of the state)")
    command, rate = answer
    remedy = "Make constants with the dtype of an argument, jnp.zeros_like(q)"
    for name, got in (("tau", command.tau), ("alpha", command.alpha), ("V1", command.V1)):
        if has_shape(findings, f"Command.{name}", got, q.shape):
            problem = f"Command.{name} is {got.dtype} for {q.dtype} arguments"
            findings.require(got.dtype == q.dtype, problem, remedy)
    has_shape(findings, "Command.guard_active", command.guard_active, q.shape, jnp.bool_)
    has_shape(findings, "Command.saturated", command.saturated, q.shape, jnp.bool_)
    same_structure(findings, "the rate that command returns", rate, state)


def _closed_loop(findings: Findings, scenario: Scenario, is_defined_beyond: bool) -> None:
    """A short run in float32, in which a state that changes its type is an error."""
    try:
        with notices.muted():
            run = simulate(scenario, duration=SHORT_RUN, dt=1e-3, record_every=10, metrics=())
    except (TypeError, ValueError) as error:
        findings.add(f"it does not run in a closed loop ({first_line(error)})")
        return
    left = int(run.status) & int(VIOLATED | Status.ALPHA_INFEASIBLE)
    if left and not is_defined_beyond:
        findings.remark(
            "the closed loop of the check left the bounds, beyond which the law is undefined",
            "Try it in a scenario of its own",
        )
        return
    status = Status(int(run.status))
    diverged = Status.NOT_FINITE in status and Status.STEP_TOO_LARGE not in status
    findings.require(
        not diverged,
        f"the closed loop diverged within {SHORT_RUN} s",
        "Look at the signs of the feedback",
    )
    finite = all(np.all(np.isfinite(x)) for x in (run.q, run.dq, run.tau, run.V))
    findings.require(finite, "the closed loop gave numbers that are not finite")
