"""Search for a start and gains at which the differential inequality of Theorem 2 is broken.

The inequality is a statement about states, so a counterexample is one state: the start of a scenario.  The proof leaves

    V2' - 1/2 |f'|^2 <= -Q,   Q = sum_i rate_i V1_i + e2^T (K2 - I/2) e2 + f_tilde^T (kf - I) f_tilde >= rho V2,           (3.24)

and `falsify` climbs  g = (V2' - 1/2 |f'|^2) / Q  at t = 0 over ranges of the scenario's parameters, from many starting points, with
the exact gradient.  Where the proof is exact g never exceeds -1, whatever is varied.  g > -1 breaks (3.24); g > 0 breaks the claim
itself, (3.18) and (3.26) for every rho > 0: V2 grows where the theorem has it fall.  For law and observer as printed such starts exist,
because the terms dropped from the proof grow with the cube of the joint velocity, and Q with its square.

What cannot be run (a start outside its bounds, a negative mass) and where nothing is claimed (the guard or a torque limit at work) is no
counterexample: such points are passed over.
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
from iblf_jax.certificates.box import admissible_points, maximise
from iblf_jax.certificates.evidence import evidence_at
from iblf_jax.closed_loop import initial_state
from iblf_jax.paths import get, why_inadmissible, with_parameters
from iblf_jax.scenario import Scenario, canonical


class Counterexample(NamedTuple):
    """The worst that `falsify` found."""

    scenario: Scenario
    parameters: dict[str, np.ndarray]
    """Path -> value."""
    growth: float
    """g, largest found; at most -1 where the proof is exact, positive where V2 grows against the claim."""


def relative_growth(scenario: Scenario) -> jax.Array:
    """The growth g = (V2' - 1/2 |f'|^2) / Q at the start of a scenario, ().                                                       (3.24)"""
    return _growth(scenario)[0]


def _growth(scenario: Scenario) -> tuple[jax.Array, jax.Array]:
    """The growth at the start, and whether the guard or a torque limit is at work there."""
    seen = evidence_at(scenario, jnp.zeros((), scenario.initial.q.dtype), initial_state(scenario))
    constants = claims.claim(scenario)
    M0 = scenario.model.mass_matrix(scenario.initial.q)
    V1 = seen.V - 0.5 * (seen.e2 @ (M0 @ seen.e2) + seen.f_tilde @ seen.f_tilde)
    by_e2 = seen.e2 @ ((constants.K2 - claims.LOWEST_K2) * seen.e2)
    by_f = seen.f_tilde @ ((constants.kf - claims.LOWEST_KF[2]) * seen.f_tilde)
    return (seen.dV - 0.5 * seen.df @ seen.df) / (jnp.min(constants.decay) * V1 + by_e2 + by_f), seen.held


def falsify(scenario: Scenario, ranges: Mapping[str, Any], *, starts: int = 16, seed: int = 0) -> Counterexample:
    """Climbs to the start and gains at which V2' - 1/2 |f'|^2 is largest relative to -Q of the proof.                    (3.24)

    Args:
      scenario: a scenario for which Theorem 2 claims something.
      ranges: path -> (low, high), each a number or an array of the leaf's shape, in the leaf's unit; what is inadmissible in them
        (a start outside its bounds) is passed over.
      starts: from how many random points to climb.
      seed: of the random points.

    Returns:
      The worst that was found, a `Counterexample` if its `growth` is positive; its scenario can be run.

    Raises:
      ValueError: no claim to break, an unknown path, an empty range, ranges in which nothing admissible was found.
    """
    scenario = canonical(scenario)
    reason = claims.why_no_claim(scenario)
    if reason:
        raise checks.fail("scenario", type(scenario.controller).__name__, "a scenario with a claim", reason + ".")
    starts, seed = checks.positive_integer("starts", starts), checks.positive_integer("seed", seed, least=0, most=2**32 - 1)
    low, high, split = _flat_ranges(scenario, ranges)
    checks.fits("starts", starts, 8.0 * 2 * low.size)
    dtype = scenario.initial.q.dtype

    def at(unit):
        """Path -> value at a point of the unit cube, in which the ranges are climbed."""
        return split(low + (high - low) * unit)

    growth = jax.jit(jax.value_and_grad(lambda unit: _growth(with_parameters(scenario, at(unit))), has_aux=True))
    best = (-np.inf, np.zeros(0))

    def seen(unit):
        """Why a point is no answer, g and its gradient there; the best point is kept."""
        nonlocal best
        why = why_inadmissible(scenario, at(unit))
        if why:
            return why, -np.inf, np.zeros(low.size)
        (g, held), slope = growth(jnp.asarray(unit, dtype))
        if held or not np.isfinite(g):
            return "The guard or a torque limit is at work at the start, where nothing is claimed.", -np.inf, np.zeros(low.size)
        best = max(best, (float(g), unit.copy()), key=lambda pair: pair[0])
        return "", float(g), np.asarray(slope)

    def climb(unit, worse):
        """What the ascent sees: beyond what is admissible a plain below its start, from which the line search turns back."""
        why, g, slope = seen(unit)
        return (worse, slope) if why else (g, slope)

    points = admissible_points("ranges", dict(ranges), starts, low.size, seed, lambda unit: seen(unit)[0])
    for point in points:
        worse = seen(point)[1] - 1.0
        maximise(lambda unit, worse=worse: climb(unit, worse), point, np.zeros(low.size), np.ones(low.size))
    values = {path: np.asarray(value) for path, value in at(best[1]).items()}
    return Counterexample(with_parameters(scenario, values), values, best[0])


def _flat_ranges(scenario: Scenario, ranges: Mapping[str, Any]):
    """Lower and upper ends as flat vectors, and the function that takes such a vector apart by path."""
    if not isinstance(ranges, Mapping) or not ranges:
        raise checks.fail("ranges", ranges, 'a mapping from path to (low, high), such as {"initial.dq": (-3, 3)}')
    lows, highs, shapes = [], [], {}
    for path, pair in ranges.items():
        shapes[path] = jnp.shape(get(scenario, path))
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise checks.fail(f"ranges[{path!r}]", pair, "(low, high)")
        low, high = (np.asarray(checks.as_floats(f"ranges[{path!r}]", end), float) for end in pair)
        if any(end.shape not in ((), shapes[path]) for end in (low, high)):
            raise checks.fail(f"ranges[{path!r}]", pair, f"one number, or shape {shapes[path]}, for each end")
        low, high = (np.broadcast_to(end, shapes[path]) for end in (low, high))
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
