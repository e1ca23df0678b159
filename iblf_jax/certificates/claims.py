"""The inequalities that are claimed about a closed loop, and their constants.

**Theorem 2** is about the backstepping law with an observer whose error obeys
f_tilde' = f' - kf f_tilde:

    V2' <= -rho V2 + 1/2 |f'|^2
    rho = min( decay rate of V1,  2 lambda_min(K2 - I/2) / lambda_max(M0),  r_f )

    case 1, f' = 0:       needs K2 > 1/2, kf > 1/2,  r_f = 2 lambda_min(kf - I/2)    (3.17), (3.19)
    case 2, |f'| <= F_d:  needs K2 > 1/2, kf > 1,    r_f = 2 lambda_min(kf - I)      (3.25), (3.27)

Every barrier that states how fast its V1 decays along alpha (`decay_rate`) has the claim, because
the law cancels the barrier's slope against e2: 2 k1 for the integral barrier, 2 p k1 for the
logarithmic one, and so on. K2 and kf are diagonal, so lambda_min is the smallest entry.

`controllers.FullState` has a claim of its own, (F.3) there, whose rate is the least of the decay
rate of V1, the decay rate of phi, and 2 (lambda_min(kf) - 1/(4 c lambda_min(M0)^2)) in case 1, with
1/2 less in the bracket in case 2.

**The claim with weights** holds for every positive K2 and kf of the corrected law with a momentum
observer:

    V_w = sum_i w_i V1_i + 1/2 e2^T M0 e2 + (w_f/2) |f_tilde|^2,   w_f > 0 [rad/(N m)]
    V_w' <= -rho V_w + (w_f/(2 b)) |f'|^2                                                      (W.1)
    rho = min( decay rate of V1,  2 (1 - a) mu,  2 min_i(kf_i - b/2 - 1/(4 a K2_i w_f)) ),
    mu = lambda_min(M0^-1 K2)                                                                  (W.2)

for any 0 < a < 1 and, where f' = 0 (case 1), b = 0. It follows from
e2_i f_tilde_i <= a K2_i e2_i^2 + f_tilde_i^2/(4 a K2_i) and
f_tilde . f' <= (b/2) |f_tilde|^2 + |f'|^2/(2 b), and integrates to

    V_w(t) <= V_w(0) exp(-rho t) + rho2/rho,   rho2 = w_f F_d^2/(2 b),   w_i V1_i <= V_w.      (W.3)

The paper has w_i = w_f = 1 and a = 1/(2 K2), hence its conditions K2 > 1/2 and kf > 1/2: below them
its envelope is lost, but stability is not. Here a, b and w_f are free, and `best_constants` chooses
those with the smallest mean of (W.3) over a run.

**The claim of a law about itself** (`controllers.LyapunovLaw`): a law may state a Lyapunov function
V, its decay W and the disturbance terms T, with V' <= -W + T.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Ideal
from iblf_jax.control.controllers import (
    AdaptiveParameters,
    Backstepping,
    FullState,
    Law,
    LyapunovLaw,
    RobotLaw,
    Saturated,
    TrackingLaw,
)
from iblf_jax.control.controllers._base import contract_of
from iblf_jax.control.observers import Momentum, Printed
from iblf_jax.core import checks, programs
from iblf_jax.core.attributes import attributes
from iblf_jax.core.families import is_default
from iblf_jax.core.pytree import layers, unwrapped
from iblf_jax.simulation.scenario import Scenario

CASES = (1, 2)
LOWEST_KF = {1: 0.5, 2: 1.0}
"""Lower bound of kf: (3.17) in case 1, (3.25) in case 2."""
LOWEST_K2 = 0.5
LOWEST_FULL = {1: 0.0, 2: 0.5}
"""Lower bound of kf - 1/(4 c lambda_min(M0)^2), by case.
(F.3)"""
OWN_CLAIM_METHODS = ("lyapunov", "decay")
"""Methods of a law that states a claim about itself."""
GRID = np.linspace(0.02, 0.98, 97)
"""Fractions of the largest rate, and of the largest b for a rate, that `best_constants` tries."""


class Claim(NamedTuple):
    """The constants of Theorem 2; (n,) each."""

    decay: jax.Array
    """Decay rate of V1 of each joint along alpha [1/s]."""
    K2: jax.Array
    kf: jax.Array


class FullClaim(NamedTuple):
    """The constants of the claim about positions and velocities; (n,) each."""

    decay: jax.Array
    """Decay rate of V1 of each joint along alpha [1/s]."""
    decay_phi: jax.Array
    """Decay rate of phi of each joint [1/s]."""
    c: jax.Array
    kf: jax.Array


class Claims(NamedTuple):
    """All claims about one scenario."""

    law: Any
    """The law without its wrappers (torque limits)."""
    constants: Claim | FullClaim | None
    """Of Theorem 2, or of (F.3); None where neither applies."""
    why_no_theorem: str
    """Why neither applies; "" if one does."""
    bounds_velocities: bool
    """Whether the law is a `FullState`."""
    why_no_weights: str
    """Why the claim with weights does not apply; "" if it does."""
    other_weights: bool
    """Whether the barriers have weights other than the paper's, which are 1."""
    own: LyapunovLaw | None
    """The law that states a claim about itself."""


