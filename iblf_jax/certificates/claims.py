"""What Theorem 2 claims about a scenario, and the constants in it.

    V2' <= -rho V2 + 1/2 |f'|^2,     rho = min( decay rate of V1,  2 lambda_min(K2 - I/2) /
    lambda_max(M0),  r_f ) case 1, f' = 0:         needs K2 > 1/2, kf > 1/2,   r_f = 2 lambda_min(kf
    - I/2)                              (3.17), (3.19) case 2, |f'| <= F_d:    needs K2 > 1/2, kf >
      1,     r_f = 2 lambda_min(kf - I)                                (3.25), (3.27)

The claim belongs to the backstepping law with an observer whose error obeys f_tilde' = f' - kf
f_tilde.  Any barrier will do that states how fast its V1 decays along alpha (`decay_rate`), because
the law cancels the barrier's slope against e2: 2 k1 for the integral barrier, 2 p k1 for the
logarithmic one, and so on.  K2 and kf are diagonal, so lambda_min is the smallest entry.
`controllers.FullState` has a claim of its own, (F.3) there, with the terms  decay rate of V1, decay
rate of phi, 2 (lambda_min(kf) - 1/(4 c lambda_min(M0)^2)) in case 1 and 1/2 less in the last
bracket in case 2. What is no such loop has no claim here, and `why_no_claim` says why.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.certificates import own_law
from iblf_jax.control.actuators import Ideal
from iblf_jax.control.controllers import Backstepping, FullState
from iblf_jax.control.observers import Momentum, Printed
from iblf_jax.core import checks
from iblf_jax.simulation.scenario import Scenario

CASES = (1, 2)
LOWEST_KF = {1: 0.5, 2: 1.0}
"""kf must be greater than this: (3.17) in case 1, (3.25) in case 2."""
LOWEST_K2 = 0.5


class Claim(NamedTuple):
    """The constants of the claim; (n,) each."""

    decay: jax.Array
    """How fast V1 of each joint decays along alpha [1/s]."""
    K2: jax.Array
    kf: jax.Array


class FullClaim(NamedTuple):
    """The constants of the claim about positions and velocities; (n,) each."""

    decay: jax.Array
    """How fast V1 of each joint decays along alpha [1/s]."""
    decay_phi: jax.Array
    """How fast phi of each joint decays [1/s]."""
    c: jax.Array
    kf: jax.Array


LOWEST_FULL = {1: 0.0, 2: 0.5}
"""kf must be greater than this and 1/(4 c lambda_min(M0)^2) together.
(F.3)"""


def law_of(scenario: Scenario) -> Any:
    """The law itself, without what wraps it (a torque limit)."""
    law: Any = scenario.controller
    while getattr(law, "wraps", None) is not None:
        law = getattr(law, law.wraps)
    return law


def why_no_claim(scenario: Scenario) -> str:
    """Why Theorem 2 claims nothing about a scenario, in words; "" if it does claim something."""
    law, observer = law_of(scenario), scenario.observer
    if not isinstance(law, Backstepping | FullState):
        words = (
            f"Theorem 2 is about the backstepping law (3.14); {type(law).__name__} has no claim of"
            " this kind"
        )
        return words + own_law.why_none(scenario)
    for barrier, rate in (
        (law.barrier, decay_rate(law)),
        *([(law.velocity_barrier, decay_phi(law))] if isinstance(law, FullState) else []),
    ):
        if rate is None:
            return f"the barrier {type(barrier).__name__} states no decay rate of its V1"
    if not isinstance(observer, Printed | Momentum):
        return (
            "Theorem 2 needs the observer (3.11), printed or in momentum form;"
            f" {type(observer).__name__} has no claim of this kind"
        )
    if not isinstance(scenario.actuator, Ideal):
        actuator = checks.with_article(type(scenario.actuator).__name__)
        law = "Theorem 2 is about a torque that acts as it is commanded"
        return f"{law}; {actuator} has no claim of this kind"
    return ""


def decay_rate(law: Backstepping | FullState) -> jax.Array | None:
    """How fast the barrier's V1 decays along alpha, (n,) [1/s], or None if the barrier does not
    say.
    """
    stated = getattr(law.barrier, "decay_rate", None)
    return None if stated is None else stated(law.k1)


def decay_phi(law: FullState) -> jax.Array | None:
    """How fast the barrier's phi decays, (n,) [1/s], or None if the barrier does not say."""
    stated = getattr(law.velocity_barrier, "decay_rate", None)
    return None if stated is None else stated(law.K2)


def claim(scenario: Scenario) -> Claim | FullClaim:
    """The constants of the claim; only for a scenario for which `why_no_claim` is empty."""
    law, observer = law_of(scenario), scenario.observer
    decay = decay_rate(law)
    if decay is None or not isinstance(observer, Printed | Momentum):
        raise TypeError(why_no_claim(scenario))
    if isinstance(law, FullState):
        return FullClaim(decay, decay_phi(law), law.c, observer.kf)  # type: ignore[arg-type]
    return Claim(decay, law.K2, observer.kf)


@partial(jax.jit, static_argnames="case")
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
        passed_on = 0.25 / (jnp.min(constants.c) * lambda_min**2)  # type: ignore[operator]
        by_kf = 2.0 * (jnp.min(constants.kf) - LOWEST_FULL[case] - passed_on)
        return jnp.stack([jnp.min(constants.decay), jnp.min(constants.decay_phi), by_kf])
    return jnp.stack([
        jnp.min(constants.decay),
        2.0 * jnp.min(constants.K2 - LOWEST_K2) / lambda_max,
        2.0 * jnp.min(constants.kf - LOWEST_KF[case]),
    ])  # fmt: skip


@partial(jax.jit, static_argnames="case")
def rho(
    constants: Claim | FullClaim,
    lambda_max: jax.typing.ArrayLike,
    case: int,
    lambda_min: jax.typing.ArrayLike = 0.0,
) -> jax.Array:
    """The rate of the claim, () [1/s].
    (3.19), (3.27), (F.3)
    """
    return jnp.min(rho_terms(constants, lambda_max, case, lambda_min))
