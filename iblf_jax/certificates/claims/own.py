"""The claim of a law about itself (`controllers.LyapunovLaw`): a law may state a Lyapunov function
V, its decay W and the disturbance terms T, with V' <= -W + T.

T is what the law's `disturbance_terms` returns.  For a law without that method it is the
contribution of the uncertain term to V',

    T = dV/dx . d_tilde + dV/dd_tilde . d'                                      laws of levels
    T = dV/dq' . M0^-1 f_tilde + dV/df_tilde . f'                               laws of robots

where the second term is zero for a V without the error of the estimate: x' is that of the model
under an exact estimate, plus d_tilde, and d_tilde' = d' - d_hat'.  Where a law of a robot receives
estimates x_hat of levels (`observers.StateObserver`), T also has
dV/dq' . M0^-1 (tau(x_hat) - tau(x)), with the true error of the estimates: it says how much of V'
they explain, and bounds nothing in advance.  For a law that does not use the estimate, d takes the
place of d_tilde.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates.claims._base import Claim, check_steps, other_actuator
from iblf_jax.certificates.lines import Line, Role, Statement, not_applicable
from iblf_jax.certificates.summary import Segment, Summary
from iblf_jax.certificates.terms import Point, Terms, TorquePoint, receives_q_dq
from iblf_jax.control.controllers import Law, LyapunovLaw, RobotLaw, Saturated, TrackingLaw
from iblf_jax.control.controllers._base import contract_of, law_of_x
from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes
from iblf_jax.core.families import is_default
from iblf_jax.core.linalg import solve_spd
from iblf_jax.simulation.levels import start_levels
from iblf_jax.simulation.scenario import Scenario

METHODS = ("lyapunov", "decay")
"""Methods of a law that states a claim about itself."""
LEVEL_TERMS = "dV/dx . d_tilde + dV/dd_tilde . d'"
"""T of a law that receives the levels and has no `disturbance_terms`."""
TORQUE_TERMS = "dV/dq' . M0^-1 f_tilde + dV/df_tilde . f'"
"""T of a law of robots without `disturbance_terms`."""
TORQUE_OF_ESTIMATES = " + dV/dq' . M0^-1 (tau(x_hat) - tau(x))"
"""What the error of estimated levels adds to T."""
ROUNDING = 8.0
"""Rounding error of V' of a law's own V, in units of that of its terms."""


class OwnTerms(NamedTuple):
    """The terms of a law's claim about itself, () each; along a run a time axis comes first."""

    V: jax.Array
    dV: jax.Array
    """V', exact, in the unit of V a second."""
    dissipation: jax.Array
    """W."""
    disturbance_terms: jax.Array
    """T."""
    size: jax.Array
    """Sum of the absolute values of the terms of V': rounding is relative to it."""

    @property
    def left_side(self) -> Any:
        """V' + W - T, which must not be positive."""
        return self.dV + self.dissipation - self.disturbance_terms


