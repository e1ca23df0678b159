"""Actuator limits around any law, without and with an auxiliary state; the paper leaves them to
future work.

The loop passes the input that the law commands, after the limits of `Saturated`, to observer and
actuator, so that the observer estimates f without the torque that was cut.  Lag, delay and faults
of an actuator are not in it.

**Auxiliary state.**  The level of the input, x_r, has the rate f_r + G_r sat(u) + d_r.  With

    lambda' = -k lambda + G_r (sat(u) - u),   lambda(0) = 0,                                  (A.1)

the error z = x_r - alpha_{r-1} - lambda obeys z' = f_r + G_r u + d_r - alpha_{r-1}' + k lambda, in
which the limit does not appear.  A law that takes alpha_{r-1} + lambda for alpha_{r-1}, and
alpha_{r-1}' - k lambda for its rate, is therefore not disturbed by the limit in this level.  For a
robot, where G_2 = M0^-1, the corrected law becomes

    tau = C0 (alpha + lambda) + G0 + M0 (alpha' - k lambda) - f_hat - K2 z - w s.             (A.2)

The level below has x_r = alpha_{r-1} + z + lambda, so that with z in the place of e_r

    V' = (V' of the law without limits) + (w_{r-1} s_{r-1})^T G_{r-1} lambda,                 (A.3)

which is w s . lambda for a robot.  Bounds of the last level become bounds of x_r - lambda, so that
(A.3) holds for barriers on that level, too.  The claims hold as far as lambda is small; runs record
it.

**Choice of k.**  (A.2) is the law without lambda, plus (C0 + K2 - k M0) lambda.  For k M0 = K2 + C0
the applied torque is that of the limit alone.  A smaller k reduces the command while the torque is
limited; a larger one keeps the torque at its limit until lambda has returned to 0.  While it is
limited, lambda' does not depend on k:

    lambda' = M0^-1 (sat(tau) - tau_0 - (C0 + K2) lambda),   tau_0 the torque for lambda = 0.

A large k therefore does not give the limit alone.

**Laws that do not take the shift** (`takes_shift`), such as those of users, are evaluated at the
state with x_r - lambda in the place of x_r, and the input is the one for which x_r - lambda moves
as x_r does without limits:

    f_r(x) + G_r(x) u = f_r(y) + G_r(y) u_law(y) - k lambda,   y = x with x_r - lambda.       (A.4)

Then V(t, y) has the rate that it has without limits, plus (dV/dx_{r-1})^T G_{r-1} lambda.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers._base import (
    Command,
    LawContext,
    Shift,
    State,
    TrackingLaw,
    Wrapping,
    check_law,
)
from iblf_jax.core import checks
from iblf_jax.core.input_limits import check_lower_limit, is_beyond, lower_or_opposite
from iblf_jax.core.pytree import Leaf, component, is_absent, leaf, static
from iblf_jax.core.units import INPUT
from iblf_jax.world import plants
from iblf_jax.world.robots import Robot
from iblf_jax.world.robots._base import has_mass_matrix

EDGES = ("hard", "smooth")
SHARPNESS = 8
"""Even exponent of the smooth limit, which reduces a torque of half the limit by 0.05 %, and one of
the limit by 8 %."""


class AuxiliaryState(NamedTuple):
    """State of a `Saturated` with an auxiliary state."""

    law: State
    """State of the wrapped law."""
    auxiliary: jax.Array
    """lambda, (n,)."""


@component
class Saturated(Wrapping):
    """tau = clip(tau_law, lower_limit, limit).

    The smooth limit, for gradients, is c + h x/(1 + |x|^8)^(1/8) with x = (tau_law - c)/h, the
    centre c of both limits and half their distance h.

    With `auxiliary` the law has the auxiliary state lambda,

        lambda' = -auxiliary lambda + G_r (sat(u) - u),   lambda(0) = 0,                      (A.1)

    G_r = M0^-1 for a robot, and follows alpha + lambda in the place of alpha, so that e2 is
    q' - alpha - lambda.  Paths reach through: "controller.K2" is the wrapped law's K2.

    Args:
      law: the law whose torque is limited, any law.
      limit: largest torque of each joint, () or (n,) [N m], > 0.
      edge: "hard" or "smooth"; "hard" if not given.
      auxiliary: rate k of the auxiliary state, () or (n,) [1/s], > 0; no auxiliary state if not
        given.  A sampled law needs one below 2 divided by its period.
      lower_limit: smallest torque of each joint, () or (n,) [N m], below the limit, such as 0 for
        a pump; -limit if not given.

    Source: the limit is a common construction; the auxiliary state as in M. Chen, S. S. Ge, B. Ren,
      Automatica 47 (2011) 452-465, with a linear filter; (A.1)-(A.4) as derived at the head of this
      module.
    """

    law: TrackingLaw
    limit: Leaf = leaf(INPUT, sign="positive")
    edge: str = static(default="hard")
    auxiliary: Leaf = leaf("1/s", sign="positive", default=None)
    lower_limit: Leaf = leaf(INPUT, default=None)

    def check(self) -> None:
        """Raises ValueError for something that is not a law, an unknown edge, or a lower limit that
        is not below the limit.
        """
        check_law("Saturated.law", self.law, "iblf_jax.controllers has them.")
        checks.one_of("Saturated.edge", self.edge, EDGES)
        check_lower_limit("Saturated", self.lower_limit, self.limit)

    @property
    def has_auxiliary(self) -> bool:
        """Whether there is an auxiliary state."""
        return self.auxiliary is not None

    @property
    def unlimited(self) -> TrackingLaw:
        """The wrapped law without limits; with the auxiliary state, if there is one."""
        law = self.law.unlimited
        if self.auxiliary is None:
            return law
        beyond = jnp.full_like(self.limit, jnp.inf)
        return dataclasses.replace(self, law=law, limit=beyond, lower_limit=None, edge="hard")

    def init(self, x: jax.Array, context: LawContext) -> State:
        """State of the wrapped law, and lambda(0) = 0."""
        state = self.inner.init(x, context)
        if self.auxiliary is None:
            return state
        return AuxiliaryState(state, jnp.zeros_like(x[-1]))

    def command(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> tuple[Command, State]:
        """The wrapped law's command with its torque limited; `saturated` says where it commanded
        more than the limit.
        """
        if self.auxiliary is None:
            command, rate = self.inner.command(t, x, d_hat, context, state)
            return self._limited(command), rate
        model, shift = plants.as_plant(context.model), self.shift(state)
        if self.law.takes_shift:
            shifted = context._replace(shift=shift)
            command, rate = self.inner.command(t, x, d_hat, shifted, state.law)
        else:
            # The command of (A.4), for a law that does not take the shift.
            y = _at_shifted_state(x, shift.value)
            command, rate = self.inner.command(t, y, d_hat, context, state.law)
            without_limit = plants.level_rate(model, model.order, t, y, command.tau)
            tau = plants.level_input(model, model.order, t, x, without_limit + shift.rate)
            command = _with_shifted_control(command._replace(tau=tau), model.order, shift.value)
        limited = self._limited(command)
        effect = plants.gain_times(model, model.order, t, x, limited.tau - command.tau)
        auxiliary_rate = AuxiliaryState(rate, shift.rate + effect)
        return limited._replace(auxiliary=state.auxiliary), auxiliary_rate

    def _limited(self, command: Command) -> Command:
        """A command with its torque limited."""
        lower = lower_or_opposite(self.lower_limit, self.limit)
        beyond = is_beyond(command.tau, self.lower_limit, self.limit)
        saturated = command.saturated | beyond
        if self.edge == "hard":
            tau = jnp.clip(command.tau, lower, self.limit)
        elif self.lower_limit is None:
            tau = self.limit * _smooth_clip(command.tau / self.limit)
        else:
            centre, half = (self.limit + lower) / 2.0, (self.limit - lower) / 2.0
            tau = centre + half * _smooth_clip((command.tau - centre) / half)
        return command._replace(tau=tau, saturated=saturated)

    def shift(self, state: AuxiliaryState) -> Shift:
        """The shift of the virtual control: lambda and -k lambda."""
        return Shift(state.auxiliary, -self.auxiliary * state.auxiliary)

    def switching(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """The wrapped law's switching functions, at which its command jumps."""
        if self.auxiliary is None:
            return self.inner.switching(t, x, d_hat, context, state)
        shift = self.shift(state)
        if self.law.takes_shift:
            shifted = context._replace(shift=shift)
            return self.inner.switching(t, x, d_hat, shifted, state.law)
        y = _at_shifted_state(x, shift.value)
        return self.inner.switching(t, y, d_hat, context, state.law)


