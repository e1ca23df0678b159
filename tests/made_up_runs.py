"""Runs of known arrays, which no simulator made: for tests of what is drawn."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

import iblf_jax as ij
from iblf_jax.simulation.signals import VIEWS, Signals


@ij.component
class Arm3D(ij.robots.Robot):
    """A robot in space: the first joint turns it about z, the others lift it.  All that a drawing
    asks for."""

    n: int = ij.static()

    def mass_matrix(self, q):
        return jnp.eye(self.n)

    def potential(self, q):
        return jnp.zeros(())

    def tip(self, q):
        return self.skeleton(q)[-1]

    def skeleton(self, q):
        lift = jnp.cumsum(q[1:])
        out = jnp.concatenate([jnp.zeros(1), jnp.cos(lift)])
        up = jnp.concatenate([jnp.ones(1), jnp.sin(lift)])
        links = 0.3 * jnp.stack([out * jnp.cos(q[0]), out * jnp.sin(q[0]), up], axis=-1)
        return jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(links, axis=0)])


ALWAYS = [
    field.name for field in dataclasses.fields(Signals) if field.default is dataclasses.MISSING
]
"""The signals that every run has."""


def with_signals(run, **signals):
    """The run with other signals, of which some are rows of those of the levels."""
    for name, value in signals.items():
        if name in VIEWS:
            view = VIEWS[name]
            levels = getattr(run, view.signal).at[:, view.row].set(value)
            name, value = view.signal, levels
        run = dataclasses.replace(run, **{name: value})
    return run


@dataclasses.dataclass(eq=False)
class Holder:
    """In place of a Scenario, without leaves: a drawing asks it for no more than this."""

    plant: object
    sampling: None = None
    sensor: object = ij.sensors.Ideal()
    actuator: object = ij.actuators.Ideal()
    regions: tuple = ()

    @property
    def loop(self) -> SimpleNamespace:
        plant = ij.plants.as_plant(self.plant)
        return SimpleNamespace(plant=plant, model=plant)


jax.tree_util.register_pytree_node(Holder, lambda holder: ((), holder), lambda holder, _: holder)


def chain(n):
    return ij.robots.PlanarChain([1.0] * n, [0.3] * n, [0.15] * n, [0.02] * n)


def made_up(plant, *, duration=4.0, dt=0.01, shift=0.0, status=0):
    """A run of known arrays, which no simulator made."""
    t = np.arange(round(duration / dt) + 1) * dt
    joints = np.arange(plant.n)
    q_d = 0.5 + 0.2 * np.sin(t[:, None] + 0.5 * joints)
    e1 = 0.15 * np.exp(-3 * t[:, None]) * (1 + 0.1 * joints) + shift * np.sin(3 * t[:, None])
    lower = q_d - 0.3 - 0.05 * np.cos(t[:, None] + joints)
    upper = q_d + 0.4 + 0.05 * np.sin(t[:, None] + joints)
    f = 0.1 * np.cos(2 * t[:, None] + joints)
    arrays = {
        "t": t,
        "x": np.stack([q_d + e1, np.gradient(q_d + e1, dt, axis=0)], axis=1),
        "tau": 3.0 - 8 * np.exp(-9 * t[:, None]) + joints,
        "e": np.stack([e1, -3 * e1], axis=1),
        "xi": e1 / 0.45,
        "q_d": q_d,
        "dq_d": np.gradient(q_d, dt, axis=0),
        "level_lower": lower[:, None],
        "level_upper": upper[:, None],
        "alpha": 0 * q_d,
        "disturbance": f,
        "disturbance_estimate": f * (1 - np.exp(-5 * t[:, None])),
        "V": np.exp(-2 * t),
    }
    arrays = jax.device_put(arrays | {"fastest_mode": np.array(10.0), "dt": np.array(dt)})
    others = {"controller_state": (), "observer_state": (), "status": jnp.int32(status)}
    others |= {"metrics": ij.Metrics({}, ()), "method": "rk4"}
    return ij.Rollout(scenario=Holder(plant), **others, **arrays)


def runaway(plant, at=150):
    """A run that blew up to 1e4, with NaN in what follows from it, and was frozen."""
    run = made_up(plant, status=int(ij.Status.NOT_FINITE | ij.Status.BOUND_VIOLATED))
    growth = np.exp(np.clip(np.arange(run.t.size) - at + 20, 0, 20))[:, None] - 1
    frozen = np.minimum(np.arange(run.t.size), at)
    arrays = {}
    for name in ("q", "dq", "e1", "e2", "tau", "xi", "disturbance", "disturbance_estimate"):
        arrays[name] = jax.device_put((np.asarray(getattr(run, name)) + 1e-4 * growth)[frozen])
    arrays["tau"] = arrays["tau"].at[at:].set(jnp.nan)
    return with_signals(run, **arrays)
