"""Bounds on positions and on velocities by barriers: one on e1, one more on e2.

With alpha and alpha' of the first barrier the velocities' bounds v_l(t) < q' < v_u(t) are bounds of
e2 = q' - alpha,

    -K_l < e2 < K_u,   K_u = v_u - alpha,   K_l = alpha - v_l,

which both must be positive: alpha inside the velocities' bounds is to e2 what Assumption 2 is to
e1.  So e2 has a tube like e1's, with alpha in the place of the reference, and any barrier of the
family, phi with its slope s2 = dphi/de2 and the "virtual velocity" a2 of that tube, keeps it:

    q" = a2 - s1 e2/s2 - c s2 + M0^-1 f_tilde,   s2 (a2 - alpha') + dphi/dt <= -(its decay),   (F.1)
    (V1 + phi)' <= -(decay of V1) - (decay of phi) + s2 . M0^-1 f_tilde - c |s2|^2,            (F.2)

as s1 e2/s2 . s2 cancels the cross term s1 . e2 of V1' exactly.  For the integral barrier
a2 = alpha' - (K2 + kappa2) e2 and e2/s2 = (K^2 - e2^2)/2.  With f_tilde in
V2 = V1 + phi + 1/2 |f_tilde|^2, s2 . M0^-1 f_tilde <= c |s2|^2 + |f_tilde|^2/(4 c lambda^2) and
lambda = lambda_min(M0), the loop with a momentum observer obeys

    V2' <= -rho V2 (+ 1/2 |f'|^2),                                                             (F.3)
    rho = min(decay rate of V1, that of phi, 2 (kf (- 1/2) - 1/(4 c lambda^2)));

terms in brackets apply for f' != 0 (case 2).

A weight w_i > 0 of each joint scales the first barrier, V1 = sum_i w_i V1_i: then w_i s1 replaces
s1 in (F.1), the cross term cancels as before, and all claims hold with this V1.

The gains k1 and K2 may depend on the time and on V1 or phi (`decays`): the decays in (F.2) then are
those of the gains of the instant.  These are at no time below k1 and K2, so that (F.3) holds as
well.

The integral and the logarithmic barrier have another e2/s2 on either side of e2 = 0 where K_u and
K_l differ: there the torque jumps by M0 s1 (K_u^2 - K_l^2)/2, which the exact cancellation
requires.  `Tan`, `State`, `Mapping` and `PrescribedPerformance` have no jump.

**Derivatives across the jump.**  In a continuous loop the derivative of a step that reaches e2_i =
0 is that of the hybrid flow, with the jump of a perturbation at the crossing (`engine.switching`,
J.1), in every executor and in forward and reverse mode; that of a metric of the torque contains the
jump of its integrand.  Limits:

- Where the torques of both sides drive e2_i towards 0, it slides along 0.  Derivatives of the state
  are then those of the sliding motion, of first order in dt; those of a metric of the torque leave
  out how the torque alternates.  Where e2_i touches 0 without crossing it, no derivative exists.
- A sampled loop holds its torque, so that its derivative needs no such term.  But its metrics, as
  functions of a gain, jump whenever a crossing moves from one sample to the next, and no derivative
  contains that.
- Second derivatives leave out the kink of the barrier's slope at e1 = 0, as those of every law with
  asymmetric bounds do.
- A fixed step across the jump is of first order; `numerical_error` contains that error.
- Other solvers that take `VectorField` step across the jump in their own way: derivatives through
  them leave the term out.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers import Barrier, Integral
from iblf_jax.control.barriers._base import (
    guard_is_active,
    has_ratio,
)
from iblf_jax.control.controllers._base import Command, LawContext, RobotLaw, decay_of, no_state
from iblf_jax.control.controllers._levels import Design, exact_levels
from iblf_jax.control.controllers.backstepping import (
    alpha_and_rate,
    check_barrier,
    fit_decays,
    fit_o,
    fit_weight,
    virtual_velocity,
)
from iblf_jax.control.decays import Decay
from iblf_jax.core import checks
from iblf_jax.core.linalg import solve_spd
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.bounds import Tube

WEIGHT_UNITS = {
    ("1", "1"): "1",
    ("rad^2", "1"): "1/rad^2",
    ("1", "rad^2"): "rad^2/s^2",
    ("rad^2", "rad^2"): "1/s^2",
}
"""Units of V1 and of phi's barrier on positions -> unit of the weight, with which w V1 has the unit
of phi."""


@component
class FullState(RobotLaw):
    """tau = C0 q' + G0 + M0 (a2 - w s1 e2/s2 - c s2) - f_hat,   a2 = alpha' - (K2 + kappa2) e2 for
    the integral barrier.

    It keeps the scenario's `bounds[1]` too, as long as alpha is inside them (`alpha_margin` >
    0); symbols at the head of this module.  Its V1 is that of e1 and that of e2.  Symmetric
    constant bounds with p = 1 logarithms on both are the barriers of the source.

    With `Integral` or `Log` as `velocity_barrier` the torque jumps at e2 = 0 where K_u and K_l
    differ.  First derivatives of a run contain that jump (head of this module, with the limits).
    Hessians leave out the kink of the barrier's slope at e1 = 0.  `Mapping`, `Tan`, `State` and
    `PrescribedPerformance` have no jump.

    Args:
      k1: gain of the virtual velocity, () or (n,) [1/s], > 0.
      K2: gain of the velocity error, () or (n,) [1/s], > 0; an acceleration's, not a torque's as
        `Backstepping.K2`.
      c: gain of the slope s2, which limits the effect of the estimation error f_tilde, () or (n,)
        [rad^2/s^3] (1/s where phi is in rad^2/s^2), > 0; the claim of case 2 asks for c > 1/(4 (kf
        - 1/2) lambda_min(M0)^2).
      o: margin under the roots of both kappas, () or (n,) [1/s^2], > 0, for barriers that have them
        and for no others; 0.1 for these, if not given.
      barrier: on e1, any `Barrier`; `Integral()` if not given.
      velocity_barrier: on e2, any `Barrier` whose slope falls with e2 itself (not `Log` with p >
        1); `Integral()` if not given.
      weight: w of the V1 of e1, () or (n,) [1], > 0; 1 if not given.  Where V1 is in rad^2 its unit
        has 1/rad^2 besides, where phi is in rad^2/s^2 it has rad^2/s^2.
      decays: a `Decay` of V1 and one of phi; one alone is that of both; exponential in k1 and K2 if
        not given.

    Source: W. He, Y. Chen, Z. Yin, IEEE Trans. Cybernetics 46 (2016) 620-629 (symmetric, constant,
    logarithms); asymmetric, time-varying and for any barrier as derived at the head of this module.
    """

    k1: Leaf = leaf("1/s", sign="positive")
    K2: Leaf = leaf("1/s", sign="positive")
    c: Leaf = leaf("rad^2/s^3", sign="positive")
    o: Leaf = leaf("1/s^2", sign="positive", default=None)
    barrier: Barrier = Integral()
    velocity_barrier: Barrier = Integral()
    weight: Leaf = leaf("1", sign="positive", default=None)
    decays: tuple[Decay, ...] = ()
    unit_factors: ClassVar[tuple[str, ...]] = ("weight",)
    needs_velocity_bounds: ClassVar[bool] = True
    includes_e2: ClassVar[bool] = True
    takes_shift: ClassVar[bool] = True
    init = no_state

    def check(self) -> None:
        """Raises ValueError for something that is no barrier, or one that cannot bound velocities;
        completes `o` and `weight`.
        """
        barriers = {"barrier": self.barrier, "velocity_barrier": self.velocity_barrier}
        for name, barrier in barriers.items():
            check_barrier(self, name, barrier)
        if not has_ratio(self.velocity_barrier):
            remedy = (
                "iblf_jax.barriers.Integral() and Log() with p = 1 are such; one of your own needs"
                " `error_over_slope`."
            )
            expected = "one whose slope falls with the error itself"
            field = "FullState.velocity_barrier"
            raise checks.fail(field, self.velocity_barrier, expected, remedy)
        fit_o(self, *barriers.values())
        fit_weight(self)
        fit_decays(self, 2)

    def leaf_units(self) -> dict[str, str]:
        """The unit of the weight, by those of V1 and phi."""
        return {"weight": WEIGHT_UNITS[self.barrier.value_unit, self.velocity_barrier.value_unit]}

    def symbols_of_part(self, field: str, index: int, symbols: Any) -> Any:
        """The units of the symbols in a part of the law: that of z = sqrt(2V) in a decay."""
        if field != "decays":
            return symbols
        barrier, unit = ((self.barrier, "rad"), (self.velocity_barrier, "rad/s"))[index]
        return {**symbols, "z": unit if barrier.value_unit == "rad^2" else "1"}

    def tubes(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext
    ) -> tuple[Tube, Tube]:
        """The tube of q around the reference, and that of q' around alpha; in the latter
        "positions" are velocities.
        """
        alpha, dalpha = alpha_and_rate(self, t, q, dq, context)
        (lower, upper), (dlower, dupper) = jax.jvp(context.speed_limits, (t,), (jnp.ones_like(t),))
        lower, dlower = context.shifted(lower, dlower)
        upper, dupper = context.shifted(upper, dupper)
        return context.tube(t), Tube(alpha, dalpha, lower, upper, dlower, dupper)

    def switching(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext, state: tuple[()]
    ) -> jax.Array | None:
        """e2 = q' - alpha, (n,) [rad/s], where the torque jumps at e2 = 0; None for a velocity
        barrier without a jump.
        """
        if not self.velocity_barrier.ratio_jumps:
            return None
        alpha = virtual_velocity(self, t, q, context)
        return dq - context.shifted(alpha, jnp.zeros_like(alpha))[0]

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: LawContext,
        state: tuple[()],
    ) -> tuple[Command, tuple[()]]:
        """The torque and what belongs to it; V1 is V1 + phi."""
        first, second = self.barrier, self.velocity_barrier
        designs = [
            Design(first, self.k1, self.o, None, self.weight, decay_of(self, 0)),
            Design(second, self.K2, self.o, self.c, None, decay_of(self, 1)),
        ]
        levels, tubes = exact_levels(designs, t, jnp.stack([q, dq]), f_hat, context)
        outer, inner = tubes
        guard_active = guard_is_active(outer, q, first.guard) | guard_is_active(
            inner, dq, second.guard
        )
        value = self.weight * first.value(outer, q) + second.value(inner, dq)
        saturated = jnp.zeros_like(guard_active)
        command = Command(levels[1].alpha, inner.q_d, value, guard_active, saturated)
        slope = solve_spd(context.model.mass_matrix(q), levels[1].slope)
        return command._replace(input_slope=slope), ()
