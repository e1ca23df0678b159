"""The closed loop: the one place where plant, law and observer meet.

    state  x = (q, q', state of the law, state of the observer)
    q" = M^-1 (tau + disturbance + friction - C q' - G)                 with the plant's M, C, G, friction at time t
    f  = M0 q" + C0 q' + G0 - tau                                       what the observer should have estimated      (2.1)
    V2 = sum V1 + 1/2 e2^T M0 e2 + 1/2 f_tilde^T f_tilde                                                             (3.12)

`evaluate` gives the rate of the state and everything that can be looked at; where only the rate is used (the inner stages of an
integrator) the compiler drops the rest.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import inner, matvec, solve_spd
from iblf_jax.robots import at_time, friction_torque
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample


class LoopState(NamedTuple):
    """The state of the loop; also the form of its rate."""

    q: jax.Array
    dq: jax.Array
    controller: Any
    observer: Any


def initial_state(scenario: Scenario) -> LoopState:
    """The state at t = 0."""
    q, dq = scenario.initial.q, scenario.initial.dq
    return LoopState(q, dq, scenario.controller.init(q, dq, scenario.setting), scenario.observer.init(q, dq, scenario.model))


@jax.jit  # so that it is traced once for all the places that call it, and `lowering` sees that they call one function
def evaluate(scenario: Scenario, t: jax.Array, state: LoopState, dt: jax.Array | float = 0.0) -> tuple[LoopState, Sample]:
    """The rate of the state and the sample at time t.

    Args:
      scenario: what runs.
      t: time, () [s].
      state: state at t.
      dt: the time that the sample stands for, () [s].
    """
    plant, model, observer = at_time(scenario.plant, t), scenario.model, scenario.observer
    q, dq = state.q, state.dq
    tube = scenario.setting.tube(t)

    f_hat = observer.estimate(t, q, dq, model, state.observer)
    command, controller_rate = scenario.controller.command(t, q, dq, f_hat, scenario.setting, state.controller)
    observer_rate = observer.derivative(t, q, dq, command.tau, model, state.observer)
    pushed = command.tau + scenario.disturbance.torque(t, q, dq, plant, model) + friction_torque(plant, dq)
    ddq = solve_spd(plant.mass_matrix(q), pushed - plant.coriolis(q, dq, dq) - plant.gravity(q))

    M0, G0 = model.mass_matrix(q), model.gravity(q)
    f = matvec(M0, ddq) + model.coriolis(q, dq, dq) + G0 - command.tau
    e2, f_tilde = dq - command.alpha, f - f_hat
    V = jnp.sum(command.V1) + 0.5 * (inner(e2, matvec(M0, e2)) + inner(f_tilde, f_tilde))
    sample = Sample(
        t=t,
        dt=jnp.asarray(dt, t.dtype),
        q=q,
        dq=dq,
        tau=command.tau,
        e1=q - tube.q_d,
        e2=e2,
        xi=tube.xi(q),
        q_d=tube.q_d,
        dq_d=tube.dq_d,
        lower=tube.lower,
        upper=tube.upper,
        alpha=command.alpha,
        gravity=G0,
        disturbance=f,
        disturbance_estimate=f_hat,
        V=V,
        guard_active=command.guard_active,
        saturated=command.saturated,
    )
    return LoopState(dq, ddq, controller_rate, observer_rate), sample


def rate(scenario: Scenario, t: jax.Array, state: LoopState) -> LoopState:
    """The rate of the state at time t: the vector field of the closed loop."""
    return evaluate(scenario, t, state)[0]
