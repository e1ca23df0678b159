"""The disturbance observer as the paper prints it: exact for a constant mass matrix only."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.linalg import matvec
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.world.robots import Robot

STARTS = ("zero", "matched")


@component
class Printed:
    """f_hat = eta + kf M0 q',   eta' = -kf eta - kf (tau - C0 q' - G0 + kf M0 q').    (3.11)

    Its error obeys f_tilde' = f' - kf f_tilde - kf M0' q': the last term is what `Momentum`
    removes.

    Args:
      kf: gain, () or (n,) [1/s], > 0; Theorem 2 asks for more than 1/2, and for more than 1 where f
        changes.
      eta0: eta(0), added to what `start` says, () or (n,) [N m]; 0 if not given.
      start: "zero": eta(0) = eta0, as printed; "matched": eta(0) = eta0 - kf M0 q'(0), so that
        f_hat(0) = eta0; "zero" if not given.

    Source: Zhang & Yan 2024, (3.11), signs restored.
    """

    kf: Leaf = leaf("1/s", sign="positive")
    eta0: Leaf = leaf("N m", default=0.0)
    start: str = static(default="zero")

    def check(self) -> None:
        """Raises ValueError for an unknown `start`."""
        checks.one_of("Printed.start", self.start, STARTS)

    def advice(self) -> list[str]:
        """Warnings about gains outside the conditions of Theorem 2."""
        return kf_advice(self.kf)

    def init(self, q: jax.Array, dq: jax.Array, model: Robot) -> jax.Array:
        """eta(0), (n,) [N m]."""
        return initial_eta(self, q, dq, model)

    def estimate(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, model: Robot, state: jax.Array
    ) -> jax.Array:
        """f_hat, (n,) [N m]."""
        return state + self.kf * matvec(model.mass_matrix(q), dq)

    def derivative(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: Robot,
        state: jax.Array,
    ) -> jax.Array:
        """eta', (n,) [N m/s]."""
        f_hat = self.estimate(t, q, dq, model, state)
        return -self.kf * (f_hat + tau - model.coriolis(q, dq, dq) - model.gravity(q))

    def advance(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: Robot,
        state: jax.Array,
        period: jax.Array,
    ) -> jax.Array:
        """Eta a period later, (n,) [N m]: exact, as (3.11) is linear in eta."""
        return held_eta(self, t, q, dq, tau, model, state, period)

    def at_period(self, period: jax.Array) -> Printed:
        """Kf = (1 - exp(-kf period)) / period: then 1 - kf period is what is left of an error after
        a period.
        """
        return dataclasses.replace(self, kf=-jnp.expm1(-self.kf * period) / period)


def kf_advice(kf: jax.Array) -> list[str]:
    """What to tell a user whose kf is below the condition of Theorem 2; nothing for traced
    values.
    """
    if not checks.is_concrete(kf) or bool(np.all(np.asarray(kf) > 0.5)):
        return []
    need = "Theorem 2 needs kf > 1/2 on every joint (3.17), and kf > 1 where f changes (3.25)"
    rest = (
        "the corrected law with a momentum observer has the weighted claim of ij.certify for every"
        " kf > 0"
    )
    return [
        f"observer.kf = {kf}: {need}, for the paper's envelope of V2. Below it that envelope is"
        f" lost: {rest}."
    ]


def held_eta(
    observer, t, q, dq, tau, model: Robot, state: jax.Array, period: jax.Array
) -> jax.Array:
    """Eta a period later for constant inputs, (n,) [N m]: eta' = kf (eta* - eta), so eta* - eta
    falls by exp(-kf period).
    """
    rate = observer.derivative(t, q, dq, tau, model, state)
    return state - jnp.expm1(-observer.kf * period) / observer.kf * rate


def initial_eta(observer, q: jax.Array, dq: jax.Array, model: Robot) -> jax.Array:
    """eta(0) of an observer with `kf`, `eta0` and `start`, (n,) [N m]."""
    eta0 = jnp.broadcast_to(observer.eta0, q.shape)
    return (
        eta0 - observer.kf * matvec(model.mass_matrix(q), dq)
        if observer.start == "matched"
        else eta0
    )
