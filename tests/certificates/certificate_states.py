"""Random states, gains and masses of the closed loop, for tests of what must hold at every
state."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from claim_terms import terms_at

import iblf_jax as ij
from iblf_jax.certificates.terms import Terms
from iblf_jax.simulation.closed_loop import LoopState
from iblf_jax.simulation.scenario import canonical

STATES = 4096


def loop(variant: str = "corrected", observer: str = "momentum", barrier=None) -> ij.Scenario:
    """The paper's loop with one law and one observer, to be varied by `random_loops`."""
    barrier = ij.barriers.Integral(guard=1e-3) if barrier is None else barrier
    law = ij.controllers.Backstepping(k1=2.0, K2=20.0, barrier=barrier, variant=variant)
    parts = {"controller": law, "observer": ij.observers.MEMBERS[observer](kf=20.0)}
    return canonical(dataclasses.replace(ij.presets.zhang_yan_2024(), **parts))


def random_loops(
    scenario: ij.Scenario,
    seed: int = 0,
    *,
    states: int = STATES,
    speed: float = 10.0,
    nearest: float = 0.99,
    weighted: bool = False,
):
    """Scenarios with other gains, masses and disturbances, and a time and state of each: (scenario,
    t, state), batched.

    With `weighted` the barriers have weights, and the gains are anything positive: below the
    conditions of Theorem 2, too.
    """
    dtype, rng, n = scenario.initial.q.dtype, np.random.default_rng(seed), scenario.n

    def uniform(low, high, *shape):
        return rng.uniform(low, high, (states, *shape)).astype(dtype)

    every = jax.tree.map(lambda x: np.broadcast_to(x, (states, *np.shape(x))), scenario)
    gains = {} if scenario.controller.o is None else {"o": 10 ** uniform(-3, 0, n)}
    gains |= {"k1": 10 ** uniform(-1, 1, n), "K2": 0.5 + 10 ** uniform(-2, 1.7, n)}
    kf, phase = 1.0 + 10 ** uniform(-2, 1.7, n), uniform(0.0, 6.28)
    load = {"mass": every.plant.mass * uniform(0.5, 1.5, n), "payload": uniform(0.0, 0.5)}
    batch = _rebuilt(
        every,
        controller=_rebuilt(every.controller, **gains),
        observer=_rebuilt(every.observer, kf=kf),
        disturbance=_rebuilt(every.disturbance, phase=phase),
        plant=_rebuilt(every.plant, **load),
        model=_rebuilt(every.model, mass=every.model.mass * uniform(0.5, 1.5, n)),
    )
    t, dq = uniform(0.0, 20.0), uniform(-speed, speed, n)
    q, momentum = _position(batch, t, uniform(-nearest, nearest, n), dq)
    if weighted:
        light = {"weight": 10 ** uniform(-3, 1.5, n), "K2": 10 ** uniform(-3, 1.7, n)}
        law, kf = _rebuilt(batch.controller, **light), 10 ** uniform(-3, 1.7, n)
        batch = _rebuilt(batch, controller=law, observer=_rebuilt(batch.observer, kf=kf))
    eta = uniform(-5.0, 5.0, n) - batch.observer.kf * momentum
    return batch, t, LoopState(jnp.stack([q, dq], axis=-2), (), eta)


def _rebuilt(part, **changes):
    """A component with other fields, unchecked: its leaves are batched."""
    copy = object.__new__(type(part))
    for field in dataclasses.fields(part):
        object.__setattr__(copy, field.name, changes.get(field.name, getattr(part, field.name)))
    return copy


@jax.jit
@jax.vmap
def _position(scenario: ij.Scenario, t, xi, dq):
    """The position with this relative error, and M0 q' there."""
    tube = scenario.context.tube(t)
    q = tube.q_d + xi * jnp.where(xi > 0, tube.k_u, tube.k_l)
    return q, scenario.model.mass_matrix(q) @ dq


@jax.jit
def terms_of(batch: ij.Scenario, t, state: LoopState) -> Terms:
    """The terms of the claims at each of the states."""
    return jax.vmap(terms_at)(batch, t, state)
