"""The claim with weights, which holds for every positive K2 and kf.

    V_w = sum_i w_i V1_i + 1/2 e2^T M0 e2 + (w_f/2) |f_tilde|^2,   w_f > 0 [rad/(N m)]
    V_w' <= -rho V_w + (w_f/(2 b)) |f'|^2
    (W.1) rho = min( decay rate of V1,  2 (1 - a) mu,  2 min_i(kf_i - b/2 - 1/(4 a K2_i w_f)) ),
    mu = lambda_min(M0^-1 K2)           (W.2)

for the corrected law with a momentum observer, any 0 < a < 1 and, where f' = 0 (case 1), b = 0.  It
follows from e2_i f_tilde_i <= a K2_i e2_i^2 + f_tilde_i^2/(4 a K2_i) and f_tilde . f' <= (b/2)
|f_tilde|^2 + |f'|^2/(2 b), and is integrated to

    V_w(t) <= V_w(0) exp(-rho t) + rho2/rho,   rho2 = w_f F_d^2/(2 b),   w_i V1_i <= V_w.
    (W.3)

The paper has w_i = w_f = 1 and a = 1/(2 K2), hence its conditions K2 > 1/2 and kf > 1/2: below them
its own envelope is lost, stability is not.  Here a, b and w_f are free.  `best` takes those with
the smallest mean of (W.3) over the run: for a rate rho the largest a that (W.2) leaves, then the
  smallest w_f, over a grid of rho and b.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iblf_jax.certificates import claims
from iblf_jax.control.controllers import Backstepping
from iblf_jax.control.observers import Momentum
from iblf_jax.simulation.scenario import Scenario

SHARES = np.linspace(0.02, 0.98, 97)
"""Of the largest rate, and of the largest b that a rate leaves: where is looked."""


class Weights(NamedTuple):
    """The free numbers of the claim, and what follows from them."""

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


def is_stated(scenario: Scenario) -> bool:
    """Whether a scenario has the law and the observer that the claim is about, and a barrier that
    says how fast its V1 decays.
    """
    law = claims.law_of(scenario)
    if not isinstance(law, Backstepping) or not isinstance(scenario.observer, Momentum):
        return False
    return law.reading == "corrected" and not claims.why_no_claim(scenario)


def has_other_weights(scenario: Scenario) -> bool:
    """Whether the barriers' weights are others than the paper's, 1 on every joint."""
    weight = getattr(claims.law_of(scenario), "weight", None)
    return weight is not None and bool(np.any(np.asarray(weight) != 1.0))


def rate_terms(
    constants: claims.Claim, slowest: float, a: float, b: float, w_f: float
) -> np.ndarray:
    """The three terms of which rho is the least, (3,) [1/s].
    (W.2)

    Args:
      constants: gains and decay rates.
      slowest: mu, the smallest eigenvalue of M0^-1 K2, () [1/s].
      a, b, w_f: as at the head of this module.
    """
    decay, K2, kf = (np.asarray(x, float) for x in constants)
    return np.array(
        [
            np.min(decay),
            2.0 * (1.0 - a) * slowest,
            2.0 * np.min(kf - b / 2.0 - 0.25 / (a * K2 * w_f)),
        ]
    )


def best(
    constants: claims.Claim,
    slowest: float,
    V_rest: float,
    half_square: float,
    F_d: float,
    duration: float,
    case: int,
) -> Weights | None:
    """The weights with the smallest mean of the envelope (W.3) over a run; None if its numbers are
    not finite.

    Args:
      constants: gains and decay rates.
      slowest: mu over the run, () [1/s].
      V_rest: V_w(0) without f_tilde, () [N m rad].
      half_square: |f_tilde(0)|^2 / 2, () [(N m)^2].
      F_d: sup |f'|, () [N m/s].
      duration: of the run [s].
      case: 1 for f' = 0, 2 for bounded f'.
    """
    decay, K2, kf = (np.asarray(x, float) for x in constants)
    top = min(float(np.min(decay)), 2.0 * slowest, 2.0 * float(np.min(kf)))
    if not (np.all(np.isfinite([top, V_rest, half_square, F_d])) and top > 0):
        return None
    rho = top * SHARES[:, None]
    a = 1.0 - rho / (2.0 * slowest)
    b = 2.0 * (np.min(kf) - rho / 2.0) * (SHARES[None, :] if case == 2 else np.zeros((1, 1)))
    room = kf - (b + rho)[..., None] / 2.0
    w_f = np.max(0.25 / (a[..., None] * K2 * room), axis=-1)
    rho2 = w_f * F_d**2 / (2.0 * b) if case == 2 else np.zeros_like(w_f)
    fading = -np.expm1(-rho * duration) / (rho * duration)
    mean = (V_rest + w_f * half_square) * fading + rho2 / rho
    row, column = np.unravel_index(np.argmin(mean), mean.shape)
    return Weights(
        float(a[row, 0]),
        float(b[row, column]),
        float(w_f[row, column]),
        float(rho[row, 0]),
        float(rho2[row, column]),
    )