def _at_shifted_state(x: jax.Array, value: jax.Array) -> jax.Array:
    """The state with x_r - lambda in the place of x_r."""
    return jnp.concatenate([x[:-1], (x[-1] - value)[None]])


def _with_shifted_control(command: Command, order: int, value: jax.Array) -> Command:
    """A command with lambda added to its virtual control of the last level, if it has one."""
    if order == 2:
        return command._replace(alpha=command.alpha + value)
    rows = command.alpha_higher
    if is_absent(rows):
        return command
    last = (rows[-1] + value)[None]
    return command._replace(alpha_higher=jnp.concatenate([rows[:-1], last]))


UNLIMITED = 1e6
"""Limit of a joint without a limit of its own, where other joints have one: beyond any actuator
[N m]."""


def within_effort(law: TrackingLaw, robot: Robot, *, edge: str = "hard") -> TrackingLaw:
    """A law within the largest torques of a robot: `Saturated` at its `effort`.

    Args:
      law: any.
      robot: such as `iblf_jax.robots.Arm`; the law is returned as it is if the robot has no
        `effort`, or an infinite one on every joint.
      edge: as `Saturated.edge`.

    Raises:
      ValueError: as `Saturated`.
    """
    effort = robot.effort if has_mass_matrix(robot) else None
    if effort is None or (checks.is_concrete(effort) and not np.isfinite(effort).any()):
        return law
    limit = jnp.where(jnp.isfinite(effort), effort, UNLIMITED)
    return Saturated(law=law, limit=limit, edge=edge)


def _smooth_clip(x: jax.Array) -> jax.Array:
    """The smooth limit x / (1 + x^8)^(1/8) in a form that does not overflow.  The scale m cancels,
    also in derivatives.
    """
    m = jax.lax.stop_gradient(jnp.maximum(jnp.abs(x), 1.0))
    return (x / m) / ((1.0 / m) ** SHARPNESS + (x / m) ** SHARPNESS) ** (1.0 / SHARPNESS)
