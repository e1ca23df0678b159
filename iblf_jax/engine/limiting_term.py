"""Which term of a loop limits the sampling period or the time step.

A term of the loop is a leaf of the scenario: a gain of law or observer, the weight of the barrier,
the delay, or the time constant of a filter or a drive.  Each term is scaled by s = 2^(-1/2), 2^-1,
... at the same instants, while the others keep their values, until

    rho(s) < 1,   rho: the spectral radius of the map from one period to the next, or
                       dt |lambda|_max divided by the stability limit of the integrator

holds for one of them.  This term limits the loop, because it has to change least.  A term whose
scaling never helps, such as a gain K2 whose damping the loop needs, is not named.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers._base import law_member
from iblf_jax.core.pytree import unwrapped
from iblf_jax.engine.step_size import largest_eigenvalue, start_and_along
from iblf_jax.simulation.closed_loop import LoopState, initial_state, run_sampled_law
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.paths import get, parameters, with_parameters
from iblf_jax.simulation.scenario import Initial, Scenario
from iblf_jax.simulation.stability import jacobian, period_map

NUMBER_OF_SCALES = 14
"""Scales 2^(-k/2) that are tried, down to 1/128."""
INSTANTS = 4
"""States that are assessed together."""
LARGEST_XI = 0.98
"""|xi| up to which a state of the run counts: beyond it the guard is near, and every slope is
steep."""
WORDS = {
    "weight": "the slope of the barrier",
    "delay": "the delay",
    "filter": "the law's filter",
    "cutoff": "the filter of the velocity",
}
"""Name of a leaf -> the term of the loop that it sets."""
LAGS = {"sensor": "the filter of the velocity", "actuator": "the lag of the drive"}
"""Part of a scenario -> the term of the loop that its time constant sets."""
BANDWIDTHS = ("cutoff", "bandwidth")
"""Leaves of sensors and actuators whose reciprocal is a time constant."""


class Term(NamedTuple):
    """A term of the loop."""

    words: str
    path: str
    is_inverse: bool = False
    """Whether the leaf is divided where the term is scaled: a bandwidth, where the term is a
    lag."""


class Limit(NamedTuple):
    """The term that limits a loop."""

    term: Term
    scale: float
    """With the term scaled by this the loop is within its limit."""

    @property
    def advice(self) -> str:
        """What to change, in words."""
        if self.term.is_inverse:
            return (
                f"raise {self.term.path} to {_two_digits(1.0 / self.scale, math.ceil):g} times its"
                " value"
            )
        return f"lower {self.term.path} to {_two_digits(self.scale, math.floor):g} times its value"


def _two_digits(x: float, rounded: Callable[[float], int]) -> float:
    """A number with two digits, rounded to the side on which the loop is within its limit."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    return float(f"{rounded(x / unit) * unit:.2g}")


def limiting_term(run: Any) -> Limit | None:
    """The term that limits the loop of a run, or None if no single one brings it within its limit.

    Args:
      run: a `Rollout` of one run, its leaves numbers.
    """
    scenario = run.scenario
    relative_to_limit = _relative_to_limit(scenario, run)
    for times, states in _instants(scenario, run):
        if relative_to_limit(scenario, times, states) < 1.0:
            continue
        for k in range(1, NUMBER_OF_SCALES + 1):
            scale = 2.0 ** (-k / 2)
            found = {
                term: relative_to_limit(_scaled(scenario, term, scale), times, states)
                for term in terms_of(scenario)
            }
            least = min(found, key=found.__getitem__, default=None)
            if least is not None and found[least] < 1.0:
                return Limit(least, scale)
        return None
    return None


