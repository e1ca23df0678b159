"""A safety filter around any law: the torque nearest to the law's that keeps bounds, by control barrier functions.

The bounds are h_u = k_uc - q >= 0 and h_l = q - k_lc >= 0, of relative degree 2.  With a1, a2 > 0 the conditions
(d/dt + a1)(d/dt + a2) h >= 0 are a box of accelerations,

    q" <= k_uc" + (a1 + a2)(k_uc' - q') + a1 a2 (k_uc - q),
    q" >= k_lc" + (a1 + a2)(k_lc' - q') + a1 a2 (k_lc - q),

and bounds on the velocities, of relative degree 1, are one more: v_l' + a3 (v_l - q') <= q" <= v_u' + a3 (v_u - q').  The model and the
observer's estimate turn accelerations into torques, tau = M0 q" + C0 q' + G0 - f_hat.  Inside what the conditions keep
(h >= 0 and h' + a2 h >= 0 at the start) they keep it for as long as they have a common torque, and f_hat is f.

Where they have none (within the torque limits, or as a bound runs into another), the torque breaks them by the least slack: it is in the
command, is recorded, and raises `Status.FILTER_INFEASIBLE`.
"""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.controllers._base import Command, Controller, Setting, State
from iblf_jax.core import checks
from iblf_jax.core.linalg import matmul, matvec, solve_spd
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.qp import quadratic_program

NEAREST = ("torque", "acceleration")


@component
class SafetyFilter:
    """The torque nearest to the law's with  q" in the box of the conditions (head of this module)  and  |tau| <= limit.

    Nearest in torque, |tau - tau_law|, or in acceleration, |M0^-1 (tau - tau_law)|; the latter without a limit is a clip, else it is a
    quadratic programme (`core.qp`).  Where the law's own torque meets all conditions it is passed on as it is.  Paths reach through:
    "controller.K2" is the wrapped law's K2.

    Args:
      law: whose torque is filtered, any `Controller`.
      a1: first rate of the position's conditions, () or (n,) [1/s], > 0; 10 if not given.
      a2: second rate of these, () or (n,) [1/s], > 0; 10 if not given.
      a3: rate of the velocity's conditions, where the scenario has `velocity_bounds`, () or (n,) [1/s], > 0; 20 if not given.
      limit: largest torque of each joint, () or (n,) [N m], > 0; none if not given.
      nearest: "torque" or "acceleration"; "torque" if not given.

    Source: A. D. Ames, X. Xu, J. W. Grizzle, P. Tabuada, IEEE Trans. Automatic Control 62 (2017) 3861-3876; relative degree 2 as Q. Nguyen,
    K. Sreenath, American Control Conference 2016, 322-328.
    """

    law: Controller
    a1: Leaf = leaf("1/s", sign="positive", default=10.0)
    a2: Leaf = leaf("1/s", sign="positive", default=10.0)
    a3: Leaf = leaf("1/s", sign="positive", default=20.0)
    limit: Leaf = leaf("N m", sign="positive", default=None)
    nearest: str = static(default="torque")
    wraps: ClassVar[str] = "law"

    def check(self) -> None:
        """Raises ValueError for something that is not a law, or an unknown measure."""
        checks.conforms("SafetyFilter.law", self.law, Controller, "iblf_jax.controllers has them.")
        checks.one_of("SafetyFilter.nearest", self.nearest, NEAREST)

    def advice(self) -> list[str]:
        """The wrapped law's."""
        return getattr(self.law, "advice", list)()

    def init(self, q: jax.Array, dq: jax.Array, setting: Setting) -> State:
        """The wrapped law's state."""
        return self.law.init(q, dq, setting)

    def box(self, t: jax.Array, q: jax.Array, dq: jax.Array, setting: Setting) -> tuple[jax.Array, jax.Array]:
        """The accelerations that the conditions allow, lowest and highest, (n,) each [rad/s^2]."""
        lowest, highest = (
            ddside + (self.a1 + self.a2) * (dside - dq) + self.a1 * self.a2 * (side - q)
            for side, dside, ddside in _moving_bounds(t, setting)
        )
        if setting.velocity_bounds is not None:
            (slow, fast), (dslow, dfast) = jax.jvp(setting.speed_limits, (t,), (jnp.ones_like(t),))
            lowest = jnp.maximum(lowest, dslow + self.a3 * (slow - dq))
            highest = jnp.minimum(highest, dfast + self.a3 * (fast - dq))
        return lowest, highest

    def command(self, t: jax.Array, q: jax.Array, dq: jax.Array, f_hat: jax.Array, setting: Setting, state: State) -> tuple[Command, State]:
        """The wrapped law's command with its torque filtered, and the slack."""
        command, rate = self.law.command(t, q, dq, f_hat, setting, state)
        model, asked = setting.model, command.tau
        M = model.mass_matrix(q)
        planned = solve_spd(M, asked + f_hat - model.coriolis(q, dq, dq) - model.gravity(q))
        lowest, highest = self.box(t, q, dq, setting)
        if self.nearest == "acceleration" and self.limit is None:
            # An empty box is broken on both sides alike.
            slack = jnp.maximum(0.5 * (lowest - highest), 0.0)
            wanted = jnp.clip(planned, lowest - slack, highest + slack)
            return command._replace(tau=asked + matvec(M, wanted - planned), slack=slack), rate
        change, slack = self._change(M, asked, lowest - planned, highest - planned)
        saturated = command.saturated if self.limit is None else command.saturated | (jnp.abs(asked) > self.limit)
        return command._replace(tau=asked + change, slack=slack, saturated=saturated), rate

    def _change(self, M: jax.Array, asked: jax.Array, least: jax.Array, most: jax.Array) -> tuple[jax.Array, jax.Array]:
        """What is added to the torque, and the slack of each joint, if the acceleration may change by `least` to `most`."""
        n = len(asked)
        unit = jnp.eye(n, dtype=asked.dtype)
        inverse = jnp.stack([solve_spd(M, row) for row in unit])
        H = unit if self.nearest == "torque" else matmul(inverse, inverse)
        G, h, soft = [inverse, -inverse], [most, -least], [jnp.ones(2 * n, asked.dtype)]
        if self.limit is not None:
            G, h, soft = [*G, unit, -unit], [*h, self.limit - asked, self.limit + asked], [*soft, jnp.zeros(2 * n, asked.dtype)]
        rows, room = jnp.concatenate(G), jnp.concatenate(h)
        found = quadratic_program(H, rows, room, jnp.concatenate(soft))
        free = jnp.all(room >= 0)
        slack = jnp.maximum(found.slack[:n], found.slack[n : 2 * n])
        return jnp.where(free, 0.0, found.x), jnp.where(free, 0.0, slack)


def _moving_bounds(t: jax.Array, setting: Setting) -> list[tuple[jax.Array, jax.Array, jax.Array]]:
    """Lower and upper bound of q, each with its first and second rate, (n,) [rad], [rad/s], [rad/s^2]."""

    def sides(t):
        q_d = setting.reference.position(t)
        return setting.bounds.lower.at(t, q_d), setting.bounds.upper.at(t, q_d)

    def rates(t):
        return jax.jvp(sides, (t,), (jnp.ones_like(t),))[1]

    return list(zip(sides(t), *jax.jvp(rates, (t,), (jnp.ones_like(t),)), strict=True))
