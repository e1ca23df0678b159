"""A barrier on a surface: prescribed performance without a model, by a law of each joint alone.

The error's surface sigma = e1' + a e1 is the velocity error e2 = q' - alpha of the virtual velocity
alpha = q_d' - a e1, and the law keeps it between bounds of its own, rho_l(t) < sigma < rho_u(t).
While it is there,

    e1(t) = exp(-a t) e1(0) + int_0^t exp(-a (t - s)) sigma(s) ds,

so a funnel on sigma that shrinks to rho_inf by exp(-l t), l < a, makes e1 shrink into rho_inf / a
by exp(-l t).  For `PrescribedPerformance` in a symmetric funnel rho, T(x) = ln((1 + x)/(1 - x)) and
xi = sigma/rho, the slope is s = T(xi) T'(xi)/(4 rho).
"""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers import Barrier, PrescribedPerformance
from iblf_jax.control.barriers._base import guard_is_active
from iblf_jax.control.controllers._base import Command, LawContext, RobotLaw
from iblf_jax.control.controllers.backstepping import check_barrier
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.bounds import Bounds, Tube


@component
class SurfaceBarrier(RobotLaw):
    """tau = -K s(sigma),   sigma = e1' + a e1,   s = dV1/dsigma of a barrier between the surface's
    own bounds.

    It knows neither model nor observer.  The scenario's bounds are kept as far as the surface's
    imply them (head of this module): it claims nothing about them.  alpha is q_d' - a e1, so e2 is
      sigma, and V1 is the barrier's.

    Args:
      a: rate of the surface, () or (n,) [1/s], > 0.
      K: gain, () or (n,) [N m rad/s], > 0 (N m s/rad for a barrier whose V1 is in rad^2/s^2).  It
        is the weight of the barrier too, so there is no other.
      surface: bounds of sigma [rad/s]; its reference is 0, so a `Funnel` on either side shrinks
        onto 0.  Where a run starts outside, the barrier's guard is at work, `Status.GUARD_ACTIVE`.
      barrier: on sigma, any `Barrier`; `PrescribedPerformance()` if not given.

    Source: C. P. Bechlioulis, A. Theodorakopoulos, G. A. Rovithakis, 52nd IEEE CDC (2013); with the
    slope in it, I. Dimanidis, diploma thesis, Aristotle University of Thessaloniki (2018), chapter
    5; other barriers and asymmetric bounds as derived here.
    """

    a: Leaf = leaf("1/s", sign="positive")
    K: Leaf = leaf("N m rad/s", sign="positive")
    surface: Bounds
    barrier: Barrier = PrescribedPerformance()
    gains: ClassVar[tuple[str, ...]] = ("K",)
    uses_observer: ClassVar[bool] = False
    includes_e2: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError for something that is no barrier, or no bounds."""
        check_barrier(self, "barrier", self.barrier, "PrescribedPerformance")
        if not isinstance(self.surface, Bounds):
            raise checks.fail(
                "SurfaceBarrier.surface",
                self.surface,
                "an iblf_jax.bounds.Bounds",
                "Such as Bounds(lower=..., upper=...).",
            )

    def check_start(self, context: LawContext) -> None:
        """Raises ValueError for bounds of the surface that do not have 0 between them at t = 0."""
        zero = jnp.zeros(context.model.n, self.a.dtype)
        lower, upper = (side.at(zero[0], zero) for side in (self.surface.lower, self.surface.upper))
        if not (jnp.all(lower < 0) and jnp.all(upper > 0)):
            raise checks.fail(
                "SurfaceBarrier.surface",
                (lower, upper),
                "lower < 0 < upper at t = 0",
                "Exchange or widen them.",
            )

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: LawContext,
        state: tuple[()],
    ) -> tuple[Command, tuple[()]]:
        """The torque and what belongs to it."""
        outer, zero = context.tube(t), jnp.zeros_like(q)
        alpha = outer.dq_d - self.a * (q - outer.q_d)
        sigma = dq - alpha
        # A slope needs no rates of the bounds.
        tube = Tube(
            zero, zero, self.surface.lower.at(t, zero), self.surface.upper.at(t, zero), zero, zero
        )
        guard_active = guard_is_active(tube, sigma, self.barrier.guard)
        V1 = self.barrier.value(tube, sigma)
        tau = -self.K * self.barrier.slope(tube, sigma)
        return Command(tau, alpha, V1, guard_active, jnp.zeros_like(guard_active)), ()
