"""`recommended_period`: the longest period at which a sampled loop is stable.

The spectral radius of the map from one period to the next decides.  It is computed at the start and
along the reference, and the largest value grows past 1 at some period.  The period is an input of
the compiled map, which has room for the commands in transit at the shortest period, so the search
compiles once.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices, programs
from iblf_jax.core.progress import announced
from iblf_jax.engine.execute import sampled_jacobians
from iblf_jax.engine.step_size import MODE_INSTANTS, largest_eigenvalue, round_down, start_and_along
from iblf_jax.simulation.closed_loop import LoopState, run_sampled_law
from iblf_jax.simulation.sampling import Sampling, commands_in_transit
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.simulation.stability import (
    continuous_map,
    growth_by_sampling,
    period_map,
)

SHORTEST_PERIOD, LONGEST_PERIOD = 1e-5, 0.2
"""Shortest and longest period that is tried [s]."""
PERIOD_RATIO = 2 ** (1 / 3)
"""Ratio of two periods that are tried one after the other; then the interval is halved."""
HALVINGS = 8
MAX_COMMANDS_IN_TRANSIT = 6
"""Commands in transit at the shortest period that is tried, at most."""


RADIUS_RANGE, MARGIN_RANGE = (1e-3, 10.0), (1.0, 1000.0)
"""Spectral radii and margins that are accepted [1]."""


def radius_at(scenario: Scenario, period: float, times: np.ndarray) -> float:
    """The largest spectral radius of the map from a period to the next, at the start and along the
    reference [1], relative to the slow growth that the loop has at any period
    (`stability.growth_by_sampling`).

    Args:
      scenario: canonical, with a sampling.  Periods that need no more commands in transit than its
        queue holds share one compiled map.
      period: that it has instead of its own [s].
      times: along the reference [s].
    """
    sampling: Any = scenario.sampling
    dtype = scenario.initial.q.dtype
    in_transit = commands_in_transit(float(sampling.delay), period)
    queue = max(sampling.queue, in_transit)
    changed = dataclasses.replace(sampling, period=jnp.asarray(period, dtype), queue=queue)
    changed_scenario = dataclasses.replace(scenario, sampling=changed)
    instants = jnp.asarray(np.concatenate([[0.0], times]), dtype)
    states = _sampled_states(changed_scenario, instants)
    derivatives = sampled_jacobians(changed_scenario, instants, states)
    maps, continuous = (
        np.asarray(each, float) for each in _maps(changed_scenario, states, derivatives)
    )
    # The last rows and columns belong to commands that are never in transit.
    size = maps.shape[-1] - (queue - in_transit) * scenario.n
    return max(
        float(growth_by_sampling(largest_eigenvalue(one), largest_eigenvalue(other), period))
        for one, other in zip(maps[:, :size, :size], continuous, strict=True)
    )


@programs.jit(options=programs.SHORTEST_TO_COMPILE, kept=True)
def _sampled_states(scenario: Scenario, instants: jax.Array) -> LoopState:
    """The states at the start and along the reference after the law has run, (T, ...): the torque
    of an instant is the one that the law commands there.
    """

    def sampled(t: jax.Array, state: LoopState) -> LoopState:
        no_noise = jnp.zeros((scenario.sensor.draws, scenario.n), t.dtype)
        return run_sampled_law(scenario, t, state, no_noise)

    return jax.vmap(sampled)(instants, start_and_along(scenario, instants[1:]))


@programs.jit(options=programs.SHORTEST_TO_COMPILE, kept=True)
def _maps(
    scenario: Scenario, states: LoopState, derivatives: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The derivatives of the period maps, (T, m, m), and the maps of the same loops in continuous
    time, (T, k, k).
    """

    def at(state: LoopState, derivative: jax.Array) -> tuple[jax.Array, jax.Array]:
        return (
            period_map(scenario, state, derivative),
            continuous_map(scenario, state, derivative),
        )

    return jax.vmap(at)(states, derivatives)


@notices.each_warning_once
@announced("searching for the longest stable sampling period")
def recommended_period(
    scenario: Scenario, *, duration: float = 20.0, radius: float = 1.0, margin: float = 2.0
) -> float:
    """A round period [s] that a law may run at: the loop would still be stable at `margin` times
    it.

        rho( d x(t_(k+1)) / d x(t_k) ) < radius,   x: plant, sensor, law, observer, actuator,
        commands under way

    at the start and along the reference, for every period up to margin times the one that is
    returned.  Slow growth that the loop has in continuous time as well, at one of these instants,
    does not count.  The condition is necessary, not sufficient: it takes account neither of noise
    nor of the distance to the bounds.  The period is rounded down to 1, 2 or 5 times a power of
    ten.

    Args:
      scenario: the loop; its delay [s], sensor and actuator count, its own period does not.
      duration: of the reference along which the map is computed [s].
      radius: spectral radius from which on a period is too long [1].
      margin: how much longer a period may be before the loop is that slow, >= 1 [1].

    Returns:
      The period [s].

    Raises:
      ValueError: bad arguments, or a loop that is too slow at every period from 10 us on (its delay
        is too long, say).

    Source: K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, 3rd ed. 1997, chapter 3.
    """
    duration = checks.time_span("duration", duration)
    remedy = "A loop is stable below a spectral radius of 1."
    radius = checks.number_between("radius", radius, *RADIUS_RANGE, "1", remedy)
    margin = checks.number_between("margin", margin, *MARGIN_RANGE, "1")
    if isinstance(scenario, Scenario) and scenario.sampling is None:
        scenario = dataclasses.replace(scenario, sampling=Sampling(period=1e-3))
    scenario = canonical(scenario)
    if not checks.is_concrete(scenario):
        raise checks.fail(
            "scenario", "traced values", "numbers", "Call it outside of jit, vmap and grad."
        )
    times = np.linspace(0.0, duration, MODE_INSTANTS)
    limit = _limit(scenario, times, radius)
    if limit is None:
        raise checks.fail(
            "scenario",
            "a loop that is unstable at every period",
            "one that some period keeps stable",
            "Shorten its delay.",
        )
    return round_down(limit / margin)


def _limit(scenario: Scenario, times: np.ndarray, radius: float) -> float | None:
    """The shortest period at which the loop is too slow; LONGEST_PERIOD if none is, None if all
    are.
    """
    sampling: Any = scenario.sampling
    delay = float(sampling.delay)
    low, high = None, max(SHORTEST_PERIOD, delay / MAX_COMMANDS_IN_TRANSIT)
    # One map is compiled for all periods: the shortest has the most commands in transit.
    first = dataclasses.replace(
        sampling,
        period=jnp.asarray(high, scenario.initial.q.dtype),
        queue=commands_in_transit(delay, high),
    )
    scenario = dataclasses.replace(scenario, sampling=first)
    while high <= LONGEST_PERIOD and radius_at(scenario, high, times) < radius:
        low, high = high, high * PERIOD_RATIO
    if low is None or high > LONGEST_PERIOD:
        return low
    for _ in range(HALVINGS):
        middle = math.sqrt(low * high)
        if radius_at(scenario, middle, times) < radius:
            low = middle
        else:
            high = middle
    return low