def claims_of(scenario: Scenario) -> Claims:
    """All claims about a scenario.

    Raises:
      ValueError: a law that states half of a claim about itself.
    """
    law: Any = unwrapped(scenario.controller)
    no_theorem = why_no_theorem(scenario)
    weight = law.weight
    is_corrected = isinstance(law, Backstepping) and law.reading == "corrected"
    why_no_weights = "the claim with weights is about the corrected law with a momentum observer"
    if is_corrected and isinstance(scenario.observer, Momentum) and not no_theorem:
        why_no_weights = ""
    return Claims(
        law=law,
        constants=None if no_theorem else constants_of(scenario),
        why_no_theorem=no_theorem,
        bounds_velocities=isinstance(law, FullState),
        why_no_weights=why_no_weights,
        other_weights=weight is not None and bool(np.any(np.asarray(weight) != 1.0)),
        own=own_claim(scenario),
    )


# --- Theorem 2 -----------------------------------------------------------------------------------


def why_no_theorem(scenario: Scenario) -> str:
    """Why Theorem 2 claims nothing about a scenario, in words; "" if it does."""
    law, observer = unwrapped(scenario.controller), scenario.observer
    if not isinstance(law, Backstepping | FullState):
        about = f"Theorem 2 is about the backstepping law (3.14); {type(law).__name__}"
        return f"{about} has no claim of this kind{_why_no_own_claim(scenario)}"
    if adaptive_law(scenario) is not None:
        return "Theorem 2 is about a constant model, and AdaptiveParameters changes it"
    rates = [(law.barrier, decay_rate(law))]
    if isinstance(law, FullState):
        rates.append((law.velocity_barrier, decay_phi(law)))
    for barrier, rate in rates:
        if rate is None:
            return f"the barrier {type(barrier).__name__} states no decay rate of its V1"
    if not isinstance(observer, Printed | Momentum):
        needs = "Theorem 2 needs the observer (3.11), printed or in momentum form"
        return f"{needs}; {type(observer).__name__} has no claim of this kind"
    if not isinstance(scenario.actuator, Ideal):
        actuator = checks.with_article(type(scenario.actuator).__name__)
        about = "Theorem 2 is about a torque that acts as it is commanded"
        return f"{about}; {actuator} has no claim of this kind"
    return ""


def why_excluded(scenario: Scenario) -> str:
    """What excludes instants from the claims about the law inside its wrappers, in words."""
    changing = []
    for law in layers(scenario.controller)[:-1]:
        if law.has_auxiliary:
            changing.append(f"the auxiliary state of {type(law).__name__}")
        elif not isinstance(law, Saturated | AdaptiveParameters):
            changing.append(type(law).__name__)
    reason = "the guard or a limit of the input was active"
    if not changing:
        return reason
    inner = type(unwrapped(scenario.controller)).__name__
    return f"{reason}, or {' or '.join(changing)} changed the input of {inner}"


