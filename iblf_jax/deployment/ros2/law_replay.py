"""The signals of a law that ran on a robot: the scenario's law on the states that it received."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.control import sensors
from iblf_jax.control.sensors._base import AnySensor
from iblf_jax.simulation.closed_loop import LoopState, initial_state, run_sampled_law
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.scenario import Scenario


def without_effects(sensor: AnySensor) -> AnySensor:
    """The part of a sensor that belongs to the law: its velocity filter, without counts, offset and
    noise.
    """
    velocity = sensor.velocity
    if velocity is None:
        return sensors.Ideal()
    return sensors.Encoder(velocity)


def replay_law(
    scenario: Scenario,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    is_due: jax.Array,
    tau: jax.Array | None = None,
) -> LoopState:
    """The state of law and observer after each of K measured states, stacked.

    Args:
      scenario: sampled and canonical; the law starts at the first state.
      t: times of the states, (K,) [s].
      q, dq: measured positions [rad] and velocities [rad/s], (K, n).
      is_due: whether the law runs at a state, (K,) bool.
      tau: torques that acted from each state on, (K, n) [N m], which the observer receives, so that
        it forgets a wrong start; those of the law if not given.
    """
    scenario = dataclasses.replace(scenario, sensor=without_effects(scenario.sensor))
    return _replay(scenario, t, q, dq, is_due, tau)


@jax.jit
def _replay(
    scenario: Scenario,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    is_due: jax.Array,
    tau: jax.Array | None,
) -> LoopState:
    # The start is not checked against the bounds: values that JAX is tracing have no number.
    scenario = dataclasses.replace(scenario, initial=Initial(q=q[0], dq=dq[0]))
    normal = jnp.zeros((scenario.sensor.draws, scenario.n), q.dtype)

    def one(state: LoopState, now: Any) -> tuple[LoopState, LoopState]:
        t, q, dq, due, applied = now
        state = state._replace(x=jnp.stack([q, dq]))
        run = partial(run_sampled_law, scenario, t, normal=normal, applied=applied)
        state = jax.lax.cond(due, run, lambda state: state, state)
        return state, state

    return jax.lax.scan(one, initial_state(scenario), (t, q, dq, is_due, tau))[1]
