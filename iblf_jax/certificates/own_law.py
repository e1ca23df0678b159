"""The claim that a law states of itself, held against a run: `controllers.LyapunovLaw`.

A law may state a Lyapunov function V of its own and how fast V decreases, W.  Then

    V' <= -W + T

is checked at every step, as the inequality of Theorem 2 is: V' is the derivative of V along the
vector field of the whole loop, by forward-mode differentiation.  No differences along a run enter.

T is what the law's `disturbance_terms` state.  For a law without that method it is what the
uncertain term adds to V', whatever the law is: by (2.1) the acceleration is the model's under an
exact estimate, plus M0^-1 f_tilde, and f_tilde' = f' - f_hat', so

    T = dV/dq' . M0^-1 f_tilde + dV/df_tilde . f'

The second term is zero for a V without f_tilde.

A law that does not use the estimate is given the uncertain term f itself in place of f_tilde.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates.result import NOT_APPLICABLE, OWN_INEQUALITY, Line
from iblf_jax.control.actuators import Ideal
from iblf_jax.control.controllers import LyapunovLaw, Saturated
from iblf_jax.core import checks
from iblf_jax.core.linalg import matvec, solve_spd
from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation.closed_loop import LoopState
from iblf_jax.simulation.scenario import Scenario

REQUIRED = ("lyapunov", "decay")
"""What a law that states a claim of its own has."""
EQUATION = "own"
"""What the lines of the claim have in the place of a number in the paper."""
NAMES = ("own V", "own decay", OWN_INEQUALITY)
"""The lines of the claim."""
GENERAL_TERMS = "dV/dq' . M0^-1 f_tilde + dV/df_tilde . f'"
"""T of a law that states none, whatever the law is."""
ROUNDING = 8.0
"""Relative errors of the derivatives of V, in those of their terms."""
UNCHANGED = 8.0
"""Units of the last place by which a torque may differ and still be the same."""


class OwnTerms(NamedTuple):
    """The law's own claim at one instant, () each; along a run a time axis comes first."""

    V: jax.Array
    dV: jax.Array
    """V', exact, in the unit of V a second."""
    decay: jax.Array
    """W."""
    terms: jax.Array
    """T."""
    size: jax.Array
    """Sizes of what V' is a sum of, added up: rounding is relative to it."""
    limited: jax.Array
    """Whether a torque limit changed the law's torque, () bool: nothing is claimed then."""


def stating_law(scenario: Scenario) -> LyapunovLaw | None:
    """The law that states a claim of its own, or None.

    It is the outermost law, or the one within limits of the torque.

    Raises:
      ValueError: a law that states half of a claim.
    """
    law: Any = scenario.controller
    while isinstance(law, Saturated) and not hasattr(law, REQUIRED[0]):
        law = law.law
    stated = [name for name in REQUIRED if hasattr(law, name)]
    if not stated:
        return None
    missing = [name for name in REQUIRED if name not in stated]
    if missing:
        what = f"{type(law).__name__} with {stated[0]} and without {missing[0]}"
        remedy = "See iblf_jax.controllers.LyapunovLaw."
        raise checks.fail("controller", what, "both methods, or neither", remedy)
    return law


def why_none(scenario: Scenario) -> str:
    """Why a law states no claim of its own, as the end of a sentence; "" if it states one."""
    if stating_law(scenario) is not None:
        return ""
    inner, outer = unwrapped(scenario.controller), scenario.controller
    if hasattr(inner, REQUIRED[0]):
        wrapper = type(outer).__name__
        return f"; the claim that it states of itself does not cover the {wrapper} that wraps it"
    return ", and states none of its own (controllers.LyapunovLaw)"


def why_not(whole: Any) -> str:
    """Why the law's own claim says nothing about a run; "" if it does."""
    actuator = whole.run.scenario.actuator
    if not isinstance(actuator, Ideal):
        about = "the law's own claim is about a torque that acts as it is commanded"
        return f"{about}, not about {checks.with_article(type(actuator).__name__)}"
    if whole.left_out == whole.samples:
        return "the guard or a torque limit was at work all the time"
    return whole.no_run


