"""The outcome of a run: records, metrics and status flags, with the assessment of the time step."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.pytree import is_absent
from iblf_jax.core.status import Status, flag, has_flag
from iblf_jax.engine.carry import Carry, Inputs
from iblf_jax.engine.linearization import Linearization, fastest_mode
from iblf_jax.engine.metric_folds import finished
from iblf_jax.simulation import error_estimate, error_growth, integrators, stability
from iblf_jax.world import plants


class Outcome(NamedTuple):
    """What the time loop returns."""

    records: Any
    metrics: dict[str, jax.Array]
    status: jax.Array
    fastest_mode: jax.Array


def outcome_of(
    inputs: Inputs,
    method: str,
    carry: Carry,
    unresolved: error_estimate.UnresolvedSignals,
    instants: Linearization,
) -> Outcome:
    """The folds' results and the accuracy, and the status with the verdict on the step.

    Args:
      inputs: of the run.
      method: the integrator.
      carry: after the last step.
      unresolved: the unresolved signals of the run, as accelerations.
      instants: linearizations at the start, at the instant nearest to a bound and at the end of the
        run, (3, ...).
    """
    scenario = inputs.scenario
    accuracy = error_estimate.with_unresolved(carry.accuracy, unresolved)
    maps: jax.Array | None = None
    rounding: dict[str, jax.Array] = {}
    if inputs.scenario.sampling is not None:
        maps = _period_maps(inputs, carry, instants)
    if not is_absent(accuracy.error_growth):
        bounds = _bounds_of_growth(inputs, carry, instants, maps)
        accuracy, rounding = error_growth.with_growth(accuracy, bounds, unresolved.width)
    modes = jax.vmap(partial(fastest_mode, inputs.scenario))(instants)
    mode = jnp.max(jnp.where(jnp.isfinite(modes), modes, 0.0))
    limit = integrators.tableau(method).stability
    status = carry.status | flag(inputs.dt * mode > limit, Status.STEP_TOO_LARGE)
    # A column is at least as long as the mode that it alone would make.
    steepest = jnp.sum(jnp.abs(instants.jacobian[:, 0]), axis=-2)
    steep = stability.has_infinite_derivative(
        instants.jacobian, inputs.scenario.sampling is not None
    ) & (inputs.dt * steepest > limit)
    if scenario.process_noise is None:
        status |= flag(~(accuracy.relative <= error_estimate.TOLERANCE), Status.INACCURATE)
    suffers = has_flag(status, Status.STEP_TOO_LARGE | Status.INACCURATE)
    status |= flag(jnp.any(steep) & suffers, Status.INFINITE_SLOPE)
    metrics = error_estimate.results(accuracy)
    if scenario.process_noise is not None:
        metrics = error_estimate.unknown(metrics)
    plant: Any = scenario.plant
    if plants.has_modes(plant):
        end = inputs.dt * inputs.steps
        metrics |= plant.switching(end)
        status |= flag(~plant.has_complete_path(end), Status.MODES_EXHAUSTED)
    if maps is not None:
        found = _sampling_radii(inputs, carry, instants, maps)
        radii, growth_by_sampling = jax.lax.stop_gradient(found)
        metrics[stability.RADIUS] = jnp.max(jnp.where(jnp.isfinite(radii), radii, 0.0))
        metrics |= rounding
        status |= flag(jnp.any(growth_by_sampling > 1.0), Status.SAMPLING_TOO_SLOW)
    metrics |= finished(inputs.folds, carry.accumulators)
    return Outcome(None, metrics, status, mode)


def _period_maps(inputs: Inputs, carry: Carry, instants: Linearization) -> jax.Array:
    """The `stability.period_map` at each instant, (k, m, m) [1]."""
    derivatives = stability.resolved_jacobian(instants.jacobian, sampled=True)
    return jax.vmap(partial(stability.period_map, inputs.scenario, carry.state))(derivatives)


def _bounds_of_growth(
    inputs: Inputs, carry: Carry, instants: Linearization, maps: jax.Array | None
) -> jax.Array:
    """The largest `error_growth.bound` of the position error, (n,) [rad]; infinite for a continuous
    loop, which has no period maps.
    """
    if maps is None:
        return jnp.full_like(carry.accuracy.error, jnp.inf)
    sampling: Any = inputs.scenario.sampling
    derivatives = stability.resolved_jacobian(instants.jacobian, sampled=True)
    periods = inputs.dt * inputs.steps / sampling.period
    bound = partial(error_growth.bound, inputs.scenario, carry.accuracy.error_growth, carry.state)
    found = jax.vmap(bound, in_axes=(0, 0, None))(derivatives, maps, periods)
    return jnp.max(found, axis=0)


def _sampling_radii(
    inputs: Inputs, carry: Carry, instants: Linearization, maps: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The spectral radius of the period map at each instant, and the growth by sampling, (k,) each
    [1].
    """
    derivatives = stability.resolved_jacobian(instants.jacobian, sampled=True)
    continuous_map = partial(stability.continuous_map, inputs.scenario, carry.state)
    radii = jax.vmap(stability.spectral_radius)(maps)
    continuous = jax.vmap(stability.spectral_radius)(jax.vmap(continuous_map)(derivatives))
    sampling: Any = inputs.scenario.sampling
    return radii, stability.growth_by_sampling(radii, continuous, sampling.period)
