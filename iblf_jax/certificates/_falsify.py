"""Search for a start and gains at which the differential inequality of Theorem 2 is broken.

The inequality is a statement about states, so a counterexample is one state: the start of a scenario.  `falsify` climbs

    g(parameters) = (V2' + rho V2 - 1/2 |f'|^2) / V2       at t = 0,  rho of (3.27) with lambda_max(M0) of that position

over ranges of the scenario's parameters, from many starting points, with the exact gradient.  g is the rate by which V2 outruns
the claim; g > 0 breaks the inequality.  For the law and the observer as printed such starts exist: the terms dropped from the proof
grow with the cube of the joint velocity, what is there to cover them with its square.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax import checks
from iblf_jax.certificates import claims
from iblf_jax.certificates.box import maximise
from iblf_jax.certificates.evidence import evidence_at
from iblf_jax.closed_loop import initial_state
from iblf_jax.paths import get, with_parameters
from iblf_jax.scenario import Scenario, canonical


class Counterexample(NamedTuple):
    """The worst that `falsify` found."""

    scenario: Scenario
    parameters: dict[str, np.ndarray]
    """Path -> value."""
    excess: float
    """g, the rate by which V2 outruns the claim [1/s]; positive if the inequality is broken."""


def relative_excess(scenario: Scenario) -> jax.Array:
    """g = (V2' + rho V2 - 1/2 |f'|^2) / V2 at the start of a scenario, () [1/s].                              (3.26), (3.27)"""
    seen = evidence_at(scenario, jnp.zeros((), scenario.initial.q.dtype), initial_state(scenario))
    rho = claims.rho(claims.claim(scenario), seen.lambda_max, case=2)
    return (seen.dV + rho * seen.V - 0.5 * seen.df @ seen.df) / seen.V


def falsify(scenario: Scenario, ranges: Mapping[str, Any], *, starts: int = 16, seed: int = 0) -> Counterexample:
    """Climbs to the start and gains at which V2' + rho V2 - 1/2 |f'|^2 is largest relative to V2.                      (3.26)

    Args:
      scenario: a scenario for which Theorem 2 claims something.
      ranges: path -> (low, high), each a number or an array of the leaf's shape, in the leaf's unit; the start must be
        inside its bounds everywhere in the range of "initial.q".
      starts: from how many random points to climb.
      seed: of the random points.

    Returns:
      The worst that was found, a `Counterexample` if its `excess` is positive.

    Raises:
      ValueError: no claim to break, an unknown path, an empty range.
    """
    scenario = canonical(scenario)
    reason = claims.why_no_claim(scenario)
    if reason:
        raise checks.fail("scenario", type(scenario.controller).__name__, "a scenario with a claim", reason + ".")
    starts = checks.positive_integer("starts", starts)
    low, high, split = _flat_ranges(scenario, ranges)
    climb = jax.jit(jax.value_and_grad(lambda x: relative_excess(with_parameters(scenario, split(x)))))
    dtype = scenario.initial.q.dtype
    points = np.random.default_rng(seed).uniform(low, high, (starts, low.size))
    found = [maximise(lambda x: climb(jnp.asarray(x, dtype)), point, low, high) for point in points]
    excess, best = max(found, key=lambda pair: np.nan_to_num(pair[0], nan=-np.inf))
    values = {path: np.asarray(value) for path, value in split(best).items()}
    return Counterexample(with_parameters(scenario, values), values, excess)


def _flat_ranges(scenario: Scenario, ranges: Mapping[str, Any]):
    """Lower and upper ends as flat vectors, and the function that takes such a vector apart by path."""
    if not isinstance(ranges, Mapping) or not ranges:
        raise checks.fail("ranges", ranges, 'a mapping from path to (low, high), such as {"initial.dq": (-3, 3)}')
    lows, highs, shapes = [], [], {}
    for path, pair in ranges.items():
        shapes[path] = jnp.shape(get(scenario, path))
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise checks.fail(f"ranges[{path!r}]", pair, "(low, high)")
        low, high = (np.broadcast_to(np.asarray(end, float), shapes[path]) for end in pair)
        if not np.all(low <= high) or not np.all(np.isfinite(low)) or not np.all(np.isfinite(high)):
            raise checks.fail(f"ranges[{path!r}]", pair, "finite low <= high")
        lows.append(low.ravel())
        highs.append(high.ravel())
    sizes = [x.size for x in lows]
    return np.concatenate(lows), np.concatenate(highs), partial(_split, shapes=shapes, ends=np.cumsum(sizes)[:-1])


def _split(x, *, shapes: dict[str, tuple[int, ...]], ends: np.ndarray):
    """A flat vector as path -> array."""
    parts = jnp.split(jnp.asarray(x), ends)
    return {path: part.reshape(shape) for (path, shape), part in zip(shapes.items(), parts, strict=True)}