def terms_at(
    scenario: Scenario,
    t: jax.Array,
    state: LoopState,
    along: LoopState,
    now: dict[str, jax.Array],
    ahead: dict[str, jax.Array],
) -> OwnTerms:
    """The law's own claim at one state.

    Args:
      scenario: canonical, with a law that states a claim.
      t: time, () [s].
      state: of the loop at t.
      along: its rate.
      now: f ("disturbance"), its estimate ("disturbance_estimate") and the torque ("tau"), (n,).
      ahead: their rates.
    """
    law: Any = stating_law(scenario)
    context, q, dq = scenario.context, state.q, state.dq
    uses_estimate = getattr(law, "uses_observer", True)
    f_tilde, df_tilde = now["disturbance"], ahead["disturbance"]
    if uses_estimate:
        f_tilde = f_tilde - now["disturbance_estimate"]
        df_tilde = df_tilde - ahead["disturbance_estimate"]

    def lyapunov(t, q, dq, f_tilde, own):
        return jnp.sum(law.lyapunov(t, q, dq, f_tilde, context, own))

    point = (t, q, dq, f_tilde, state.controller)
    rates = (jnp.ones_like(t), along.q, along.dq, df_tilde, along.controller)
    V, dV = jax.jvp(lyapunov, point, rates)
    decay = jnp.sum(law.decay(t, q, dq, f_tilde, context, state.controller))
    slopes = jax.grad(lyapunov, argnums=(0, 1, 2, 3, 4))(*point)
    M0 = scenario.model.mass_matrix(q)
    if hasattr(law, "disturbance_terms"):
        df = ahead["disturbance"]
        terms = jnp.sum(law.disturbance_terms(t, q, dq, f_tilde, df, context, state.controller))
    else:
        terms = slopes[2] @ solve_spd(M0, f_tilde) + slopes[3] @ ahead["disturbance"]
    size = _size(M0, slopes, rates, now) + jnp.abs(decay) + jnp.abs(terms)
    return OwnTerms(V, dV, decay, terms, size, _limited(scenario, law, t, state, now))


def _size(M0, slopes, rates, now) -> jax.Array:
    """Sizes of the terms of V', added up.

    An acceleration is known only as well as the torques whose difference it is.
    """

    def product(slope, rate):
        return jnp.sum(jnp.abs(slope) * jnp.abs(rate))

    torques = jnp.abs(matvec(M0, rates[2]))
    for name in ("tau", "disturbance", "disturbance_estimate"):
        torques = torques + jnp.abs(now[name])
    products = jax.tree.map(product, slopes, rates)
    return sum(jax.tree.leaves(products)) + product(slopes[2], solve_spd(M0, torques))


def _limited(scenario: Scenario, law: Any, t: jax.Array, state: LoopState, now) -> jax.Array:
    """Whether limits changed the law's torque; a smooth one does so before it is reached."""
    if law is scenario.controller:
        return jnp.zeros((), bool)
    f_hat = now["disturbance_estimate"]
    command, _ = law.command(t, state.q, state.dq, f_hat, scenario.context, state.controller)
    own = command.tau
    return jnp.any(jnp.abs(now["tau"] - own) > UNCHANGED * jnp.finfo(own.dtype).eps * jnp.abs(own))


def applies(trajectory: Any) -> bool:
    """Whether the law states a claim of its own that says something about the run."""
    return trajectory.proof.own != () and not why_not(trajectory.whole)


def left_side(own: Any) -> np.ndarray:
    """V' + W - T, which must not be positive, (T,)."""
    return own.dV + own.decay - own.terms


def lines(trajectory: Any, judged: Any) -> list[Line]:
    """The lines of the law's own claim for one stretch of a run; none for a law that states none.

    Args:
      trajectory: the stretch.
      judged: how margins along it become a line.
    """
    whole, own = trajectory.whole, trajectory.proof.own
    law = stating_law(whole.run.scenario)
    if law is None:
        return []
    states_terms = hasattr(law, "disturbance_terms")
    right_side = "what the law states" if states_terms else GENERAL_TERMS
    described = (
        (NAMES[0], "V >= 0", own.V, _largest(own.V)),
        (NAMES[1], "W >= 0: the decay that the law states", own.decay, _largest(own.decay)),
        (NAMES[2], f"V' <= -W + T,  T: {right_side}", -left_side(own), own.size),
    )
    found = []
    for name, statement, margins, sizes in described:
        description: dict[str, Any] = {
            "name": name,
            "equation": EQUATION,
            "statement": statement,
            "unit": "1" if name == NAMES[0] else "1/s",
        }
        reason = why_not(whole)
        if reason:
            found.append(Line(verdict=NOT_APPLICABLE, note=reason, **description))
            continue
        description["note"] = _excluded(whole)
        found.append(judged(trajectory, margins, ROUNDING * whole.eps * sizes, description))
    return found


def _largest(values: np.ndarray) -> np.ndarray:
    """The largest size of some values, at each: near 0 they are differences of such numbers."""
    return np.full(values.shape, np.max(np.abs(values)))


def _excluded(whole: Any) -> str:
    """How many samples are left out, in words; "" if none is."""
    if not whole.left_out:
        return ""
    left_out = f"{whole.left_out} of {whole.samples} samples are left out"
    return f"{left_out}: the guard or a torque limit was at work"