def terms_of(scenario: Scenario) -> Iterator[Term]:
    """The terms of a scenario's loop that are leaves."""
    law = unwrapped(scenario.controller)
    names = (*law_member(law, "gains"), *law_member(law, "unit_factors"), "c")
    of_law = {f"controller.{name}" for name in names}
    for parameter in parameters(scenario, named=False):
        part, _, rest = parameter.path.partition(".")
        name = rest.rpartition(".")[2]
        if not np.all(np.asarray(parameter.value) > 0):
            continue
        if parameter.path in of_law:
            yield Term(WORDS.get(name, f"the gain {name}"), parameter.path)
        elif parameter.path == "controller.filter":
            yield Term(WORDS[name], parameter.path, True)
        elif part == "observer" and parameter.unit in ("1/s", "1/s^2"):
            yield Term(f"the observer's gain {name}", parameter.path)
        elif parameter.path == "sampling.delay":
            yield Term(WORDS[name], parameter.path)
        elif part in ("sensor", "actuator") and name in BANDWIDTHS:
            yield Term(LAGS[part], parameter.path, True)


def _scaled(scenario: Scenario, term: Term, scale: float) -> Scenario:
    factor = 1.0 / scale if term.is_inverse else scale
    return with_parameters(scenario, {term.path: get(scenario, term.path) * factor})


def _relative_to_limit(
    scenario: Scenario, run: Any
) -> Callable[[Scenario, jax.Array, LoopState], float]:
    """The function that rates a loop at some instants, 1 at its limit: by the spectral radius of a
    sampled loop, else by the fastest mode times dt.
    """

    def radius(scenario: Scenario, times: jax.Array, states: LoopState) -> float:
        return largest_eigenvalue(np.asarray(_period_maps(scenario, times, states), float))

    def scaled_modes(scenario: Scenario, times: jax.Array, states: LoopState) -> float:
        modes = largest_eigenvalue(np.asarray(_jacobians(scenario, times, states), float))
        return float(run.dt) * modes / tableau(run.method).stability

    if scenario.sampling is None:
        return scaled_modes
    return radius


@jax.jit
def _period_maps(scenario: Scenario, times: jax.Array, states: LoopState) -> jax.Array:
    """The derivatives of the maps from one period to the next, (INSTANTS, m, m)."""

    def at(t: jax.Array, state: LoopState) -> jax.Array:
        draws = jnp.zeros((scenario.sensor.draws, scenario.n), t.dtype)
        state = run_sampled_law(scenario, t, state, draws)
        return period_map(scenario, state, jacobian(scenario, t, state))

    return jax.vmap(at)(times, states)


@jax.jit
def _jacobians(scenario: Scenario, times: jax.Array, states: LoopState) -> jax.Array:
    """The closed loop's Jacobians, (INSTANTS, m, m) [1/s]."""
    return jax.vmap(lambda t, state: jacobian(scenario, t, state))(times, states)


def _instants(scenario: Scenario, run: Any) -> Iterator[tuple[jax.Array, LoopState]]:
    """Times and states, one group after the other: the start and along the reference, and where the
    run was nearest to its bounds.

    What is unstable in the first group is so whatever the run does; a run that comes near a bound
    after that has steep slopes besides.
    """
    dtype = scenario.initial.q.dtype
    recorded = np.asarray(run.t)
    later = jnp.asarray(np.linspace(0.0, float(recorded[-1]), INSTANTS - 1), dtype)
    yield jnp.concatenate([jnp.zeros_like(later[:1]), later]), start_and_along(scenario, later)
    size = np.max(np.abs(np.asarray(run.xi)), axis=1)
    inside = np.flatnonzero(np.isfinite(size) & (size < LARGEST_XI))
    if not inside.size:
        return
    nearest = np.resize(inside[np.argsort(size[inside])[::-1]], INSTANTS)
    q, dq = (jnp.asarray(np.asarray(x)[nearest], dtype) for x in (run.q, run.dq))
    yield jnp.asarray(recorded[nearest], dtype), _states_at(scenario, q, dq)


@jax.jit
def _states_at(scenario: Scenario, q: jax.Array, dq: jax.Array) -> LoopState:
    """States of a loop that starts at these positions and velocities, (INSTANTS, ...)."""
    return jax.vmap(
        lambda q, dq: initial_state(dataclasses.replace(scenario, initial=Initial(q, dq)))
    )(q, dq)
