"""Random states, gains and masses of the closed loop, for tests of what must hold at every state."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp

import iblf_jax as ij
from iblf_jax.certificates.evidence import Evidence, evidence_at
from iblf_jax.closed_loop import LoopState
from iblf_jax.scenario import canonical

STATES = 4096


def loop(reading: str = "corrected", observer: str = "momentum", barrier=None, wall: float = 1e-3) -> ij.Scenario:
    """The paper's loop with one law and one observer, to be varied by `random_loops`."""
    barrier = ij.barriers.Integral(guard=wall) if barrier is None else barrier
    law = ij.controllers.Backstepping(k1=2.0, K2=20.0, barrier=barrier, reading=reading)
    paper = ij.presets.zhang_yan_2024()
    return canonical(dataclasses.replace(paper, controller=law, observer=ij.observers.MEMBERS[observer](kf=20.0)))


def random_loops(scenario: ij.Scenario, seed: int = 0, *, states: int = STATES, speed: float = 10.0, nearest: float = 0.99):
    """Scenarios with other gains, masses and disturbances, and a time and state of each: (scenario, t, state), batched."""
    dtype = scenario.initial.q.dtype
    keys = iter(jax.random.split(jax.random.key(seed), 64))

    def uniform(low, high, *shape):
        return jax.random.uniform(next(keys), (states, *shape), dtype, low, high)

    n = scenario.n
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (states, *jnp.shape(x))), scenario)
    law = dataclasses.asdict(batch.controller) | {"barrier": batch.controller.barrier}
    law |= {"k1": 10 ** uniform(-1, 1, n), "K2": 0.5 + 10 ** uniform(-2, 1.7, n)}
    law |= {} if batch.controller.o is None else {"o": 10 ** uniform(-3, 0, n)}
    unbuilt = partial(_rebuilt, batch)
    plant = _rebuilt(batch.plant, mass=batch.plant.mass * uniform(0.5, 1.5, n), payload=uniform(0.0, 0.5))
    model = _rebuilt(batch.model, mass=batch.model.mass * uniform(0.5, 1.5, n))
    batch = unbuilt(
        controller=_rebuilt(batch.controller, **law),
        observer=_rebuilt(batch.observer, kf=1.0 + 10 ** uniform(-2, 1.7, n)),
        disturbance=_rebuilt(batch.disturbance, phase=uniform(0.0, 6.28)),
        plant=plant,
        model=model,
    )
    t, dq = uniform(0.0, 20.0), uniform(-speed, speed, n)
    q = jax.vmap(_position)(batch, t, uniform(-nearest, nearest, n))
    f_hat = uniform(-5.0, 5.0, n)
    eta = f_hat - batch.observer.kf * jax.vmap(lambda model, q, dq: model.mass_matrix(q) @ dq)(batch.model, q, dq)
    return batch, t, LoopState(q, dq, (), eta)


def _rebuilt(part, **changes):
    """A component with other fields, unchecked: its leaves are batched."""
    copy = object.__new__(type(part))
    for field in dataclasses.fields(part):
        object.__setattr__(copy, field.name, changes.get(field.name, getattr(part, field.name)))
    return copy


def _position(scenario: ij.Scenario, t, xi):
    """The position with this relative error."""
    tube = scenario.setting.tube(t)
    return tube.q_d + xi * jnp.where(xi > 0, tube.k_u, tube.k_l)


@jax.jit
def evidence_of(batch: ij.Scenario, t, state: LoopState) -> Evidence:
    """The evidence at each of the states."""
    return jax.vmap(evidence_at)(batch, t, state)
