"""An explicit reference governor: it gives a law without bounds an auxiliary reference that stops
near a bound.

With a reference g at rest, PD with gravity compensation and computed torque have a Lyapunov
function that never grows,

    V = 1/2 q'^T M0 q' + 1/2 (q - g)^T Kp (q - g)      (PD; computed torque has 1 in place of M0),

and V <= Gamma(g) = 1/2 min_i Kp_i d_i(g)^2 means |q_i - g_i| <= d_i, the distance of g_i to its
nearer bound, less a margin.  So g may move towards the reference q_d as long as V is below Gamma,

    g' = eta max(Gamma - V, 0) (attraction + repulsion)
    attraction = (q_d - g)/max(|q_d - g|, width)
    repulsion_i = max(1 - d_li/width, 0) - max(1 - d_ui/width, 0)
    d_l = g - k_lc - margin,   d_u = k_uc - margin - g,

and stops otherwise.  V <= Gamma then stays true, and every bound is kept, for constant bounds, an
exact model and f_hat = f.  The margin is for time-varying bounds, disturbances and sampling, for
which no claim holds.  The joints lag behind a reference that moves.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.controllers._base import Command, LawContext, RobotLaw
from iblf_jax.control.controllers.computed_torque import ComputedTorque
from iblf_jax.control.controllers.pd_gravity import PDGravity
from iblf_jax.core import checks
from iblf_jax.core.linalg import inner
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import momentum


class GovernorState(NamedTuple):
    """State of `ReferenceGovernor`."""

    g: jax.Array
    """The reference that the law is given, (n,) [rad]."""
    law: Any
    """State of the law."""


@component
class _AtRest(Reference):
    """A constant reference.

    Args:
      g: the position, () or (n,) [rad].

    Source: none.
    """

    g: Leaf = leaf("rad")

    def position(self, t: jax.Array) -> jax.Array:
        """g, (n,) [rad]."""
        return self.g


@component
class ReferenceGovernor(RobotLaw):
    """The law's torque for a reference g at rest,  g' = eta max(Gamma(g) - V, 0) (attraction +
    repulsion).

    Symbols and claim at the head of this module.  Paths reach through: "controller.Kp" is the
    wrapped law's Kp.

    Args:
      law: the governed law, `PDGravity` or `ComputedTorque`.
      eta: gain of the rate of g, () or (n,) [rad/(N m s)] (1/(rad s) around computed torque), > 0;
        50 if not given.
      margin: distance that is kept from the bounds, () or (n,) [rad], >= 0; 0.02 if not given.
      width: distance at which bounds repel g and over which the attraction ends, () or (n,) [rad],
        > 0; 0.02 if not given.

    Source: M. M. Nicotra, E. Garone, IEEE Control Systems Magazine 38 (2018) 89-107; E. Gilbert, I.
      Kolmanovsky, Automatica 38 (2002)
    2063-2073.
    """

    law: RobotLaw
    eta: Leaf = leaf("rad/(N m s)", sign="positive", default=50.0)
    margin: Leaf = leaf("rad", sign="nonnegative", default=0.02)
    width: Leaf = leaf("rad", sign="positive", default=0.02)
    wraps: ClassVar[str] = "law"

    def check(self) -> None:
        """Raises ValueError for a law that has no such Lyapunov function."""
        if not isinstance(self.law, PDGravity | ComputedTorque):
            remedy = "Such as PDGravity(Kp=60.0, Kd=20.0)."
            raise checks.fail(
                "ReferenceGovernor.law",
                type(self.law).__name__,
                "a PDGravity or a ComputedTorque",
                remedy,
            )

    def init(self, q: jax.Array, dq: jax.Array, context: LawContext) -> GovernorState:
        """g(0) = q(0), moved inside the margin where it is not."""
        low, high = self._allowed_range(jnp.zeros((), q.dtype), context)
        return GovernorState(jnp.minimum(jnp.maximum(q, low), high), self.law.init(q, dq, context))

    def _allowed_range(self, t: jax.Array, context: LawContext) -> tuple[jax.Array, jax.Array]:
        """The bounds less the margin, (n,) each [rad]."""
        tube = context.tube(t, acceleration=False)
        return tube.lower + self.margin, tube.upper - self.margin

    def energy(  # type: ignore[override]
        self, q: jax.Array, dq: jax.Array, g: jax.Array, context: LawContext
    ) -> jax.Array:
        """V, () [N m for PD, rad^2/s^2 for computed torque]."""
        law: Any = self.law
        weighted = dq
        if isinstance(law, PDGravity):
            weighted = momentum(context.model, q, dq)
        return 0.5 * (inner(dq, weighted) + jnp.sum(law.Kp * (q - g) ** 2))

    def level(self, t: jax.Array, g: jax.Array, context: LawContext) -> jax.Array:
        """Gamma, () in the unit of V; 0 for a g outside."""
        law: Any = self.law
        low, high = self._allowed_range(t, context)
        return 0.5 * jnp.min(law.Kp * jnp.maximum(jnp.minimum(g - low, high - g), 0.0) ** 2)

    def switching(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext, state: GovernorState
    ) -> jax.Array | None:
        """Where the wrapped law's command jumps."""
        governed = context._replace(reference=_AtRest(state.g))
        return self.law.switching(t, q, dq, governed, state.law)

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: LawContext,
        state: GovernorState,
    ) -> tuple[Command, GovernorState]:
        """The law's command for the reference g, and the rates of g and of the law's state."""
        g, (low, high) = state.g, self._allowed_range(t, context)
        command, rate = self.law.command(
            t, q, dq, f_hat, context._replace(reference=_AtRest(g)), state.law
        )
        away = context.reference.position(t) - g
        # The square root has no slope at 0, where the attraction is away/width.
        square, near = inner(away, away), jnp.min(self.width) ** 2
        attraction = away / jnp.sqrt(jnp.maximum(square, near))
        repulsion = jnp.maximum(1.0 - (g - low) / self.width, 0.0) - jnp.maximum(
            1.0 - (high - g) / self.width, 0.0
        )
        free = jnp.maximum(self.level(t, g, context) - self.energy(q, dq, g, context), 0.0)
        return command, GovernorState(self.eta * free * (attraction + repulsion), rate)
