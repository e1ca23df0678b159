"""Finds the term of a loop that limits the sampling period or the time step.

A term of the loop is a leaf of the scenario: a gain of law or observer, the weight of the barrier,
the delay, or the time constant of a filter or a drive.  Each term is scaled separately by
s = 2^(-1/2), 2^-1, ..., until

    rho(s) < 1,   rho: the spectral radius of the map from one period to the next, or
                       dt |lambda|_max divided by the stability limit of the integrator

holds for one of them at the assessed instants.  This term limits the loop, because it has to change
least.  A term that no scale makes stable, such as a gain K2 whose damping the loop needs, does not
limit it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import programs
from iblf_jax.core.pytree import unwrapped
from iblf_jax.engine.step_size import largest_eigenvalue, start_and_along
from iblf_jax.simulation.closed_loop import LoopState, initial_state, run_sampled_law
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.paths import get, parameters, with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.stability import jacobian, period_map

if TYPE_CHECKING:
    from iblf_jax.simulation.results import Rollout


NUMBER_OF_SCALES = 14
"""Scales 2^(-k/2) that are tried, down to 1/128."""
INSTANTS = 4
"""States that are assessed in one batch."""
LARGEST_XI = 0.98
"""Largest |xi| of an assessed state of the run.  Near the guard every slope is steep."""
TERMS = {
    "weight": "the slope of the barrier",
    "delay": "the delay",
    "filter": "the law's filter",
    "cutoff": "the filter of the velocity",
}
"""Name of a leaf -> the term of the loop, in words."""
LAGS = {"sensor": "the filter of the velocity", "actuator": "the lag of the drive"}
"""Part of a scenario -> the lag of this part, in words."""
BANDWIDTHS = ("cutoff", "bandwidth")
"""Leaves of sensors and actuators whose reciprocal is the time constant of a lag."""


class Term(NamedTuple):
    """A term of the loop."""

    words: str
    path: str
    is_reciprocal: bool = False
    """Whether the leaf is the reciprocal of the term, as a bandwidth is of a time constant."""


class Limit(NamedTuple):
    """The term that limits a loop."""

    term: Term
    scale: float
    """A scale of the term at which the loop is stable."""

    @property
    def advice(self) -> str:
        """How to change the leaf, in words."""
        if self.term.is_reciprocal:
            return (
                f"raise {self.term.path} to {_two_digits(1.0 / self.scale, math.ceil):g} times its"
                " value"
            )
        return f"lower {self.term.path} to {_two_digits(self.scale, math.floor):g} times its value"


def _two_digits(x: float, rounding: Callable[[float], int]) -> float:
    """A number with two significant digits; `rounding` is `math.floor` or `math.ceil`."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    return float(f"{rounding(x / unit) * unit:.2g}")


def limiting_term(run: Rollout) -> Limit | None:
    """The term that limits the loop of a run; None if the loop is stable, or no single term does.

    Args:
      run: a `Rollout` of one run, with concrete numbers.
    """
    scenario = run.scenario
    relative_to_limit = _relative_to_limit(scenario, run)
    for times, states in _instants(scenario, run):
        if relative_to_limit(scenario, times, states) < 1.0:
            continue
        for k in range(1, NUMBER_OF_SCALES + 1):
            scale = 2.0 ** (-k / 2)
            ratings = {
                term: relative_to_limit(_scaled(scenario, term, scale), times, states)
                for term in terms_of(scenario)
            }
            stable = [term for term, rating in ratings.items() if rating < 1.0]
            if stable:
                return Limit(min(stable, key=ratings.__getitem__), scale)
        return None
    return None


