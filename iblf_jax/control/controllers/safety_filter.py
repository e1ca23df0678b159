"""A safety filter around any law: the torque nearest to the law's that keeps bounds, by control
barrier functions.

The bounds are h_u = k_uc - q >= 0 and h_l = q - k_lc >= 0, of relative degree 2.  With a1, a2 > 0
the conditions (d/dt + a1)(d/dt + a2) h >= 0 are a box of accelerations,

    q" <= k_uc" + (a1 + a2)(k_uc' - q') + a1 a2 (k_uc - q),
    q" >= k_lc" + (a1 + a2)(k_lc' - q') + a1 a2 (k_lc - q),

and bounds on the velocities, of relative degree 1, are another:
v_l' + a3 (v_l - q') <= q" <= v_u' + a3 (v_u - q').  Regions for the tip or a joint's origin
(`Scenario.regions`) are of relative degree 2 in their level h(q), with b1, b2 > 0 (`regions.along`
has dh/dq and c):

    h" + (b1 + b2) h' + b1 b2 h >= 0,    h' = dh/dq q',    h" = dh/dq q" + c.

The conditions on positions may have other shapes, and a margin eta: with z = h' + a1 A(h),
z' + a2 B(z) >= eta, A(h) = h or atan h, B(z) = z or z^3.  An arc tangent bounds the speed towards a
bound by pi a1/2 wherever the joint is; a cube is softer the nearer z is to 0.

The model and the observer's estimate turn accelerations into torques,
tau = M0 q" + C0 q' + G0 - f_hat.  A run that starts with h >= 0 and z >= 0 stays there as long as
the conditions have a common torque and f_hat = f.

Where they have none (because of the torque limits, or because two bounds conflict), the torque
violates them by the least slack.  The slack is the sum of squares of the violations, in torque or
in acceleration as `nearest` says; the command holds it, runs record it, and it sets
`Status.FILTER_INFEASIBLE`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.controllers._base import (
    Command,
    LawContext,
    State,
    TrackingLaw,
    Wrapping,
    check_law,
)
from iblf_jax.core import checks
from iblf_jax.core.linalg import matmul, matvec, solve_spd
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.qp import Solution, quadratic_program
from iblf_jax.world import plants
from iblf_jax.world.bounds import bounds_at

NEAREST = ("torque", "acceleration")
SHAPES1 = ("linear", "atan")
SHAPES2 = ("linear", "cubic")


@component
class SafetyFilter(Wrapping):
    """The torque nearest to the law's that meets the conditions on q" (head of this module) and
    |tau| <= limit.

    Nearest in torque, |tau - tau_law|, or in acceleration, |M0^-1 (tau - tau_law)|; the latter
    without limit and regions is a clip, else it is a quadratic programme (`core.qp`).  Where the
    law's own torque meets all conditions it is passed on as it is.  Paths reach through:
    "controller.K2" is the wrapped law's K2.

    Args:
      law: the law whose torque is filtered, any law.
      a1: first rate of the position's conditions, () or (n,) [1/s] ([rad/s] for "atan"), > 0; 10 if
        not given.
      a2: second rate of these, () or (n,) [1/s] ([s/rad^2] for "cubic"), > 0; 10 if not given.
      a3: rate of the velocity's conditions, where velocities have bounds, () or (n,) [1/s], > 0; 20
        if not given.
      b1: first rate of the regions' conditions, where the scenario has `regions`, () [1/s], > 0; 10
        if not given.
      b2: second rate of these, () [1/s], > 0; 10 if not given.
      limit: largest torque of each joint, () or (n,) [N m], > 0; none if not given.
      nearest: "torque" or "acceleration"; "torque" if not given.
      shape1: A of the position's conditions, "linear" or "atan"; "linear" if not given.
      shape2: B of these, "linear" or "cubic"; "linear" if not given.
      margin: eta of these, () or (n,) [rad/s^2], >= 0; none if not given.

    Source: A. D. Ames, X. Xu, J. W. Grizzle, P. Tabuada, IEEE Trans. Automatic Control 62 (2017)
      3861-3876; relative degree 2 as Q. Nguyen,
    K. Sreenath, American Control Conference 2016, 322-328; shapes and margin as W. Shaw Cortez, D.
    V. Dimarogonas, Automatica 2022, 110620.
    """

    law: TrackingLaw
    a1: Leaf = leaf("1/s", sign="positive", default=10.0)
    a2: Leaf = leaf("1/s", sign="positive", default=10.0)
    a3: Leaf = leaf("1/s", sign="positive", default=20.0)
    b1: Leaf = leaf("1/s", sign="positive", shape="scalar", default=10.0)
    b2: Leaf = leaf("1/s", sign="positive", shape="scalar", default=10.0)
    limit: Leaf = leaf("N m", sign="positive", default=None)
    nearest: str = static(default="torque")
    shape1: str = static(default="linear")
    shape2: str = static(default="linear")
    margin: Leaf = leaf("rad/s^2", sign="nonnegative", default=None)
    has_slack: ClassVar[bool] = True
    needs_robot: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError for something that is not a law, or an unknown measure."""
        check_law("SafetyFilter.law", self.law, "iblf_jax.controllers has them.")
        checks.one_of("SafetyFilter.nearest", self.nearest, NEAREST)
        checks.one_of("SafetyFilter.shape1", self.shape1, SHAPES1)
        checks.one_of("SafetyFilter.shape2", self.shape2, SHAPES2)

    @property
    def unlimited(self) -> SafetyFilter:
        """The filter without a limit of the torque, around the wrapped law without limits."""
        return dataclasses.replace(self, law=self.law.unlimited, limit=None)

    def box(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext
    ) -> tuple[jax.Array, jax.Array]:
        """The accelerations that the conditions allow, lowest and highest, (n,) each [rad/s^2]."""

        def sides(t):
            return bounds_at(context.bounds[0], t, context.reference.position(t))

        def rates(t):
            return jax.jvp(sides, (t,), (jnp.ones_like(t),))[1]

        first, second = jax.jvp(rates, (t,), (jnp.ones_like(t),))
        lowest, highest = (
            ddside + self._room(side - q, dside - dq)
            for side, dside, ddside in zip(sides(t), first, second, strict=True)
        )
        if self.margin is not None:
            lowest, highest = lowest + self.margin, highest - self.margin
        if context.bounds[1] is not None:
            (slow, fast), (dslow, dfast) = jax.jvp(context.speed_limits, (t,), (jnp.ones_like(t),))
            lowest = jnp.maximum(lowest, dslow + self.a3 * (slow - dq))
            highest = jnp.minimum(highest, dfast + self.a3 * (fast - dq))
        return lowest, highest

    def _room(self, h: jax.Array, dh: jax.Array) -> jax.Array:
        """How much faster than its bound a joint may accelerate towards it, (n,) [rad/s^2]; odd in
        (h, h'), so for either side.
        """
        if self.shape1 == self.shape2 == "linear":
            return (self.a1 + self.a2) * dh + self.a1 * self.a2 * h
        A = h
        dA: jax.Array | float = 1.0
        if self.shape1 == "atan":
            A, dA = jnp.arctan(h), 1.0 / (1.0 + h * h)
        z = dh + self.a1 * A
        carried = self.a1 * dA * dh
        B = z if self.shape2 == "linear" else z**3
        return carried + self.a2 * B

    def command(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> tuple[Command, State]:
        """The wrapped law's command with its torque filtered, and the slack."""
        q, dq = x[0], x[1]
        command, rate = self.inner.command(t, x, d_hat, context, state)
        model, tau_law = context.model, command.tau
        f_hat = plants.as_plant(model).as_uncertain(x, d_hat)
        M = model.mass_matrix(q)
        nominal = solve_spd(M, tau_law + f_hat - model.coriolis(q, dq, dq) - model.gravity(q))
        lowest, highest = self.box(t, q, dq, context)
        if self.nearest == "acceleration" and self.limit is None and not context.regions:
            # An empty box is violated equally on both sides.
            slack = jnp.maximum(0.5 * (lowest - highest), 0.0)
            admitted = jnp.clip(nominal, lowest - slack, highest + slack)
            tau = tau_law + matvec(M, admitted - nominal)
            return command._replace(tau=tau, slack=slack), rate
        unit = jnp.eye(context.model.n, dtype=tau_law.dtype)
        # The unknown is the change of the torque or of the acceleration; the columns of these two
        # matrices are its effects on both.
        torque, acceleration = M, unit
        if self.nearest == "torque":
            torque, acceleration = unit, jnp.stack([solve_spd(M, row) for row in unit])
        conditions = [
            Condition(acceleration, highest - nominal, is_soft=True),
            Condition(-acceleration, nominal - lowest, is_soft=True),
        ]
        if context.regions:
            levels = context.regions_along(q, dq)
            room = (
                matvec(levels.slope, nominal)
                + levels.bend
                + (self.b1 + self.b2) * levels.rate
                + self.b1 * self.b2 * levels.level
            )
            conditions.append(Condition(-matmul(levels.slope, acceleration), room, is_soft=True))
        saturated = command.saturated
        if self.limit is not None:
            conditions += [
                Condition(torque, self.limit - tau_law, is_soft=False),
                Condition(-torque, self.limit + tau_law, is_soft=False),
            ]
            saturated = saturated | (jnp.abs(tau_law) > self.limit)
        found = _nearest(conditions)
        n, m = len(q), len(context.regions)
        above, below, of_regions, _ = jnp.split(found.slack, [n, 2 * n, 2 * n + m])
        slack = jnp.maximum(above, below)
        region_slack: Any = of_regions if context.regions else ()
        command = command._replace(tau=tau_law + matvec(torque, found.x), saturated=saturated)
        return command._replace(slack=slack, region_slack=region_slack), rate


class Condition(NamedTuple):
    """m conditions  rows x <= room  on the change x of the torque or of the acceleration."""

    rows: jax.Array
    """(m, n)."""
    room: jax.Array
    """(m,)."""
    is_soft: bool
    """Whether they may be violated, by a slack."""


def _nearest(conditions: list[Condition]) -> Solution:
    """The smallest x that meets all conditions; zero if none has a negative room."""
    room = jnp.concatenate([x.room for x in conditions])
    soft = jnp.concatenate([jnp.full_like(x.room, float(x.is_soft)) for x in conditions])
    G = jnp.concatenate([x.rows for x in conditions])
    found = quadratic_program(jnp.eye(G.shape[1], dtype=G.dtype), G, room, soft)
    free = jnp.all(room >= 0)
    return Solution(*(jnp.where(free, 0.0, x) for x in found))
