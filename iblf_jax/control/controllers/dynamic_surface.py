"""Backstepping that filters alpha instead of differentiating it (dynamic surface, command filter).

A filter of the first order smooths alpha, and the law follows the output beta of the filter,

    mu beta' + beta = alpha,   beta(0) = alpha(0),   e2 = q' - beta,
    tau = C0 beta + G0 + M0 beta' - f_hat - K2 e2 - w s,   beta' = (alpha - beta)/mu,

so that alpha' is never formed: neither the reference's acceleration nor the rates of the bounds'
rates are needed.  The price is the filter's lag, beta - alpha = -mu beta', which drives e1 as an
error of the velocity would: about mu |alpha'|/k1 is left of it.  For mu -> 0 it is the backstepping
law in its corrected variant.  The literature claims ultimate boundedness; Theorem 2 does not apply.

Two other forms of the filter (`filter_form`) keep the equation of beta and its start:

    derivative    e2 = q' - alpha,   tau = C0 alpha + G0 + M0 beta' - f_hat - K2 e2 - w s
    compensated   the barrier acts on y = q - xi,   alpha = a(y) - k1 xi,                    (S.7)
                  xi' = -k1 xi + beta - alpha,   xi(0) = 0

with a(y) the barrier's virtual velocity.  In the first the filter gives alpha' only, and beta' -
alpha' is the error that remains.  In the second y' = a(y) + e2, so that V1(y) + 1/2 e2^T M0 e2
decays as with the exact derivative, and the bounds are those of q - xi.
"""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers import Barrier, Integral
from iblf_jax.control.controllers._base import Command, LawContext, RobotLaw
from iblf_jax.control.controllers.backstepping import (
    barrier_command,
    check_barrier,
    fit_decays,
    fit_o,
    fit_weight,
    symbols_of_energy,
    virtual_velocity,
    weight_units,
    with_energy_decay,
)
from iblf_jax.control.controllers.barrier_backstepping import FORMS
from iblf_jax.control.decays import Decay
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.world.robots import inverse_dynamics


@component
class DynamicSurface(RobotLaw):
    """tau = C0 beta + G0 + M0 beta' - f_hat - K2 e2 - w s,   mu beta' + beta = alpha.

    With e2 = q' - beta.  The state is beta, (n,) [rad/s], with beta(0) = alpha(0); records show it
    as alpha.

    Args:
      k1: gain of the virtual velocity, () or (n,) [1/s], > 0.
      K2: diagonal of the velocity error's gain, () or (n,) [N m s/rad], > 0.
      filter: time constant mu of the filter, () or (n,) [s], > 0; a sampled law needs one longer
        than half its period.  It starts at beta(0) = alpha(0).
      o: as `Backstepping.o`, () or (n,) [1/s^2], > 0; 0.1 for a barrier that needs it, if not
        given.
      barrier: any `Barrier`; `Integral()` if not given.
      weight: w of the barrier's V1, () or (n,) [N m rad] ([N m/rad] for a barrier whose V1 is in
        rad^2), > 0; 1, the paper's, if not given.
      decays: as `Backstepping.decays`; exponential in k1 and K2 if not given.
      filter_form: "surface"; "derivative", with e2 = q' - alpha, which records show; or
        "compensated" (S.7), whose state is (beta, xi), (2, n) [rad/s, rad]; "surface" if not given.

    Source: D. Swaroop, J. K. Hedrick, P. P. Yip, J. C. Gerdes, IEEE Trans. Automatic Control 45
    (2000) 1893-1899; J. A. Farrell, M. Polycarpou, M. Sharma, W. Dong, IEEE Trans. Automatic
    Control 54 (2009) 1391-1395 ("compensated", there with a filter of the second order); with
    barriers as at the head of this module.
    """

    k1: Leaf = leaf("1/s", sign="positive")
    K2: Leaf = leaf("N m s/rad", sign="positive")
    filter: Leaf = leaf("s", sign="positive")
    o: Leaf = leaf("1/s^2", sign="positive", default=None)
    barrier: Barrier = Integral()
    weight: Leaf = leaf("N m rad", sign="positive", default=None)
    decays: tuple[Decay, ...] = ()
    filter_form: str = static(default="surface")
    factors: ClassVar[tuple[str, ...]] = ("weight",)
    takes_shift: ClassVar[bool] = True
    leaf_units = weight_units
    symbols_of_part = symbols_of_energy

    def check(self) -> None:
        """Raises ValueError for something that is no barrier, or an unknown form; completes `o` and
        `weight`.
        """
        checks.one_of("DynamicSurface.filter_form", self.filter_form, FORMS)
        check_barrier(self, "barrier", self.barrier)
        fit_o(self, self.barrier)
        fit_weight(self)
        fit_decays(self, 2)

    def init(self, q: jax.Array, dq: jax.Array, context: LawContext) -> jax.Array:
        """beta(0) = alpha(0), (n,) [rad/s]; with xi(0) = 0 below it of the compensated form."""
        beta = virtual_velocity(self, jnp.zeros((), q.dtype), q, context)
        if self.filter_form != "compensated":
            return beta
        return jnp.stack([beta, jnp.zeros_like(beta)])

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: LawContext,
        state: jax.Array,
    ) -> tuple[Command, jax.Array]:
        """The torque, what belongs to it, and the rate of the state."""
        tube, beta, position = context.tube(t), state, q
        if self.filter_form == "compensated":
            beta, xi = state
            position = q - xi
        alpha = virtual_velocity(self, t, position, context)
        if self.filter_form == "compensated":
            alpha = alpha - self.k1 * xi
        dbeta = (alpha - beta) / self.filter
        rates = dbeta
        if self.filter_form == "compensated":
            rates = jnp.stack([dbeta, beta - alpha - self.k1 * xi])
        followed = alpha if self.filter_form == "derivative" else beta
        centre, rate = context.shifted(followed, dbeta)
        feedforward = inverse_dynamics(context.model, q, dq, centre, rate)
        tau = feedforward - f_hat - self.K2 * (dq - centre)
        tau = tau - self.weight * self.barrier.slope(tube, position)
        tau = with_energy_decay(self, t, q, dq - centre, context, tau)
        command = barrier_command(self, tube, position, centre, tau)
        return command._replace(input_slope=dq - centre), rates