def terms_of(scenario: Scenario) -> Iterator[Term]:
    """The terms of a scenario's loop that are leaves."""
    law = unwrapped(scenario.controller)
    # Scaling the weights of all levels scales V, and no term of the loop.
    names = {*law.gains, *law.factors, "c"} - {"weights"}
    of_law = {f"controller.{name}" for name in names}
    for parameter in parameters(scenario, named=False):
        part, _, rest = parameter.path.partition(".")
        name = rest.rpartition(".")[2]
        if not np.all(np.asarray(parameter.value) > 0):
            continue
        if parameter.path in of_law:
            yield Term(TERMS.get(name, f"the gain {name}"), parameter.path)
        elif parameter.path == "controller.filter":
            yield Term(TERMS[name], parameter.path, is_reciprocal=True)
        elif part == "observer" and parameter.unit in ("1/s", "1/s^2"):
            yield Term(f"the observer's gain {name}", parameter.path)
        elif parameter.path == "sampling.delay":
            yield Term(TERMS[name], parameter.path)
        elif part in LAGS and name in BANDWIDTHS:
            yield Term(LAGS[part], parameter.path, is_reciprocal=True)


def _scaled(scenario: Scenario, term: Term, scale: float) -> Scenario:
    """The scenario with one of its terms scaled."""
    factor = 1.0 / scale if term.is_reciprocal else scale
    return with_parameters(scenario, {term.path: get(scenario, term.path) * factor})


def _relative_to_limit(
    scenario: Scenario, run: Rollout
) -> Callable[[Scenario, jax.Array, LoopState], float]:
    """A function that rates a loop at some instants, 1 at its limit of stability.

    It is the spectral radius of a sampled loop; otherwise the fastest mode times dt, relative to
    the stability limit of the integrator.
    """

    def radius(scenario: Scenario, times: jax.Array, states: LoopState) -> float:
        return largest_eigenvalue(np.asarray(_period_maps(scenario, times, states), float))

    def fastest_mode(scenario: Scenario, times: jax.Array, states: LoopState) -> float:
        mode = largest_eigenvalue(np.asarray(_jacobians(scenario, times, states), float))
        return float(run.dt) * mode / tableau(run.method).stability

    if scenario.sampling is None:
        return fastest_mode
    return radius


@programs.jit(options=programs.SHORTEST_TO_COMPILE)
def _period_maps(scenario: Scenario, times: jax.Array, states: LoopState) -> jax.Array:
    """The derivatives of the maps from one period to the next, (INSTANTS, m, m)."""

    def at(t: jax.Array, state: LoopState) -> jax.Array:
        draws = jnp.zeros((scenario.sensor.draws, scenario.n), t.dtype)
        state = run_sampled_law(scenario, t, state, draws)
        return period_map(scenario, state, jacobian(scenario, t, state))

    return jax.vmap(at)(times, states)


@programs.jit(options=programs.SHORTEST_TO_COMPILE)
def _jacobians(scenario: Scenario, times: jax.Array, states: LoopState) -> jax.Array:
    """The closed loop's Jacobians, (INSTANTS, m, m) [1/s]."""
    return jax.vmap(lambda t, state: jacobian(scenario, t, state))(times, states)


def _instants(scenario: Scenario, run: Rollout) -> Iterator[tuple[jax.Array, LoopState]]:
    """Two groups of times and states: the start and along the reference, and where the run was
    nearest to its bounds.

    The first group does not depend on the course of the run, so it is assessed first: an unstable
    run comes near its bounds, where slopes are steep in addition.
    """
    dtype = scenario.initial.q.dtype
    recorded = np.asarray(run.t)
    later = jnp.asarray(np.linspace(0.0, float(recorded[-1]), INSTANTS - 1), dtype)
    yield jnp.concatenate([jnp.zeros_like(later[:1]), later]), start_and_along(scenario, later)
    xi = np.max(np.abs(np.asarray(run.xi)), axis=1)
    inside = np.flatnonzero(np.isfinite(xi) & (xi < LARGEST_XI))
    if not inside.size:
        return
    by_decreasing_xi = inside[np.argsort(xi[inside])[::-1]]
    nearest = np.resize(by_decreasing_xi, INSTANTS)
    x = jnp.asarray(np.asarray(run.x)[nearest], dtype)
    yield jnp.asarray(recorded[nearest], dtype), _states_at(scenario, x)


@programs.jit(options=programs.SHORTEST_TO_COMPILE)
def _states_at(scenario: Scenario, x: jax.Array) -> LoopState:
    """Initial states of a loop at these states of the plant, (INSTANTS, r, n)."""
    return jax.vmap(lambda x: initial_state(dataclasses.replace(scenario, initial=Initial(x=x))))(x)
