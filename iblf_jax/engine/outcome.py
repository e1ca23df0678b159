"""The outcome of a run: records, metrics and status flags, with the assessment of the time step."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.pytree import is_absent
from iblf_jax.core.status import Status, flag, has_flag
from iblf_jax.engine.carry import Carry, Inputs
from iblf_jax.engine.linearization import Linearization
from iblf_jax.engine.metric_folds import finished
from iblf_jax.engine.request import RunRequest
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
    request: RunRequest,
    carry: Carry,
    unresolved: error_estimate.UnresolvedSignals,
    instants: Linearization,
    modes: jax.Array,
) -> Outcome:
    """The folds' results and the accuracy, and the status with the verdict on the step.

    Args:
      inputs: of the run.
      request: of the run.
      carry: after the last step.
      unresolved: the unresolved signals of the run, as accelerations.
      instants: linearizations at the start, at the instant nearest to a bound and at the end of the
        run, (3, ...).
      modes: `fastest_modes` of these, (3,) [1/s].
    """
    scenario = inputs.scenario
    mode = jnp.max(jnp.where(jnp.isfinite(modes), modes, 0.0))
    limit = integrators.tableau(request.method).stability
    status = carry.status | flag(inputs.dt * mode > limit, Status.STEP_TOO_LARGE)
    if not request.assessed:
        return Outcome(None, finished(inputs.folds, carry.accumulators), status, mode)
    accuracy = error_estimate.with_unresolved(carry.accuracy, unresolved)
    sampled: _Sampled | None = None
    rounding: dict[str, jax.Array] = {}
    if scenario.sampling is not None:
        sampled = _Sampled.of(inputs, carry, instants)
    if not is_absent(accuracy.error_growth):
        bounds = _bounds_of_growth(inputs, carry, sampled)
        accuracy, rounding = error_growth.with_growth(accuracy, bounds, unresolved.width)
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
    if sampled is not None:
        found = _sampling_radii(inputs, carry, sampled)
        radii, growth_by_sampling = jax.lax.stop_gradient(found)
        metrics[stability.RADIUS] = jnp.max(jnp.where(jnp.isfinite(radii), radii, 0.0))
        metrics |= rounding
        status |= flag(jnp.any(growth_by_sampling > 1.0), Status.SAMPLING_TOO_SLOW)
    metrics |= finished(inputs.folds, carry.accumulators)
    return Outcome(None, metrics, status, mode)


class _Sampled(NamedTuple):
    """A sampled loop at the `instants` of `outcome_of`."""

    derivatives: jax.Array
    """`stability.resolved_jacobian` of the loop between samples, (k, m, m)."""
    maps: jax.Array
    """`stability.period_map`, (k, m, m) [1]."""

    @staticmethod
    def of(inputs: Inputs, carry: Carry, instants: Linearization) -> _Sampled:
        derivatives = stability.resolved_jacobian(instants.jacobian, sampled=True)
        period_map = partial(stability.period_map, inputs.scenario, carry.state)
        return _Sampled(derivatives, jax.vmap(period_map)(derivatives))


def _bounds_of_growth(inputs: Inputs, carry: Carry, sampled: _Sampled | None) -> jax.Array:
    """The largest `error_growth.bound` of the position error, (n,) [rad]; infinite for a continuous
    loop, which has no period maps.
    """
    if sampled is None:
        return jnp.full_like(carry.accuracy.error, jnp.inf)
    sampling: Any = inputs.scenario.sampling
    periods = inputs.dt * inputs.steps / sampling.period
    bound = partial(error_growth.bound, inputs.scenario, carry.accuracy.error_growth, carry.state)
    found = jax.vmap(bound, in_axes=(0, 0, None))(sampled.derivatives, sampled.maps, periods)
    return jnp.max(found, axis=0)


def _sampling_radii(inputs: Inputs, carry: Carry, sampled: _Sampled) -> tuple[jax.Array, jax.Array]:
    """The spectral radius of the period map at each instant, and the growth by sampling, (k,) each
    [1].
    """
    continuous_map = partial(stability.continuous_map, inputs.scenario, carry.state)
    radii = jax.vmap(stability.spectral_radius)(sampled.maps)
    continuous = jax.vmap(continuous_map)(sampled.derivatives)
    continuous_radii = jax.vmap(stability.spectral_radius)(continuous)
    sampling: Any = inputs.scenario.sampling
    return radii, stability.growth_by_sampling(radii, continuous_radii, sampling.period)
