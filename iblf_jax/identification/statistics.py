"""How well numbers are known: standard errors, what cannot be told, and whether what is left is
noise.

With A = sum_w A_w (`shooting`), in units of the numbers' scales, A = V diag(lambda) V^T: along v_i
the log knows the numbers to lambda_i^-1/2 of their scales.  1 / A is their covariance if what is
left is white and its size the same everywhere.  Whatever it is like,

    C' = (W - 1) / W sum_w (d_w - d)(d_w - d)^T,     d_w = (A - A_w)^-1 g_w: how far z moves when
    window w is left out

(the jackknife).  The standard error of a number is the larger of the two, and correlations are
those of 1 / A.  What a wrong model does is the same in every window, and in neither: where what is
left is clearly more than the noise of the positions, both are multiplied by how much.

Source: B. Efron, C. Stein, Ann. Statist. 9 (1981) 586-596; G. M. Ljung, G. E. P. Box, Biometrika 65
  (1978) 297-303.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

UNKNOWN = 0.5
"""Standard error, in scales, from which a number, or a combination of numbers, counts as not
told."""
FEWEST_WINDOWS = 4
"""Below which leaving out one window says nothing.  A few windows say it roughly, but counts of an
encoder are far from white: without it, 10 to 25 % of the numbers of 12 logs of 6 and 4 s, at 500 Hz
  and 14 bits, were more than three standard errors off."""
LAGS = 20
CLEAR = 0.1
"""Part of a direction's largest share from which a number is named in it."""


class Known(NamedTuple):
    """What a log tells of p numbers (the delay is one of them)."""

    errors: np.ndarray
    """Standard errors, (p,); infinite where a number cannot be told."""
    covariance: np.ndarray
    """(p, p); zero where a number cannot be told."""
    singular: np.ndarray
    """lambda^1/2, (p,), from the best known direction on; their inverse is the standard error along
    it, in scales."""
    directions: np.ndarray
    """One a column, (p, p), in scales."""
    widened: np.ndarray
    """By how much the jackknife's errors are larger than those of white noise, (p,), at least 1."""


def known(
    information: np.ndarray,
    scores: np.ndarray,
    prior: np.ndarray,
    scale: np.ndarray,
    lacking: float = 1.0,
) -> Known:
    """What windows tell.

    Args:
      information, scores: A_w (W, p, p) and g_w (W, p) by the numbers themselves.
      prior: precision that was known before, (p, p).
      scale: of each number, (p,).
      lacking: by how much what is left is more than noise, >= 1.
    """
    own, g = information * scale[:, None] * scale / lacking**2, scores * scale / lacking**2
    size, V = np.linalg.eigh(np.sum(own, axis=0) + prior * scale[:, None] * scale)
    order = np.argsort(size)[::-1]
    size, V = np.maximum(size[order], 1e-13 * size.max(initial=1e-300)), V[:, order]
    share = np.where(V**2 < 1e-10, 0.0, V**2)
    clear = size > UNKNOWN**-2
    inverse = (V[:, clear] / size[clear]) @ V[:, clear].T
    errors = np.sqrt(np.diag(inverse))
    spread = lacking * np.sqrt(
        np.maximum(np.diag(_left_out(own, g, V[:, clear], size[clear])), 0.0)
    )
    widened = np.where(errors > 0, np.maximum(1.0, spread / np.maximum(errors, 1e-300)), 1.0)
    told = np.sqrt(share @ (1.0 / size)) * widened < UNKNOWN
    covariance = (
        np.where(told[:, None] & told, inverse * widened[:, None] * widened, 0.0)
        * scale[:, None]
        * scale
    )
    return Known(
        np.where(told, errors * widened * scale, np.inf), covariance, np.sqrt(size), V, widened
    )


def _left_out(own: np.ndarray, g: np.ndarray, V: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The jackknife's covariance; zero where there are too few windows."""
    W = len(own)
    if W < FEWEST_WINDOWS:
        return np.zeros((len(V), len(V)))
    parts, pushes = V.T @ own @ V, g @ V
    moved = np.stack(
        [
            np.linalg.lstsq(np.diag(size) - part, push, rcond=1e-12)[0]
            for part, push in zip(parts, pushes, strict=True)
        ]
    )
    moved = (moved - moved.mean(axis=0)) @ V.T
    return (W - 1) / W * moved.T @ moved


def in_words(direction: np.ndarray, names: tuple[str, ...]) -> str:
    """A combination of numbers, each in its scale, by their paths: "0.71 plant.mass[0] - 0.70
    plant.inertia[0]".
    """
    most = np.max(np.abs(direction))
    chosen = [
        i for i in np.argsort(-np.abs(direction), kind="stable") if abs(direction[i]) > CLEAR * most
    ]
    sign = np.sign(direction[chosen[0]])
    words = [
        f"{'+' if sign * direction[i] > 0 else '-'} {abs(direction[i]):.2g} {names[i]}"
        for i in chosen
    ]
    return " ".join(words).removeprefix("+ ")


class Whiteness(NamedTuple):
    """Whether residuals of a joint are white."""

    correlations: np.ndarray
    """Autocorrelation at lags 1, 2, ..., (LAGS,)."""
    p: float
    """Probability of correlations as large if they are (Ljung and Box)."""


def whiteness(rest: np.ndarray) -> Whiteness:
    """Of the residuals of one joint, (W, K)."""
    from scipy.stats import chi2

    rest = rest - rest.mean()
    W, K = rest.shape
    lags = min(LAGS, K - 2)
    power = float(np.mean(rest**2)) or 1.0
    found = np.array(
        [
            np.sum(rest[:, lag:] * rest[:, :-lag]) / (W * (K - lag) * power)
            for lag in range(1, lags + 1)
        ]
    )
    Q = np.sum(found**2 * W * (K - np.arange(1, lags + 1)))
    return Whiteness(found, float(chi2.sf(Q, lags)))