def adaptive_law(scenario: Scenario) -> AdaptiveParameters | None:
    """The law that changes the parameters of the model, or None."""
    for law in layers(scenario.controller):
        if isinstance(law, AdaptiveParameters):
            return law
    return None


def decay_rate(law: Backstepping | FullState, gain: Any = None) -> jax.Array | None:
    """Decay rate of the barrier's V1 along alpha, (n,) [1/s]; None if the barrier states none.

    For the gain k1, below which the gain of a law with `decays` is at no instant; or for the gain
    of an instant.
    """
    return _decay_of(law.barrier, law.k1 if gain is None else gain)


def decay_phi(law: FullState, gain: Any = None) -> jax.Array | None:
    """Decay rate of the velocity barrier's phi, (n,) [1/s], for the gain K2 or another one; None if
    the barrier states none.
    """
    return _decay_of(law.velocity_barrier, law.K2 if gain is None else gain)


def _decay_of(barrier: Any, gain: jax.Array) -> jax.Array | None:
    """Decay rate that a barrier states for a gain, (n,) [1/s], or None."""
    stated = barrier.decay_rate
    return None if stated is None else stated(gain)


def constants_of(scenario: Scenario) -> Claim | FullClaim:
    """The constants of Theorem 2; only for a scenario for which `why_no_theorem` is empty."""
    law: Any = unwrapped(scenario.controller)
    observer, decay = scenario.observer, decay_rate(law)
    if decay is None or not isinstance(observer, Printed | Momentum):
        raise TypeError(why_no_theorem(scenario))
    if isinstance(law, FullState):
        return FullClaim(decay, decay_phi(law), law.c, observer.kf)  # type: ignore[arg-type]
    return Claim(decay, law.K2, observer.kf)


@programs.jit(static_argnames="case")
def rho_terms(
    constants: Claim | FullClaim,
    lambda_max: jax.typing.ArrayLike,
    case: int,
    lambda_min: jax.typing.ArrayLike = 0.0,
) -> jax.Array:
    """The three terms of which rho is the least, (3,) [1/s].
    (3.19), (3.27), (F.3)

    Args:
      constants: gains and decay rates.
      lambda_max: largest eigenvalue of M0, () [kg m^2].
      case: 1 for f' = 0, 2 for bounded f'.
      lambda_min: smallest eigenvalue of M0, () [kg m^2], on which a `FullClaim` depends.
    """
    if isinstance(constants, FullClaim):
        coupling = 0.25 / (jnp.min(constants.c) * lambda_min**2)  # type: ignore[operator]
        by_kf = 2.0 * (jnp.min(constants.kf) - LOWEST_FULL[case] - coupling)
        return jnp.stack([jnp.min(constants.decay), jnp.min(constants.decay_phi), by_kf])
    return jnp.stack([
        jnp.min(constants.decay),
        2.0 * jnp.min(constants.K2 - LOWEST_K2) / lambda_max,
        2.0 * jnp.min(constants.kf - LOWEST_KF[case]),
    ])  # fmt: skip


# --- the claim with weights ----------------------------------------------------------------------


class WeightedConstants(NamedTuple):
    """The free numbers of the claim with weights, and the resulting rates."""

    a: float
    """[1]."""
    b: float
    """[1/s]; 0 in case 1."""
    w_f: float
    """[rad/(N m)]."""
    rho: float
    """[1/s]."""
    rho2: float
    """[N m rad/s]."""