class OwnClaim(Claim):
    """What a law states about itself."""

    key: ClassVar[str] = "own"

    def why_not(self, scenario: Scenario) -> str:
        """Why a law states nothing about itself; "" if it does.

        Raises:
          ValueError: a law that states half of a claim.
        """
        if own_claim(scenario) is None:
            return "the law states no claim of its own (controllers.LyapunovLaw)"
        return ""

    def why_not_in_run(self, summary: Summary) -> str:
        """Why it does not apply to a run; "" if it does."""
        scenario = summary.run.scenario
        actuator = other_actuator(scenario)
        if actuator:
            about = "the law's own claim is about a torque that acts as it is commanded"
            return f"{about}, not about {actuator}"
        return _why_not_with_estimates(scenario) or summary.why_never or summary.why_invalid

    def applies(self, summary: Summary) -> bool:
        """Whether the claim is made about a run."""
        return self in summary.claims and not self.why_not_in_run(summary)

    def with_terms_of_claim(self, point: Point, terms: Terms) -> Terms:
        """The terms at a state with those of this claim."""
        scenario, t = point.scenario, point.t
        law: Any = own_claim(scenario)
        of_x: Any = law_of_x(law)
        context = scenario.context._replace(plant=scenario.plant)
        own_state, own_rate = point.law_state
        d, d_tilde, dd, dd_tilde = point.uncertain
        if not law.uses_observer:
            d_tilde, dd_tilde = d, dd

        def lyapunov(t: jax.Array, x: jax.Array, d_tilde: jax.Array, law_state: Any) -> jax.Array:
            return jnp.sum(of_x.lyapunov(t, x, d_tilde, context, law_state))

        at = (t, point.x, d_tilde, own_state)
        dx = point.rate.x[: len(point.x)]
        direction = (jnp.ones_like(t), dx, dd_tilde, own_rate)
        V, dV = jax.jvp(lyapunov, at, direction)
        W = jnp.sum(of_x.decay(t, point.x, d_tilde, context, own_state))
        slopes = jax.grad(lyapunov, argnums=(0, 1, 2, 3))(*at)
        if states_disturbance_terms(law):
            T = jnp.sum(of_x.disturbance_terms(t, point.x, d_tilde, dd, context, own_state))
        else:
            T = point.disturbance_power(slopes[1], d_tilde) + jnp.sum(slopes[2] * dd)
            if isinstance(point, TorquePoint) and scenario.loop.observer.completes:
                # The law received estimates: what that changes of the torque acts like f_tilde.
                f_hat = point.now["disturbance_estimate"]
                command, _ = of_x.command(t, point.x, f_hat, context, own_state)
                T += slopes[1][1] @ solve_spd(point.M0, point.now["tau"] - command.tau)
        products = jax.tree.map(lambda a, b: jnp.sum(jnp.abs(a * b)), slopes, direction)
        size = sum(jax.tree.leaves(products)) + point.rate_size(slopes[1])
        entry = OwnTerms(V, dV, W, T, size + jnp.abs(W) + jnp.abs(T))
        terms = terms._replace(claims=terms.claims | {self.key: entry})
        if not isinstance(point, TorquePoint) or law is scenario.controller:
            return terms
        limited = point.differs_from_command(law, own_state)
        return terms._replace(excluded=terms.excluded | limited)

    def on_traces(self, segment: Segment, traces: Any) -> Any:
        """Curves with V and the left side of this claim."""
        own = segment.terms.claims[self.key]
        return traces._replace(V=own.V, left=own.left_side)

    def lines(self, segment: Segment) -> list[Line]:
        """The lines of the law's claim about itself for one segment."""
        summary, own = segment.summary, segment.terms.claims[self.key]
        scenario = summary.run.scenario
        law: Any = own_claim(scenario)
        general = TORQUE_TERMS if receives_q_dq(scenario) else LEVEL_TERMS
        right_side = "what the law states" if states_disturbance_terms(law) else general
        if scenario.loop.observer.completes:
            right_side += TORQUE_OF_ESTIMATES
        decay = "W >= 0: the decay that the law states"
        text = f"V' <= -W + T,  T: {right_side}"
        stated = Statement("inequality, own V", "own", text, "1/s", Role.OWN_INEQUALITY)
        W = own.dissipation
        # Near 0, V and W are differences of numbers as large as their largest values.
        checked = (
            (Statement("own V", "own", "V >= 0", "1"), own.V, np.max(np.abs(own.V))),
            (Statement("own decay", "own", decay, "1/s"), W, np.max(np.abs(W))),
            (stated, -own.left_side, own.size),
        )
        reason = self.why_not_in_run(summary)
        if reason:
            return [not_applicable(statement, reason) for statement, _, _ in checked]
        note = summary.exclusion_note()
        return [
            check_steps(segment, statement, margins, ROUNDING * summary.eps * sizes, note=note)
            for statement, margins, sizes in checked
        ]


OWN = OwnClaim()


def _why_not_with_estimates(scenario: Scenario) -> str:
    """Why the law's claim does not apply to estimated levels; "" if it does.

    The claim is about a measured state.  For a law of robots without a state of its own and with
    the general T, the error of the estimates acts through the torque alone, which T then contains.
    """
    if not scenario.loop.observer.completes:
        return ""
    law: Any = own_claim(scenario)
    kind = type(scenario.observer).__name__
    about = f"the law's own claim is about a measured state, and {kind} estimates levels"
    if not receives_q_dq(scenario):
        return about
    if states_disturbance_terms(law):
        return f"{about}; the T that the law states does not contain their error"
    x = start_levels(scenario)[: scenario.loop.model.order]
    start = jax.eval_shape(law_of_x(law).init, x, scenario.context)
    if jax.tree.leaves(start):
        return f"{about}, which act on the law's own state"
    return ""


def own_claim(scenario: Scenario) -> LyapunovLaw | None:
    """The law that states a claim about itself, or None.

    It is the outermost law, or the one within limits of the torque.

    Raises:
      ValueError: a law that states half of a claim.
    """
    law: Any = scenario.controller
    while isinstance(law, Saturated) and not stated_methods(law):
        law = law.law
    stated = stated_methods(law)
    if not stated:
        return None
    missing = [name for name in METHODS if name not in stated]
    if missing:
        what = f"{type(law).__name__} with {stated[0]} and without {missing[0]}"
        remedy = "See iblf_jax.controllers.LyapunovLaw."
        raise checks.fail("controller", what, "both methods, or neither", remedy)
    return law


def stated_methods(law: TrackingLaw) -> list[str]:
    """The methods among `lyapunov` and `decay` that a law has."""
    base: Any = contract_of(law)
    methods = attributes(law, METHODS)
    defaults = attributes(base, METHODS)
    return [name for name, own in methods.items() if not is_default(own, defaults[name])]


def states_disturbance_terms(law: Law | RobotLaw) -> bool:
    """Whether a law states the T of its own claim."""
    return not is_default(law.disturbance_terms, contract_of(law).disturbance_terms)
