"""What the observers f_hat = eta + kf M0 q' share: all but the rate of eta.

Each function is a member of `AsPublished` and of `Momentum`; the first argument is the observer.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.observers._base import RobotObserver
from iblf_jax.core import checks
from iblf_jax.world.robots import Robot, momentum

STARTS = ("zero", "matched")


def kf_advice(observer: RobotObserver) -> list[str]:
    """Warnings about a kf below the condition of Theorem 2; none for traced values."""
    kf = observer.kf
    if not checks.is_concrete(kf) or bool(np.all(np.asarray(kf) > 0.5)):
        return []
    need = (
        "Theorem 2 needs kf > 1/2 on every joint, and kf > 1 where the disturbance changes:"
        " conditions (3.17) and (3.25) of the paper"
    )
    lost = "Below it the paper's bound on V2 is not proven"
    rest = (
        'with variant="corrected" and observers.Momentum, ij.certify computes another bound, its'
        ' claim "weighted", which holds for every kf > 0'
    )
    return [f"observer.kf = {kf}: {need}. {lost}; {rest}."]


def initial_eta(observer: Any, q: jax.Array, dq: jax.Array, model: Robot) -> jax.Array:
    """eta(0) of an observer with `kf`, `eta0` and `start`, (n,) [N m]."""
    eta0 = jnp.broadcast_to(observer.eta0, q.shape)
    if observer.start == "zero":
        return eta0
    return eta0 - observer.kf * momentum(model, q, dq)


def eta_and_momentum(
    observer: RobotObserver,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    model: Robot,
    state: jax.Array,
) -> jax.Array:
    """f_hat = eta + kf M0 q', (n,) [N m]."""
    return state + observer.kf * momentum(model, q, dq)


def advanced_eta(
    observer: RobotObserver,
    t: jax.Array,
    q: jax.Array,
    dq: jax.Array,
    tau: jax.Array,
    model: Robot,
    state: jax.Array,
    period: jax.Array,
) -> jax.Array:
    """The state eta a period later for constant inputs, (n,) [N m].

    It is exact, because (3.11) is linear in eta: eta' = kf (eta* - eta), so eta* - eta falls by
    exp(-kf period).
    """
    rate = observer.derivative(t, q, dq, tau, model, state)
    return state - jnp.expm1(-observer.kf * period) / observer.kf * rate


def with_discrete_gain(observer: Any, period: jax.Array) -> Any:
    """The observer with kf = (1 - exp(-kf period)) / period, for which 1 - kf period is what is
    left of an error after a period.
    """
    return dataclasses.replace(observer, kf=-jnp.expm1(-observer.kf * period) / period)