def weighted_rate_terms(constants: Claim, mu: float, a: float, b: float, w_f: float) -> np.ndarray:
    """The three terms of which rho is the least, (3,) [1/s].
    (W.2)

    Args:
      constants: gains and decay rates.
      mu: the smallest eigenvalue of M0^-1 K2, () [1/s].
      a, b, w_f: as in the docstring of this module.
    """
    decay, K2, kf = (np.asarray(x, float) for x in constants)
    by_K2 = 2.0 * (1.0 - a) * mu
    by_kf = 2.0 * np.min(kf - b / 2.0 - 0.25 / (a * K2 * w_f))
    return np.array([np.min(decay), by_K2, by_kf])


def best_constants(
    constants: Claim,
    mu: float,
    V_rest: float,
    half_square: float,
    F_d: float,
    duration: float,
    case: int,
) -> WeightedConstants | None:
    """The constants with the smallest mean of the envelope (W.3) over a run; None if the numbers of
    the run are not finite.

    For each rho and b of a grid it takes the largest a that (W.2) allows, then the smallest w_f.

    Args:
      constants: gains and decay rates.
      mu: the same over the run, () [1/s].
      V_rest: V_w(0) without f_tilde, () [N m rad].
      half_square: |f_tilde(0)|^2 / 2, () [(N m)^2].
      F_d: sup |f'|, () [N m/s].
      duration: of the run [s].
      case: 1 for f' = 0, 2 for bounded f'.
    """
    decay, K2, kf = (np.asarray(x, float) for x in constants)
    top = min(float(np.min(decay)), 2.0 * mu, 2.0 * float(np.min(kf)))
    if not (np.all(np.isfinite([top, V_rest, half_square, F_d])) and top > 0):
        return None
    # Axes: rates rho, then fractions of the largest b.
    rho = top * GRID[:, None]
    a = 1.0 - rho / (2.0 * mu)
    fractions = {1: np.zeros((1, 1)), 2: GRID[None, :]}[case]
    b = 2.0 * (np.min(kf) - rho / 2.0) * fractions
    kf_margin = kf - (b + rho)[..., None] / 2.0
    w_f = np.max(0.25 / (a[..., None] * K2 * kf_margin), axis=-1)
    rho2 = np.zeros_like(w_f)
    if case == 2:
        rho2 = w_f * F_d**2 / (2.0 * b)
    mean_decay = -np.expm1(-rho * duration) / (rho * duration)
    mean = (V_rest + w_f * half_square) * mean_decay + rho2 / rho
    row, column = np.unravel_index(np.argmin(mean), mean.shape)
    return WeightedConstants(
        a=float(a[row, 0]),
        b=float(b[row, column]),
        w_f=float(w_f[row, column]),
        rho=float(rho[row, 0]),
        rho2=float(rho2[row, column]),
    )


# --- the claim of a law about itself -------------------------------------------------------------


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
    missing = [name for name in OWN_CLAIM_METHODS if name not in stated]
    if missing:
        what = f"{type(law).__name__} with {stated[0]} and without {missing[0]}"
        remedy = "See iblf_jax.controllers.LyapunovLaw."
        raise checks.fail("controller", what, "both methods, or neither", remedy)
    return law


def stated_methods(law: TrackingLaw) -> list[str]:
    """The methods among `lyapunov` and `decay` that a law has."""
    base: Any = contract_of(law)
    methods = attributes(law, OWN_CLAIM_METHODS)
    defaults = attributes(base, OWN_CLAIM_METHODS)
    return [name for name, own in methods.items() if not is_default(own, defaults[name])]


def states_disturbance_terms(law: Law | RobotLaw) -> bool:
    """Whether a law states the T of its own claim."""
    return not is_default(law.disturbance_terms, contract_of(law).disturbance_terms)


def _why_no_own_claim(scenario: Scenario) -> str:
    """Why a law states no claim about itself, as the end of a sentence; "" if it states one."""
    if own_claim(scenario) is not None:
        return ""
    inner, outer = unwrapped(scenario.controller), scenario.controller
    if stated_methods(inner):
        wrapper = type(outer).__name__
        return f"; the claim that it states of itself does not cover the {wrapper} that wraps it"
    return ", and states none of its own (controllers.LyapunovLaw)"
