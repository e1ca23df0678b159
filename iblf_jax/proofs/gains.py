"""Gains for which a level set is proved to be invariant.

The largest V_w' that is found on a level set is a function of the gains that costs a few thousand
evaluations of V_w'.  `gains_for_guarantee` minimises it over gains and weight, and proves the
result.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.core.presentation import Content, Result
from iblf_jax.proofs._prove import problem_of, prove, weights_of
from iblf_jax.proofs.largest import ends_of
from iblf_jax.proofs.points import sample_weights
from iblf_jax.proofs.result import Proof
from iblf_jax.simulation.paths import get, with_parameters
from iblf_jax.simulation.scenario import HOW_TO_MAKE, Scenario
from iblf_jax.studies.distributions import Perturbation

TRIES = 60
"""Gains that are tried, if the caller gives no number."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class GuaranteedGains(Result):
    """Gains with the least largest V_w' on a level set, and the proof."""

    scenario: Scenario
    """With the gains in it."""
    gains: dict[str, float]
    """Path -> value."""
    rate: float
    """The largest V_w' that was found, in the unit of V_w per second."""
    rate_before: float
    """The same for the scenario that was given."""
    tries: int
    """Number of gains that were tried."""
    proof: Proof

    def _content(self) -> Content:
        gains = ", ".join(f"{path} = {value:.4g}" for path, value in self.gains.items())
        found = (
            f"Gains {gains}: largest V_w' found {self.rate:+.4g}, before"
            f" {self.rate_before:+.4g} ({self.tries} tries)."
        )
        return [found, *self.proof._content()]


def gains_for_guarantee(
    scenario: Scenario,
    gains: Mapping[str, tuple[float, float]],
    *,
    level: float,
    parameters: Mapping[str, Perturbation],
    tries: int = TRIES,
    duration: float | None = None,
    disturbance_rate: ArrayLike | None = None,
    seed: int = 0,
    **options: Any,
) -> GuaranteedGains:
    """Chooses gains for which {V_w <= level} decreases fastest where it decreases least, and proves
    the result.

        min over gains and w of  max V_w'  on V_w = level and the box of parameters

    The maximum is that of random points which a search improves (`prove`, step 1), so that only the
    proof at the end is a guarantee.  Gains are searched on a logarithmic scale by the method of
    Nelder and Mead, from the given ones.

    Args:
      scenario: the loop with the gains from which the search starts.
      gains: path -> its least and its greatest value, such as {"controller.K2": (1.0, 20.0)}; all
        entries of a vector are equal.
      level: c, in the unit of V_w.
      parameters: path -> perturbation by an `interval`, as in `prove`.
      tries: number of gains that are tried.
      duration: as in `prove`.
      disturbance_rate: as in `prove`.
      seed: of the random points.
      options: further options of `prove`.

    Returns:
      The gains and the proof.

    Raises:
      ValueError: bad arguments, as in `prove`.

    Source: J. A. Nelder, R. Mead, The Computer Journal 7 (1965) 308-313.
    """
    if not isinstance(scenario, Scenario):
        raise checks.fail("scenario", scenario, "a Scenario", HOW_TO_MAKE)
    limits = _limits(gains)
    tries = checks.positive_integer("tries", tries, most=100_000)
    uncertain = (parameters, duration, disturbance_rate)
    found = _Search(scenario, limits, level, uncertain, seed).best(tries)
    proof = prove(
        found.scenario,
        level=level,
        parameters=parameters,
        duration=duration,
        disturbance_rate=disturbance_rate,
        seed=seed,
        **options,
    )
    values = {path: float(np.ravel(get(found.scenario, path))[0]) for path in limits}
    return GuaranteedGains(
        found.scenario, values, found.rate, found.rate_before, found.tries, proof
    )


class _Found(NamedTuple):
    """The result of a search."""

    scenario: Scenario
    rate: float
    rate_before: float
    tries: int


class _Search(NamedTuple):
    """The search over gains and weight, as numbers u in [0, 1] on a logarithmic scale."""

    scenario: Scenario
    limits: dict[str, tuple[float, float]]
    level: float
    uncertain: tuple[Mapping[str, Perturbation], float | None, Any]
    """Parameters, duration and bound of the rate of a further disturbance, as `prove` takes
    them."""
    seed: int

    def at(self, u: np.ndarray) -> tuple[Scenario, float]:
        """The scenario and the weight."""
        low, high = np.log(np.array(list(self.limits.values()))).T
        values = map(float, np.exp(low + u[:-1] * (high - low)))
        candidate = with_parameters(self.scenario, dict(zip(self.limits, values, strict=True)))
        weights = weights_of(candidate, None)
        return candidate, float(weights[0] * (weights[-1] / weights[0]) ** u[-1])

    def rates(self, scenario: Scenario, weights: Sequence[float]) -> list[float]:
        """The largest V_w' that is found at each weight."""
        problem = problem_of(scenario, *self.uncertain)
        return [x.largest for x in sample_weights(problem, self.level, weights, self.seed)]

    def rate_at(self, u: np.ndarray) -> float:
        """The largest V_w' that is found."""
        candidate, weight = self.at(u)
        return self.rates(candidate, [weight])[0]

    def best(self, tries: int) -> _Found:
        """The gains with the least rate, by the method of Nelder and Mead."""
        from scipy.optimize import minimize

        before = self.rates(self.scenario, weights_of(self.scenario, None))
        start = [_place(self.scenario, path, ends) for path, ends in self.limits.items()]
        start.append(float(np.clip(np.argmin(before) / (len(before) - 1), 0.05, 0.95)))
        found = minimize(
            self.rate_at,
            start,
            method="Nelder-Mead",
            bounds=[(0.0, 1.0)] * len(start),
            options={"maxfev": tries, "xatol": 1e-3, "fatol": 1e-4 * self.level},
        )
        scenario, _ = self.at(found.x)
        return _Found(scenario, float(found.fun), min(before), int(found.nfev))


def _limits(gains: object) -> dict[str, tuple[float, float]]:
    """Path -> ends, checked."""
    example = '{"controller.K2": (1.0, 20.0)}'
    limits = {}
    for path, ends in checks.mapping("gains", gains, example).items():
        limits[path] = ends_of(f"gains[{path!r}]", ends)
    if not limits:
        raise checks.fail("gains", gains, f"at least one gain, such as {example}")
    return limits


def _place(scenario: Scenario, path: str, ends: tuple[float, float]) -> float:
    """The place of a gain between its ends on a logarithmic scale, away from them."""
    value = float(np.mean(np.asarray(get(scenario, path))))
    share = np.log(max(value, ends[0]) / ends[0]) / np.log(ends[1] / ends[0])
    return float(np.clip(share, 0.05, 0.95))
