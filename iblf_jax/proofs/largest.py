"""The greatest level, the largest box of parameters, or the longest period of a sampled loop for
which `prove` finds a proof.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.proofs._prove import prove
from iblf_jax.proofs.result import Attempt, Proof
from iblf_jax.simulation import paths
from iblf_jax.simulation.sampling import Sampling
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.distributions import Perturbation, interval, is_interval

MAX_BOXES = 20_000_000
"""Boxes of each proof of a bisection, if the caller gives no number."""


def largest_level(
    scenario: Scenario,
    *,
    parameters: Mapping[str, Perturbation],
    between: tuple[float, float],
    accuracy: float = 0.05,
    max_boxes: int = MAX_BOXES,
    **options: Any,
) -> Proof:
    """Searches the greatest level c for which {V_w <= c} is proved to be invariant, by bisection.

    A level set may be invariant although a smaller one is not: the result is a level that is
    proved, next to one that is not.

    Args:
      scenario: the loop.
      parameters: path -> perturbation by an `interval`, as in `prove`.
      between: the least and the greatest level that are tried, in the unit of V_w.
      accuracy: ratio - 1 of the two levels at which the search ends [1].
      max_boxes: largest number of boxes of each proof.
      options: of `prove`; without `runs`, no attempt is made to refute the statement.

    Returns:
      The `Proof` of the greatest level that was proved, with all attempts in `history`; that of the
      least level if none was proved.

    Raises:
      ValueError: bad arguments, as in `prove`.

    Source: bisection.
    """
    given = {"runs": 0} | options

    def proof_at(level: float) -> Proof:
        return prove(scenario, level=level, parameters=parameters, max_boxes=max_boxes, **given)

    return _bisected("levels", proof_at, between, accuracy)


def largest_parameters(
    scenario: Scenario,
    *,
    level: float,
    parameters: Mapping[str, Perturbation],
    between: tuple[float, float] = (0.01, 1.0),
    accuracy: float = 0.05,
    max_boxes: int = MAX_BOXES,
    **options: Any,
) -> Proof:
    """Searches the largest factor of all intervals for which the level set is proved to be
    invariant, by bisection.

        [z0 + s (low - z0), z0 + s (high - z0)],   z0 the value that changes nothing

    Args:
      scenario: the loop.
      level: c, in the unit of V_w.
      parameters: path -> perturbation by an `interval`, at s = 1.
      between: the least and the greatest s that are tried [1].
      accuracy: ratio - 1 of the two factors at which the search ends [1].
      max_boxes: largest number of boxes of each proof.
      options: of `prove`; without `runs`, no attempt is made to refute the statement.

    Returns:
      The `Proof` of the largest box that was proved, with all attempts in `history`; that of the
      smallest box if none was proved.

    Raises:
      ValueError: bad arguments, as in `prove`.

    Source: bisection.
    """
    checks.mapping("parameters", parameters, '{"plant.mass": ij.factor(ij.interval(0.9, 1.1))}')
    if not parameters:
        remedy = "Without an uncertain parameter there is no box."
        raise checks.fail("parameters", parameters, "at least one interval", remedy)
    given = {"runs": 0} | options

    def proof_at(factor: float) -> Proof:
        narrowed = {
            path: scaled(scenario, path, perturbation, factor)
            for path, perturbation in parameters.items()
        }
        return prove(scenario, level=level, parameters=narrowed, max_boxes=max_boxes, **given)

    return _bisected("factors of the intervals", proof_at, between, accuracy)


def largest_period(
    scenario: Scenario,
    *,
    level: float,
    parameters: Mapping[str, Perturbation],
    between: tuple[float, float],
    accuracy: float = 0.05,
    max_boxes: int = MAX_BOXES,
    **options: Any,
) -> Proof:
    """Searches the longest period h of the samples for which the level set is proved to be
    invariant, by bisection.

    Each proof is about one period.  Those that were not tried are not covered, shorter ones
    included: the gain of the observer's step "poles" depends on the period.

    Args:
      scenario: the loop of a robot with a `Sampling`, whose period is replaced.
      level: c [N m rad].
      parameters: path -> perturbation by an `interval`, as in `prove`.
      between: the shortest and the longest period that are tried [s].
      accuracy: ratio - 1 of the two periods at which the search ends [1].
      max_boxes: largest number of boxes of each proof.
      options: of `prove`; without `runs`, no attempt is made to refute the statement.

    Returns:
      The `Proof` of the longest period that was proved, with all attempts in `history`; that of the
      shortest one if none was proved.

    Raises:
      ValueError: a scenario without a sampling, or bad arguments, as in `prove`.

    Source: bisection.
    """
    if not isinstance(scenario, Scenario):
        raise checks.fail("scenario", scenario, "a Scenario", "Make one with ij.presets.")
    sampling = scenario.sampling
    if sampling is None:
        remedy = 'Add one: sampling=ij.Sampling(period=1e-3, observer="poles").'
        raise checks.fail("scenario.sampling", None, "a Sampling", remedy)
    given = {"runs": 0} | options

    def proof_at(period: float) -> Proof:
        # A new one, whose queue is that of the period.
        changed = Sampling(period, sampling.delay, sampling.observer, trigger=sampling.trigger)
        loop = dataclasses.replace(scenario, sampling=changed)
        return prove(loop, level=level, parameters=parameters, max_boxes=max_boxes, **given)

    return _bisected("periods [s]", proof_at, between, accuracy)


def scaled(
    scenario: Scenario, path: str, perturbation: Perturbation, factor: float
) -> Perturbation:
    """A perturbation by an interval with all deviations multiplied by a factor."""
    if not is_interval(perturbation):
        remedy = "Make one with ij.factor(ij.interval(low, high)), for example."
        raise checks.fail(f"parameters[{path!r}]", perturbation, "an interval", remedy)
    neutral: Any = {"factor": 1.0, "offset": 0.0}.get(perturbation.kind)
    if neutral is None:
        neutral = np.asarray(paths.get(scenario, path.split(",")[0].strip()))
    low, high = (neutral + factor * (end - neutral) for end in perturbation.distribution.support())
    return dataclasses.replace(perturbation, distribution=interval(low, high))


def _bisected(
    searched: str, proof_at: Callable[[float], Proof], between: Sequence[float], accuracy: float
) -> Proof:
    """The proof at the greatest value, within the accuracy, by bisection of the logarithm.

    Args:
      searched: the values in words, with their unit.
      proof_at: value -> proof.
      between: the least and the greatest value.
      accuracy: ratio - 1 of the two values at which the search ends [1].
    """
    low, high = ends_of("between", between)
    accuracy = checks.positive_number("accuracy", accuracy, "1")
    history = []

    def tried(value: float) -> Proof:
        found = proof_at(value)
        history.append(Attempt(value, found.verdict, found.boxes, found.seconds))
        return found

    best = tried(low)
    if best.proved and (top := tried(high)).proved:
        best, low = top, high
    while best.proved and high > (1.0 + accuracy) * low:
        middle = math.sqrt(low * high)
        found = tried(middle)
        if found.proved:
            best, low = found, middle
        else:
            high = middle
    return dataclasses.replace(best, history=tuple(history), searched=searched)


def ends_of(field: str, between: object) -> tuple[float, float]:
    """Two positive numbers in ascending order; ValueError for anything else."""
    ends = np.asarray(checks.as_floats(field, between), float)
    if ends.shape != (2,) or not 0.0 < ends[0] < ends[1] < math.inf:
        raise checks.fail(field, between, "two positive numbers in ascending order")
    return float(ends[0]), float(ends[1])
